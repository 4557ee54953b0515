"""Photographs to scenes and cameras."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from typing import Any, Callable, NamedTuple, Optional, Sequence, Union

import numpy as np
from numpy.typing import NDArray

from . import _native
from ._native import Camera
from .scene import Path, Scene

Photos = Union[Path, Sequence[Any]]
Progress = Union[None, bool, Callable[[str, float], Any]]


class Estimate(NamedTuple):
    """Cameras that were estimated from photographs."""

    cameras: list[Optional[Camera]]
    """One for each photograph, in px of the photograph; None where it could not be placed."""
    points: NDArray[np.float32]
    """[M, 3]: points that the photographs share, world units."""
    reliable: bool
    """Whether the estimate is certain."""
    warnings: list[str]
    """Remarks, a sentence each."""


class Photograph(NamedTuple):
    """A photograph with its camera."""

    name: str
    """Its name in the scene's files."""
    image: NDArray[np.uint8]
    """[H, W, 3], sRGB, without lens distortion."""
    camera: Camera
    """Its camera, in px of the image."""


def photographs(path: Path, *, progress: Progress = None) -> list[Photograph]:
    """Reads the photographs of a scene with cameras: a folder, or a file of cameras (COLMAP, cameras.json, …).

    progress: as of `reconstruct`.
    """
    with _Bar(progress) as report:
        return [Photograph(*found) for found in _native.photographs(os.fspath(path), report)]


def reconstruct(
    photos: Photos,
    cameras: Optional[Sequence[Camera]] = None,
    quality: str = "normal",
    *,
    gaussians: Optional[int] = None,
    refine_seconds: Optional[int] = None,
    upscale: int = 2,
    adjust_poses: Optional[bool] = None,
    weights: Optional[Path] = None,
    progress: Progress = None,
) -> Scene:
    """Makes a scene of two or more photographs of one place.

    photos: a folder of photographs, or of a scene with cameras (COLMAP, transforms.json, cameras.json, …), of
    which at most 12 photographs that overlap are used (6 at "high" and "best"); or a list of paths, PIL pictures
    and uint8 arrays [H, W, 3], of which all are used.
    cameras: one for each photograph of a list. Without, the cameras are estimated.
    quality: "fast", "normal", "high" or "best". gaussians: at most this number after the refinement.
    refine_seconds: time of the refinement, 0 for none. upscale: 1 to 8, Gaussians per input pixel and side.
    adjust_poses: corrects cameras that are nearly right; None where points of the photographs contradict them.
    weights: a file of weights.
    progress: a function of a stage (text) and the share that is done (0 to 1); True shows a bar (tqdm).

    Ctrl-C stops the call. Raises ValueError where the photographs do not determine their cameras, and OSError
    for a file that cannot be read.
    """
    with _Bar(progress) as report:
        native = _native.reconstruct(
            _photos(photos), _cameras(cameras), quality, gaussians, refine_seconds, upscale,
            adjust_poses, None if weights is None else os.fspath(weights), report,
        )
    return Scene._of(native)


def estimate_cameras(photos: Photos, *, progress: Progress = None) -> Estimate:
    """Estimates where photographs of one place were taken from.

    photos and progress: as of `reconstruct`. The unit of length is the median distance of the points.
    """
    with _Bar(progress) as report:
        return Estimate(*_native.estimate_cameras(_photos(photos), report))


def check(
    photos: Photos, cameras: Optional[Sequence[Camera]] = None, *, progress: Progress = None
) -> list[dict[str, Any]]:
    """Checks whether cameras fit their photographs, by points that consecutive photographs share.

    photos and cameras: as of `reconstruct` at "normal". Returns a dictionary for each pair: ``verdict`` ("ok", "warning" or
    "bad"), ``findings`` (each with ``severity``, ``code`` and ``sentence``), ``matches``, ``overlap``, … .
    """
    with _Bar(progress) as report:
        reports = json.loads(_native.check(_photos(photos), _cameras(cameras), report))
    return list(reports)


def _photos(photos: Photos) -> Union[str, list[Any]]:
    """Paths as text, pictures as arrays."""
    if isinstance(photos, (str, os.PathLike)):
        return os.fspath(photos)
    if not isinstance(photos, Iterable):
        raise TypeError(f"photos: expected a path or a list of photographs, got {photos!r}")
    return [_photo(photo) for photo in photos]


def _photo(photo: Any) -> Any:
    if isinstance(photo, (str, os.PathLike)):
        return os.fspath(photo)
    if type(photo).__module__.partition(".")[0] == "PIL":
        from PIL import ImageOps

        return np.ascontiguousarray(ImageOps.exif_transpose(photo).convert("RGB"))
    return photo


def _cameras(cameras: Optional[Sequence[Camera]]) -> Optional[list[Camera]]:
    if cameras is None:
        return None
    for camera in cameras:
        if not isinstance(camera, Camera):
            raise TypeError(f"cameras: expected subsplat.Camera, got {camera!r}")
    return list(cameras)


class _Bar:
    """The callback of the argument ``progress``; with True a bar of tqdm."""

    def __init__(self, progress: Progress) -> None:
        if not (progress is None or isinstance(progress, bool) or callable(progress)):
            raise TypeError(f"progress: expected a function or True, got {progress!r}")
        self._progress = progress
        self._bar: Any = None

    def __enter__(self) -> Optional[Callable[[str, float], Any]]:
        if self._progress is not True:
            return self._progress or None
        try:
            from tqdm.auto import tqdm  # type: ignore[import-untyped, unused-ignore]
        except ImportError as missing:
            raise ImportError("progress=True needs tqdm: pip install tqdm") from missing
        self._bar = tqdm(total=100, bar_format="{desc} {percentage:3.0f} %|{bar}| {elapsed}")
        return self._show

    def _show(self, stage: str, fraction: float) -> None:
        self._bar.set_description(stage, refresh=False)
        self._bar.update(100 * fraction - self._bar.n)

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()
