#!/usr/bin/env bash
# Runs every fuzz target for some seconds, one after another, and goes on where the last call ended.
#
#   tests/fuzz/rounds.sh SECONDS [TARGET…]
#
# CORPUS (out/fuzz/corpus) has what the fuzzer found, beside the committed corpus; LOG (out/fuzz/log.tsv) has one line a
# slice: target, executions, seconds of the slowest input, exit status, peak memory in MB. Inputs that fail are in
# out/fuzz/failed. READER is the program: `cargo +nightly fuzz build --fuzz-dir tests/fuzz` makes it.
set -euo pipefail
cd "$(dirname "$0")/../.."
seconds=$1
shift
READER=${READER:-tests/fuzz/target/x86_64-unknown-linux-gnu/release/reader}
CORPUS=${CORPUS:-out/fuzz/corpus}
LOG=${LOG:-out/fuzz/log.tsv}
failed=out/fuzz/failed
[ $# -gt 0 ] || set -- $(cd tests/fuzz/corpus && ls | sed 's/\.zip$//')
# Pictures that this build does not read would be handed to ffmpeg and others: the fuzzer would test them.
target_path=$(mktemp -d)
trap 'rmdir "$target_path"' EXIT
# Targets that read files have them in memory where the system has such a folder.
[ -d /dev/shm ] && export TMPDIR=${TMPDIR:-/dev/shm}
mkdir -p "$(dirname "$LOG")"
for target; do
    seeds=out/fuzz/seeds/$target
    mkdir -p "$CORPUS/$target" "$failed/$target" "$seeds"
    tests/fuzz/corpus.py unpack "$target" "$seeds"
    status=0
    SUBSPLAT_FUZZ_TARGET=$target PATH=$target_path "$READER" "$CORPUS/$target" "$seeds" -max_total_time="$seconds" \
        -timeout=10 -rss_limit_mb=3000 -max_len=16384 -report_slow_units=1 -print_final_stats=1 -print_funcs=0 \
        -artifact_prefix="$failed/$target/" >"$LOG.$target" 2>&1 || status=$?
    stat() { sed -n "s/^stat::$1: *//p" "$LOG.$target" | tail -1; }
    printf '%s\t%s\t%s\t%s\t%s\n' "$target" "$(stat number_of_executed_units)" "$(stat slowest_unit_time_sec)" \
        "$status" "$(stat peak_rss_mb)" >>"$LOG"
done
