#!/bin/sh
# Evaluates part I of N, unless it is complete: for any engine that starts a command for each number.
#
#   part.sh I N OUT ARGUMENTS...    runs `subsplat-lab eval ARGUMENTS --shard I/N -o OUT/partI`
#
# `targets.csv` is written whole, after the last case, so that a part that was killed has none and is
# evaluated again from its first case. SUBSPLAT_LAB names the program (default: subsplat-lab).
set -eu
part=$1 count=$2 out=$3
shift 3
[ -f "$out/part$part/targets.csv" ] && exit 0
exec "${SUBSPLAT_LAB:-subsplat-lab}" eval "$@" --shard "$part/$count" -o "$out/part$part"
