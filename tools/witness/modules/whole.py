"""The whole network in one graph: pictures and cameras of one scene to children. MVSplat's encoder (backbone.py), its
primaries (adapter.py), then SubSplat's embeddings, attention, heads and reparameterization (subsplat_*.py)."""

import numpy as np

from .backbone import encode
from .subsplat_attention import Attention
from .subsplat_embed import embed
from .subsplat_geometry import View
from .subsplat_precise import Precise
from .subsplat_scene import AGG, EMBED, SPGR
from .subsplat_spgr import Spgr, heads

E, SIDE = 32, 2
# Near enough that f32 noise of disparity (3e-6) stays small in depth, whose differences the occlusion gate of `tuned`
# multiplies by fifty.
FAR = 5.0
STRIDES = {"depths": 5, "sh": 367, "gain": 5, "means": 11, "quats": 17, "scales": 11, "opacities": 5}


def case(preset, views, height, width):
    def build(c):
        g = c.g = Precise(c.name)
        c.notes = {"upscale": SIDE, "embed": EMBED[preset] | {"dim": E}, "agg": AGG[preset],
                   "spgr": SPGR[preset] | {"hidden": E}}
        out, primaries, frames = encode(c, views, height, width, far=FAR)
        n = views * height * width
        pictures = np.array([width, height] * 2, np.float64)
        lenses = frames["intrinsics"] / pictures
        poses = [g.concat([frames["rotation"][v], frames["origin"][v].reshape(3, 1)], 1) for v in range(views)]
        seen_by = [View(g, poses[v], lenses[v], (width, height)) for v in range(views)]
        near = c.given("near", c.asides["near_far"][:, 0])
        parents = {"means": primaries["means"], "quats": primaries["quats"], "scales": primaries["scales"],
                   "opacities": primaries["opacities"].reshape(n, 1)}
        sh = primaries["sh_camera" if EMBED[preset]["sh"] == "camera" else "sh"].reshape(n, 75)
        z = embed(g, c.notes["embed"], seen_by, parents, sh, height * width)
        attention = Attention(g, c.notes["agg"], E, out, seen_by, parents, height * width)
        record = heads(g, c.notes["spgr"], *attention.head_inputs(*z), SIDE)
        rows, gain = Spgr(g, c.notes["spgr"], SIDE, seen_by, near, parents, height * width).forward(record)
        found = {"depths": out["depths"].reshape(views, height * width), "sh": primaries["sh"].transpose(0, 2, 1),
                 "gain": gain, "means": rows[:, 0:3], "quats": rows[:, 3:7], "scales": rows[:, 7:10],
                 "opacities": rows[:, 10]}
        for name, value in found.items():
            c.output(name, value, STRIDES[name])
    return build


CASES = {"whole_paper": case("paper", 2, 32, 48), "whole_tuned": case("tuned", 3, 48, 32)}
