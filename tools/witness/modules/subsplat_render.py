"""Spherical harmonics and the projection of a Gaussian, by their definitions: harmonics from Legendre
recurrences, covariances as J W Sigma W^T J^T."""

import math

import numpy as np

from . import subsplat_geometry as geo
from .subsplat_precise import Precise
from .subsplat_scene import Scene


def harmonics(g, d, degree):
    """Returns real spherical harmonics with the Condon-Shortley sign at unit vectors d [N, 3], index l^2 + l
    + m: [N, D]."""
    x, y, z = d[:, 0], d[:, 1], d[:, 2]
    # cos m phi and sin m phi times sin^m theta: powers of x + i y.
    waves = [(z * 0.0 + 1.0, z * 0.0)]
    for _ in range(degree):
        a, b = waves[-1]
        waves.append((a * x - b * y, a * y + b * x))
    # Associated Legendre functions over sin^m theta, without the Condon-Shortley sign.
    legendre = {}
    for m in range(degree + 1):
        legendre[m, m] = z * 0.0 + float(math.prod(range(1, 2 * m, 2)))
        for l in range(m + 1, degree + 1):
            before = legendre[l - 2, m] * float(l + m - 1) if l > m + 1 else 0.0
            legendre[l, m] = (z * legendre[l - 1, m] * float(2 * l - 1) - before) / float(l - m)
    out = []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            k = abs(m)
            norm = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - k) / math.factorial(l + k))
            norm *= (-1) ** k * (math.sqrt(2.0) if m else 1.0)
            out.append(legendre[l, k] * waves[k][m < 0] * norm)
    return g.stack(out, 1)


def radiance(g, basis, degree, d, sh):
    """Returns the sum over k of sh [N, 25, 3] times the basis at d [N, 3]: [N, 3]. In `mvsplat` the degree is
    at most 3, the polar axis is y (x_std = z, y_std = x), and function 14 has an additional factor z, as in
    its rasterizer."""
    if basis == "mvsplat":
        degree = min(degree, 3)
        x, z = d[:, 0], d[:, 2]
        y = harmonics(g, g.stack([d[:, 2], d[:, 0], d[:, 1]], 1), degree)
        if degree == 3:
            quirk = z * (z * z - x * x) * (math.sqrt(105.0 / math.pi) / 4.0)
            y = g.concat([y[:, :14], quirk[:, None], y[:, 15:]], 1)
    else:
        y = harmonics(g, d, degree)
    return (y[..., None] * sh[:, :(degree + 1) ** 2]).sum(1)


def sh_case(c):
    c.g = Precise(c.name)
    d = c.random_input("direction", (24, 3))
    d = d / c.g.sqrt((d * d).sum(1, keep=True))
    sh = c.random_input("sh", (24, 25, 3))
    for basis, degrees in (("standard", 5), ("mvsplat", 5)):
        for degree in range(degrees):
            c.output(f"{basis}_{degree}", radiance(c.g, basis, degree, d, sh))


def tangents(g, lens):
    """Returns the tangent of half the angle between the rays through the middles of opposite edges, [2]."""
    out = []
    for axis in (0, 1):
        rays = []
        for at in (0.0, 1.0):
            position = [0.5, 0.5]
            position[axis] = at
            slope = (g.const(position) - lens[2:]) / lens[:2]
            ray = g.concat([slope, g.const([1.0])], 0)
            rays.append(ray / g.sqrt((ray * ray).sum(0, keep=True)))
        cos = (rays[0] * rays[1]).sum(0, keep=True)
        out.append(g.sqrt((1.0 - cos) / (1.0 + cos)))
    return g.concat(out, 0)


def project(g, view, near, splats, convention, lowpass, antialiased):
    """Returns the values of a frame that depend on one splat alone; zeros for a splat that is not drawn.
    means2d: px, pixel centres at integers; conic A, B, C; depth; half: half-widths of the area where alpha
    may reach 1/255, px; opacity; pixels: first column and row and one past the last; wide: the same with 0.02
    px more on each side."""
    standard = convention == "standard"
    p = view.to_camera(splats["means"])
    z = p[:, 2:]
    if standard:
        focal, centre = view.focal, view.centre - 0.5
        low = -view.centre / view.focal - view.size * 0.15 / view.focal
        high = (view.size - view.centre) / view.focal + view.size * 0.15 / view.focal
        means2d, nearest = p[:, :2] / z * focal + centre, near
    else:
        tan = tangents(g, view.lens)
        focal, low, high = view.size / tan * 0.5, -(tan * 1.3), tan * 1.3
        ndc = p[:, :2] / tan / (z + near * 1e-7)
        means2d, nearest = ((ndc + 1.0) * view.size - 1.0) * 0.5, near * 0.2
    j = geo.jacobian(g, p, focal, -1e9, low, high) @ view.rotation.transpose(1, 0)
    sigma = geo.gram(g, geo.matrix(g, splats["quats"]) * splats["scales"][:, None])
    bare = j @ sigma @ j.transpose(0, 2, 1)
    cov = bare + np.eye(2) * lowpass
    det = geo.det2(cov)
    a, b, d = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    opacity = splats["opacities"][:, 0]
    if antialiased:
        opacity = opacity * g.sqrt(g.maximum(geo.det2(bare), 0.0) / det)
    reach = g.log(g.maximum(opacity * 255.0, 1.0)) * 2.0
    half = g.sqrt(g.stack([a, d], 1) * reach[:, None])
    tiles = None
    if not standard:
        mid = (a + d) * 0.5
        radius = g.sqrt(mid + g.sqrt(g.maximum(mid * mid - det, 0.1))) * 3.0
        radius = -g.floor(-radius[:, None])
        # [trunc((u - r)/16), trunc((u + r + 15)/16)): truncation changes only positions left of or
        # above the picture.
        tiles = [g.floor((means2d - radius) / 16.0) * 16.0, g.floor((means2d + radius + 15.0) / 16.0) * 16.0]
    pixels = rectangle(g, view, means2d, half, tiles)
    wide = rectangle(g, view, means2d, half + 0.02, tiles)
    drawn = (z[:, 0] > nearest) & (opacity >= 1.0 / 255.0)
    drawn = drawn & (pixels[:, 2] > pixels[:, 0]) & (pixels[:, 3] > pixels[:, 1])
    out = {"means2d": means2d, "conic": g.stack([d / det, -b / det, a / det], 1), "depth": z, "half": half,
           "opacity": opacity[:, None], "pixels": pixels, "wide": wide}
    return {name: g.where(drawn[:, None], value, 0.0) for name, value in out.items()}


def rectangle(g, view, means2d, half, tiles):
    """Returns the pixels whose centres are within `half` of the mean, inside the picture and the tiles: x0,
    y0, x1, y1."""
    first = g.maximum(-g.floor(half - means2d), 0.0)
    past = g.minimum(g.floor(means2d + half) + 1.0, view.size)
    if tiles:
        first, past = g.maximum(first, tiles[0]), g.minimum(past, tiles[1])
    return g.concat([first, past], 1)


def ewa_case(convention, lowpass=0.3, antialiased=False, size=0.25):
    def case(c):
        # Parents of two views of 6 x 5 px, rendered in view 0 as a picture of 72 x 60 px with
        # `size` times their scales.
        scene = Scene(c, 2, 6, 5, lost=("outside", "behind", "round"))
        c.notes |= {"convention": convention, "lowpass": lowpass, "antialiased": antialiased, "picture": [72, 60]}
        c.notes["scale"] = size
        view = geo.View(c.g, scene.poses[0], scene.lenses[0], (72, 60))
        splats = scene.parents | {"scales": scene.parents["scales"] * size}
        # Some parents are nearer than 2 near planes (`standard`), or a fifth of 10 (`mvsplat`).
        near = scene.near[:1] * (10.0 if convention == "mvsplat" else 2.0)
        for name, value in project(c.g, view, near[0], splats, convention, lowpass, antialiased).items():
            c.output(name, value)
    return case


CASES = {
    "sub_sh": sh_case,
    "sub_ewa_standard": ewa_case("standard"),
    "sub_ewa_antialiased": ewa_case("standard", 1.2, True),
    "sub_ewa_mvsplat": ewa_case("mvsplat"),
    "sub_ewa_standard_large": ewa_case("standard", size=2.0),
    "sub_ewa_mvsplat_large": ewa_case("mvsplat", size=2.0),
}
