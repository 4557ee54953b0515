"""The rasterizer of 3D Gaussians for numpy arrays: pictures, and gradients of their inputs."""

from __future__ import annotations

from typing import NamedTuple, Optional

import numpy as np
from numpy.typing import NDArray

from . import _native

Floats = NDArray[np.float32]

# Smallest alpha that depth is divided by.
ALPHA_MIN = 1e-10


class Rasterized(NamedTuple):
    """Pictures of C cameras."""

    colors: Floats
    """[C, H, W, 3]: colour over the background."""
    alphas: Floats
    """[C, H, W, 1]: accumulated opacity, 0 to 1."""
    depths: Floats
    """[C, H, W, 1]: expected depth, camera z in world units; 0 where alpha is 0."""


def antialiased(rasterize_mode: str) -> bool:
    """Reads gsplat's ``rasterize_mode``."""
    if rasterize_mode not in ("classic", "antialiased"):
        raise ValueError(
            f"rasterize_mode: expected classic or antialiased, got {rasterize_mode!r}"
        )
    return rasterize_mode == "antialiased"


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
    *,
    near_plane: float = 0.01,
    eps2d: float = 0.3,
    sh_degree: Optional[int] = None,
    rasterize_mode: str = "classic",
    backgrounds: Optional[Floats] = None,
) -> Rasterized:
    """Renders 3D Gaussians as seen by C cameras, on all cores.

    The arguments have gsplat's names and meanings. All arrays are float32, C-contiguous and read in place.

    means: [N, 3], world units. quats: [N, 4], wxyz, of any length but 0. scales: [N, 3], standard deviations,
    world units. opacities: [N], in [0, 1].
    colors: [N, 3] or [C, N, 3] RGB of any range; with ``sh_degree`` SH coefficients [N, D, 3] or
    [C, N, D, 3] with D = 1, 4, 9, 16 or 25, of which the first (sh_degree + 1)² are used.
    viewmats: [C, 4, 4], world to camera (rigid). Ks: [C, 3, 3], px, without skew.
    near_plane: nearest depth that is drawn, world units. eps2d: low-pass, px², added to the diagonal of 2-D
    covariances. backgrounds: [C, 3]; black without.
    rasterize_mode: "classic", or "antialiased", which scales opacities by what the low-pass adds.

    Unlike gsplat, a Gaussian is drawn as far as its alpha reaches 1/255, not to 3 standard deviations; there
    is no far plane and no ``radius_clip``.

    Raises TypeError for arrays of another type, ValueError for shapes, strides, NaN, and cameras that are none.
    """
    rgb, alphas, depth_sums, _ = _native.rasterize(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, eps2d,
        sh_degree, antialiased(rasterize_mode), backgrounds, False,
    )
    return Rasterized(rgb, alphas, _expected(depth_sums, alphas))


def rasterize_backward(
    means: Floats,
    quats: Floats,
    scales: Floats,
    opacities: Floats,
    colors: Floats,
    viewmats: Floats,
    Ks: Floats,
    width: int,
    height: int,
    v_colors: Optional[Floats] = None,
    v_alphas: Optional[Floats] = None,
    v_depths: Optional[Floats] = None,
    *,
    near_plane: float = 0.01,
    eps2d: float = 0.3,
    sh_degree: Optional[int] = None,
    rasterize_mode: str = "classic",
    backgrounds: Optional[Floats] = None,
) -> dict[str, Floats]:
    """Gradients of a loss with respect to the inputs of `rasterize`, from those with respect to its outputs.

    v_colors: [C, H, W, 3]. v_alphas, v_depths: [C, H, W, 1]. None stands for zeros. The other arguments are
    those of `rasterize`, which this function runs again.

    Returns arrays in the shapes of the inputs: means, quats, scales, opacities, colors, backgrounds [C, 3]
    and viewmats [C, 4, 4]. The gradient of a viewmat is exact along rigid motions, and 0 along others.
    """
    _, alphas, depth_sums, frame = _native.rasterize(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane, eps2d,
        sh_degree, antialiased(rasterize_mode), backgrounds, True,
    )
    v_sums = None
    if v_depths is not None:
        v_depths = np.ascontiguousarray(v_depths, dtype=np.float32)
        if v_depths.shape != alphas.shape:
            raise ValueError(f"v_depths: expected shape {alphas.shape}, got {v_depths.shape}")
        v_sums, through_alpha = _expected_backward(v_depths, depth_sums, alphas)
        v_alphas = through_alpha if v_alphas is None else v_alphas + through_alpha
    assert frame is not None, "keep is True"
    return frame.backward(v_colors, v_alphas, v_sums, True)


def _expected(depth_sums: Floats, alphas: Floats) -> Floats:
    """Expected depth of Σ w·z and alpha."""
    return np.divide(depth_sums, np.maximum(alphas, np.float32(ALPHA_MIN)), dtype=np.float32)


def _expected_backward(v: Floats, depth_sums: Floats, alphas: Floats) -> tuple[Floats, Floats]:
    """Gradients of `_expected` with respect to both arguments."""
    least = np.maximum(alphas, np.float32(ALPHA_MIN))
    through_alpha = np.where(alphas > ALPHA_MIN, -v * depth_sums / (least * least), 0)
    return np.divide(v, least, dtype=np.float32), through_alpha.astype(np.float32)
