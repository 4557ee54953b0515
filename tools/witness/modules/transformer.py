"""MVSplat's multi-view transformer of one scene: features [V, C, h, w] to the same shape."""

import numpy as np

SPLITS = 2


def position_encoding(c, h, w):
    """Returns [C, h, w], restarting in each window: C/2 channels from y, then C/2 from x."""
    def axis(n):
        p = (np.arange(n * SPLITS) % n + 1) / (n + 1e-6) * 2 * np.pi
        k = np.arange(c // 2)
        angle = p[None] / 10000.0 ** (2 * (k // 2) / (c // 2))[:, None]
        return np.where((k % 2 == 0)[:, None], np.sin(angle), np.cos(angle))
    y, x = axis(h // SPLITS), axis(w // SPLITS)
    return np.concatenate([np.repeat(y[:, :, None], w, 2), np.repeat(x[:, None, :], h, 1)])


def windows(x, h, w):
    """Splits [..., h, w, C] into [..., 4, L, C]; window = row * 2 + column."""
    lead, c, wh, ww = x.shape[:-3], x.shape[-1], h // SPLITS, w // SPLITS
    n = len(lead)
    x = x.reshape(lead + (SPLITS, wh, SPLITS, ww, c))
    x = x.transpose(*range(n), n, n + 2, n + 1, n + 3, n + 4)
    return x.reshape(lead + (SPLITS * SPLITS, wh * ww, c))


def merged(x, h, w):
    """Inverts `windows`."""
    lead, c, wh, ww = x.shape[:-3], x.shape[-1], h // SPLITS, w // SPLITS
    n = len(lead)
    x = x.reshape(lead + (SPLITS, SPLITS, wh, ww, c))
    return x.transpose(*range(n), n, n + 2, n + 1, n + 3, n + 4).reshape(lead + (h, w, c))


def shift_mask(h, w, shift):
    """Returns [4, L, L]: 0, or -100 between rolled pixels of different regions."""
    def region(n, s):
        i = np.arange(n)
        return np.where(i < n - n // SPLITS, 0, np.where(i < n - s, 1, 2))
    label = 3 * region(h, shift[0])[:, None] + region(w, shift[1])[None]
    wh, ww = h // SPLITS, w // SPLITS
    label = label.reshape(SPLITS, wh, SPLITS, ww).transpose(0, 2, 1, 3).reshape(SPLITS**2, wh * ww)
    return np.where(label[:, :, None] == label[:, None, :], 0.0, -100.0)


def sublayer(g, source, targets, name, shift, expansion):
    """Attention of source [V, h, w, C] to targets [V, m, h, w, C], m other views each."""
    v, h, w, c = source.shape
    m = targets.shape[1]
    q = g.linear(source, f"{name}.q_proj", c, bias=False)
    k = g.linear(targets, f"{name}.k_proj", c, bias=False)
    value = g.linear(targets, f"{name}.v_proj", c, bias=False)
    for axis, s in enumerate(shift):
        q, k, value = g.roll(q, -s, axis + 1), g.roll(k, -s, axis + 2), g.roll(value, -s, axis + 2)
    # Keys of a window: position-major, view-minor.
    keys = lambda x: windows(x, h, w).transpose(0, 2, 3, 1, 4).reshape(v, SPLITS**2, -1, c)
    logits = windows(q, h, w) @ keys(k).transpose(0, 1, 3, 2) * (1 / np.sqrt(c))
    if shift != (0, 0):
        # Tiled view-major: as in MVSplat, misaligned with the keys for m > 1.
        logits = logits + g.const(np.concatenate([shift_mask(h, w, shift)] * m, 2)[None])
    message = merged(g.softmax(logits) @ keys(value), h, w)
    message = g.linear(message, f"{name}.merge", c, bias=False)
    for axis, s in enumerate(shift):
        message = g.roll(message, s, axis + 1)
    message = g.layer_norm(message, f"{name}.norm1")
    if expansion:
        hidden = g.linear(g.concat([source, message], -1), f"{name}.mlp.0", 2 * c * expansion, bias=False)
        message = g.linear(g.gelu(hidden), f"{name}.mlp.2", c, bias=False)
        message = g.layer_norm(message, f"{name}.norm2")
    return source + message


def transformer(g, features, layers, expansion=4, name="backbone.transformer", stages=None):
    v, c, h, w = features.shape
    x = (features + g.const(position_encoding(c, h, w)[None])).transpose(0, 2, 3, 1)
    for i in range(layers):
        shift = (h // SPLITS // 2, w // SPLITS // 2) if i % 2 else (0, 0)
        at = f"{name}.layers.{i}"
        own = sublayer(g, x, x.reshape(v, 1, h, w, c), f"{at}.self_attn", shift, None)
        # The other views at this layer's input.
        others = [g.stack([x[j] for j in range(v) if j != i], 0) for i in range(v)]
        x = sublayer(g, own, g.stack(others, 0), f"{at}.cross_attn_ffn", shift, expansion)
        if stages is not None:
            stages.append((own, x))
    return x.transpose(0, 3, 1, 2)


def case(views, h, w):
    def build(c):
        stages, rows = [], (views, h * w, 16)
        out = transformer(c.g, c.random_input("features", (views, 16, h, w), -2.0, 2.0), 2, stages=stages)
        for i, (own, x) in enumerate(stages):
            c.output(f"self{i}", own.reshape(rows), stride=3)
            c.output(f"layer{i}", x.reshape(rows), stride=3)
        c.output("out", out)
    return build


CASES = {"transformer": case(2, 8, 12), "transformer3": case(3, 8, 8)}
