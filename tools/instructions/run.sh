#!/usr/bin/env bash
# Prints the instructions per product, number or pixel of the kernels with AVX2 and with NEON, counted by
# QEMU's emulators of both processors. A kernel's count is the difference of programs that run it three
# times and once, so that start and inputs cancel. Needs Debian's qemu-user, gcc and
# gcc-aarch64-linux-gnu with libc6-dev-arm64-cross.
set -euo pipefail
cd "$(dirname "$0")/../.."
target="${CARGO_TARGET_DIR:-$PWD/target}"
export CARGO_TARGET_DIR="$target" CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
plugin="$target/instructions/count.so"
mkdir -p "$target/instructions"
gcc -O2 -Wall -Wextra -shared -fPIC -o "$plugin" tools/instructions/count.c
for platform in x86_64 aarch64; do
    rustup target add --toolchain "$(rustup show active-toolchain | cut -d' ' -f1)" $platform-unknown-linux-gnu 2>/dev/null
    cargo build --locked --release --quiet -p subsplat-lab --no-default-features \
        --target $platform-unknown-linux-gnu --example one_kernel
done

# instructions EMULATOR LEVEL PLATFORM KERNEL REPEATS
instructions() {
    "$1" -plugin "$plugin" -E SUBSPLAT_SIMD="$2" \
        "$target/$3-unknown-linux-gnu/release/examples/one_kernel" "$4" "$5" 2>&1 >/dev/null |
        sed -n 's/^instructions //p'
}

# per_unit EMULATOR LEVEL PLATFORM KERNEL UNITS
per_unit() {
    local three one
    three=$(instructions "$1" "$2" "$3" "$4" 3)
    one=$(instructions "$1" "$2" "$3" "$4" 1)
    awk -v d=$((three - one)) -v u="$5" 'BEGIN { printf "%.4f", d / 2 / u }'
}

export QEMU_LD_PREFIX=
printf '| kernel | units | AVX2 | NEON | ratio |\n|---|---|---|---|---|\n'
for kernel in product conv1x1 conv3x3 conv3x3s2 softmax forward backward; do
    units=$("$target/x86_64-unknown-linux-gnu/release/examples/one_kernel" $kernel 0)
    avx2=$(QEMU_CPU=max per_unit qemu-x86_64 avx2 x86_64 $kernel "$units")
    neon=$(QEMU_LD_PREFIX=/usr/aarch64-linux-gnu per_unit qemu-aarch64 neon aarch64 $kernel "$units")
    awk -v k=$kernel -v u="$units" -v a="$avx2" -v n="$neon" \
        'BEGIN { printf "| %s | %d | %s | %s | %.2f |\n", k, u, a, n, n / a }'
done
