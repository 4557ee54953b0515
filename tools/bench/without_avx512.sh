#!/usr/bin/env bash
# Runs a command as on a processor with AVX2 but without AVX-512: onnxruntime, Mesa's llvmpipe and
# this crate then choose AVX2. Measured on an AVX-512 processor with
#
#   tools/bench/without_avx512.sh cargo bench --bench network -- --onnxruntime
#
# Needs a C compiler and x86-64 Linux with CPUID faulting.
set -euo pipefail
here=$(cd "$(dirname "$0")" && pwd)
[ $# -gt 0 ] || { echo "usage: $0 COMMAND [ARGUMENT …]" >&2; exit 2; }
library="$here/../../target/without_avx512.so"
mkdir -p "$(dirname "$library")"
[ "$library" -nt "$here/without_avx512.c" ] ||
    cc -O1 -Wall -shared -fPIC -o "$library" "$here/without_avx512.c"
LD_PRELOAD="$library${LD_PRELOAD:+:$LD_PRELOAD}" exec "$@"
