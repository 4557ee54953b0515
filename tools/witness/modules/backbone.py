"""MVSplat's encoder in one graph: images and cameras of one scene to raw head outputs, feature maps and
primaries."""

from .adapter import adapt, frames
from .adapter import STRIDES as ADAPTER_STRIDES
from .cnn import cnn
from .depth import SMALL, predict
from .sweep import geometry
from .transformer import transformer

CHANNELS, LAYERS = (8, 12, 16), 2


def encode(c, views, height, width, far=20.0):
    """Declares the inputs and returns (encoder's stages and feature maps, primaries, frames)."""
    g = c.g
    geo = geometry(c, views, height, width, far=far)
    images = c.random_input("images", (views, 3, height, width), 0.0, 1.0)
    half, quarter = cnn(g, images, CHANNELS)
    trans = transformer(g, quarter, LAYERS)
    out = predict(g, images, quarter, trans, geo, SMALL)
    out |= {"cnn2": half, "cnn4": quarter, "trans4": trans, "trans8": g.mean_pool(trans, 2),
            "trans16": g.mean_pool(trans, 4), "refine1": out["refine"]}
    views = frames(c, geo["poses"], geo["intrinsics"])
    primaries = adapt(g, out["raw"], out["depths"], out["densities"], views, height, width)
    return out, primaries, views


STRIDES = {"raw": 199, "disparity": 5, "densities": 5, "cnn2": 7, "cnn4": 3, "trans4": 3, "refine1": 101}


def case(c):
    out, primaries, _ = encode(c, 3, 32, 48)
    for name in ("cnn2", "cnn4", "trans4", "trans8", "trans16", "refine1", "raw", "disparity", "densities"):
        c.output(name, out[name], stride=STRIDES.get(name, 1))
    for name, value in primaries.items():
        c.output(name, value, stride=5 * ADAPTER_STRIDES[name])


CASES = {"backbone": case}
