#!/usr/bin/env python3
"""Adds the executions of rounds.sh's log to the table of README.md, and prints the sums and the slowest input.

    tests/fuzz/count.py [LOG] [--sanitizer]

LOG is out/fuzz/log.tsv by default. `--sanitizer`: the reader had AddressSanitizer. The log is renamed to LOG.counted, so
that no slice is counted twice.
"""
import argparse
import pathlib
import re

HERE = pathlib.Path(__file__).resolve().parent
# | `target` | reads | with AddressSanitizer | without | failures |
ROW = re.compile(r"^\| `(\w+)` \| (.*) \| ([\d,–]+) \| ([\d,–]+) \| ([\d–]+) \|$")


def number(cell: str) -> int:
    return 0 if cell == "–" else int(cell.replace(",", ""))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", nargs="?", type=pathlib.Path, default=pathlib.Path("out/fuzz/log.tsv"))
    parser.add_argument("--sanitizer", action="store_true")
    options = parser.parse_args()
    slices: dict[str, list[tuple[int, int, int]]] = {}
    for line in options.log.read_text().splitlines():
        target, executions, seconds, status, _ = line.split("\t")
        # A target that the reader lacks executes nothing.
        if executions:
            slices.setdefault(target, []).append((int(executions), int(seconds), int(status)))
    readme = HERE / "README.md"
    lines, sums, unknown = [], [0, 0], set(slices)
    for line in readme.read_text().splitlines():
        if row := ROW.match(line):
            target, reads, *cells = row.groups()
            counts = [number(cell) for cell in cells]
            unknown.discard(target)
            for executions, _, status in slices.get(target, []):
                counts[0 if options.sanitizer else 1] += executions
                counts[2] += status != 0
            sums = [sums[0] + counts[0], sums[1] + counts[1]]
            ran = counts[0] + counts[1] > 0
            shown = [f"{count:,}" if count else "–" for count in counts[:2]] + [str(counts[2]) if ran else "–"]
            line = f"| `{target}` | {reads} | {' | '.join(shown)} |"
        lines.append(line)
    if unknown:
        raise SystemExit(f"error: README.md has no row for {', '.join(sorted(unknown))}")
    readme.write_text("\n".join(lines) + "\n")
    options.log.rename(options.log.with_name(options.log.name + ".counted"))
    slowest = max((seconds, target) for target, all in slices.items() for _, seconds, _ in all)
    print(f"with AddressSanitizer {sums[0]:,}, without {sums[1]:,}; slowest input of this log: {slowest[0]} s, {slowest[1]}")


if __name__ == "__main__":
    main()
