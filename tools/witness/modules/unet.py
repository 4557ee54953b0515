"""MVSplat's 2-D U-Net: [V, C, h, w] of one scene to the same shape."""

HEAD = 32


def resblock(g, x, name, c):
    h = g.silu(g.group_norm(g.conv(x, f"{name}.in_layers.0", c), f"{name}.in_layers.1", 8))
    h = g.silu(g.group_norm(g.conv(h, f"{name}.out_layers.0", c), f"{name}.out_layers.1", 8))
    return (x if x.shape[1] == c else g.conv(x, f"{name}.skip_connection", c, kernel=1)) + h


def conv1d(g, x, name, c_out):
    """Convolution of x [V, C, n] with kernel 1."""
    w = g.weight(f"{name}.weight", (c_out, x.shape[1], 1)).reshape(c_out, x.shape[1])
    return w @ x + g.weight(f"{name}.bias", (c_out,)).reshape(c_out, 1)


def attention(g, x, name):
    """The tokens of all views form one sequence; norm after the projection."""
    v, c, h, w = x.shape
    n = h * w
    qkv = conv1d(g, x.reshape(v, c, n), f"{name}.qkv", 3 * c).reshape(v, c // HEAD, 3, HEAD, n)
    # [heads, 3, HEAD, V * n]
    joint = qkv.transpose(1, 2, 3, 0, 4).reshape(c // HEAD, 3, HEAD, v * n)
    q, k, value = joint[:, 0] * HEAD**-0.25, joint[:, 1] * HEAD**-0.25, joint[:, 2]
    weights = g.softmax(q.transpose(0, 2, 1) @ k)
    y = value @ weights.transpose(0, 2, 1)
    y = y.reshape(c, v, n).transpose(1, 0, 2)
    y = conv1d(g, y, f"{name}.proj_out", c).reshape(v, c, h, w)
    return x + g.group_norm(y, f"{name}.norm", 8)


def unet(g, x, name, levels):
    c = x.shape[1]
    x = g.conv(x, f"{name}.input_blocks.0.0", c)
    skips = [x]
    for level in range(levels):
        x = resblock(g, x, f"{name}.input_blocks.{1 + 2 * level}.0", c)
        if level == levels - 1:
            x = attention(g, x, f"{name}.input_blocks.{1 + 2 * level}.1")
        skips.append(x)
        if level < levels - 1:
            x = g.conv(x, f"{name}.input_blocks.{2 + 2 * level}.0.op", c, stride=2)
            skips.append(x)
    x = resblock(g, x, f"{name}.middle_block.0", c)
    x = resblock(g, x, f"{name}.middle_block.2", c)
    for i in range(2 * levels):
        at, lowest = f"{name}.output_blocks.{i}", i < 2
        x = resblock(g, g.concat([x, skips.pop()], 1), f"{at}.0", c)
        if lowest:
            x = attention(g, x, f"{at}.1")
        if i % 2 == 1 and i < 2 * levels - 2:
            x = g.conv(g.upsample_nearest(x, 2), f"{at}.2.conv" if lowest else f"{at}.1.conv", c)
    return g.silu(g.group_norm(g.conv(x, f"{name}.out.0", c), f"{name}.out.1", 8))


def case(shape, levels, high, stride):
    def build(c):
        c.output("out", unet(c.g, c.random_input("x", shape, -high, high), "net", levels), stride)
    return build


# In unet_dim the variance within a group of the first norms comes from the biases alone, so that
# eps affects the result.
CASES = {"unet": case((2, 64, 12, 8), 3, 1.5, 5), "unet_dim": case((2, 32, 4, 6), 2, 0.01, 1)}
