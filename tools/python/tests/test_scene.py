"""Scenes, files, photographs and cameras."""

import math
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from conftest import REPOSITORY, make_scene

import subsplat

BERLIN = REPOSITORY / "examples" / "berlin"


def small_scene(n=50, degree=1):
    arrays = make_scene(n=n, degree=degree)
    names = ("means", "quats", "scales", "opacities")
    return subsplat.Scene(*(arrays[k] for k in names), arrays["colors"]), arrays


def camera_of(arrays):
    return subsplat.Camera(arrays["viewmats"][0], arrays["Ks"][0], arrays["width"], arrays["height"])


def test_a_scene_renders_what_rasterize_does():
    scene, arrays = small_scene()
    picture = scene.render(camera_of(arrays), background=(0.2, 0.4, 0.6))
    background = np.float32([[0.2, 0.4, 0.6]])
    got = subsplat.rasterize(**arrays, backgrounds=background)
    assert np.array_equal(picture.rgb, got.colors[0])
    assert np.array_equal(picture.alpha, got.alphas[0, ..., 0])
    assert np.allclose(picture.depth, got.depths[0, ..., 0], rtol=1e-6)
    assert picture.to_uint8().dtype == np.uint8 and len(scene) == 50
    assert scene.verdict is None


def test_cameras_give_their_matrices_back():
    arrays = make_scene()
    camera = camera_of(arrays)
    assert np.allclose(camera.viewmat, arrays["viewmats"][0], atol=1e-6)
    assert np.array_equal(camera.K, arrays["Ks"][0])
    twice = camera.resized(2 * camera.width, 2 * camera.height)
    assert np.allclose(twice.K[:2], 2 * camera.K[:2]) and (twice.width, twice.height) == (72, 56)
    assert "36x28" in repr(camera)


def test_files_of_every_format(tmp_path):
    scene, arrays = small_scene()
    before = scene.render(camera_of(arrays)).rgb
    # Quantised formats change a picture a little; .splat has no directions.
    for name, tolerance in [("a.ply", 1e-4), ("a.glb", 1e-4), ("a.spz", 0.05), ("a.splat", 0.4)]:
        scene.save(tmp_path / name)
        again = subsplat.load(tmp_path / name)
        assert len(again) == len(scene)
        difference = np.abs(again.render(camera_of(arrays)).rgb - before).mean()
        assert difference < tolerance, f"{name}: {difference}"
    converted = subsplat.convert(tmp_path / "a.ply", tmp_path / "b.spz", sh_degree=0)
    assert len(converted) == 50 and (tmp_path / "b.spz").stat().st_size > 0
    splats = subsplat.load(tmp_path / "a.ply").splats
    assert np.array_equal(splats.means, arrays["means"])
    assert np.allclose(splats.opacities, arrays["opacities"], atol=1e-5)
    assert np.array_equal(scene.splats.sh, arrays["colors"])


def test_a_page_and_the_viewer_of_a_notebook(tmp_path):
    scene, _ = small_scene()
    scene.save(tmp_path / "scene.html")
    page = (tmp_path / "scene.html").read_text(encoding="utf-8")
    assert "<canvas" in page or "canvas" in page
    shown = scene._repr_html_()
    assert shown.startswith("<iframe srcdoc=") and "&lt;script" in shown


def test_bad_files_are_one_exception(tmp_path):
    scene, _ = small_scene()
    with pytest.raises(FileNotFoundError, match="absent.ply"):
        subsplat.load(tmp_path / "absent.ply")
    (tmp_path / "bad.ply").write_bytes(b"ply\nno header")
    with pytest.raises(ValueError, match="bad.ply"):
        subsplat.load(tmp_path / "bad.ply")
    with pytest.raises(ValueError, match="scene.xyz"):
        scene.save(tmp_path / "scene.xyz")
    with pytest.raises(OSError):
        scene.save(tmp_path / "no" / "folder.ply")
    with pytest.raises(ValueError, match="up axis: expected keep, y or z"):
        scene.save(tmp_path / "a.ply", up="x")
    with pytest.raises(ValueError, match="min_opacity"):
        scene.save(tmp_path / "a.ply", min_opacity=float("nan"))
    with pytest.raises(ValueError, match="page_bytes: expected a whole number of at least 200000, got 10"):
        scene.save(tmp_path / "a.html", page_bytes=10)
    with pytest.raises(ValueError, match="sh_degree: expected a whole number from 0 to 4, got 9"):
        scene.save(tmp_path / "a.ply", sh_degree=9)


def test_bad_views_are_one_exception():
    scene, arrays = small_scene()
    with pytest.raises(ValueError, match="background: expected finite"):
        scene.render(background=(0, float("nan"), 0))
    for background in (1, (1, 2), "red"):
        with pytest.raises(TypeError, match="background: expected three numbers"):
            scene.render(background=background)
    with pytest.raises(TypeError, match="camera: expected a subsplat.Camera, got 3"):
        scene.render(3)
    with pytest.raises(ValueError, match="side: expected a whole number from 1 to 32768, got -1"):
        scene.overview(-1)
    with pytest.raises(TypeError, match="width: expected a whole number from 1 to 32768, got 3.5"):
        subsplat.Camera(arrays["viewmats"][0], arrays["Ks"][0], 3.5, 4)
    with pytest.raises(TypeError, match="viewmat: expected float32, got float64"):
        subsplat.Camera(np.eye(4), arrays["Ks"][0], 4, 4)


def test_photographs_become_a_scene(tmp_path):
    stages = []
    pil = pytest.importorskip("PIL.Image")
    paths = sorted(BERLIN.glob("*.jpg"))[:2]
    first = pil.open(paths[0])
    photos = [first, np.array(pil.open(paths[1]))]
    scene = subsplat.reconstruct(
        photos, quality="fast", gaussians=80_000, progress=lambda *report: stages.append(report)
    )
    assert 60_000 < len(scene) <= 80_000 and len(scene.cameras) == 2
    picture = scene.render()
    assert picture.alpha.mean() > 0.8 and 0.1 < picture.rgb.mean() < 0.9
    names = [stage for stage, _ in stages]
    assert "estimating the cameras" in names and len(set(names)) > 4
    assert all(0 <= fraction <= 1 for _, fraction in stages)
    assert scene.verdict.trust in ("good", "near_photographs")
    assert str(scene.verdict).endswith(scene.verdict.reason)
    scene.save(tmp_path / "berlin.html")
    whole = (tmp_path / "berlin.html").stat().st_size
    assert whole > 1_000_000
    scene.save(tmp_path / "berlin.html", page_bytes=500_000)
    assert 250_000 < (tmp_path / "berlin.html").stat().st_size <= 500_000
    splats = scene.splats
    again = subsplat.rasterize(
        *splats[:4], splats.sh, scene.cameras[0].viewmat[None], scene.cameras[0].K[None],
        scene.cameras[0].width, scene.cameras[0].height,
        sh_degree=min(3, math.isqrt(splats.sh.shape[1]) - 1),
    )
    plain = scene.render(background=(0, 0, 0)).rgb
    assert np.abs(again.colors[0] - plain).mean() < 0.02


def test_cameras_are_estimated_and_checked():
    photos = sorted(BERLIN.glob("*.jpg"))[:2]
    estimate = subsplat.estimate_cameras(photos)
    assert len(estimate.cameras) == 2 and estimate.points.shape[1] == 3
    assert len(estimate.points) > 50
    (report,) = subsplat.check(photos, estimate.cameras)
    assert report["verdict"] in ("ok", "warning") and report["matches"] > 50
    # The second camera turned by a right angle contradicts the photographs.
    turned = estimate.cameras[1].viewmat.copy()
    turned[:3] = np.float32([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]) @ turned[:3]
    wrong = subsplat.Camera(turned, estimate.cameras[1].K, estimate.cameras[1].width, estimate.cameras[1].height)
    (report,) = subsplat.check(photos, [estimate.cameras[0], wrong])
    assert report["verdict"] == "bad"


def test_bad_photographs_are_one_exception(tmp_path):
    good = np.zeros((64, 64, 3), np.uint8)
    for photos, kind, text in [
        (str(tmp_path), ValueError, "folder of at least 2 photographs"),
        ([good], ValueError, "photograph"),
        ([good.astype(np.float32)] * 2, TypeError, "photos: expected uint8, got float32"),
        ([good[..., 0].copy()] * 2, ValueError, r"photos: expected shape \[H, W, 3\]"),
        ([good[:, ::2]] * 2, ValueError, "photos: expected a contiguous array"),
        ([tmp_path / "a.jpg", tmp_path / "b.jpg"], FileNotFoundError, "a.jpg"),
        ([good, good], ValueError, "do not tell where their cameras were"),
        ([3, 4], TypeError, "photos: expected a numpy array"),
    ]:
        with pytest.raises(kind, match=text):
            subsplat.reconstruct(photos)
    with pytest.raises(ValueError, match="quality: expected fast, normal, high or best, got 'x'|got x"):
        subsplat.reconstruct([good, good], quality="x")
    for name, value in [("upscale", 9), ("gaussians", 0), ("gaussians", -5), ("refine_seconds", -1)]:
        with pytest.raises(ValueError, match=f"{name}: expected a whole number .* got {value}"):
            subsplat.reconstruct([good, good], **{name: value})
    with pytest.raises(TypeError, match="gaussians: expected a whole number of at least 1, got 0.5"):
        subsplat.reconstruct([good, good], gaussians=0.5)
    with pytest.raises(FileNotFoundError, match="absent.safetensors"):
        subsplat.reconstruct([good, good], weights="absent.safetensors")
    with pytest.raises(TypeError, match="cameras: expected subsplat.Camera, got 1"):
        subsplat.reconstruct([good, good], cameras=[1, 2])
    with pytest.raises(TypeError, match="photos: expected a path or a list of photographs, got 5"):
        subsplat.reconstruct(5)
    with pytest.raises(ValueError, match="cameras: expected 2 cameras"):
        subsplat.reconstruct([good, good], cameras=[])
    with pytest.raises(TypeError, match="progress: expected a function or True"):
        subsplat.reconstruct([good, good], progress=3)


def test_an_exception_of_the_callback_stops_the_call():
    def stop(stage, fraction):
        raise KeyError(stage)

    with pytest.raises(KeyError):
        subsplat.estimate_cameras(sorted(BERLIN.glob("*.jpg"))[:2], progress=stop)


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGINT to another process")
def test_ctrl_c_is_heard():
    code = (
        "import subsplat, sys\n"
        f"photos = {str(BERLIN)!r}\n"
        "report = lambda *stage: print(*stage, flush=True)\n"
        "try:\n    subsplat.reconstruct(photos, quality='best', progress=report)\n"
        "except KeyboardInterrupt:\n    sys.exit(7)\n"
    )
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert child.stdout.readline()
    start = time.monotonic()
    child.send_signal(signal.SIGINT)
    assert child.wait(timeout=60) == 7
    assert time.monotonic() - start < 30


def test_other_python_threads_run_meanwhile():
    counted, stop = [0], threading.Event()

    def count():
        while not stop.is_set():
            counted[0] += 1
            time.sleep(0.001)

    thread = threading.Thread(target=count)
    thread.start()
    big = make_scene(n=60_000, degree=3, width=512, height=512)
    before = counted[0]
    for _ in range(5):
        subsplat.rasterize(**big)
    during = counted[0] - before
    stop.set()
    thread.join()
    assert during >= 5
