#!/usr/bin/env bash
# Creates the virtual environment of tools/witness in out/witness-venv (git-ignored) from the wheels
# pinned in requirements.txt. An up-to-date environment is kept. PYTHON names the interpreter
# (python3; 3.11 to 3.13).
set -euo pipefail
here="$(cd "$(dirname "$0")" && pwd)"
venv="$here/../../out/witness-venv"
if ! cmp -s "$here/requirements.txt" "$venv/requirements.txt"; then
    rm -rf "$venv"
    "${PYTHON:-python3}" -m venv "$venv"
    "$venv/bin/pip" install --quiet --disable-pip-version-check --only-binary :all: --require-hashes \
        -r "$here/requirements.txt"
    cp "$here/requirements.txt" "$venv/"
fi
echo "$venv/bin/python"
