"""A rasterizer in numpy, float64, from the formulas of 3DGS and gsplat: a pixel blends all Gaussians.

It follows `shared/spec/rasterizer.md`: the covariance J R Σ Rᵀ Jᵀ + eps2d, alpha at least 1/255 and at most
0.999, the stop at a transmittance of 1e-4, the order by depth.
"""

import numpy as np

# Relative distance of alpha or transmittance from a threshold within which a rounding may decide.
BOUNDARY = 1e-2


def sh_basis(d, degree):
    """[(degree + 1)², ...]: real spherical harmonics with the signs of 3DGS, of unit vectors d [..., 3]."""
    x, y, z = np.moveaxis(d, -1, 0)
    out = [np.full_like(x, 0.28209479177387814)]
    if degree > 0:
        c = 0.4886025119029199
        out += [-c * y, c * z, -c * x]
    if degree > 1:
        c = 1.0925484305920792
        out += [c * x * y, -c * y * z, 0.31539156525252005 * (2 * z * z - x * x - y * y)]
        out += [-c * x * z, 0.5462742152960396 * (x * x - y * y)]
    assert degree < 3, "the reference knows degrees 0 to 2"
    return np.stack(out)


def rotations(quats):
    """[N, 3, 3] of wxyz of any length."""
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def render(
    means, quats, scales, opacities, colors, viewmats, Ks, width, height,
    near_plane=0.01, eps2d=0.3, sh_degree=None, backgrounds=None, antialiased=False,
):
    """Pictures [C, H, W, 3], alphas and depth sums [C, H, W, 1], and where a threshold is near, [C, H, W, 1]."""
    out = [[], [], [], []]
    arrays = [np.asarray(a, np.float64) for a in (means, quats, scales, opacities, colors)]
    for c, (view, k) in enumerate(zip(np.float64(viewmats), np.float64(Ks))):
        background = np.zeros(3) if backgrounds is None else np.float64(backgrounds[c])
        own = arrays[4][c] if arrays[4].ndim == (3 if sh_degree is None else 4) else arrays[4]
        options = (width, height, near_plane, eps2d, sh_degree, background, antialiased)
        for pictures, picture in zip(out, _one(*arrays[:4], own, view, k, *options)):
            pictures.append(picture)
    return [np.stack(pictures) for pictures in out]


def _one(
    means, quats, scales, opacities, colors, view, k, width, height,
    near_plane, eps2d, sh_degree, background, antialiased,
):
    r, t = view[:3, :3], view[:3, 3]
    x, y, z = (means @ r.T + t).T
    if sh_degree is not None:
        away = means + r.T @ t
        basis = sh_basis(away / np.linalg.norm(away, axis=1, keepdims=True), sh_degree)
        used = colors[:, : len(basis)]
        colors = np.maximum(0.5 + np.einsum("kn,nkc->nc", basis, used), 0)
    fx, fy, cx, cy = k[0, 0], k[1, 1], k[0, 2], k[1, 2]

    def clamped(ratio, f, centre, side):
        margin = 0.3 * 0.5 * side / f
        return np.clip(ratio, -centre / f - margin, (side - centre) / f + margin)

    zeros = np.zeros_like(z)
    j = np.array([
        [fx / z, zeros, -fx * clamped(x / z, fx, cx, width) / z],
        [zeros, fy / z, -fy * clamped(y / z, fy, cy, height) / z],
    ])
    m = np.einsum("ijn,jk,nkl,nl->nil", j, r, rotations(quats), scales)
    cov = m @ m.transpose(0, 2, 1)
    before = np.linalg.det(cov)
    cov += eps2d * np.eye(2)
    if antialiased:
        opacities = opacities * np.sqrt(np.maximum(before / np.linalg.det(cov), 0))
    conic = np.linalg.inv(cov)
    px, py = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rgb, depth = np.zeros((height, width, 3)), np.zeros((height, width))
    left, open_ = np.ones((height, width)), np.ones((height, width), bool)
    near = np.zeros((height, width), bool)
    for i in np.argsort(z, kind="stable"):
        if z[i] <= near_plane:
            continue
        dx, dy = px - (fx * x[i] / z[i] + cx), py - (fy * y[i] / z[i] + cy)
        (a, b), (_, d) = conic[i]
        power = 0.5 * (a * dx * dx + d * dy * dy) + b * dx * dy
        alpha = np.minimum(opacities[i] * np.exp(-power), 0.999)
        near |= np.abs(255 * alpha - 1) < BOUNDARY
        alpha[alpha < 1 / 255] = 0
        near |= np.abs(1e4 * left * (1 - alpha) - 1) < BOUNDARY
        open_ &= left * (1 - alpha) > 1e-4
        weight = np.where(open_, left * alpha, 0)
        rgb += weight[..., None] * colors[i]
        depth += weight * z[i]
        left = np.where(open_, left * (1 - alpha), left)
    rgb += left[..., None] * background
    return rgb, (1 - left)[..., None], depth[..., None], near[..., None]
