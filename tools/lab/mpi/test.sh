#!/usr/bin/env bash
# Tests trainings over MPI: one, two and three ranks give the same bytes; a killed rank ends all with
# an error that names it, and the training goes on from its checkpoint; ranks that do not fit together
# end with one error. Installs Open MPI and libclang on Debian where they are absent.
#
#   tools/lab/mpi/test.sh [PROGRAM]    PROGRAM: subsplat-lab, built with --features mpi
set -euo pipefail
cd "$(dirname "$0")/../../.."

command -v mpirun >/dev/null && command -v mpicc >/dev/null &&
    dpkg -s libclang-dev >/dev/null 2>&1 ||
    { apt-get update && apt-get install -y --no-install-recommends \
        openmpi-bin libopenmpi-dev libclang-dev; }
if [ $# -gt 0 ]; then
    lab=$(realpath "$1")
else
    cargo build --locked --release --quiet -p subsplat-lab --features mpi
    lab=$(realpath "${CARGO_TARGET_DIR:-target}/release/subsplat-lab")
fi
tiny=$PWD/tools/lab/mpi/tiny.toml
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cd "$work"
export RAYON_NUM_THREADS=1
# More ranks than cores, and as root, in a container; the ranks give way while they wait.
mpi=(mpirun --oversubscribe --bind-to none --mca mpi_yield_when_idle 1)
[ "$(id -u)" = 0 ] && mpi+=(--allow-run-as-root)
passed=0
fail() { echo "error: $*" >&2; exit 1; }
pass() { passed=$((passed + 1)); echo "ok: $*"; }

# 1. The same bytes.
for n in 1 2 3; do
    "${mpi[@]}" -n $n "$lab" train "$tiny" -o "ranks$n" --steps 6 >"ranks$n.log" 2>&1 ||
        { cat "ranks$n.log"; fail "a training of $n ranks failed"; }
    grep -q '6 of 40 steps done' "ranks$n.log" || fail "$n ranks: expected 6 steps, found $(tail -1 "ranks$n.log")"
    [ "$(grep -c 'parameters, step 0' "ranks$n.log")" = 1 ] || fail "$n ranks: expected one report"
    cmp "ranks1/weights.safetensors" "ranks$n/weights.safetensors" || fail "$n ranks: other weights"
done
cmp -s ranks1/weights.safetensors <(head -c 1000 ranks1/weights.safetensors) && fail "cmp sees no difference"
pass "1, 2 and 3 ranks write the same weights"

# 2. A killed rank. Each rank writes its process's number before it becomes the program.
"${mpi[@]}" -n 3 sh -c 'echo $$ >pid$OMPI_COMM_WORLD_RANK; exec "$@"' rank \
    "$lab" train "$tiny" -o killed >killed.log 2>&1 &
run=$!
for _ in $(seq 600); do
    ls killed/step-*.safetensors >/dev/null 2>&1 && break
    sleep 0.1
done
kill -KILL "$(cat pid1)"
code=0
wait $run || code=$?
[ $code != 0 ] || fail "a killed rank: expected another exit code than 0"
grep -q 'rank 1 .*signal 9' killed.log || { cat killed.log; fail "a killed rank: expected its name"; }
for rank in 0 2; do
    for _ in $(seq 100); do
        kill -0 "$(cat pid$rank)" 2>/dev/null || continue 2
        sleep 0.1
    done
    fail "rank $rank runs 10 s after rank 1 was killed"
done
at=$(ls killed/step-*.safetensors | tail -1)
"${mpi[@]}" -n 2 "$lab" train "$tiny" -o killed >resumed.log 2>&1 || { cat resumed.log; fail "not resumed"; }
grep -q "continuing from $at" resumed.log || { cat resumed.log; fail "expected to go on from $at"; }
"$lab" train "$tiny" -o whole >whole.log 2>&1 || { cat whole.log; fail "without mpirun"; }
cmp whole/weights.safetensors killed/weights.safetensors || fail "other weights after the kill"
pass "a rank killed after $(basename "$at"): one error; resumed by 2 ranks to the bytes of one process"

# 3. Ranks that do not fit together.
sed 's/^steps = 40/steps = 41/' "$tiny" >other.toml
"${mpi[@]}" -n 1 "$lab" train "$tiny" -o other : -n 1 "$lab" train other.toml -o other >other.log 2>&1 &&
    fail "another configuration: expected an error"
# mpirun ends the second rank that prints it, if the first one has ended before.
grep -q 'rank 1 of 2: expected the configuration' other.log ||
    { cat other.log; fail "another configuration: expected an error with the rank"; }
"${mpi[@]}" -n 1 "$lab" train "$tiny" -o absent : -n 1 "$lab" train absent.toml -o absent >absent.log 2>&1 &&
    fail "an absent configuration: expected an error"
grep -q 'absent.toml.*No such file' absent.log || { cat absent.log; fail "expected the error of rank 1"; }
"${mpi[@]}" -n 7 "$lab" train "$tiny" -o seven >seven.log 2>&1 && fail "7 ranks of 6 groups"
grep -q 'number of ranks: expected at most 6' seven.log || { cat seven.log; fail "7 ranks of 6 groups"; }
pass "ranks of another, an absent and a too small configuration end with one error"
echo "$passed passed, 0 failed"
