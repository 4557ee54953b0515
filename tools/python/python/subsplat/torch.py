"""The rasterizer for PyTorch tensors on the CPU, with gradients.

>>> from subsplat.torch import rasterization
>>> colors, alphas, meta = rasterization(means, quats, scales, opacities, colors, viewmats, Ks, 640, 480)
"""

from __future__ import annotations

from typing import Any, Optional

try:
    import torch
except ImportError as missing:  # pragma: no cover
    raise ImportError("subsplat.torch needs PyTorch: pip install subsplat[torch]") from missing

from torch.autograd.function import once_differentiable

from . import _native
from .raster import ALPHA_MIN, antialiased

__all__ = ["rasterization"]

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


def rasterization(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    eps2d: float = 0.3,
    sh_degree: Optional[int] = None,
    backgrounds: Optional[torch.Tensor] = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Renders 3D Gaussians as seen by C cameras, with gradients to all tensors but ``Ks``.

    The arguments and results are gsplat's, and `subsplat.rasterize` describes them: float32 tensors on the CPU.
    A tensor with strides is copied, another is read in place.

    render_mode: "RGB"; "D", accumulated depth Σ w·z; "ED", expected depth; or "RGB+D" and "RGB+ED", where
    depth is a fourth channel.

    The gradient of a viewmat is exact along rigid motions (a rotation, a translation), and 0 along others.

    Returns pictures [C, H, W, channels], alphas [C, H, W, 1] and a dictionary with width, height and the
    number of cameras.
    """
    if render_mode not in MODES:
        raise ValueError(f"render_mode: expected one of {', '.join(MODES)}, got {render_mode!r}")
    tensors = (means, quats, scales, opacities, colors, viewmats, Ks)
    for name, tensor in zip(NAMES, tensors):
        _check(name, tensor)
    if backgrounds is not None:
        _check("backgrounds", backgrounds)
    settings = (width, height, near_plane, eps2d, sh_degree, antialiased(rasterize_mode))
    rgb, alphas, depths = _Rasterize.apply(*tensors, backgrounds, settings)
    if render_mode.endswith("ED"):
        depths = depths / alphas.clamp(min=ALPHA_MIN)
    pictures = {"RGB": [rgb], "D": [depths], "ED": [depths]}.get(render_mode, [rgb, depths])
    meta = {"width": width, "height": height, "n_cameras": viewmats.shape[0]}
    return pictures[0] if len(pictures) == 1 else torch.cat(pictures, dim=-1), alphas, meta


def _check(name: str, tensor: torch.Tensor) -> None:
    if not isinstance(tensor, torch.Tensor):
        got = f"{type(tensor).__module__}.{type(tensor).__qualname__}"
        raise TypeError(f"{name}: expected a torch.Tensor, got {got}; arrays: subsplat.rasterize")
    if tensor.device.type != "cpu" or tensor.layout != torch.strided:
        raise ValueError(
            f"{name}: expected a dense tensor on the CPU, got {tensor.layout} on {tensor.device}"
        )
    if tensor.dtype != torch.float32:
        raise TypeError(f"{name}: expected torch.float32, got {tensor.dtype}")


def _array(tensor: Optional[torch.Tensor]) -> Any:
    """The tensor's numbers, in place where it is contiguous."""
    return None if tensor is None else tensor.detach().contiguous().numpy()


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Any:
        *tensors, backgrounds, settings = arguments
        width, height, near_plane, eps2d, sh_degree, smooth = settings
        keep = any(ctx.needs_input_grad)
        means, quats, scales, opacities, colors, viewmats, Ks = map(_array, tensors)
        rgb, alphas, depths, ctx.frame = _native.rasterize(
            means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane,
            eps2d, sh_degree, smooth, _array(backgrounds), keep,
        )
        ctx.set_materialize_grads(False)
        # PyTorch refuses a backward pass after a change of these in place.
        ctx.save_for_backward(*tensors[:5])
        return torch.from_numpy(rgb), torch.from_numpy(alphas), torch.from_numpy(depths)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, v_rgb: Any, v_alphas: Any, v_depths: Any) -> Any:
        ctx.saved_tensors  # noqa: B018 (the check above)
        needs = ctx.needs_input_grad
        found = ctx.frame.backward(_array(v_rgb), _array(v_alphas), _array(v_depths), needs[5])
        names = (*NAMES[:6], None, "backgrounds")
        wanted = (name if need else None for name, need in zip(names, needs))
        return (*(name and torch.from_numpy(found[name]) for name in wanted), None)
