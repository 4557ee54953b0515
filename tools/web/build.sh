#!/usr/bin/env bash
# Builds the page into out/web (or the folder given): static files for any web server.
set -euo pipefail
out=$(realpath -m "${1:-$(dirname "$0")/../../out/web}")
cd "$(dirname "$0")/../.."
target=wasm32-unknown-unknown
places=${CARGO_TARGET_DIR:-target}
rustup target list --installed 2>/dev/null | grep -qx $target || rustup target add $target
echo "compiling the library for $target (the first time about 5 minutes on one core) …" >&2
cargo rustc --locked --release --quiet -p subsplat-web --lib --crate-type cdylib --target $target \
    -- -C link-arg=-zstack-size=4194304
echo "writing the imports of WebGPU …" >&2
# wgpu declares its imports with wasm-bindgen, whose library writes them as JavaScript.
cargo run --locked --release --quiet --manifest-path tools/web/bindgen/Cargo.toml \
    --target-dir "$places/web-bindgen" -- "$places/$target/release/subsplat_web.wasm" "$places/web-bindgen/out"

mkdir -p "$out"
# Servers like `python3 -m http.server` compress nothing; the page unpacks the file itself.
gzip -9 -n -c "$places/web-bindgen/out/subsplat_bg.wasm" >"$out/subsplat.wasm.gz"
files=(index.html page.css page.js scene.html video.js viewer.css worker.js)
cp "${files[@]/#/tools/web/}" "$places/web-bindgen/out/subsplat_bg.js" "$out"
cat tools/web/viewer/*.js >"$out/viewer.js"
cd "$out"
bytes=$(cat "${files[@]}" viewer.js subsplat_bg.js subsplat.wasm.gz | wc -c)
printf '%s: %d bytes\n' "$out" "$bytes"
((bytes <= 6000000)) || { echo "error: expected at most 6000000 bytes" >&2; exit 1; }
