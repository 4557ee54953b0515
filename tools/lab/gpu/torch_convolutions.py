#!/usr/bin/env python3
"""Adds PyTorch's time to each convolution that `device --convolutions` prints.

    device --convolutions | torch_convolutions.py

float32 without TF32, CUDA where it is, cuDNN's fastest algorithm; ms a call, least of seven runs of ten.
"""

import sys
import time

import torch

CALLS, REPEATS = 10, 7


def main() -> None:
    device = "cuda" if torch.cuda.is_available() else "cpu"
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = False
    torch.backends.cudnn.benchmark = True
    wait = torch.cuda.synchronize if device == "cuda" else lambda: None
    name = torch.cuda.get_device_name() if device == "cuda" else "CPU"
    for line in sys.stdin:
        if line.startswith("#"):
            print(f"{line.rstrip()}; then PyTorch {torch.__version__}'s ms and ours over it, {name}")
            continue
        *sizes, own, _ = line.split()
        b, c, h, w, o, k, stride = map(int, sizes)
        x, weight = torch.randn(b, c, h, w, device=device), torch.randn(o, c, k, k, device=device)
        best = float("inf")
        with torch.no_grad():
            for _ in range(REPEATS + 1):
                wait()
                start = time.perf_counter()
                for _ in range(CALLS):
                    torch.nn.functional.conv2d(x, weight, stride=stride, padding=k // 2)
                wait()
                best = min(best, (time.perf_counter() - start) / CALLS)
        print(f"{line.rstrip()} {1e3 * best:.4f} {float(own) / (1e3 * best):.2f}", flush=True)


if __name__ == "__main__":
    main()
