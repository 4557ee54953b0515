"""The native module. Its functions have no defaults; the package's modules document and call them."""

from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, Optional

import numpy as np
from numpy.typing import NDArray

__version__: str

Floats = NDArray[np.float32]
Progress = Optional[Callable[[str, float], Any]]

class Camera:
    """A pinhole camera without lens distortion.

    viewmat: [4, 4] float32, world to camera (rigid). K: [3, 3] float32, px. width, height: px.
    """

    def __init__(self, viewmat: Floats, K: Floats, width: int, height: int) -> None: ...
    @property
    def viewmat(self) -> Floats: ...
    @property
    def K(self) -> Floats: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    def resized(self, width: int, height: int) -> Camera: ...

class Frame:
    def backward(
        self,
        v_colors: Optional[Floats],
        v_alphas: Optional[Floats],
        v_depth_sums: Optional[Floats],
        viewmats: bool,
    ) -> dict[str, Floats]: ...

class Scene:
    def __init__(
        self, means: Floats, quats: Floats, scales: Floats, opacities: Floats, sh: Floats
    ) -> None: ...
    def __len__(self) -> int: ...
    @property
    def cameras(self) -> list[Camera]: ...
    @property
    def verdict(self) -> Optional[tuple[str, str, str]]: ...
    @property
    def warnings(self) -> list[str]: ...
    def overview(self, side: int) -> Camera: ...
    def splats(self) -> dict[str, Floats]: ...
    def render(
        self, camera: Camera, background: Optional[Sequence[float]]
    ) -> tuple[Floats, Floats, Floats]: ...
    def save(
        self,
        path: str | PathLike[str],
        sh_degree: Optional[int],
        min_opacity: float,
        up: str,
        page_bytes: Optional[int],
    ) -> None: ...

def rasterize(
    means: Floats,
    quats: Floats,
    scales: Floats,
    opacities: Floats,
    colors: Floats,
    viewmats: Floats,
    Ks: Floats,
    width: int,
    height: int,
    near_plane: float,
    eps2d: float,
    sh_degree: Optional[int],
    antialiased: bool,
    backgrounds: Optional[Floats],
    keep: bool,
) -> tuple[Floats, Floats, Floats, Optional[Frame]]: ...
def load(path: str | PathLike[str]) -> Scene: ...
def photographs(
    path: str | PathLike[str], progress: Progress
) -> list[tuple[str, NDArray[np.uint8], Camera]]: ...
def reconstruct(
    photos: str | list[Any],
    cameras: Optional[list[Camera]],
    quality: str,
    gaussians: Optional[int],
    refine_seconds: Optional[int],
    upscale: int,
    adjust_poses: bool,
    weights: Optional[str | PathLike[str]],
    progress: Progress,
) -> Scene: ...
def estimate_cameras(
    photos: str | list[Any], progress: Progress
) -> tuple[list[Optional[Camera]], Floats, bool, list[str]]: ...
def check(
    photos: str | list[Any], cameras: Optional[list[Camera]], progress: Progress
) -> str: ...
