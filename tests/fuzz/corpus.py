#!/usr/bin/env python3
"""Archives of the corpus: one .zip for each fuzz target, so that thousands of files are 43.

    tests/fuzz/corpus.py unpack TARGET FOLDER    the committed inputs, as files
    tests/fuzz/corpus.py pack TARGET FOLDER      the files of a folder, as the committed inputs

The same files give the same bytes."""

import sys
import zipfile
from pathlib import Path


def main(action, target, folder):
    archive, folder = Path(__file__).parent / "corpus" / f"{target}.zip", Path(folder)
    if action == "unpack":
        with zipfile.ZipFile(archive) as inputs:
            inputs.extractall(folder)
    elif action == "pack":
        with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as inputs:
            for path in sorted(p for p in folder.iterdir() if p.is_file()):
                # A fixed date.
                inputs.writestr(zipfile.ZipInfo(path.name), path.read_bytes(), zipfile.ZIP_DEFLATED, 9)
    else:
        sys.exit(f"expected unpack or pack, got {action}")


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    main(*sys.argv[1:])
