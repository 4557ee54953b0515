#!/usr/bin/env bash
# Builds the page into out/web (or the folder given): static files for any web server.
#
# rust-lld links the library itself, because rustc would also export the functions that
# wasm-bindgen's crates declare under candle; they would need glue that nothing here calls.
set -euo pipefail
out=$(realpath -m "${1:-$(dirname "$0")/../../out/web}")
cd "$(dirname "$0")/../.."
target=wasm32-unknown-unknown
rustup target list --installed 2>/dev/null | grep -qx $target || rustup target add $target
cargo rustc --locked --release --quiet -p subsplat-web --lib --crate-type staticlib --target $target

host=$(rustc -vV | sed -n 's/^host: //p')
exports=$(sed -n 's/^pub extern "C" fn \([a-z_]*\)(.*/--export=\1/p' tools/web/wasm/src/lib.rs)
mkdir -p "$out"
# shellcheck disable=SC2086  # one argument each
"$(rustc --print sysroot)/lib/rustlib/$host/bin/rust-lld" -flavor wasm \
    "${CARGO_TARGET_DIR:-target}/$target/release/libsubsplat_web.a" \
    --no-entry --gc-sections --strip-all --allow-undefined --stack-first -z stack-size=4194304 \
    $exports -o "$out/subsplat.wasm"
# Servers like `python3 -m http.server` compress nothing; the worker unpacks the file itself.
gzip -9 -n -f "$out/subsplat.wasm"
cp tools/web/{index.html,page.css,page.js,viewer.css,viewer.js,worker.js} "$out"
bytes=$(cat "$out"/{index.html,page.css,page.js,viewer.css,viewer.js,worker.js,subsplat.wasm.gz} | wc -c)
printf '%s: %d bytes\n' "$out" "$bytes"
((bytes <= 6000000)) || { echo "error: expected at most 6000000 bytes" >&2; exit 1; }
