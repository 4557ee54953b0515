"""Scenes of the SubSplat cases: cameras, parents similar to a backbone's, and the presets."""

import numpy as np

import formula
from .subsplat_geometry import View
from .subsplat_precise import Precise

EMBED = {
    "paper": {"dim": 128, "mlp": "pg", "anchor_frame": "world", "mu": "raw", "scale": "raw", "alpha": "raw",
              "sh": "world"},
    "tuned": {"dim": 128, "mlp": "lite", "anchor_frame": "src_cam", "mu": "ray_logz", "scale": "log_px",
              "alpha": "logit", "sh": "camera"},
}

_AGG = {"enabled": True, "stages_geo": 3, "stages_app": 1, "share_stage_weights": False, "levels": ["trans4"],
        "op": "dot", "points": "ref", "n_fixed": 7, "n_learned": 6, "groups": 1, "logit_scale": "inv_sqrt",
        "kv_proj": True, "gate": "softmaxV", "gate_views": 8, "residual": "add", "norm": "none", "ffn": False,
        "mask": "renorm", "attn_drop": 0.0, "sample_convention": "half_pixel", "detach_points": False,
        "occlusion_gate": False, "head_input": "f_plus_z", "strict_literal": False}
AGG = {"paper": _AGG, "tuned": _AGG | {"levels": ["trans4", "cnn2"], "norm": "pre", "occlusion_gate": True}}

_SPGR = {"enabled": True, "head": "mlp2", "hidden": 128, "zero_init": True, "primary_view": "nearest_visible",
         "offset_bound": None, "beta_z": 0.25, "depth_dir": "axis", "depth_unit": "world", "slide": "z_const",
         "lambda_s": {"value": 0.6}, "dlog_clamp": 3.0, "area_at": "child", "a_min": "over_k", "a_min_mode": "iso",
         "opacity": "linear", "delta": 0.25, "gain_space": "sh"}
SPGR = {"paper": _SPGR, "tuned": _SPGR | {"primary_view": "source", "offset_bound": 0.5, "beta_z": 0.1,
        "depth_dir": "ray", "depth_unit": "relative", "lambda_s": {"over_sqrt_k": 1.0}, "opacity": "optical_depth"}}


class Scene:
    """V views of width x height px with one parent per pixel, in double precision.

    `lost` lists special parents: "outside" moves parent 1 outside every picture, "behind" moves parent 2
    behind every camera, "round" makes parents 8 to 23 round, opaque and 0.24 px wide, and moves 24 to 29
    slightly outside the picture."""

    def __init__(self, c, views=2, width=6, height=4, lost=()):
        c.g = Precise(c.name)
        c.notes["size"] = [width, height]
        self.size, self.per_view = (width, height), width * height
        poses, intrinsics, near_far = c.cameras(views, height, width)
        lenses = intrinsics / np.array([width, height] * 2, np.float32)
        self.poses, self.lenses = c.stored_input("poses", poses), c.stored_input("lenses", lenses)
        self.near = c.stored_input("near", near_far[:, 0])
        self.views = [View(c.g, self.poses[i], self.lenses[i], self.size) for i in range(views)]
        numbers = parents(c.seed, poses.astype(np.float64), intrinsics.astype(np.float64), width, height, lost)
        self.parents = {name: c.stored_input(f"parent.{name}", a) for name, a in numbers.items()}


def quat_of(r):
    """Returns the quaternion of a rotation matrix."""
    w = 0.5 * np.sqrt(1.0 + np.trace(r))
    return np.array([w, *(np.array([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / (4 * w))])


def product(a, b):
    """Returns the Hamilton product."""
    w, v, s, u = a[0], a[1:], b[0], b[1:]
    return np.array([w * s - v @ u, *(w * u + s * v + np.cross(v, u))])


def parents(seed, poses, intrinsics, width, height, lost):
    """Returns means [N, 3], quats [N, 4] wxyz with w >= 0, scales [N, 3], opacities [N, 1], in the world
    frame. Parent 3 is nearly opaque, 4 nearly transparent, 5 very small, 6 very elongated."""
    n = len(poses) * width * height
    u = formula.uniform(seed, "parents", 14 * n).reshape(n, 14)
    out = {"means": [], "quats": [], "scales": [], "opacities": []}
    for i in range(n):
        v, pixel = divmod(i, width * height)
        fx, fy, cx, cy = intrinsics[v]
        row, column = divmod(pixel, width)
        z = 2.0 + 3.0 * u[i, 2]
        at = np.array([column + 0.1 + 0.8 * u[i, 0], row + 0.1 + 0.8 * u[i, 1]])
        if "outside" in lost and i == 1:
            at = np.array([-4.0 * width, 0.5 * height])
        if "round" in lost and 24 <= i < 30:
            away = np.array([[-0.8, 2], [6.8, 1], [3, -0.65], [2, 5.65], [-1.5, 4], [7.5, 3]])[i - 24]
            at = away / np.array([6, 5]) * np.array([width, height])
        if "behind" in lost and i == 2:
            z = -z
        in_camera = np.array([(at[0] - cx) / fx, (at[1] - cy) / fy, 1.0]) * z
        rotation, eye = poses[v, :3, :3], poses[v, :3, 3]
        out["means"].append(rotation @ in_camera + eye)
        q = 2.0 * u[i, 3:7] - 1.0
        q = product(quat_of(rotation), q / np.linalg.norm(q))
        out["quats"].append(q if q[0] >= 0 else -q)
        px = 0.2 * (2.5 / 0.2) ** u[i, 7:10]
        px = px * {5: 0.002}.get(i, 1.0) * (np.array([20.0, 0.02, 0.02]) if i == 6 else 1.0)
        if "round" in lost and 8 <= i < 24:
            px, u[i, 10] = np.full(3, 0.24), 0.98
        out["scales"].append(px * abs(z) / fx)
        out["opacities"].append([{3: 0.99996, 4: 0.0011}.get(i, 0.02 + 0.96 * u[i, 10])])
    return {name: np.array(rows, np.float32) for name, rows in out.items()}
