"""The rasterizer: pictures and gradients against a reference, the fixtures and finite differences."""

import subprocess
import sys
import threading

import numpy as np
import pytest
from conftest import make_scene, read_safetensors, rotation, shared
from reference import render

import subsplat

# f32 against f64: about 1e-6; a threshold of 1/255 may flip in few pixels.
PICTURE = 2e-5
FLIPS = 3e-3
# Finite differences of the f64 reference against f32 gradients, relative to the largest of an array.
GRADIENT = 2e-3


def close(got, expected, tolerance=PICTURE):
    """All but FLIPS of the numbers agree."""
    wrong = np.abs(got - expected) > tolerance * max(1.0, np.abs(expected).max())
    assert got.shape == expected.shape and got.dtype == np.float32
    assert wrong.mean() <= FLIPS, f"{wrong.mean():.1%} differ, by {np.abs(got - expected).max()}"


@pytest.mark.parametrize("degree", [None, 0, 1, 2])
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_pictures_are_the_reference_s(degree, mode):
    scene = make_scene(degree=degree, cameras=2, seed=3)
    backgrounds = np.float32([[0.1, 0.5, 0.2], [0.9, 0.3, 0.0]])
    got = subsplat.rasterize(**scene, backgrounds=backgrounds, rasterize_mode=mode)
    rgb, alphas, sums, _ = render(
        **scene, backgrounds=backgrounds, antialiased=mode == "antialiased"
    )
    assert alphas.max() > 0.5
    close(got.colors, rgb)
    close(got.alphas, alphas)
    close(got.depths, sums / np.maximum(alphas, 1e-10), 1e-4)


def test_colours_may_have_any_sign_and_differ_by_camera():
    scene = make_scene(cameras=2)
    scene["colors"] = np.stack([scene["colors"] - 2, scene["colors"] * 3])
    got = subsplat.rasterize(**scene)
    close(got.colors, render(**scene)[0])
    assert got.colors[0].min() < -0.5


def losses(scene, seed=5):
    """Upstream gradients, 0 where a threshold is near, and the loss by the reference with them."""
    r = np.random.default_rng(seed)
    count, h, w = len(scene["viewmats"]), scene["height"], scene["width"]
    away = ~render(**scene)[3]
    v = [(away * r.normal(size=(count, h, w, c))).astype(np.float32) for c in (3, 1, 1)]

    def loss(**changed):
        rgb, alphas, sums, _ = render(**{**scene, **changed})
        depths = sums / np.maximum(alphas, 1e-10)
        return sum((np.float64(a) * b).sum() for a, b in zip(v, (rgb, alphas, depths)))

    return v, loss


def slopes(loss, name, value, step, indices):
    """Central differences of the loss in some numbers of an array."""
    out = []
    for i in indices:
        ends = []
        for sign in (1, -1):
            moved = np.float64(value)
            moved.flat[i] += sign * step
            ends.append(loss(**{name: moved}))
        out.append((ends[0] - ends[1]) / (2 * step))
    return np.array(out)


@pytest.mark.parametrize("degree", [None, 2])
def test_gradients_are_slopes_of_the_reference(degree):
    scene = make_scene(n=12, degree=degree, cameras=2, seed=11)
    scene["opacities"] *= 0.6
    backgrounds = np.float32([[0.1, 0.5, 0.2], [0.9, 0.3, 0.0]])
    (v_colors, v_alphas, v_depths), loss = losses({**scene, "backgrounds": backgrounds})
    got = subsplat.rasterize_backward(
        **scene, backgrounds=backgrounds, v_colors=v_colors, v_alphas=v_alphas, v_depths=v_depths
    )
    r = np.random.default_rng(1)
    for name in ("means", "quats", "scales", "opacities", "colors", "backgrounds"):
        value = backgrounds if name == "backgrounds" else scene[name]
        assert got[name].shape == value.shape and got[name].dtype == np.float32
        indices = r.choice(value.size, min(24, value.size), replace=False)
        expected = slopes(loss, name, value, 1e-5, indices)
        error = np.abs(got[name].flat[indices] - expected)
        worst = error.max() / np.abs(expected).max()
        assert worst < GRADIENT, f"{name}: {worst}"


@pytest.mark.parametrize("degree", [None, 2])
def test_gradients_of_cameras_are_slopes_along_rigid_motions(degree):
    scene = make_scene(n=12, degree=degree, seed=21)
    scene["opacities"] *= 0.6
    (v_colors, v_alphas, v_depths), loss = losses(scene)
    got = subsplat.rasterize_backward(**scene, v_colors=v_colors, v_alphas=v_alphas, v_depths=v_depths)
    gradient = got["viewmats"][0].astype(np.float64)
    view = np.float64(scene["viewmats"][0])
    step, expected, found = 1e-5, [], []
    for axis in np.eye(3):
        for motion in ("turn", "move"):
            ends = []
            for sign in (1, -1):
                twist = np.eye(4)
                if motion == "turn":
                    twist[:3, :3] = rotation(sign * step, axis)
                else:
                    twist[:3, 3] = sign * step * axis
                ends.append(twist @ view)
            pair = [loss(viewmats=end[None]) for end in ends]
            expected.append((pair[0] - pair[1]) / (2 * step))
            found.append((gradient * (ends[0] - ends[1])).sum() / (2 * step))
    error = np.abs(np.array(found) - expected) / np.abs(expected).max()
    assert error.max() < GRADIENT, f"{found} for {expected}"


CASES = ["sh0_32", "sh1", "sh2", "sh3", "sh4", "antialiased", "odd_size", "saturated", "behind_camera"]


@pytest.mark.parametrize("name", CASES)
def test_conformance_cases(name):
    tensors, metadata = read_safetensors(shared(f"fixtures/raster/{name}.safetensors"))
    fx, fy, cx, cy = tensors["intrinsics"]
    pose = np.float64(tensors["world_from_camera"])
    view = np.eye(4)
    view[:3, :3] = pose[:3, :3].T
    view[:3, 3] = -pose[:3, :3].T @ pose[:3, 3]
    smooth = metadata["antialiased"].lower() in ("1", "true")
    arguments = {k: tensors[k].copy() for k in ("means", "quats", "scales", "opacities")}
    arguments.update(
        colors=tensors["sh"].copy(),
        viewmats=view[None].astype(np.float32),
        Ks=np.float32([[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]]),
        width=int(metadata["width"]),
        height=int(metadata["height"]),
        near_plane=float(metadata["near"]),
        eps2d=float(metadata["lowpass"]),
        sh_degree=int(metadata["sh_degree"]),
        rasterize_mode="antialiased" if smooth else "classic",
        backgrounds=tensors["background"][None].copy(),
    )
    got = subsplat.rasterize(**arguments)
    inside = tensors["boundary"] == 0
    assert np.abs(got.colors[0] - tensors["rgb"])[inside].max() < 3e-5
    assert np.abs(got.alphas[0, ..., 0] - tensors["alpha"])[inside].max() < 3e-5
    v = (tensors["v_rgb"][None].copy(), tensors["v_alpha"][None, ..., None].copy())
    gradients = subsplat.rasterize_backward(**arguments, v_colors=v[0], v_alphas=v[1])
    for ours, theirs in [("colors", "sh"), *((k, k) for k in ("means", "quats", "scales", "opacities"))]:
        expected = tensors[f"grad.{theirs}"].reshape(len(tensors["means"]), -1)
        rows = np.abs(expected).max(1)
        error = np.abs(gradients[ours].reshape(expected.shape) - expected).max(1)
        assert (error / (rows + np.median(rows[rows > 0]))).max() < 5e-4, ours


def test_inputs_are_read_in_place(scene):
    """The call holds the arrays that were passed."""
    n = 20_000
    large = make_scene(n=n, degree=4)
    large["width"] = large["height"] = 16
    arrays = [v for v in large.values() if isinstance(v, np.ndarray)]
    before = [sys.getrefcount(a) for a in arrays[:5]]
    arguments = [large[k] for k in ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")]
    *_, frame = subsplat._native.rasterize(*arguments, 16, 16, 0.01, 0.3, 4, False, None, True)
    # The frame keeps these arrays and no others.
    assert [sys.getrefcount(a) for a in arrays[:5]] == [count + 2 for count in before]
    del arguments
    # A change of an array is seen by the backward pass: there is no copy that it could read.
    v = np.ones((1, 16, 16, 3), np.float32)
    first = frame.backward(v, None, None, False)["means"]
    large["colors"][:] = 0
    second = frame.backward(v, None, None, False)["means"]
    assert np.abs(first).max() > 0 and not np.array_equal(first, second)
    del frame
    assert [sys.getrefcount(a) for a in arrays[:5]] == before


COUNT_MEMORY = """
import resource
import numpy as np
import subsplat

def most():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024

n = 400_000
arrays = [np.ones((n, k), np.float32) for k in (3, 4, 3)] + [np.ones(n, np.float32)]
sh = np.ones((n, 25, 3), np.float32)
# Every Gaussian lies behind the camera: the call needs little memory of its own.
arrays[0] *= -1
K = np.float32([[[20, 0, 8], [0, 20, 8], [0, 0, 1]]])
call = lambda part: subsplat.rasterize(
    *(a[:part] for a in arrays), sh[:part], np.eye(4, dtype=np.float32)[None], K, 16, 16, sh_degree=4
)
call(1000)
before = most()
call(n)
print(most() - before, sum(a.nbytes for a in arrays) + sh.nbytes)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="ru_maxrss has another unit")
def test_a_call_takes_no_memory_of_the_size_of_its_arrays():
    out = subprocess.run([sys.executable, "-c", COUNT_MEMORY], check=True, capture_output=True, text=True)
    grown, size = map(int, out.stdout.split())
    assert size > 130e6 and grown < 0.5 * size, f"{grown} bytes for arrays of {size}"


def test_outputs_own_their_memory(scene):
    got = subsplat.rasterize(**scene)
    assert all(a.flags.c_contiguous and a.flags.writeable for a in got)


def test_two_threads_give_the_same_bytes():
    scenes = [make_scene(n=3000, degree=1, width=160, height=120, seed=s) for s in (1, 2)]
    v = np.random.default_rng(0).normal(size=(1, 120, 160, 3)).astype(np.float32)

    def run(scene):
        gradients = subsplat.rasterize_backward(**scene, v_colors=v)
        return [*subsplat.rasterize(**scene), *(gradients[k] for k in sorted(gradients))]

    expected = [run(scene) for scene in scenes]
    results = {}

    def work(i):
        results[i] = [run(scenes[i % 2]) for _ in range(3)]

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    [t.start() for t in threads]
    [t.join() for t in threads]
    assert len(results) == 4
    for i, repeats in results.items():
        for got in repeats:
            assert all(a.tobytes() == b.tobytes() for a, b in zip(got, expected[i % 2]))


def replaced(scene, **changed):
    return {**scene, **changed}


def nan(values, number=np.nan):
    values = values.copy()
    values.flat[5] = number
    return values


REFUSED = [
    (lambda s: {"means": s["means"][:, :2].copy()}, ValueError, r"means: expected shape \[N, 3\], got \[40, 2\]"),
    (lambda s: {"quats": s["quats"][:7].copy()}, ValueError, r"quats: expected shape \[40, 4\], got \[7, 4\]"),
    (lambda s: {"scales": s["scales"].ravel()}, ValueError, r"scales: expected shape \[40, 3\]"),
    (lambda s: {"opacities": s["opacities"][:, None]}, ValueError, r"opacities: expected shape \[40\]"),
    (lambda s: {"colors": s["colors"][:, :1].copy()}, ValueError, r"colors: expected shape \[40, 3\]"),
    (lambda s: {"sh_degree": 1}, ValueError, r"colors: expected shape \[40, D, 3\]"),
    (lambda s: {"sh_degree": 7}, ValueError, "sh_degree: expected a whole number from 0 to 4, got 7"),
    (lambda s: {"sh_degree": -1}, ValueError, "sh_degree: expected a whole number from 0 to 4, got -1"),
    (lambda s: {"means": s["means"].astype(np.float64)}, TypeError, "means: expected float32, got float64"),
    (lambda s: {"colors": (s["colors"] * 255).astype(np.uint8)}, TypeError, "colors: expected float32, got uint8"),
    (lambda s: {"means": s["means"].tolist()}, TypeError, r"means: expected a numpy array \[N, 3\] of float32"),
    (lambda s: {"means": np.asfortranarray(s["means"])}, ValueError, "means: expected a contiguous array"),
    (lambda s: {"quats": np.repeat(s["quats"], 2, 0)[::2]}, ValueError, "quats: expected a contiguous array"),
    (lambda s: {"means": nan(s["means"])}, ValueError, "means: expected finite numbers, got NaN in entry 1"),
    (lambda s: {"opacities": nan(s["opacities"], -np.inf)}, ValueError, "opacities: expected finite numbers"),
    (lambda s: {"colors": nan(s["colors"])}, ValueError, "colors: expected finite numbers"),
    (lambda s: {"viewmats": nan(s["viewmats"])}, ValueError, "camera 0: .*finite"),
    (lambda s: {"viewmats": 2 * s["viewmats"]}, ValueError, "camera 0: .*last row"),
    (lambda s: {"viewmats": s["viewmats"][0]}, ValueError, r"viewmats: expected shape \[C, 4, 4\]"),
    (lambda s: {"viewmats": s["viewmats"][:0]}, ValueError, "at least one camera"),
    (lambda s: {"Ks": s["Ks"] * np.float32([[-1], [1], [1]])}, ValueError, "camera 0: .*"),
    (lambda s: {"Ks": np.repeat(s["Ks"], 2, 0)}, ValueError, r"Ks: expected shape \[1, 3, 3\]"),
    (lambda s: {"quats": 0 * s["quats"]}, ValueError, "quats: expected a length above 0, got 0 in entry 0"),
    (lambda s: {"opacities": s["opacities"] + 1}, ValueError, "opacities: expected 0 to 1, after the sigmoid, got"),
    (lambda s: {"width": 0}, ValueError, "width: expected a whole number from 1 to 32768, got 0"),
    (lambda s: {"width": 3.5}, TypeError, "width: expected a whole number from 1 to 32768, got 3.5"),
    (lambda s: {"height": 2**70}, ValueError, "height: expected a whole number from 1 to 32768"),
    (lambda s: {"eps2d": "x"}, TypeError, "eps2d: expected a number, got 'x'"),
    (lambda s: {"width": 32768, "height": 32768}, ValueError, "pictures: expected at most"),
    (lambda s: {"near_plane": 0.0}, ValueError, "near_plane: expected a number above 0"),
    (lambda s: {"eps2d": float("nan")}, ValueError, "eps2d: expected"),
    (lambda s: {"rasterize_mode": "soft"}, ValueError, "rasterize_mode: expected classic or antialiased"),
    (lambda s: {"backgrounds": np.zeros((2, 3), np.float32)}, ValueError, r"backgrounds: expected shape \[1, 3\]"),
]


@pytest.mark.parametrize("change,kind,text", REFUSED)
def test_bad_input_is_one_exception(scene, change, kind, text):
    with pytest.raises(kind, match=text):
        subsplat.rasterize(**replaced(scene, **change(scene)))


def test_bad_gradients_are_one_exception(scene):
    good = np.ones((1, 28, 36, 3), np.float32)
    for v, kind, text in [
        (good[..., :2].copy(), ValueError, r"v_colors: expected shape \[1, 28, 36, 3\]"),
        (good.astype(np.float16), TypeError, "v_colors: expected float32, got float16"),
        (good * np.float32(np.nan), ValueError, "v_colors: expected finite numbers"),
    ]:
        with pytest.raises(kind, match=text):
            subsplat.rasterize_backward(**scene, v_colors=v)
    with pytest.raises(ValueError, match="v_depths: expected shape"):
        subsplat.rasterize_backward(**scene, v_depths=good)


def test_no_gaussians_give_the_background():
    scene = make_scene(n=1)
    for name in ("means", "quats", "scales", "opacities", "colors"):
        scene[name] = scene[name][:0]
    got = subsplat.rasterize(**scene, backgrounds=np.float32([[1, 0.5, 0]]))
    assert np.array_equal(got.colors[0, 3, 4], np.float32([1, 0.5, 0])) and got.alphas.max() == 0
    gradients = subsplat.rasterize_backward(**scene, v_colors=np.ones((1, 28, 36, 3), np.float32))
    assert gradients["means"].shape == (0, 3) and gradients["backgrounds"][0, 0] == 28 * 36
