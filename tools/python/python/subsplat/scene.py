"""Scenes of 3D Gaussians: files, pictures, and the viewer in a notebook."""

from __future__ import annotations

import html
import os
import tempfile
from typing import NamedTuple, Optional, Sequence, Union

import numpy as np
from numpy.typing import NDArray

from . import _native
from ._native import Camera

Floats = NDArray[np.float32]
Path = Union[str, "os.PathLike[str]"]

# Largest page, bytes: that of `subsplat run`.
PAGE_BYTES = 12_000_000
# Height of the viewer in a notebook, px.
VIEWER_HEIGHT = 480


class Picture(NamedTuple):
    """A rendered picture."""

    rgb: Floats
    """[H, W, 3]: colour over the background, sRGB; 1 is white."""
    alpha: Floats
    """[H, W]: accumulated opacity, 0 to 1."""
    depth: Floats
    """[H, W]: expected depth, camera z in world units; 0 where alpha is 0."""

    def to_uint8(self) -> NDArray[np.uint8]:
        """The colours [H, W, 3] as a picture of 8 bits, for PIL.Image.fromarray."""
        return (np.clip(self.rgb, 0, 1) * 255 + 0.5).astype(np.uint8)


class Splats(NamedTuple):
    """Arrays of N Gaussians, as `subsplat.rasterize` takes them (``colors=splats.sh`` with ``sh_degree``)."""

    means: Floats
    """[N, 3], world units."""
    quats: Floats
    """[N, 4], wxyz."""
    scales: Floats
    """[N, 3]: standard deviations, world units."""
    opacities: Floats
    """[N], in [0, 1]."""
    sh: Floats
    """[N, D, 3]: SH coefficients; D = 1, 4, 9, 16 or 25."""


class Verdict(NamedTuple):
    """The verdict on a scene of photographs. Its text is one sentence."""

    trust: str
    """"good"; "near_photographs", where views near the photographs are right; or "wrong"."""
    reason: str
    """The likeliest cause, and what to do."""
    sentence: str
    """Both."""

    def __str__(self) -> str:
        return self.sentence


class Scene:
    """3D Gaussians with the rules to render them.

    `subsplat.reconstruct` and `subsplat.load` make scenes; so do arrays, which are copied:
    means [N, 3], quats [N, 4] wxyz, scales [N, 3], opacities [N], sh [N, D, 3], float32 (see `Splats`).
    In a notebook a scene shows itself in a viewer.
    """

    def __init__(
        self, means: Floats, quats: Floats, scales: Floats, opacities: Floats, sh: Floats
    ) -> None:
        self._native = _native.Scene(means, quats, scales, opacities, sh)

    @classmethod
    def _of(cls, native: _native.Scene) -> Scene:
        scene = cls.__new__(cls)
        scene._native = native
        return scene

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self._native)

    def __repr__(self) -> str:
        return f"<subsplat.Scene of {len(self)} Gaussians>"

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the photographs; of a file the one that it names, or none."""
        return self._native.cameras

    @property
    def verdict(self) -> Optional[Verdict]:
        """How far a scene of photographs can be trusted; None for one of a file or of arrays."""
        verdict = self._native.verdict
        return None if verdict is None else Verdict(*verdict)

    @property
    def warnings(self) -> list[str]:
        """Remarks about the photographs or the file, a sentence each."""
        return self._native.warnings

    @property
    def splats(self) -> Splats:
        """The Gaussians as arrays: copies, each with SH coefficients of its own."""
        return Splats(**self._native.splats())

    def overview(self, side: int = 512) -> Camera:
        """A camera of side × side px that sees the whole scene, along the world's +z."""
        return self._native.overview(side)

    def render(
        self, camera: Optional[Camera] = None, background: Optional[Sequence[float]] = None
    ) -> Picture:
        """Renders the scene as seen by ``camera``; without one, from the first photograph.

        background: RGB, 1 is white. Default: the mean colour of the photographs, or black.
        """
        if camera is None:
            camera = next(iter(self.cameras), None) or self.overview()
        return Picture(*self._native.render(camera, background))

    def save(
        self,
        path: Path,
        *,
        sh_degree: Optional[int] = None,
        min_opacity: float = 0.0,
        up: str = "keep",
        page_bytes: Optional[int] = PAGE_BYTES,
    ) -> None:
        """Writes a .ply, .glb, .spz, .sog or .splat file, or a .html page with a viewer.

        sh_degree: highest degree of colours that is written; None is what the format's readers know.
        min_opacity: Gaussians of a lower opacity are left out. up: "keep" (OpenCV, y down), "y" or "z".
        page_bytes: size of a page. Of a larger scene it has one colour for all views, then fewer Gaussians; with
        None all.
        """
        self._native.save(os.fspath(path), sh_degree, min_opacity, up, page_bytes)

    def _repr_html_(self) -> str:
        with tempfile.TemporaryDirectory() as folder:
            page = os.path.join(folder, "scene.html")
            self.save(page)
            with open(page, encoding="utf-8") as file:
                text = file.read()
        return (
            f'<iframe srcdoc="{html.escape(text)}" width="100%" height="{VIEWER_HEIGHT}" '
            'style="border:0" allow="fullscreen"></iframe>'
        )


def load(path: Path) -> Scene:
    """Reads a .ply, .glb, .spz, .sog, .splat or .ksplat file."""
    return Scene._of(_native.load(os.fspath(path)))


def convert(
    source: Path,
    target: Path,
    *,
    sh_degree: Optional[int] = None,
    min_opacity: float = 0.0,
    up: str = "keep",
) -> Scene:
    """Writes the scene of the file ``source`` to the file ``target``, whose name decides the format.

    The options are those of `Scene.save`. Returns the scene.
    """
    scene = load(source)
    scene.save(target, sh_degree=sh_degree, min_opacity=min_opacity, up=up)
    return scene
