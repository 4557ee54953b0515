"""The native module. Its functions have no defaults; the package's modules document and call them."""

from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, Optional, final

import numpy as np
from numpy.typing import NDArray

__version__: str
__all__ = [
    "Camera",
    "Frame",
    "Scene",
    "__version__",
    "check",
    "estimate_cameras",
    "load",
    "photographs",
    "rasterize",
    "reconstruct",
]

_Floats = NDArray[np.float32]
_Progress = Optional[Callable[[str, float], Any]]

@final
class Camera:
    """A pinhole camera without lens distortion.

    viewmat: [4, 4] float32, world to camera (rigid). K: [3, 3] float32, px. width, height: px.
    """

    def __new__(cls, viewmat: _Floats, K: _Floats, width: int, height: int) -> Camera: ...
    @property
    def viewmat(self) -> _Floats: ...
    @property
    def K(self) -> _Floats: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    def resized(self, width: int, height: int) -> Camera: ...

@final
class Frame:
    def backward(
        self,
        v_colors: Optional[_Floats],
        v_alphas: Optional[_Floats],
        v_depth_sums: Optional[_Floats],
        viewmats: bool,
    ) -> dict[str, _Floats]: ...

@final
class Scene:
    def __new__(
        cls, means: _Floats, quats: _Floats, scales: _Floats, opacities: _Floats, sh: _Floats
    ) -> Scene: ...
    def __len__(self) -> int: ...
    @property
    def cameras(self) -> list[Camera]: ...
    @property
    def verdict(self) -> Optional[tuple[str, str, str]]: ...
    @property
    def warnings(self) -> list[str]: ...
    def overview(self, side: int) -> Camera: ...
    def splats(self) -> dict[str, _Floats]: ...
    def render(
        self, camera: Camera, background: Optional[Sequence[float]]
    ) -> tuple[_Floats, _Floats, _Floats]: ...
    def save(
        self,
        path: str | PathLike[str],
        sh_degree: Optional[int],
        min_opacity: float,
        up: str,
        page_bytes: Optional[int],
    ) -> None: ...

def rasterize(
    means: _Floats,
    quats: _Floats,
    scales: _Floats,
    opacities: _Floats,
    colors: _Floats,
    viewmats: _Floats,
    Ks: _Floats,
    width: int,
    height: int,
    near_plane: float,
    eps2d: float,
    sh_degree: Optional[int],
    antialiased: bool,
    backgrounds: Optional[_Floats],
    keep: bool,
) -> tuple[_Floats, _Floats, _Floats, Optional[Frame]]: ...
def load(path: str | PathLike[str]) -> Scene: ...
def photographs(
    path: str | PathLike[str], progress: _Progress
) -> list[tuple[str, NDArray[np.uint8], Camera]]: ...
def reconstruct(
    photos: str | list[Any],
    cameras: Optional[list[Camera]],
    quality: str,
    gaussians: Optional[int],
    refine_seconds: Optional[int],
    upscale: int,
    adjust_poses: Optional[bool],
    weights: Optional[str | PathLike[str]],
    progress: _Progress,
) -> Scene: ...
def estimate_cameras(
    photos: str | list[Any], progress: _Progress
) -> tuple[list[Optional[Camera]], _Floats, bool, list[str]]: ...
def check(
    photos: str | list[Any], cameras: Optional[list[Camera]], progress: _Progress
) -> str: ...
