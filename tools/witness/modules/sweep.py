"""MVSplat's plane sweep: features of V views to the correlation [V, D, h, w], with GridSample."""

import numpy as np


def geometry(c, views, height, width, scale=4, near=0.6, far=20.0, step=(0.5, 0.0, 0.0)):
    """Declares the cameras as graph inputs. Matrix inverses are computed here in f64: relative [V, V-1, 4, 4]
    (offset o: view i to view (i + o) mod V), k and k_inv [V, 3, 3] at 1/scale of the picture."""
    poses, intrinsics, near_far = (a.astype(np.float64) for a in c.cameras(views, height, width, near, far, step))
    relative = [[np.linalg.inv(poses[(i + o) % views]) @ poses[i] for o in range(1, views)] for i in range(views)]
    if views == 2:
        relative[1][0] = np.linalg.inv(relative[0][0])
    k = np.zeros((views, 3, 3))
    k[:, 0, 0], k[:, 1, 1], k[:, 2, 2] = intrinsics[:, 0] / scale, intrinsics[:, 1] / scale, 1
    k[:, 0, 2], k[:, 1, 2] = intrinsics[:, 2] / scale, intrinsics[:, 3] / scale
    return {"relative": c.stored_input("relative", relative), "k": c.stored_input("k", k), "k_inv": c.stored_input("k_inv", np.linalg.inv(k)),
            "near_far": c.stored_input("near_far", near_far), "poses": poses, "intrinsics": intrinsics}


def candidates(g, near_far, d):
    """Returns [V, D] disparities; 0 is the farthest."""
    near, far = 1.0 / near_far[:, 0:1], 1.0 / near_far[:, 1:2]
    return far + g.const(np.arange(d)[None] / (d - 1)) * (near - far)


def correlation(g, features, geo, disparities):
    v, c, h, w = features.shape
    d = disparities.shape[1]
    y, x = np.mgrid[0:h, 0:w]
    pixels = g.const(np.stack([x, y, np.ones_like(x)]).reshape(3, h * w))
    volumes = []
    for i in range(v):
        total = None
        for o in range(1, v):
            pose, k = geo["relative"][i, o - 1], geo["k"][i]
            rays = pose[:3, :3] @ (geo["k_inv"][i] @ pixels)
            points = rays.reshape(3, 1, h * w) * (1.0 / disparities[i]).reshape(1, d, 1) + pose[:3, 3].reshape(3, 1, 1)
            # As in MVSplat, the reference view's intrinsics also project into the source view.
            p = k @ points.reshape(3, d * h * w)
            uv = p[:2] / g.maximum(p[2:3], 1e-3)
            size = g.const(np.array([[2 / (w - 1)], [2 / (h - 1)]]))
            grid = (uv * size - 1.0).transpose(1, 0).reshape(1, d * h, w, 2)
            warped = g.grid_sample(features[(i + o) % v:(i + o) % v + 1], grid, align_corners=True)
            dot = (warped.reshape(c, d, h, w) * features[i].reshape(c, 1, h, w)).sum(0) * (1 / np.sqrt(c))
            total = dot if total is None else total + dot
        volumes.append(total * (1 / (v - 1)))
    return g.stack(volumes, 0)


def case(views, height, width, stride=5, **cameras):
    def build(c):
        geo = geometry(c, views, height, width, **cameras)
        d = candidates(c.g, geo["near_far"], 24)
        features = c.random_input("features", (views, 16, height // 4, width // 4), -2.0, 2.0)
        c.output("disparities", d)
        c.output("correlation", correlation(c.g, features, geo, d), stride)
    return build


# sweep_close: the second camera lies within the first one's depth range, so that some points are
# behind it and some directly in front of it.
CASES = {"sweep": case(2, 48, 64), "sweep3": case(3, 40, 48),
         "sweep_close": case(2, 48, 64, stride=1, near=0.3, step=(0.02, 0.0, 0.6))}
