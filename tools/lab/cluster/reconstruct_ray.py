#!/usr/bin/env python3
"""Makes a scene of each folder of photographs, over the processes of a Ray cluster.

    reconstruct_ray.py OUT FOLDER... [--cpus N] [--quality NAME] [--format EXT] [--address ADDRESS]

Needs the wheel of tools/python and `pip install ray` on every machine, and folders that all of them see. A
scene goes to OUT/NAME.EXT, NAME as the folder's, and is written whole: what OUT holds is not made again.
Ray starts a scene again whose worker died, three times. A last line counts the scenes; the exit code
is 1 where one is absent.
"""

import argparse
import os
import sys
import time
from pathlib import Path

import ray


def make(folder: str, file: str, quality: str) -> dict:
    """Makes one scene, unless it exists."""
    if os.path.exists(file):
        return {"made": False}
    import subsplat

    begin = time.monotonic()
    scene = subsplat.reconstruct(folder, quality=quality)
    root, extension = os.path.splitext(file)
    # Under a name of its own: two attempts do not write one file.
    part = f"{root}.part-{os.getpid()}{extension}"
    scene.save(part)
    os.replace(part, file)
    return {"made": True, "seconds": time.monotonic() - begin, "verdict": str(scene.verdict)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--cpus", type=int, default=1, help="threads of a scene (default 1)")
    parser.add_argument("--quality", default="normal", help="fast, normal, high or best")
    parser.add_argument("--format", default="ply", help="ply, spz, glb, …")
    parser.add_argument("--address", help="of a running cluster; without it, this machine alone")
    args = parser.parse_args()
    names = [folder.resolve().name for folder in args.folders]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        parser.error(f"expected folders of different names, found {', '.join(twice)} twice")
    args.out.mkdir(parents=True, exist_ok=True)
    ray.init(address=args.address, log_to_driver=False, include_dashboard=False)
    environment = {"env_vars": {"RAYON_NUM_THREADS": str(args.cpus)}}
    remote = ray.remote(num_cpus=args.cpus, max_retries=3, runtime_env=environment)(make)
    file = {name: args.out.resolve() / f"{name}.{args.format}" for name in names}
    waiting = {
        remote.remote(str(folder.resolve()), str(file[name]), args.quality): name
        for folder, name in zip(args.folders, names)
    }
    counts = {"made": 0, "there before": 0, "failed": 0}
    while waiting:
        [done], _ = ray.wait(list(waiting), num_returns=1)
        name = waiting.pop(done)
        try:
            result = ray.get(done)
        except Exception as error:  # A scene's own failure must not end the others.
            counts["failed"] += 1
            cause = getattr(error, "cause", None) or error
            print(f"{name}: error: {str(cause).strip().splitlines()[-1]}", file=sys.stderr, flush=True)
            continue
        counts["made" if result["made"] else "there before"] += 1
        if result["made"]:
            print(f"{name}: {result['seconds']:.1f} s, {result['verdict']}", flush=True)
    absent = [name for name in names if not file[name].is_file()]
    print(f"{len(names)} scenes: " + ", ".join(f"{n} {what}" for what, n in counts.items()))
    return 1 if absent else 0


if __name__ == "__main__":
    sys.exit(main())
