#!/usr/bin/env bash
# Packs the kit for a borrowed GPU: one script of less than 64 MiB that unpacks itself and runs run.sh.
#
#   tools/lab/gpu/pack.sh CONFIG FOLDER [KIT]     KIT: default out/gpu-kit.sh
#
# CONFIG and FOLDER are those of a training (`subsplat-lab train CONFIG -o FOLDER`) that has a checkpoint.
# SUBSPLAT_LAB and KIT_BENCHES name a program and a folder with the benches `device` and `raster` that are built;
# otherwise this builds them. The other machine needs bash, tar, gzip, glibc as new as here's, and a driver of Vulkan;
# neither Rust nor a network. MVSplat's weights and reference (85 MB) do not fit in: run.sh finds them there.
set -euo pipefail
cd "$(dirname "$0")/../../.."
[ $# -ge 2 ] || { sed -n '2,10s/^# \{0,1\}//p' "$0" >&2; exit 2; }
config=$1 folder=$2 kit=${3:-out/gpu-kit.sh}
target=${CARGO_TARGET_DIR:-target}
checkpoint=$(ls "$folder"/step-*.safetensors 2>/dev/null | tail -1)
[ -n "$checkpoint" ] || { echo "error: $folder: expected a checkpoint, found none" >&2; exit 1; }
lab=${SUBSPLAT_LAB:-}
if [ -z "$lab" ]; then
    cargo build --locked --release -p subsplat-lab
    lab=$target/release/subsplat-lab
fi
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
mkdir -p "$work"/{bin,lib,goldens/raster,train}
strip -o "$work/bin/subsplat-lab" "$lab"
for bench in device raster; do
    if [ -n "${KIT_BENCHES:-}" ]; then
        program=$KIT_BENCHES/$bench
    else
        log=$(cargo bench --locked --no-run --bench $bench --message-format short 2>&1) || { echo "$log" >&2; exit 1; }
        program=$(sed -n 's/.*(\(.*\))$/\1/p' <<<"$log" | tail -1)
    fi
    [ -f "$program" ] && strip -o "$work/bin/$bench" "$program"
done
# The loader of Vulkan, a library of half a megabyte that needs glibc alone.
loader=$(ldconfig -p | awk '/libvulkan\.so\.1 .*x86-64/ { print $NF; exit }')
[ -n "$loader" ] && cp -L "$loader" "$work/lib/libvulkan.so.1"
cp tests/goldens/raster/*.safetensors "$work/goldens/raster/"
cp tools/lab/gpu/run.sh tools/lab/gpu/torch_convolutions.py "$work/"
cp "$checkpoint" "$folder"/*.csv "$work/train/"
# `device` is a key of the whole configuration, `workers` one of its table `data`.
{ echo 'device = "gpu"'; grep -v '^device = ' "$config" | sed '/^workers = /d; s/^\[data\]$/[data]\nworkers = 1/'; } >"$work/train/config.toml"
{
    echo "$(git rev-parse --short HEAD 2>/dev/null || echo unknown), $(basename "$checkpoint") of $(basename "$folder")"
    (cd "$work" && find . -type f -printf '%s %p\n' | sort -k2)
} >"$work/kit.txt"
mkdir -p "$(dirname "$kit")"
cat >"$kit" <<'HEAD'
#!/bin/bash
# Kit of subsplat for a borrowed GPU (tools/lab/gpu): unpacks itself and runs run.sh.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
sed '1,/^# archive$/d' "$0" | tar -xzf - -C "$folder"
code=0
bash "$folder/run.sh" || code=$?
exit $code
# archive
HEAD
tar -C "$work" -cf - . | gzip -9 >>"$kit"
chmod +x "$kit"
bytes=$(stat -c %s "$kit")
echo "$kit: $((bytes / 1048576)) MiB"
[ "$bytes" -lt $((64 * 1048576)) ] || { echo "error: $kit: expected less than 64 MiB" >&2; exit 1; }
