"""MVSplat's CNN: images [N, 3, H, W] in [0, 1] to maps at 1/2 and 1/4."""

import numpy as np

import formula

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def residual(g, x, name, c, stride=1):
    y = g.relu(g.instance_norm(g.conv(x, f"{name}.conv1", c, stride=stride, bias=False)))
    y = g.relu(g.instance_norm(g.conv(y, f"{name}.conv2", c, bias=False)))
    if stride != 1 or x.shape[1] != c:
        x = g.instance_norm(g.conv(x, f"{name}.downsample.0", c, kernel=1, stride=stride))
    return g.relu(x + y)


def cnn(g, images, channels, name="backbone.backbone"):
    row = lambda v: g.const(np.array(v, np.float32).reshape(1, 3, 1, 1))
    x = (images - row(MEAN)) / row(STD)
    x = g.relu(g.instance_norm(g.conv(x, f"{name}.conv1", channels[0], kernel=7, stride=2, bias=False)))
    stages = []
    for i, (c, stride) in enumerate(zip(channels, (1, 2, 1)), 1):
        x = residual(g, residual(g, x, f"{name}.layer{i}.0", c, stride), f"{name}.layer{i}.1", c)
        stages.append(x)
    return stages[0], g.conv(x, f"{name}.conv2", channels[2], kernel=1)


def case(c):
    half, quarter = cnn(c.g, c.random_input("images", (2, 3, 32, 48), 0.0, 1.0), (8, 12, 16))
    c.output("half", half, stride=3)
    c.output("quarter", quarter)


def dim_case(c):
    """A picture of very low contrast around the colour that normalises to 0, so that the zero padding adds no
    contrast either. The first layer's variance is close to eps."""
    noise = formula.uniform_input(c.seed, "noise", (1, 3, 32, 32), -0.003, 0.003)
    images = c.stored_input("images", np.array(MEAN, np.float32).reshape(1, 3, 1, 1) + noise)
    half, quarter = cnn(c.g, images, (8, 12, 16))
    c.output("half", half, stride=3)
    c.output("quarter", quarter)


CASES = {"cnn": case, "cnn_dim": dim_case}
