"""Writes tests/goldens/heic and tests/goldens/photographs.

The tests compute the picture again: 64x48 px, RGB (40 + 2x, 60 + 3y, 200 - x - y); grey
30 + 3x + y // 2. Needs heif-enc (Debian: libheif-examples), Pillow, NumPy and pillow-heif:

    python tools/make_photograph_fixtures.py
"""

import subprocess
import tempfile
from pathlib import Path

import numpy as np
import pillow_heif
from PIL import Image

GOLDENS = Path(__file__).parent.parent / "tests" / "goldens"


def exif(orientation):
    block = Image.Exif()
    block[0x0112] = orientation
    block[0x010F] = "Maker"
    block[0x0110] = "Model 1"
    block.get_ifd(0x8769)[0xA405] = 26  # FocalLengthIn35mmFilm, mm
    return block.tobytes()


def heif_enc(*arguments):
    subprocess.run(["heif-enc", *map(str, arguments)], check=True)


def main():
    y, x = np.mgrid[0:48, 0:64]
    colour = np.stack([40 + 2 * x, 60 + 3 * y, 200 - x - y], -1).astype(np.uint8)
    colour = Image.fromarray(colour)
    grey = Image.fromarray((30 + 3 * x + y // 2).clip(0, 255).astype(np.uint8))
    heic = GOLDENS / "heic"
    heic.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        colour.save(folder / "colour.png")
        grey.save(folder / "grey.png")
        colour.save(folder / "turned.jpg", quality=98, subsampling=0, exif=exif(6))
        heif_enc("-q", 90, folder / "colour.png", "-o", heic / "colour.heic")
        heif_enc("-q", 90, folder / "grey.png", "-o", heic / "grey.heic")
        # This version of heif-enc copies EXIF and writes no rotation.
        heif_enc("-q", 90, folder / "turned.jpg", "-o", heic / "exif_turned.heic")
        heif_enc("-A", "-q", 60, folder / "colour.png", "-o", heic / "colour.avif")
    pillow_heif.register_heif_opener()
    for name, orientation in [("rotated", 6), ("mirrored", 5)]:
        # pillow-heif converts the orientation to irot and imir, and keeps it in EXIF.
        path = heic / f"{name}.heic"
        colour.save(path, quality=90, chroma=444, exif=exif(orientation))
    photographs = GOLDENS / "photographs"
    photographs.mkdir(exist_ok=True)
    colour.save(photographs / "lossy.webp", quality=90)


main()
