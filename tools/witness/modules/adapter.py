"""MVSplat's Gaussian adapter: raw head outputs to Gaussians in the world frame, with world quaternions wxyz,
w >= 0. It has no weights. Rotations of SH and quaternions are inputs, computed in f64."""

import math

import numpy as np


def real_sh(degree, directions):
    """Returns [n, (degree + 1)^2]: real spherical harmonics without the Condon-Shortley sign, order m =
    -l..l, polar axis y: (x_s, y_s, z_s) = (z, x, y)."""
    x, y, z = directions.T
    phi, columns = np.arctan2(x, z), []
    s = np.sqrt(np.maximum(0.0, 1 - y * y))
    for l in range(degree + 1):
        # P_l^m by the recurrence upwards in l, without the sign (-1)^m.
        legendre = []
        for m in range(l + 1):
            p = np.prod(np.arange(1, 2 * m, 2, dtype=float)) * s**m
            before = np.zeros_like(p)
            for n in range(m + 1, l + 1):
                p, before = ((2 * n - 1) * y * p - (n + m - 1) * before) / (n - m), p
            legendre.append(p * math.sqrt((2 * l + 1) * math.factorial(l - m) / math.factorial(l + m)))
        for m in range(-l, l + 1):
            wave = np.sin(-m * phi) * math.sqrt(2) if m < 0 else np.cos(m * phi) * (math.sqrt(2) if m else 1)
            columns.append(legendre[abs(m)] * wave)
    return np.stack(columns, 1)


def sh_rotation(degree, rotation):
    """Returns D with Y(R d) = D Y(d), block by degree, by least squares over many directions."""
    i = np.arange(400) + 0.5
    polar, phi = np.arccos(1 - 2 * i / 400), np.pi * (1 + 5**0.5) * i
    d = np.stack([np.sin(polar) * np.cos(phi), np.sin(polar) * np.sin(phi), np.cos(polar)], 1)
    before, after = real_sh(degree, d), real_sh(degree, d @ rotation.T)
    turn = np.zeros((before.shape[1],) * 2)
    for l in range(degree + 1):
        own = slice(l * l, (l + 1) ** 2)
        turn[own, own] = np.linalg.lstsq(before[:, own], after[:, own], rcond=None)[0].T
    return turn


def quaternion(r):
    """Returns wxyz of a rotation matrix: the eigenvector of the largest eigenvalue (Bar-Itzhack)."""
    (a, b, c), (d, e, f), (g, h, i) = r
    k = np.array([[a + e + i, h - f, c - g, d - b], [h - f, a - e - i, b + d, c + g],
                  [c - g, b + d, e - a - i, f + h], [d - b, c + g, f + h, i - a - e]])
    q = np.linalg.eigh(k)[1][:, -1]
    return q * np.sign(q[0])


def mask(degree):
    """Returns MVSplat's factors on the SH coefficients."""
    return np.concatenate([[1.0] if l == 0 else [0.1 * 0.25**l] * (2 * l + 1) for l in range(degree + 1)])


def frames(c, poses, intrinsics, degree=4):
    """Declares the graph inputs of the views: rotation [V, 3, 3], origin [V, 3], intrinsics [V, 4] px,
    quaternion [V, 4] of the camera, sh_turn [V, 25, 25]."""
    r = poses[:, :3, :3]
    return {"rotation": c.stored_input("rotation", r), "origin": c.stored_input("origin", poses[:, :3, 3]),
            "intrinsics": c.stored_input("intrinsics", intrinsics),
            "quaternion": c.stored_input("quaternion", [quaternion(m) for m in r]),
            "sh_turn": c.stored_input("sh_turn", [sh_rotation(degree, m) for m in r])}


def product(g, a, b):
    """Returns the Hamilton product a * b of wxyz, a [..., 4], b [..., 4]."""
    (aw, ax, ay, az), (bw, bx, by, bz) = ([q[..., i:i + 1] for i in range(4)] for q in (a, b))
    return g.concat([aw * bw - ax * bx - ay * by - az * bz, aw * bx + ax * bw + ay * bz - az * by,
                     aw * by - ax * bz + ay * bw + az * bx, aw * bz + ax * by - ay * bx + az * bw], -1)


def adapt(g, raw, depths, densities, frames, height, width, exponent=0.0):
    """Converts raw [V, P, 84], depths and densities [V, P, G] to tensors [V * P * G, ...]."""
    v, p, channels = raw.shape
    n, gpp = (channels - 9) // 3, depths.shape[2]
    norm = lambda x: g.sqrt((x * x).sum(-1, keep=True))
    offset, scale, q, sh = raw[..., 0:2], raw[..., 2:5], raw[..., 5:9], raw[..., 9:]
    row, column = np.mgrid[0:height, 0:width]
    centres = np.stack([(column + 0.5) / width, (row + 0.5) / height], -1).reshape(1, p, 2)
    pixel = g.const(np.array([1 / width, 1 / height]))
    xy = g.const(centres) + (g.sigmoid(offset) - 0.5) * pixel
    k = frames["intrinsics"].reshape(v, 1, 4)
    f, centre = k[..., 0:2] * pixel, k[..., 2:4] * pixel  # normalised by the picture's size
    plane = (xy - centre) / f
    ray = g.concat([plane, g.const(np.ones((v, p, 1)))], -1)
    ray = (ray / norm(ray)) @ frames["rotation"].transpose(0, 2, 1)
    z = depths.reshape(v, p, gpp, 1)
    means = ray.reshape(v, p, 1, 3) * z + frames["origin"].reshape(v, 1, 1, 3)
    m = 0.1 * (1.0 / f * pixel).sum(-1, keep=True)  # [V, 1, 1]
    scales = ((0.5 + 14.5 * g.sigmoid(scale)) * m).reshape(v, p, 1, 3) * z
    q = q / (norm(q) + 1e-8)
    wxyz = g.concat([q[..., 3:4], q[..., 0:3]], -1)
    world = product(g, frames["quaternion"].reshape(v, 1, 4), wxyz)
    world = world / norm(world)
    world = g.where(world[..., 0:1] < 0.0, -world, world)
    camera = sh.reshape(v, p * 3, n) * g.const(mask(4))
    rotated = camera @ frames["sh_turn"].transpose(0, 2, 1)
    alpha = densities
    if exponent:
        e = 2.0**exponent
        alpha = 0.5 * (1.0 - (1.0 - densities) ** e + densities ** (1 / e))
    shared = lambda x, dims: g.broadcast(x.reshape((v, p, 1) + dims), (v, p, gpp) + dims).reshape((v * p * gpp,) + dims)
    count = v * p * gpp
    return {"means": means.reshape(count, 3), "quats": shared(world, (4,)), "scales": scales.reshape(count, 3),
            "opacities": (alpha * (1 / gpp)).reshape(count), "sh": shared(rotated, (3, n)),
            "sh_camera": shared(camera, (3, n))}


STRIDES = {"sh": 37, "sh_camera": 37, "means": 2, "scales": 2, "quats": 3, "opacities": 2}


def case(c):
    """Two Gaussians per pixel and an opacity mapping that is not the identity."""
    v, height, width, gpp = 2, 12, 20, 2
    poses, intrinsics, _ = (a.astype(np.float64) for a in c.cameras(v, height, width))
    f = frames(c, poses, intrinsics)
    raw = c.random_input("raw", (v, height * width, 84), -2.0, 2.0)
    depths = c.random_input("depths", (v, height * width, gpp), 1.0, 9.0)
    densities = c.random_input("densities", (v, height * width, gpp), 0.01, 0.99)
    for name, value in adapt(c.g, raw, depths, densities, f, height, width, exponent=0.7).items():
        c.output(name, value, stride=STRIDES[name])


CASES = {"adapter": case}
