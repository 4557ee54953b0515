"""MVSplat's depth predictor of one scene, one Gaussian per pixel."""

from .sweep import candidates, correlation, geometry
from .unet import unet

NAME = "depth_predictor"


def head(g, x, name, hidden, c_out):
    return g.conv(g.gelu(g.conv(x, f"{name}.0", hidden)), f"{name}.2", c_out)


def refined_volume(g, volume, features, s):
    x = g.concat([volume, features], 1)
    at, c, d = f"{NAME}.corr_refine_net", s["costvolume_channels"], s["depth_candidates"]
    y = g.gelu(g.group_norm(g.conv(x, f"{at}.0", c), f"{at}.1", 8))
    y = g.conv(unet(g, y, f"{at}.3", s["costvolume_levels"]), f"{at}.4", d)
    return y + g.conv(x, f"{NAME}.regressor_residual", d, kernel=1)


def predict(g, images, cnn, trans, geo, s):
    """images [V, 3, H, W]; cnn, trans [V, C, H/4, W/4]. Returns every stage by name."""
    v, _, height, width = images.shape
    _, c, h, w = trans.shape
    d, r = s["depth_candidates"], s["refine_channels"]
    disparities = candidates(g, geo["near_far"], d)
    volume = correlation(g, trans, geo, disparities)
    refined = refined_volume(g, volume, trans, s)
    pdf = g.softmax(head(g, refined, f"{NAME}.depth_head_lowres", 2 * d, d), axis=1)
    coarse = (pdf * disparities.reshape(v, d, 1, 1)).sum(1, keep=True)
    pdf_max = pdf.max(1, keep=True)
    full = g.resize_bilinear(coarse, height, width, align_corners=True)
    low = g.conv(g.concat([trans, cnn], 1), f"{NAME}.upsampler.0", c)
    up = g.gelu(g.resize_bilinear(low, height, width, align_corners=True))
    projected = g.conv(up, f"{NAME}.proj_feature", r)
    x = g.concat([images, projected, full, g.upsample_nearest(pdf_max, 4)], 1)
    at = f"{NAME}.refine_unet"
    x = g.gelu(g.group_norm(g.conv(x, f"{at}.0", r), f"{at}.1", 4))
    refine = unet(g, x, f"{at}.3", s["refine_levels"])
    channels = 9 + 3 * 25
    raw = head(g, g.concat([refine, images, up], 1), f"{NAME}.to_gaussians", 2 * channels, channels)
    delta = head(g, refine, f"{NAME}.to_disparity", 2 * r, 2)
    near, far = (geo["near_far"][:, i].reshape(v, 1, 1, 1) for i in (0, 1))
    disparity = g.clamp(full + delta[:, 0:1], 1.0 / far, 1.0 / near)
    return {"correlation": volume, "refined_volume": refined, "pdf": pdf, "coarse_disp": coarse, "pdf_max": pdf_max,
            "fullres_disp": full, "upsampled": up, "projected": projected, "refine": refine, "delta": delta,
            "raw": raw.transpose(0, 2, 3, 1).reshape(v, height * width, channels),
            "disparity": disparity.reshape(v, height * width, 1),
            "depths": (1.0 / disparity).reshape(v, height * width, 1),
            "densities": g.sigmoid(delta[:, 1:2]).reshape(v, height * width, 1)}


# Reduced numbers of channels; the structure is that of the released network.
SMALL = {"depth_candidates": 24, "costvolume_channels": 32, "costvolume_levels": 3, "refine_channels": 32,
         "refine_levels": 5}
STRIDES = {"correlation": 7, "refined_volume": 7, "pdf": 7, "fullres_disp": 7, "upsampled": 53, "projected": 101,
           "refine": 101, "delta": 5, "raw": 199, "depths": 5, "disparity": 5, "densities": 5}


def case(c):
    v, height, width = 2, 32, 48
    geo = geometry(c, v, height, width)
    images = c.random_input("images", (v, 3, height, width), 0.0, 1.0)
    cnn, trans = (c.random_input(n, (v, 16, height // 4, width // 4), -2.0, 2.0) for n in ("cnn", "trans"))
    for name, value in predict(c.g, images, cnn, trans, geo, SMALL).items():
        c.output(name, value, stride=STRIDES.get(name, 1))


CASES = {"depth": case}
