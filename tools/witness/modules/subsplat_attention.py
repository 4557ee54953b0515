"""Feature aggregation (SubSplat, supplement A.2): one GridSample per sample, and a softmax over the samples
of all views, levels and points together."""

import numpy as np
from . import subsplat_geometry as geo

# kappa of the fixed key points: the centre and +-0.45 on each axis (PixelGaussian).
FIXED = np.array([[0, 0, 0]] + [[s * 0.45 * (i == j) for j in range(3)] for i in range(3) for s in (1, -1)])


def resolved(keys):
    """Replaces `strict_literal` by the settings of the bare equation of A.2."""
    if not keys["strict_literal"]:
        return keys
    return {**keys, "levels": ["trans4"], "op": "dot", "points": "ref", "groups": 1, "logit_scale": "one",
            "kv_proj": False, "gate": "softmax", "residual": "none", "norm": "none", "ffn": False, "head_input": "f",
            "occlusion_gate": False}


class Attention:
    """Attention of N parents over the maps of V views.

    maps: {level: [V, C, h, w]}; parents: means, quats, scales of all N, in view and pixel order; size: (W, H)
    of the pictures."""

    def __init__(self, g, keys, dim, maps, views, parents, per_view, name="subsplat.agg"):
        self.g, self.keys, self.dim, self.name = g, resolved(keys), dim, name
        self.views, self.parents, self.per_view = views, parents, per_view
        self.n = parents["means"].shape[0]
        self.maps = [self.with_embedding_width(i, maps[level]) for i, level in enumerate(self.keys["levels"])]
        self.occlusion = self.occlusion_gates() if self.keys["occlusion_gate"] else None

    def forward(self, z_g, z_a):
        """Returns f^g, f^a [N, E]."""
        f = z_g * 0.0
        for t in range(self.keys["stages_geo"]):
            shared = self.keys["share_stage_weights"]
            f = self.stage(f"{self.name}.g{0 if shared else t}", f, z_g)
        f_g = f
        for t in range(self.keys["stages_app"]):
            f = self.stage(f"{self.name}.a{t}", f, z_a)
        return f_g, f

    def head_inputs(self, z_g, z_a):
        f_g, f_a = self.forward(z_g, z_a)
        return (f_g + z_g, f_a + z_a) if self.keys["head_input"] == "f_plus_z" else (f_g, f_a)

    # --- maps and positions ---------------------------------------------------------

    def with_embedding_width(self, i, chw):
        """Returns a map as [V, h, w, C], projected to E channels where no W_v does so."""
        x = chw.transpose(0, 2, 3, 1)
        projected = self.keys["kv_proj"] and self.keys["groups"] == 1
        if x.shape[-1] == self.dim or projected:
            return x
        return self.g.linear(x, f"{self.name}.in.{i}", self.dim, bias=False)

    def sample(self, map_hwc, v, at, clamped=False):
        """Returns bilinear samples [N, M, C] of view v's [V, h, w, C] at picture positions `at` [N, M, 2]."""
        height, width = map_hwc.shape[1:3]
        chw = map_hwc[v:v + 1].transpose(0, 3, 1, 2)
        corners = self.keys["sample_convention"] == "integer" and not clamped
        # integer: x = R W = (grid + 1)/2 (W - 1); half_pixel: x = R W - 1/2 = ((grid + 1) W - 1)/2.
        factor = np.array([2.0 * s / (s - 1.0) for s in (width, height)]) if corners else np.array([2.0, 2.0])
        out_shape = (1, chw.shape[1], *at.shape[:2])
        grid = (at * factor - 1.0)[None]
        if clamped:
            got = self.g.op("GridSample", [chw, grid], out_shape, mode="bilinear", padding_mode="border", align_corners=0)
        else:
            got = self.g.grid_sample(chw, grid, corners)
        return got[0].transpose(1, 2, 0)

    def project(self, view, points):
        """Returns positions [N, M, 2] and camera z [N, M] of world points [N, M, 3]."""
        p = view.to_camera(points)
        at = view.positions(p)
        return self.g.clamp(at, 0.0, 0.9999) if self.keys["mask"] == "pg_clamp" else at, p[..., 2]

    def points(self, name, f, q, v, level):
        """Returns positions [N, M, 2] in view v on one level, and the camera z [N, M] that determines their
        visibility."""
        g, keys, view, means = self.g, self.keys, self.views[v], self.parents["means"]
        centre, z = self.project(view, means[:, None])
        if keys["points"] == "ref":
            return centre, z
        m = keys["n_learned"]
        if keys["points"] == "pixelgaussian":
            kappa = []
            if keys["n_fixed"]:
                kappa.append(g.broadcast(g.const(FIXED[None, :keys["n_fixed"]]), (self.n, keys["n_fixed"], 3)))
            if m:
                kappa.append((g.sigmoid(g.linear(f, f"{name}.key_points", 3 * m)) - 0.5).reshape(self.n, m, 3))
            local = g.concat(kappa, 1) * self.parents["scales"][:, None]
            rotation = geo.matrix(g, self.parents["quats"])
            return self.project(view, local @ rotation.transpose(0, 2, 1) + means[:, None])
        if m == 0:
            return centre, z
        height, width = self.maps[level].shape[1:3]
        offsets = g.linear(q, f"{name}.offsets", 2 * len(self.maps) * m)
        offsets = offsets.reshape(self.n, len(self.maps), m, 2)[:, level] / np.array([width, height])
        return g.concat([centre, centre + offsets], 1), g.broadcast(z, (self.n, m + 1))

    def occlusion_gates(self):
        """Returns exp(-max(0, z - D(R) - t)/t), t = 2 % of z, per view [N, 1]; 1 outside the picture."""
        gates = []
        for v, view in enumerate(self.views):
            own = view.to_camera(self.parents["means"][v * self.per_view:(v + 1) * self.per_view])[:, 2]
            depth = own.reshape(1, view.height, view.width, 1)
            in_camera = view.to_camera(self.parents["means"])
            at, z = view.positions(in_camera), in_camera[:, 2:]
            hidden_by = self.sample(depth, 0, at[:, None], clamped=True)[:, 0]
            gate = self.g.exp(-(self.g.maximum(z - hidden_by - 0.02 * z, 0.0) / (0.02 * z)))
            gates.append(self.g.where(geo.is_visible(z[:, 0], at)[:, None], gate, 1.0))
        return gates

    # --- a stage --------------------------------------------------------------------

    def gates(self, name, q):
        """Returns alpha_v [N or 1, 1] of every view."""
        g, kind, v = self.g, self.keys["gate"], len(self.views)
        if kind in ("softmaxV", "softmax"):
            p = g.softmax(g.weight(f"{name}.gate", (self.keys["gate_views"],))[:v])
            gates = [p[i].reshape(1, 1) * (float(v) if kind == "softmaxV" else 1.0) for i in range(v)]
        elif kind == "query":
            gates = [2.0 * g.sigmoid(g.linear(q, f"{name}.gate", 1))] * v
        else:
            gates = [g.const([[1.0]])] * v
        if self.occlusion:
            gates = [gate * o for gate, o in zip(gates, self.occlusion)]
        return gates

    def logits(self, name, q, key, v, level, m):
        """Returns [N, M, G]."""
        g, keys, groups = self.g, self.keys, self.keys["groups"]
        if keys["op"] == "linear":
            shape = (keys["gate_views"], len(self.maps), m, groups)
            return g.linear(q, f"{name}.weights", int(np.prod(shape))).reshape(self.n, *shape)[:, v, level]
        width = self.dim // groups
        scale = 1.0 if keys["logit_scale"] == "one" else 1.0 / np.sqrt(width)
        dots = (key.reshape(self.n, m, groups, width) * q.reshape(self.n, 1, groups, width)).sum(-1) * scale
        if len(self.maps) > 1:
            dots = dots + g.weight(f"{name}.level_bias", (len(self.maps),))[level]
        return dots

    def projected(self, name, part, enabled, level):
        """Projects a level's map by W_k or W_v."""
        if not (enabled and self.keys["kv_proj"]):
            return self.maps[level]
        return self.g.linear(self.maps[level], f"{name}.{part}.{level}", self.dim)

    def attend(self, name, f, q):
        """Returns o [N, E]."""
        g, keys, groups = self.g, self.keys, self.keys["groups"]
        gates = self.gates(name, q)
        logits, values, factors, visible = [], [], [], []
        keyed = [self.projected(name, "wk", keys["op"] == "dot", i) for i in range(len(self.maps))]
        valued = [self.projected(name, "wv", groups == 1, i) for i in range(len(self.maps))]
        for v in range(len(self.views)):
            for level, (key, value) in enumerate(zip(keyed, valued)):
                at, z = self.points(name, f, q, v, level)
                m = at.shape[1]
                if keys["mask"] == "renorm":
                    inside = geo.is_visible(z, at)
                else:
                    # A position clamped to 0: PixelGaussian's kernel skips the sample and changes
                    # nothing else.
                    inside = (at[..., 0] > 0.0) & (at[..., 1] > 0.0)
                live = g.where(inside[..., None], 1.0, 0.0)
                k = self.sample(key, v, at) * live
                u = self.sample(value, v, at) * live
                logits.append(self.logits(name, q, k, v, level, m))
                values.append(u.reshape(self.n, m, groups, self.dim // groups))
                factors.append(g.broadcast(gates[v][..., None], (self.n, m, 1)))
                visible.append(live)
        a, factor, live = g.concat(logits, 1), g.concat(factors, 1), g.concat(visible, 1)
        if keys["mask"] == "renorm":
            a = g.where(live > 0.5, a, -1e30)
            p = g.softmax(a, axis=1) * live
        else:
            p = g.softmax(a, axis=1)
        o = ((p * factor)[..., None] * g.concat(values, 1)).sum(1).reshape(self.n, self.dim)
        if keys["kv_proj"] and groups > 1:
            o = g.linear(o, f"{name}.wo", self.dim)
        return o

    def stage(self, name, f, z):
        g, keys = self.g, self.keys
        q = f + z
        if keys["norm"] == "pre":
            q = g.layer_norm(q, f"{name}.norm")
        o = self.attend(name, f, q)
        if keys["residual"] == "cat":
            joined = g.concat([f, o], 1)
            out = g.linear(joined, f"{name}.cat", self.dim)
        else:
            joined = out = f + o if keys["residual"] == "add" else o
        if keys["ffn"]:
            hidden = g.relu(g.linear(g.layer_norm(joined, f"{name}.ffn.norm"), f"{name}.ffn.lin0", 4 * self.dim))
            out = out + g.linear(hidden, f"{name}.ffn.lin1", self.dim)
        return out
