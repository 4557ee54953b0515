"""`subsplat.torch`: gradients against PyTorch's own, its conventions and its exceptions."""

import sys

import numpy as np
import pytest
from conftest import make_scene

import subsplat

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")


def test_torch_is_not_imported_with_the_package():
    import subprocess

    code = "import subsplat, sys; assert 'torch' not in sys.modules; assert 'numpy' in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


torch = pytest.importorskip("torch", reason="PyTORCH IS ABSENT: the tests of subsplat.torch do not run")


def tensors(scene, grad=True):
    out = {k: torch.from_numpy(scene[k].copy()) for k in NAMES}
    for k in NAMES[:6]:
        out[k].requires_grad_(grad)
    return out, {k: v for k, v in scene.items() if k not in NAMES}


def rasterization(*arguments, **options):
    return subsplat.torch.rasterization(*arguments, **options)


def test_pictures_and_gradients_are_those_of_numpy():
    scene = make_scene(degree=2, cameras=2)
    inputs, rest = tensors(scene)
    pictures, alphas, meta = rasterization(**inputs, **rest, render_mode="RGB+ED")
    got = subsplat.rasterize(**scene)
    assert pictures.shape == (2, 28, 36, 4) and meta["n_cameras"] == 2
    assert np.array_equal(pictures[..., :3].detach(), got.colors)
    assert np.array_equal(alphas.detach(), got.alphas)
    assert np.allclose(pictures[..., 3:].detach(), got.depths, rtol=1e-6)
    v = torch.randn(pictures.shape, generator=torch.Generator().manual_seed(1))
    (pictures * v).sum().backward()
    expected = subsplat.rasterize_backward(
        **scene,
        v_colors=np.ascontiguousarray(v[..., :3]),
        v_depths=np.ascontiguousarray(v[..., 3:]),
    )
    for name in NAMES[:6]:
        a, b = inputs[name].grad.numpy(), expected[name]
        assert np.abs(b).max() > 0
        assert np.abs(a - b).max() <= 1e-5 * np.abs(b).max(), name


def test_gradcheck_in_f32():
    """PyTorch's gradcheck. In f32 a difference of a loss has an error of about 1e-3 of the slopes."""
    scene = make_scene(n=4, width=12, height=10, seed=8)
    # Every Gaussian covers the whole picture: no pixel is near the threshold of 1/255.
    scene["scales"] += 1.4
    inputs, rest = tensors(scene)
    view, k = inputs["viewmats"].detach(), inputs["Ks"]

    def smooth(means, quats, scales, opacities, colors):
        pictures, alphas, _ = rasterization(
            means, quats, scales, opacities, colors, view, k, **rest, render_mode="RGB+D"
        )
        return pictures.mean(), alphas.mean()

    arguments = [inputs[name] for name in NAMES[:5]]
    assert torch.autograd.gradcheck(
        smooth, arguments, eps=2e-3, atol=1e-3, rtol=3e-2, check_undefined_grad=False
    )


def test_only_what_is_asked_for_has_gradients():
    inputs, rest = tensors(make_scene(), grad=False)
    inputs["colors"].requires_grad_()
    background = torch.zeros(1, 3, requires_grad=True)
    pictures, alphas, _ = rasterization(**inputs, **rest, backgrounds=background)
    pictures.sum().backward()
    assert inputs["colors"].grad.abs().max() > 0 and inputs["means"].grad is None
    assert torch.allclose(background.grad[0, 0], (1 - alphas).sum())
    with torch.no_grad():
        assert not rasterization(**inputs, **rest)[0].requires_grad


def test_a_backward_pass_sees_nothing_of_the_one_before():
    """Upstream gradients that one call has and the next lacks: buffers are reused between calls."""

    def gradient(*losses):
        inputs, rest = tensors(make_scene())
        drawn = dict(zip(("pictures", "alphas"), rasterization(**inputs, **rest, render_mode="RGB+D")))
        drawn["depths"] = drawn["pictures"][..., 3:]
        drawn["pictures"] = drawn["pictures"][..., :3]
        sum(drawn[name].sum() for name in losses).backward()
        return inputs["means"].grad.clone()

    alone = [gradient("pictures"), gradient("alphas")]
    gradient("pictures", "alphas", "depths")
    assert torch.equal(gradient("alphas"), alone[1])
    gradient("pictures", "alphas", "depths")
    assert torch.equal(gradient("pictures"), alone[0])


def test_colours_go_uphill():
    """Adam finds the colours of a picture."""
    scene = make_scene(n=60)
    inputs, rest = tensors(scene, grad=False)
    truth = rasterization(**inputs, **rest)[0]
    inputs["colors"] = torch.full_like(inputs["colors"], 0.5).requires_grad_()
    adam = torch.optim.Adam([inputs["colors"]], lr=0.05)
    losses = []
    for _ in range(60):
        loss = (rasterization(**inputs, **rest)[0] - truth).square().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        losses.append(loss.item())
    assert losses[-1] < 0.02 * losses[0]


def test_copies_are_counted(monkeypatch):
    """Memory of tensors and of the arrays of the native calls: the same, in both directions and both passes."""
    native, seen = subsplat._native.rasterize, []

    class Frame:
        def __init__(self, frame):
            self.frame = frame

        def backward(self, *upstream):
            seen.append([None if v is None else v.ctypes.data for v in upstream[:3]])
            found = self.frame.backward(*upstream)
            seen.append({name: v.ctypes.data for name, v in found.items()})
            return found

    def counted(*arguments):
        seen.append([a.ctypes.data for a in arguments[:7]])
        *pictures, frame = native(*arguments)
        seen.append([p.ctypes.data for p in pictures])
        return (*pictures, Frame(frame))

    monkeypatch.setattr(subsplat.torch._native, "rasterize", counted)
    inputs, rest = tensors(make_scene())
    pictures, alphas, _ = rasterization(**inputs, **rest)
    v = torch.randn(pictures.shape)
    pictures.backward(v)
    given, drawn, upstream, found = seen
    copies = [name for name, at in zip(NAMES, given) if at != inputs[name].data_ptr()]
    copies += [name for name in NAMES[:5] if found[name] != inputs[name].grad.data_ptr()]
    assert copies == []
    assert drawn[:2] == [pictures.data_ptr(), alphas.data_ptr()] and upstream[0] == v.data_ptr()
    # The counter counts: a tensor with strides is copied.
    seen.clear()
    inputs["means"] = torch.cat([inputs["means"].detach()] * 2, 1)[:, :3]
    rasterization(**inputs, **rest)
    assert sum(at != inputs[name].data_ptr() for name, at in zip(NAMES, seen[0])) == 1


def test_a_tensor_with_strides_is_copied():
    inputs, rest = tensors(make_scene())
    wide = torch.cat([inputs["means"].detach()] * 2, 1).requires_grad_()
    expected = rasterization(**inputs, **rest)[0]
    inputs["means"] = wide[:, :3]
    pictures = rasterization(**inputs, **rest)[0]
    assert torch.equal(pictures, expected)
    pictures.sum().backward()
    assert wide.grad[:, 3:].abs().max() == 0 and wide.grad[:, :3].abs().max() > 0


def test_bad_tensors_are_one_exception():
    inputs, rest = tensors(make_scene(), grad=False)
    means = inputs["means"]
    for bad, kind, text in [
        (means.double(), TypeError, "means: expected torch.float32, got torch.float64"),
        (means.to("meta"), ValueError, "means: expected a dense tensor on the CPU, got .* on meta"),
        (means.to_sparse(), ValueError, "means: expected a dense tensor"),
        (means.numpy(), TypeError, "means: expected a torch.Tensor, got numpy.ndarray"),
        (means[:, :2], ValueError, r"means: expected shape \[N, 3\]"),
        (means * torch.nan, ValueError, "means: expected finite numbers"),
    ]:
        with pytest.raises(kind, match=text):
            rasterization(**{**inputs, "means": bad}, **rest)
    with pytest.raises(TypeError, match="got torch.Tensor; tensors: subsplat.torch"):
        subsplat.rasterize(**inputs, **rest)
    with pytest.raises(ValueError, match="render_mode: expected one of"):
        rasterization(**inputs, **rest, render_mode="depth")


def test_a_change_in_place_is_refused():
    inputs, rest = tensors(make_scene())
    loss = rasterization(**inputs, **rest)[0].sum()
    with torch.no_grad():
        inputs["means"] += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()
