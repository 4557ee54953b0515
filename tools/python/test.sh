#!/usr/bin/env bash
# Builds the wheel in the repository's target folder, installs it in a virtual environment of its own, and runs
# the tests. Arguments go to pytest.
#
# PYTHON: the interpreter. SUBSPLAT_WHEEL_FEATURES: features of the crate, such as heic. PyTorch is not installed:
# its tests run where the environment's Python has it (SUBSPLAT_VENV_ARGUMENTS=--system-site-packages with a
# system's PyTorch), and are skipped aloud elsewhere.
set -euo pipefail
cd "$(dirname "$0")/../.."
export CARGO_TARGET_DIR="${CARGO_TARGET_DIR:-$PWD/target}"
out="${SUBSPLAT_PYTHON_OUT:-$PWD/out/python}"
python="${PYTHON:-python3}"

rm -rf "$out"
mkdir -p "$out"
# shellcheck disable=SC2086
"$python" -m venv ${SUBSPLAT_VENV_ARGUMENTS:-} "$out/venv"
"$out/venv/bin/pip" install --quiet --disable-pip-version-check 'maturin>=1.9,<2' numpy pillow pytest
"$out/venv/bin/maturin" build --locked --quiet --release --out "$out" \
    --features "${SUBSPLAT_WHEEL_FEATURES:-}" \
    --interpreter "$out/venv/bin/python" --manifest-path tools/python/Cargo.toml
"$out/venv/bin/pip" install --quiet --disable-pip-version-check --no-deps "$out"/subsplat-*.whl
# Away from the sources, so that the installed package is the one that is imported.
cd "$out"
venv/bin/python -m pytest -q -rs --rootdir "$OLDPWD/tools/python" "$OLDPWD/tools/python/tests" "$@"
