"""Plots loss and PSNR of trainings as one SVG. Needs the standard library only.

    python3 tools/lab/train/curves.py OUT.svg NAME=out/run/log.csv ...
"""

import csv
import pathlib
import sys
from html import escape

WIDTH, HEIGHT, LEFT, TOP, GAP = 380, 220, 48, 28, 64
COLOURS = ("#1b6ca8", "#c8553d", "#3a7d44", "#7d3a78")
PANELS = (("loss", "loss"), ("psnr", "PSNR of the training views, dB"))


def read(path):
    """Reads step, loss and PSNR of a log."""
    with open(path, newline="") as file:
        return [{key: float(row[key]) for key in ("step", "loss", "psnr")} for row in csv.DictReader(file)]


def smoothed(values, half=3):
    """Returns means of up to 2 * half + 1 neighbours."""
    parts = (values[max(0, i - half) : i + half + 1] for i in range(len(values)))
    return [sum(part) / len(part) for part in parts]


def panel(left, key, title, runs):
    """Draws one quantity of all runs as SVG elements."""
    curves = {name: ([r["step"] for r in rows], smoothed([r[key] for r in rows])) for name, rows in runs.items()}
    last = max(max(steps) for steps, _ in curves.values())
    low = min(min(values) for _, values in curves.values())
    high = max(max(values) for _, values in curves.values())
    x = lambda step: left + WIDTH * step / last
    y = lambda value: TOP + HEIGHT * (high - value) / max(high - low, 1e-9)
    out = [f'<text x="{left}" y="{TOP - 10}">{escape(title)}</text>']
    for i in range(5):
        value, step = low + (high - low) * i / 4, last * i / 4
        out.append(f'<path d="M{left} {y(value):.1f}h{WIDTH}" stroke="#ddd"/>')
        out.append(f'<text x="{left - 6}" y="{y(value) + 4:.1f}" text-anchor="end">{value:.2f}</text>')
        out.append(f'<text x="{x(step):.1f}" y="{TOP + HEIGHT + 18}" text-anchor="middle">{step:.0f}</text>')
    for (name, (steps, values)), colour in zip(curves.items(), COLOURS):
        points = " ".join(f"{x(s):.1f},{y(v):.1f}" for s, v in zip(steps, values))
        out.append(f'<polyline points="{points}" fill="none" stroke="{colour}" stroke-width="1.5"/>')
    return out


def main(arguments):
    if len(arguments) < 2 or len(arguments) > 1 + len(COLOURS) or not all("=" in argument for argument in arguments[1:]):
        raise SystemExit(__doc__)
    runs = {name: read(path) for name, path in (argument.split("=", 1) for argument in arguments[1:])}
    if not all(runs.values()):
        raise SystemExit("curves: expected rows in every log, got an empty one")
    width, height = 2 * (LEFT + WIDTH) + GAP, TOP + HEIGHT + 48
    out = [f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" font-family="sans-serif" font-size="11">',
           f'<rect width="{width}" height="{height}" fill="#fff"/>']
    for i, (key, title) in enumerate(PANELS):
        out += panel(LEFT + i * (WIDTH + GAP), key, title, runs)
    for i, (name, colour) in enumerate(zip(runs, COLOURS)):
        at = LEFT + 110 * i
        out.append(f'<path d="M{at} {height - 10}h18" stroke="{colour}" stroke-width="2"/>')
        out.append(f'<text x="{at + 24}" y="{height - 6}">{escape(name)}</text>')
    pathlib.Path(arguments[0]).write_text("\n".join([*out, "</svg>"]) + "\n")


main(sys.argv[1:])
