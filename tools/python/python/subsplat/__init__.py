"""3D Gaussians from photographs, and a differentiable rasterizer of 3D Gaussians, on any CPU.

>>> import subsplat
>>> scene = subsplat.reconstruct("examples/berlin")
>>> scene.save("berlin.html")

Conventions, everywhere: OpenCV axes (+x right, +y down, +z forward); ``viewmat`` maps world to camera; ``K``
in px, pixel centres at +0.5; quaternions are wxyz; scales are standard deviations in world units, not
logarithms; opacities lie in [0, 1], after the sigmoid. Arrays are float32 and C-contiguous, and are read in
place.

``subsplat.torch`` has the rasterizer for tensors. PyTorch is imported when it is first used.
"""

from typing import Any

from ._native import Camera, __version__
from .photographs import (
    Estimate,
    Photograph,
    check,
    estimate_cameras,
    photographs,
    reconstruct,
)
from .raster import Rasterized, rasterize, rasterize_backward
from .scene import Picture, Scene, Splats, Verdict, convert, load

__all__ = [
    "Camera",
    "Estimate",
    "Photograph",
    "Picture",
    "Rasterized",
    "Scene",
    "Splats",
    "Verdict",
    "check",
    "convert",
    "estimate_cameras",
    "load",
    "photographs",
    "rasterize",
    "rasterize_backward",
    "reconstruct",
    "torch",
]


def __getattr__(name: str) -> Any:
    if name == "torch":
        import importlib

        return importlib.import_module(".torch", __name__)
    raise AttributeError(f"module 'subsplat' has no attribute {name!r}")
