"""Makes tests/goldens/resize.txt: what Pillow's Image.resize gives for pictures of
noise, in hex where small and as CRC-32 where not. Checked by tests/scenes/resize.rs.

    pip install pillow==13.0.0 && python tools/make_resize_golden.py
"""

import pathlib
import zlib

import PIL
from PIL import Image

FILTERS = {"box": Image.BOX, "bilinear": Image.BILINEAR, "bicubic": Image.BICUBIC, "lanczos": Image.LANCZOS}
SMALL = [
    ((23, 17), (11, 8)), ((23, 17), (7, 17)), ((23, 17), (23, 5)), ((8, 6), (4, 3)),
    ((8, 6), (2, 2)), ((5, 4), (13, 11)), ((3, 2), (1, 1)), ((1, 1), (3, 2)),
]
LARGE = [
    ((640, 360), (455, 256)), ((1280, 720), (910, 512)), ((512, 512), (256, 256)),
    ((1024, 1024), (256, 256)), ((135, 240), (288, 512)), ((1080, 1920), (256, 455)),
]


def noise(width, height):
    """Bytes of a linear congruential generator (Numerical Recipes), high byte; every
    seventh pixel is 0 or 255, so that clipping is seen."""
    state, data = 12345, bytearray()
    for i in range(width * height * 3):
        state = (state * 1664525 + 1013904223) & 0xFFFFFFFF
        value = state >> 24
        data.append((255 if value > 127 else 0) if i // 3 % 7 == 0 else value)
    return Image.frombytes("RGB", (width, height), bytes(data))


lines = [f"# Pillow {PIL.__version__}, tools/make_resize_golden.py", "# filter from to (hex | crc32)"]
for name, mode in FILTERS.items():
    for source, target in SMALL:
        out = noise(*source).resize(target, mode).tobytes().hex()
        lines.append(f"{name} {source[0]}x{source[1]} {target[0]}x{target[1]} {out}")
    for source, target in LARGE:
        crc = zlib.crc32(noise(*source).resize(target, mode).tobytes())
        lines.append(f"{name} {source[0]}x{source[1]} {target[0]}x{target[1]} crc {crc}")
path = pathlib.Path(__file__).parent.parent / "tests" / "goldens" / "resize.txt"
path.parent.mkdir(exist_ok=True)
path.write_text("\n".join(lines) + "\n")
