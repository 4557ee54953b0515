"""Makes tests/goldens/metrics.txt: PSNR and SSIM of made-up pictures by scikit-image, as
MVSplat computes them. Checked by tests/scenes/metrics.rs.

    pip install scikit-image==0.26.0 && python tools/make_metrics_golden.py
"""

import pathlib

import numpy as np
import skimage
from skimage.metrics import peak_signal_noise_ratio, structural_similarity


def noise(width, height):
    """Bytes of a linear congruential generator, as tests/support/src/noise.rs has them."""
    state, data = 12345, bytearray()
    for i in range(width * height * 3):
        state = (state * 1664525 + 1013904223) & 0xFFFFFFFF
        value = state >> 24
        data.append((255 if value > 127 else 0) if i // 3 % 7 == 0 else value)
    return np.frombuffer(bytes(data), np.uint8).reshape(height, width, 3)


def pair(width, height, weight):
    """A ramp, and the ramp with `weight` / 256 of noise, in integers."""
    y, x, c = np.meshgrid(np.arange(height), np.arange(width), np.arange(3), indexing="ij")
    ramp = (3 * x + 5 * y + 40 * c) % 256
    mixed = (ramp * (256 - weight) + noise(width, height).astype(int) * weight) // 256
    # float32 divided by 255, as tests/scenes/metrics.rs does; the sums are in float64.
    return [(p.astype(np.float32) / np.float32(255)).astype(np.float64) for p in (ramp, mixed)]


lines = [f"# scikit-image {skimage.__version__}, numpy {np.__version__}, tools/make_metrics_golden.py"]
lines.append("# width height weight psnr ssim")
for width, height, weight in [(64, 48, 4), (37, 53, 32), (40, 40, 128), (11, 11, 256), (96, 20, 1)]:
    a, b = pair(width, height, weight)
    psnr = peak_signal_noise_ratio(a, b, data_range=1.0)
    ssim = structural_similarity(
        a, b, win_size=11, gaussian_weights=True, channel_axis=2, data_range=1.0
    )
    lines.append(f"{width} {height} {weight} {psnr:.12f} {ssim:.12f}")
path = pathlib.Path(__file__).parent.parent / "tests" / "goldens" / "metrics.txt"
path.write_text("\n".join(lines) + "\n")
