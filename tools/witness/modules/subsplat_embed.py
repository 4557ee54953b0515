"""Attribute embeddings of the primaries (SubSplat, supplement A.2)."""

import numpy as np
from . import subsplat_geometry as geo

NAMES = ["x", "s", "q", "a"]


def in_source(g, views, x, per_view, transform):
    """Applies transform(view, rows of that view) to parents in view order and joins the results."""
    rows = [transform(view, x[v * per_view:(v + 1) * per_view]) for v, view in enumerate(views)]
    return g.concat(rows, 0)


def conditioned(g, keys, views, parents, per_view):
    """Returns mu [N, 3], s [N, 3], q [N, 4], alpha [N, 1] in the representation that `keys` selects."""
    frame = keys["anchor_frame"]
    to_source = lambda x: in_source(g, views, x, per_view, lambda view, rows: view.to_camera(rows))
    to_view_frame = lambda view, q: geo.product(g, geo.conjugate(g, view.quat().reshape(1, 4)), q)
    means, quats = parents["means"], parents["quats"]
    if frame == "src_cam":
        means, quats = to_source(means), in_source(g, views, quats, per_view, to_view_frame)
    elif frame == "view0":
        means, quats = views[0].to_camera(means), to_view_frame(views[0], quats)
    if keys["mu"] == "ray_logz":
        z = means[:, 2:]
        means = g.concat([means[:, :2] / z, g.log(z)], 1)
    scales, alpha = parents["scales"], parents["opacities"]
    if keys["scale"] == "log_px":
        z = to_source(parents["means"])[:, 2:]
        focal = g.concat([g.broadcast(v.focal[0].reshape(1, 1), (per_view, 1)) for v in views], 0)
        scales = g.log(scales * focal / z)
    if keys["alpha"] == "logit":
        alpha = g.clamp(g.log(alpha / (1.0 - alpha)), -6.0, 6.0)
    quats = g.where(quats[:, :1] < 0.0, -quats, quats)
    return [means, scales, quats, alpha]


def block(g, x, name, dim):
    """Applies Linear, ReLU and LayerNorm twice."""
    for i in range(2):
        x = g.layer_norm(g.relu(g.linear(x, f"{name}.lin{i}", dim)), f"{name}.ln{i}")
    return x


def embed(g, keys, views, parents, sh, per_view, name="subsplat.embed"):
    """Returns z^g and z^a [N, E]; sh [N, 3 D], colour by colour."""
    dim = keys["dim"]
    x = conditioned(g, keys, views, parents, per_view)
    if keys["mlp"] == "pg":
        total = block(g, x[0], f"{name}.x", dim)
        for value, part in zip(x[1:], NAMES[1:]):
            total = total + block(g, value, f"{name}.{part}", dim)
        return g.linear(total, f"{name}.w_g", dim), block(g, sh, f"{name}.c", dim)
    # W_g (sum of W2_i h_i), with the products W_g W2_i as the 32-wide columns of one matrix.
    w = g.weight(f"{name}.w_g.weight", (dim, 4 * 32))
    z = g.weight(f"{name}.w_g.bias", (dim,))
    for i, (value, part) in enumerate(zip(x, NAMES)):
        hidden = g.gelu(g.linear(value, f"{name}.{part}.lin0", 32))
        z = z + hidden @ w[:, 32 * i:32 * (i + 1)].transpose(1, 0)
    colour = g.linear(g.gelu(g.linear(sh, f"{name}.c.lin0", 64)), f"{name}.c.lin1", dim)
    return g.layer_norm(z, f"{name}.ln_g"), g.layer_norm(colour, f"{name}.c.ln")
