"""Values derived from names, so that no weight file is committed. The Rust counterpart is
tests/support/src/witness/formula.rs.

With h the 64-bit FNV-1a hash of the name and mix the finaliser of SplitMix64:
word i = mix(k + (i + 1) * 0x9E3779B97F4A7C15), k = h xor mix(seed);
uniform i = (top 24 bits of word i + 1/2) / 2^24; u = 2 * uniform - 1. All operations are in integers and f64,
with one rounding to f32 at the end, so that every machine computes the same bits.

Weights, by name and shape (all branches are active, in contrast to seeded initial weights):

    rank >= 2                      u * sqrt(3 / fan_in), fan_in = elements per output row
    rank 1, name ends in .weight   1 + u / 4     (scales of norms)
    rank 1, name ends in .bias     u / 10
    any other                      u / 4         (gates and similar)

Inputs: low + (high - low) * uniform of the input's name.
"""

import numpy as np

U64 = np.uint64


def mix(x):
    """Applies SplitMix64's finaliser to u64 arrays."""
    x = np.asarray(x, dtype=U64)
    with np.errstate(over="ignore"):
        x = (x ^ (x >> U64(30))) * U64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> U64(27))) * U64(0x94D049BB133111EB)
    return x ^ (x >> U64(31))


def fnv1a(name):
    """Returns the 64-bit FNV-1a hash of a name."""
    h = 0xCBF29CE484222325
    for b in name.encode():
        h = ((h ^ b) * 0x100000001B3) & 0xFFFFFFFFFFFFFFFF
    return h


def uniform(seed, name, count):
    """Returns f64 in (0, 1), multiples of 2^-25."""
    key = U64(fnv1a(name)) ^ mix(seed)
    with np.errstate(over="ignore"):
        words = mix(key + np.arange(1, count + 1, dtype=U64) * U64(0x9E3779B97F4A7C15))
    return ((words >> U64(40)).astype(np.float64) + 0.5) / 2.0**24


def weight(seed, name, shape):
    """Returns the weight of a name and shape."""
    u = 2.0 * uniform(seed, name, int(np.prod(shape))) - 1.0
    if len(shape) >= 2:
        u = u * np.sqrt(3.0 / np.prod(shape[1:]))
    elif len(shape) == 1 and name.endswith(".weight"):
        u = 1.0 + u / 4.0
    elif len(shape) == 1 and name.endswith(".bias"):
        u = u / 10.0
    else:
        u = u / 4.0
    return u.reshape(shape).astype(np.float32)


def uniform_input(seed, name, shape, low, high):
    """Returns the input of a name and shape, uniform in (low, high)."""
    u = uniform(seed, name, int(np.prod(shape)))
    return (low + (high - low) * u).reshape(shape).astype(np.float32)
