"""Times `subsplat.torch.rasterization`, forward and backward, on a scene of the Rust bench.

    cargo bench --bench raster -- 131k-512 --write out/raster
    python tools/python/benches/torch_raster.py out/raster/131k-512.safetensors
    cargo bench --bench raster -- backward 131k-512 own      # "subsplat, picture, then gradients", all threads

The gradients are those of the bench: all inputs but the camera, with respect to colours and alpha.
"""

import json
import statistics
import struct
import sys
import time

import numpy as np
import torch

from subsplat.torch import rasterization

REPEATS = 60


def scene(path):
    """Tensors and metadata of a .safetensors file of float32."""
    data = open(path, "rb").read()
    (size,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + size])
    metadata = header.pop("__metadata__")

    def tensor(entry):
        first, past = (8 + size + offset for offset in entry["data_offsets"])
        values = np.frombuffer(data[first:past], np.float32).reshape(entry["shape"])
        return torch.from_numpy(values.copy())

    return {name: tensor(entry) for name, entry in header.items()}, metadata


def main():
    tensors, metadata = scene(sys.argv[1])
    fx, fy, cx, cy = tensors["intrinsics"].tolist()
    Ks = torch.tensor([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]])
    viewmats = torch.linalg.inv(tensors["world_from_camera"].double()).float()[None].contiguous()
    viewmats[:, 3] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    names = ("means", "quats", "scales", "opacities", "sh")
    leaves = [tensors[name].requires_grad_() for name in names]
    w, h, degree = (int(metadata[k]) for k in ("width", "height", "sh_degree"))
    v = torch.randn(1, h, w, 3), torch.randn(1, h, w, 1)

    def forward():
        return rasterization(*leaves, viewmats, Ks, w, h, sh_degree=degree)[:2]

    times = {"forward": [], "forward and backward": [], "CPU time of both": []}
    for _ in range(REPEATS):
        for leaf in leaves:
            leaf.grad = None
        cpu, began = time.process_time(), time.perf_counter()
        pictures = forward()
        drawn = time.perf_counter()
        torch.autograd.backward(pictures, v)
        times["forward and backward"].append(time.perf_counter() - began)
        times["forward"].append(drawn - began)
        times["CPU time of both"].append(time.process_time() - cpu)
    print(f"{len(leaves[0])} Gaussians, {w}x{h}, SH degree {degree}, {torch.get_num_threads()} threads")
    for name, seconds in times.items():
        kept = [1e3 * s for s in seconds[3:]]
        print(f"{name}: median {statistics.median(kept):.1f} ms, least {min(kept):.1f} ms")


if __name__ == "__main__":
    main()
