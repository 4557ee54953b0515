#!/usr/bin/env bash
# Tests the page and an exported scene in headless Chromium (software WebGL2 and WebGPU), from a release
# build of the programs. `test.sh page`, `test.sh export` and `test.sh network` run one of the three.
# Before them, the unit tests of the SIMD level simd128 run under node.
set -euo pipefail
cd "$(dirname "$0")/../.."
# Only missing packages: Debian's npm conflicts with other builds of nodejs.
missing=()
command -v chromium >/dev/null || missing+=(chromium)
command -v npm >/dev/null || missing+=(nodejs npm)
[[ ${#missing[@]} -eq 0 ]] ||
    { apt-get update && apt-get install -y --no-install-recommends "${missing[@]}"; }
place=out/web-test
mkdir -p "$place"

# The modules of kernels/src/cpu/simd import nothing else of the crate, so they make a crate of their own.
# wasm32-wasip1 has the same instructions as the page's target, and a standard output.
rustup target add wasm32-wasip1
simd=$place/simd
rm -rf "$simd" && mkdir -p "$simd/cpu"
cp -r kernels/src/cpu/simd.rs kernels/src/cpu/simd "$simd/cpu"
echo '#![allow(dead_code, unused_imports)] pub mod cpu { pub mod simd; }' >"$simd/tests.rs"
rustc --test --edition 2024 -O --target wasm32-wasip1 -C target-feature=+simd128 \
    "$simd/tests.rs" -o "$simd/tests.wasm"
node --no-warnings tools/web/wasi.mjs "$simd/tests.wasm"

[[ -d $place/node_modules/playwright-core ]] ||
    npm install --prefix "$place" --no-audit --no-fund --silent playwright-core@1.65.1
rm -rf "$place/test"
cp -r tools/web/test.mjs tools/web/test "$place"
tools/web/build.sh "$place/site"
export SUBSPLAT="${CARGO_TARGET_DIR:-target}/release/subsplat"
exec node "$place/test.mjs" "$@"
