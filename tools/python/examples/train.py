"""Optimises the Gaussians of a room with PyTorch on a CPU; beside it the optimiser of the library.

    python tools/python/examples/train.py [FOLDER] [--use 0,1] [--gaussians 150000] [--steps 60]

FOLDER has photographs with cameras (examples/room). Those of --use make the scene; the others measure it.
"""

import argparse
import math
import time
from pathlib import Path

import torch

import subsplat
from subsplat.torch import rasterization

# Learning rates of 3DGS; those of lengths are relative to the scene's extent.
RATES = {"means": 1.6e-4, "quats": 1e-3, "log_scales": 5e-3, "logits": 5e-2, "sh": 2.5e-3}


def psnr(scene, photographs):
    """Mean PSNR of rendered pictures against photographs, dB."""
    total = 0.0
    for photograph in photographs:
        truth = torch.from_numpy(photograph.image) / 255
        picture = torch.from_numpy(scene.render(photograph.camera).rgb).clamp(0, 1)
        total -= 10 * math.log10((picture - truth).square().mean())
    return total / len(photographs)


def parameters(splats):
    """What Adam moves, as leaves: scales as logarithms, opacities as logits."""
    values = {
        "means": torch.from_numpy(splats.means),
        "quats": torch.from_numpy(splats.quats),
        "log_scales": torch.from_numpy(splats.scales).clamp(min=1e-8).log(),
        "logits": torch.from_numpy(splats.opacities).clamp(1e-5, 1 - 1e-5).logit(),
        "sh": torch.from_numpy(splats.sh),
    }
    return {name: value.clone().requires_grad_() for name, value in values.items()}


def train(scene, photographs, steps):
    """Returns the scene after `steps` steps of Adam, one photograph each."""
    leaves = parameters(scene.splats)
    extent = (leaves["means"] - leaves["means"].mean(0)).norm(dim=1).median().item()
    rate = {name: RATES[name] * (extent if name == "means" else 1) for name in leaves}
    adam = torch.optim.Adam([{"params": [leaves[n]], "lr": rate[n]} for n in leaves], eps=1e-15)
    degree = math.isqrt(leaves["sh"].shape[1]) - 1
    for step in range(steps):
        photograph = photographs[step % len(photographs)]
        camera = photograph.camera
        picture, _, _ = rasterization(
            leaves["means"], leaves["quats"], leaves["log_scales"].exp(),
            leaves["logits"].sigmoid(), leaves["sh"],
            torch.from_numpy(camera.viewmat)[None], torch.from_numpy(camera.K)[None],
            camera.width, camera.height, sh_degree=degree,
        )
        truth = torch.from_numpy(photograph.image) / 255
        loss = (picture[0] - truth).abs().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        if step % 10 == 0:
            print(f"step {step}: {loss.item():.4f}")
    with torch.no_grad():
        scales, opacities = leaves["log_scales"].exp(), leaves["logits"].sigmoid()
    arrays = (leaves["means"], leaves["quats"], scales, opacities, leaves["sh"])
    return subsplat.Scene(*(a.detach().contiguous().numpy() for a in arrays))


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", nargs="?", default=Path(__file__).parents[3] / "examples/room")
    parser.add_argument("--use", default="0,1", help="indices of the photographs")
    parser.add_argument("--gaussians", type=int, default=150_000)
    parser.add_argument("--steps", type=int, default=60)
    arguments = parser.parse_args()
    photographs = subsplat.photographs(arguments.folder)
    used = [int(i) for i in arguments.use.split(",")]
    chosen = [photographs[i] for i in used]
    held_out = [p for i, p in enumerate(photographs) if i not in used]
    inputs = [p.image for p in chosen], [p.camera for p in chosen]
    limit = {"gaussians": arguments.gaussians}
    start = subsplat.reconstruct(*inputs, **limit, refine_seconds=0)
    print(f"{len(start)} Gaussians, {psnr(start, held_out):.2f} dB at photographs that were not used")
    began = time.perf_counter()
    trained = train(start, chosen, arguments.steps)
    seconds = time.perf_counter() - began
    print(f"PyTorch: {psnr(trained, held_out):.2f} dB, {arguments.steps} steps in {seconds:.1f} s")
    began = time.perf_counter()
    refined = subsplat.reconstruct(*inputs, **limit, refine_seconds=max(1, round(seconds)))
    seconds = time.perf_counter() - began
    print(f"the library's optimiser: {psnr(refined, held_out):.2f} dB, {len(refined)} Gaussians, all in {seconds:.1f} s")


if __name__ == "__main__":
    main()
