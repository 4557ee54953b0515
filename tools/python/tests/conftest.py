"""Scenes for the tests: random Gaussians before a rotated camera, and the shared references."""

import json
import os
import struct
from pathlib import Path

import numpy as np
import pytest

REPOSITORY = Path(__file__).resolve().parents[3]
SHARED = REPOSITORY.parent / "shared"


def shared(name):
    """A file of the references beside the repository; SUBSPLAT_SHARED=require fails without them."""
    path = SHARED / name
    if not path.exists():
        if os.environ.get("SUBSPLAT_SHARED") == "require":
            pytest.fail(f"{path} is required")
        pytest.skip(f"{path} is missing")
    return path


def read_safetensors(path):
    """Tensors (float32 and uint8) and metadata of a file."""
    data = path.read_bytes()
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    metadata = header.pop("__metadata__", {})
    kinds = {"F32": np.float32, "U8": np.uint8}
    tensors = {}
    for name, entry in header.items():
        first, past = (8 + size + offset for offset in entry["data_offsets"])
        values = np.frombuffer(data[first:past], dtype=kinds[entry["dtype"]])
        tensors[name] = values.reshape(entry["shape"])
    return tensors, metadata


def rotation(angle, axis):
    """Rotation by `angle`, radians, about `axis`: Rodrigues' formula."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def viewmat(angle=0.3, axis=(0.2, 1.0, -0.4), at=(0.3, -0.2, 0.4)):
    pose = np.eye(4)
    pose[:3, :3] = rotation(angle, axis)
    pose[:3, 3] = at
    return pose.astype(np.float32)


def make_scene(n=40, degree=None, cameras=1, width=36, height=28, seed=0):
    """Arguments of `subsplat.rasterize`: `n` Gaussians before the cameras."""
    r = np.random.default_rng(seed)
    views = np.stack([viewmat(0.3 + 0.05 * c, at=(0.3 - 0.1 * c, -0.2, 0.4)) for c in range(cameras)])
    in_camera = np.stack([r.uniform(-1, 1, n), r.uniform(-0.8, 0.8, n), r.uniform(2, 4, n)], 1)
    view = views[0].astype(np.float64)
    means = (in_camera - view[:3, 3]) @ view[:3, :3]
    k = np.array([[30, 0, width / 2 + 1], [0, 32, height / 2 - 1], [0, 0, 1]])
    shape = (n, 3) if degree is None else (n, (degree + 1) ** 2, 3)
    colors = r.uniform(0, 1, shape) if degree is None else r.normal(0, 0.4, shape)
    floats = {
        "means": means,
        "quats": r.normal(size=(n, 4)),
        "scales": r.uniform(0.05, 0.3, (n, 3)),
        "opacities": r.uniform(0.2, 0.9, n),
        "colors": colors,
        "viewmats": views,
        "Ks": np.repeat(k[None], cameras, 0),
    }
    scene = {name: np.ascontiguousarray(v, dtype=np.float32) for name, v in floats.items()}
    scene.update(width=width, height=height)
    if degree is not None:
        scene["sh_degree"] = degree
    return scene


@pytest.fixture
def scene():
    return make_scene()
