"""The whole network in one graph: pictures and cameras of one scene to children. It consists of MVSplat's
encoder (backbone.py), its primaries (adapter.py), and SubSplat's modules (trunk.py)."""

import numpy as np

from .backbone import encode
from .subsplat_geometry import View
from .subsplat_precise import Precise
from .trunk import preset, trunk

E, SIDE = 32, 2
# A small far plane: f32 noise of disparity (3e-6) then stays small in depth, whose differences the
# occlusion gate of `tuned` multiplies by fifty.
FAR = 5.0
STRIDES = {"depths": 5, "sh": 367, "gain": 5, "means": 11, "steps": 11, "quats": 17, "log_scales": 11, "opacities": 5}


def case(name, views, height, width):
    def build(c):
        g = c.g = Precise(c.name)
        config = preset(name, embed={"dim": E}, spgr={"hidden": E})
        c.notes = {**config, "upscale": SIDE}
        out, primaries, frames = encode(c, views, height, width, far=FAR)
        n, k = views * height * width, SIDE * SIDE
        lenses = frames["intrinsics"] / np.array([width, height] * 2)
        poses = [g.concat([frames["rotation"][v], frames["origin"][v].reshape(3, 1)], 1) for v in range(views)]
        view_cameras = [View(g, poses[v], lenses[v], (width, height)) for v in range(views)]
        near = c.stored_input("near", c.auxiliaries["near_far"][:, 0])
        parents = {key: primaries[key] for key in ("means", "quats", "scales")}
        parents["opacities"] = primaries["opacities"].reshape(n, 1)
        sh = primaries["sh_camera" if config["embed"]["sh"] == "camera" else "sh"].reshape(n, 75)
        children = trunk(g, config, SIDE, view_cameras, near, parents, sh, out, height * width)
        owners = g.broadcast(parents["means"].reshape(n, 1, 3), (n, k, 3)).reshape(n * k, 3)
        children |= {"means": owners + children["steps"], "sh": primaries["sh"].transpose(0, 2, 1),
                     "depths": out["depths"].reshape(views, height * width)}
        for key, value in children.items():
            c.output(key, value, STRIDES[key])
    return build


CASES = {"whole_paper": case("paper", 2, 32, 48), "whole_tuned": case("tuned", 3, 48, 32)}
