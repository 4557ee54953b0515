#!/bin/bash
# Runs on the borrowed machine, in the unpacked kit (pack.sh). Writes to $OUT (default: kit-out).
#
#   KIT_SECONDS   seconds in all, 60 to 540 (default 540)
#   KIT_DEVICE    device as of `compare --device` (default gpu)
#   KIT_SIDE      side of the bench's pictures, px (default 256)
#   GOLDEN        folder of MVSplat's weights and reference (default: shared/golden or ../shared/golden, if present)
#   KIT_MARGIN    seconds at the end for the training's last step and its scores (default 20)
#   KIT_WORKERS   threads that make training scenes (default: all but two, at least one)
#
# Stages: (a) every golden on the GPU, (b) the benches, beside PyTorch where it is, (c) training from the newest
# checkpoint until the time ends. A stage that fails or runs late does not stop the next one. summary.txt
# has a line a check; the exit code is 1 where one failed.
set -u
kit=$(cd "$(dirname "$0")" && pwd)
out=${OUT:-kit-out}
mkdir -p "$out"
out=$(cd "$out" && pwd)
seconds=${KIT_SECONDS:-540}
[ "$seconds" -ge 60 ] && [ "$seconds" -le 540 ] ||
    { echo "error: KIT_SECONDS: expected 60 to 540, found $seconds" >&2; exit 2; }
device=${KIT_DEVICE:-gpu} side=${KIT_SIDE:-256}
begin=$(date +%s) failed=0
# Seconds that are left, less $1.
left() { echo $((seconds - $1 - $(date +%s) + begin)); }
note() { printf '%4d s  %s\n' $(($(date +%s) - begin)) "$*" | tee -a "$out/summary.txt"; }
# check NAME LIMIT COMMAND...: output in NAME.log, a line in the summary.
check() {
    local name=$1 limit=$2 code=0
    shift 2
    [ "$limit" -gt 3 ] || { note "$name: no time"; failed=1; return; }
    timeout --kill-after=5 "$limit" "$@" >"$out/$name.log" 2>&1 || code=$?
    case $code in
        0) note "$name: ok" ;;
        124 | 137) note "$name: not done after $limit s"; failed=1 ;;
        *) note "$name: exit code $code: $(grep -v '^$' "$out/$name.log" | tail -1 | cut -c1-200)"; failed=1 ;;
    esac
}

# A loader of Vulkan, if the machine has none; NVIDIA's driver by its library, where a container has no
# manifest of it.
ldconfig -p 2>/dev/null | grep -q 'libvulkan\.so\.1' || export LD_LIBRARY_PATH="$kit/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}"
if [ -z "${VK_DRIVER_FILES:-}" ] && ! ls /usr/share/vulkan/icd.d/*.json /etc/vulkan/icd.d/*.json >/dev/null 2>&1; then
    for library in libGLX_nvidia.so.0 libEGL_nvidia.so.0; do
        ldconfig -p 2>/dev/null | grep -q "$library" || continue
        printf '{"file_format_version": "1.0.0", "ICD": {"library_path": "%s", "api_version": "1.3.0"}}\n' \
            "$library" >"$out/nvidia_icd.json"
        export VK_DRIVER_FILES="$out/nvidia_icd.json" VK_ICD_FILENAMES="$out/nvidia_icd.json"
        break
    done
fi
export XDG_RUNTIME_DIR="${XDG_RUNTIME_DIR:-/tmp}"
{
    uname -a; nproc; grep -m1 'model name' /proc/cpuinfo; free -m
    nvidia-smi 2>&1 | head -20
    ldconfig -p | grep -i 'vulkan\|nvidia' | head -40
    ls -l /usr/share/vulkan/icd.d /etc/vulkan/icd.d 2>&1
    ldd "$kit/bin/subsplat-lab"; cat "$kit/kit.txt"
} >"$out/machine.log" 2>&1
note "kit: $(head -1 "$kit/kit.txt"); $seconds s, device $device"

# (a) 40 s at most a golden, 2 minutes in all.
for golden in "$kit"/goldens/raster/*.safetensors; do
    limit=$(left $((seconds - 120)))
    check "compare-$(basename "$golden" .safetensors)" $((limit < 40 ? limit : 40)) \
        "$kit/bin/subsplat-lab" compare --reference "$golden" --device "$device"
done
golden=${GOLDEN:-$(ls -d shared/golden ../shared/golden 2>/dev/null | head -1)}
if [ -f "$golden/mvsplat_weights.safetensors" ]; then
    limit=$(left $((seconds - 150)))
    check compare-encoder $((limit < 90 ? limit : 90)) "$kit/bin/subsplat-lab" compare --device "$device" \
        --weights "$golden/mvsplat_weights.safetensors" --reference "$golden/mvsplat_64x64_b1v2.safetensors"
else
    note "compare-encoder: no reference here"
fi

# (b) 4 minutes in all, less where the time is short: a third is left for the training.
share() { local n; n=$(left $((seconds / 3))); echo $((n < $1 ? n : $1)); }
for network in small mvsplat; do
    check "bench-$network" "$(share 60)" "$kit/bin/device" $network --side "$side" --device "$device"
done
check bench-subgroups "$(share 30)" "$kit/bin/device" --subgroups
check bench-convolutions "$(share 40)" "$kit/bin/device" --convolutions --side "$side" --device "$device"
if python3 -c 'import torch' >/dev/null 2>&1; then
    check bench-torch "$(share 60)" sh -c \
        '"$1/torch_convolutions.py" <"$2/bench-convolutions.log"' sh "$kit" "$out"
else
    note "bench-torch: no PyTorch here"
fi
if [ -x "$kit/bin/raster" ]; then
    check bench-raster "$(share 60)" "$kit/bin/raster" --bench --quick own
fi

# (c) Until some seconds before the end, which the last checkpoint and its scores take.
cores=$(nproc)
workers=${KIT_WORKERS:-$((cores > 2 ? cores - 2 : 1))}
mkdir -p "$out/train"
cp "$kit"/train/step-*.safetensors "$kit"/train/*.csv "$out/train/" 2>/dev/null
sed "s/^device = .*/device = \"$device\"/; s/^workers = .*/workers = $workers/" "$kit/train/config.toml" >"$out/train/config.toml"
limit=$(left 5)
minutes=$(awk "BEGIN { print ($(left "${KIT_MARGIN:-20}")) / 60 }")
check train "$limit" "$kit/bin/subsplat-lab" train "$out/train/config.toml" -o "$out/train" --minutes "$minutes"
# The newest checkpoint alone comes back.
ls "$out"/train/step-*.safetensors 2>/dev/null | head -n -1 | xargs -r rm
note "$(tail -1 "$out/train.log" | cut -c1-200)"
exit $failed
