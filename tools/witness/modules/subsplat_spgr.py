"""Heads and sub-pixel reparameterization (SubSplat, section 3.2; supplement A.3), by their definitions:
positions by unprojection, areas as sqrt det(J Sigma J^T), opacities from softmax weights."""

import numpy as np
from . import subsplat_geometry as geo

GROWTH_MAX = 50.0
ALPHA_MAX = 0.9999


def head(g, keys, x, name, side, channels):
    """Returns [N, K, channels] from [N, E]."""
    n, k, hidden = x.shape[0], side * side, keys["hidden"]
    if keys["head"] == "mlp2":
        h = g.gelu(g.linear(g.layer_norm(x, f"{name}.norm"), f"{name}.lin0", hidden))
        return g.linear(h, f"{name}.lin1", k * channels).reshape(n, k, channels)
    if keys["head"] == "pg":
        for i in range(2):
            x = g.relu(g.linear(x, f"{name}.lin{2 * i}", hidden))
            x = g.layer_norm(g.relu(g.linear(x, f"{name}.lin{2 * i + 1}", hidden)), f"{name}.ln{i}")
        return g.linear(x, f"{name}.lin4", k * channels).reshape(n, k, channels)
    if keys["head"] == "polynomial":
        h = g.gelu(g.linear(g.layer_norm(x, f"{name}.norm"), f"{name}.lin0", hidden))
        # Outputs of all 18 layers, then their sums with the factors of each child.
        layers = [g.linear(h, f"{name}.lin{i}", m * channels).reshape(n, m, channels) for i, m in ((1, 4), (2, 14))]
        return g.matmul(g.const(polynomial(side)), g.concat(layers, 1))
    # coord: hid_k = GELU(W x + c_k), o_k = W' hid_k, c_k = MLP(posenc(g_k)).
    x = g.linear(g.layer_norm(x, f"{name}.norm"), f"{name}.lin0", hidden)
    c = g.linear(g.gelu(g.linear(g.const(posenc(side)), f"{name}.pos0", hidden)), f"{name}.pos1", hidden)
    return g.linear(g.gelu(x[:, None] + c), f"{name}.lin1", channels)


def subpixel_centres(side):
    """Returns [K, 2]: centres of the sub-pixels in input px from the pixel's centre, row-major."""
    return np.array([[(j + 0.5) / side - 0.5, (i + 0.5) / side - 0.5] for i in range(side) for j in range(side)])


def polynomial(side):
    """Returns [K, 18]: weights of bilinear interpolation from (u, v) = (-1, -1), (1, -1), (-1, 1), (1, 1); then
    (1, kappa) x (1, v, v^2 - 1) x (1, u, u^2 - 1), the last factor fastest, without 1, u, v, uv. (u, v) is four times the
    position, kappa = log2(side / 2)."""
    u, v = 4.0 * subpixel_centres(side).T
    corners = [(1 + a * u) * (1 + b * v) / 4 for b in (-1, 1) for a in (-1, 1)]
    powers = lambda t: [np.ones_like(t), t, t**2 - 1.0]
    kappa = np.log2(side / 2.0)
    products = [k * b * a for k in (1.0, kappa) for b in powers(v) for a in powers(u)]
    return np.stack(corners + [p for i, p in enumerate(products) if i not in (0, 1, 3, 4)], 1)


def posenc(side):
    """Returns [K, 18]: x, y, then per octave 2^o pi: sin x, cos x, sin y, cos y."""
    p = subpixel_centres(side)
    waves = [f(np.pi * 2.0**o * p[:, i]) for o in range(4) for i in range(2) for f in (np.sin, np.cos)]
    return np.stack([p[:, 0], p[:, 1]] + waves, 1)


def heads(g, keys, geo_in, app_in, side, name="subsplat"):
    """Returns records [N, K, 11]: (du, dv, dz, dlog s (3), dr (3), l, gamma~)."""
    return g.concat([head(g, keys, geo_in, f"{name}.geo", side, 9), head(g, keys, app_in, f"{name}.app", side, 2)], 2)


def a_min(keys, side):
    """Returns the minimum area, target px^2; the key is one of over_k, off, {target_px: a}, {input_px: a}."""
    rule, k = keys["a_min"], side * side
    if rule == "over_k":
        return 1.0 / k if k > 1 else 0.0
    if rule == "off":
        return 0.0
    (unit, value), = rule.items()
    return value * (k if unit == "input_px" else 1.0)


def lambda_s(keys, side):
    """Returns the initial scale factor of a child."""
    (rule, value), = keys["lambda_s"].items()
    return value / side if rule == "over_sqrt_k" else value


class Primary:
    """The primary view v* of every parent: rotation [N, 3, 3], camera point [N, 3], and its projection."""

    def __init__(self, g, keys, views, near, parents, per_view):
        n, means = parents["means"].shape[0], parents["means"]
        index = g.const(np.arange(n) // per_view, np.int64)
        if keys["primary_view"] == "nearest_visible":
            costs = []
            for view in views:
                p = view.to_camera(means)
                costs.append(g.where(geo.is_visible(p[:, 2], view.positions(p)), p[:, 2], 1e30))
            cost = g.stack(costs, 1)
            best = g.op("ArgMin", [cost], (n,), "int64", axis=1, keepdims=0)
            index = g.where(cost.min(1) < 1e29, best, index)
        table = lambda rows: g.gather(g.stack(rows, 0), index)
        self.rotation = table([v.rotation for v in views])
        self.focal = table([v.focal for v in views])
        self.z_min = g.maximum(table([near[i:i + 1] * 0.01 for i in range(len(views))]), 1e-3)
        eye = table([v.position for v in views])
        self.in_camera = (self.w2c() @ (means - eye)[..., None])[..., 0]
        # 0.3 tan(fov/2) beyond each edge, tan(fov/2) as half the picture over f.
        edge = lambda v, at: (v.size * at - v.centre) / v.focal
        margin = lambda v: (v.size * 0.15) / v.focal
        self.low = table([edge(v, 0.0) - margin(v) for v in views])
        self.high = table([edge(v, 1.0) + margin(v) for v in views])

    def w2c(self):
        return self.rotation.transpose(0, 2, 1)


class Spgr:
    """The reparameterization. keys: the `spgr` section; near: [V]; lowpass: (target px^2, input px^2)."""

    def __init__(self, g, keys, side, views, near, parents, per_view, lowpass=(0.3, 0.3)):
        self.g, self.keys, self.side, self.k = g, keys, side, side * side
        self.parents, self.lowpass, self.n = parents, lowpass, parents["means"].shape[0]
        self.view = Primary(g, keys, views, near, parents, per_view)
        self.z = g.maximum(self.view.in_camera[:, 2:], self.view.z_min)

    def forward(self, record):
        """Returns the children of records [N, K, 11], child k of parent n in row n K + k: `steps` [N K, 3]
        from the parent's mean, `quats` [N K, 4] wxyz, `log_scales` [N K, 3], `opacities` [N K], `gain` [N K]
        or [N K, 4]."""
        g, keys = self.g, self.keys
        in_camera = self.positions(record)
        steps = (in_camera - self.view.in_camera[:, None]) @ self.view.w2c()
        clamp = keys["dlog_clamp"]
        growth = g.exp(g.tanh(record[..., 3:6] / clamp) * clamp)
        scales = self.parents["scales"][:, None] * growth * lambda_s(keys, self.side)
        quats = geo.unit(g, geo.product(g, self.parents["quats"][:, None], geo.exponential(g, record[..., 6:9])))
        at = self.view.in_camera[:, None] if keys["area_at"] == "parent" else in_camera
        m = self.footprint(at, quats, scales, self.side)
        area, min_area = geo.area(g, m), a_min(keys, self.side)
        factors = self.growth_factors(m, area, min_area)
        scales = scales * factors
        grown = self.footprint(at, quats, scales, self.side)
        alpha = self.opacity(record[..., 9], g.maximum(area, min_area), grown)
        flat = lambda x: x.reshape(self.n * self.k, x.shape[-1])
        extra = g.tanh(record[..., 10:]) * keys["delta"]
        gain = (extra + 1.0).reshape(self.n * self.k)
        if keys["gain_space"] == "rgb":
            # gamma (1/2 + S) = gamma S + 1/2 + (gamma - 1)/2.
            rest = g.broadcast(flat(extra) * 0.5, (self.n * self.k, 3))
            gain = g.concat([gain[:, None], rest], 1)
        return {"steps": flat(steps), "quats": flat(quats), "log_scales": g.log(flat(scales)),
                "opacities": alpha.reshape(self.n * self.k), "gain": gain}

    def positions(self, record):
        """Returns the camera points of the children [N, K, 3]."""
        g, keys, c, z = self.g, self.keys, self.view.in_camera[:, None], self.z[:, None]
        learned = record[..., :2]
        if keys["offset_bound"] is not None:
            learned = g.tanh(learned) * keys["offset_bound"]
        delta = learned / self.side + subpixel_centres(self.side)
        lateral = delta / self.view.focal[:, None] * z
        flat = g.concat([c[..., :2] + lateral, g.broadcast(c[..., 2:], (self.n, self.k, 1))], 2)
        moved = self.slide_on_disc(flat, delta) if keys["slide"] == "disc" else flat
        depth = g.tanh(record[..., 2:3]) * keys["beta_z"]
        if keys["depth_unit"] == "relative":
            depth = depth * z
        # z + dz >= 0.1 z.
        target = g.maximum(moved[..., 2:] + depth, moved[..., 2:] * 0.0 + 0.1 * z)
        if keys["depth_dir"] == "ray":
            return moved / moved[..., 2:] * target
        return g.concat([moved[..., :2], target], 2)

    def slide_on_disc(self, flat, delta):
        """Returns the camera points of steps along the disc, Sigma J^T (J Sigma J^T)^-1 delta, mixed with the
        steps at constant z so that z changes by at most a tenth."""
        g, c = self.g, self.view.in_camera
        rotation = geo.matrix(g, geo.unit(g, self.parents["quats"]))
        axes = self.view.w2c() @ rotation * self.parents["scales"][:, None]
        sigma = geo.gram(g, axes)
        free = np.full((1, 2), 1e9)
        j = geo.jacobian(g, c, self.view.focal, self.view.z_min, -free, free)
        s = j @ sigma @ j.transpose(0, 2, 1)
        a, b, d, det = s[:, 0, 0], s[:, 0, 1], s[:, 1, 1], geo.det2(s)
        inverse = g.stack([g.stack([d, -b], -1), g.stack([-b, a], -1)], -2) / det[:, None, None]
        steps = sigma @ j.transpose(0, 2, 1) @ inverse
        along = delta @ steps.transpose(0, 2, 1) + c[:, None]
        reach, tenth = g.abs(along[..., 2:] - c[:, None, 2:]), 0.1 * self.z[:, None]
        share = g.where(reach > tenth, tenth / reach, 1.0)
        return flat * (1.0 - share) + along * share

    def footprint(self, at, quats, scales, zoom):
        """Returns M = J R_w2c R(q) S [.., 2, 3] at camera points `at`, px of a picture `zoom` times the
        input."""
        g, view = self.g, self.view
        low, high, z_min = view.low[:, None], view.high[:, None], view.z_min[:, None]
        j = geo.jacobian(g, at, view.focal[:, None] * float(zoom), z_min, low, high)
        return j @ view.w2c()[:, None] @ geo.matrix(g, quats) * scales[..., None, :]

    def growth_factors(self, m, area, min_area):
        """Returns the factors [N, K, 3] of sigma that enforce the minimum area."""
        g = self.g
        small = area[..., None] < min_area
        if self.keys["a_min_mode"] == "iso":
            c = g.minimum(g.sqrt(min_area / area[..., None]), GROWTH_MAX)
            return g.broadcast(g.where(small, c, 1.0), (self.n, self.k, 3))
        lengths = (m * m).sum(2)
        still = g.op("ArgMin", [lengths], (self.n, self.k), "int64", axis=2, keepdims=0)
        still = g.gather(g.const(np.eye(3)), still)
        # |m_a x m_b|^2 per pair; the index is the remaining axis.
        u, v = m[:, :, 0], m[:, :, 1]
        pairs = [(1, 2), (2, 0), (0, 1)]
        squares = g.stack([(u[..., i] * v[..., j] - u[..., j] * v[..., i]) ** 2.0 for i, j in pairs], 2)
        p = (squares * still).sum(2, keep=True)
        q = (squares * (1.0 - still)).sum(2, keep=True)
        # c^4 p + c^2 q = A_min^2.
        c2 = (g.sqrt(q * q + 4.0 * min_area**2 * p) - q) / (2.0 * p)
        c = g.minimum(g.sqrt(c2), GROWTH_MAX)
        return g.where(small, still + (1.0 - still) * c, 1.0)

    def parent_footprint(self):
        """Returns M of the parents, input px: [N, 1, 2, 3]."""
        quats = geo.unit(self.g, self.parents["quats"])[:, None]
        return self.footprint(self.view.in_camera[:, None], quats, self.parents["scales"][:, None], 1)

    def opacity(self, logits, area, grown):
        """Returns the opacities [N, K]; `area` is the area after the clamp."""
        g, rule, alpha = self.g, self.keys["opacity"], self.parents["opacities"]
        w = g.softmax(logits, axis=1)
        if rule == "none":
            return g.broadcast(alpha, (self.n, self.k))
        if rule == "linear":
            shared = w / (area + 1e-8)
            return alpha * shared / shared.sum(1, keep=True)
        capped = g.minimum(alpha, ALPHA_MAX)
        if rule == "transmittance":
            return 1.0 - (1.0 - capped) ** w
        if rule == "area":
            own = geo.area(g, self.parent_footprint()) * float(self.k)
            return g.minimum(alpha * own * w / area, 0.99)
        tau = -g.log(1.0 - capped)
        own = geo.blurred(g, self.parent_footprint(), self.lowpass[1]) * float(self.k)
        # A child whose growth reaches GROWTH_MAX still counts with the minimum area.
        blurred, bare = geo.blurred(g, grown, self.lowpass[0]), geo.area(g, grown)
        blurred = g.sqrt(blurred * blurred + area * area - bare * bare)
        return 1.0 - g.exp(-(tau * w * own / blurred))
