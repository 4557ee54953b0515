"""Numbers made from names, so that no weight file is committed. The Rust twin is
tests/witness_common/formula.rs.

With h the 64-bit FNV-1a hash of the name and mix the finaliser of SplitMix64:
word i = mix(k + (i + 1) * 0x9E3779B97F4A7C15), k = h xor mix(seed);
uniform i = (top 24 bits of word i + 1/2) / 2^24; u = 2 * uniform - 1. All of it in
integers and f64, rounded to f32 once at the end, so every machine makes the same bits.

Weights, by name and shape (no branch is dead, unlike a seeded start):

    rank >= 2                      u * sqrt(3 / fan_in), fan_in = elements per output row
    rank 1, name ends in .weight   1 + u / 4     (scales of norms)
    rank 1, name ends in .bias     u / 10
    any other                      u / 4         (gates and such)

Inputs: low + (high - low) * uniform, the name's own.
"""

import numpy as np

U64 = np.uint64


def mix(x):
    """SplitMix64's finaliser, on u64 arrays."""
    x = np.asarray(x, dtype=U64)
    with np.errstate(over="ignore"):
        x = (x ^ (x >> U64(30))) * U64(0xBF58476D1CE4E5B9)
        x = (x ^ (x >> U64(27))) * U64(0x94D049BB133111EB)
    return x ^ (x >> U64(31))


def fnv1a(name):
    h = 0xCBF29CE484222325
    for b in name.encode():
        h = ((h ^ b) * 0x100000001B3) & 0xFFFFFFFFFFFFFFFF
    return h


def uniform(seed, name, count):
    """f64 in (0, 1), multiples of 2^-25."""
    key = U64(fnv1a(name)) ^ mix(seed)
    with np.errstate(over="ignore"):
        words = mix(key + np.arange(1, count + 1, dtype=U64) * U64(0x9E3779B97F4A7C15))
    return ((words >> U64(40)).astype(np.float64) + 0.5) / 2.0**24


def weight(seed, name, shape):
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


def drawn(seed, name, shape, low, high):
    u = uniform(seed, name, int(np.prod(shape)))
    return (low + (high - low) * u).reshape(shape).astype(np.float32)
