//! Peak memory of whole runs, as the program itself reports it (`VmHWM`), and the memory of a process that makes many
//! scenes.

use subsplat_test_support::whole;

use std::path::Path;
use std::process::Command;
use subsplat::files::photos::image::save_png;
use subsplat::files::poses::cameras_json::{CameraFile, NamedCamera, save_cameras_json};
use subsplat::{Options, Photo, Reconstructor};

/// Largest difference between the peaks of runs with small and with large photographs, MiB.
const LARGE_PHOTOGRAPHS: f64 = 8.0;

/// A scene folder of two photographs.
fn scene(folder: &Path, width: usize, height: usize) {
    let shoot = whole::shoot(3, 2, width, height);
    std::fs::create_dir_all(folder.join("images")).unwrap();
    let frame = |(i, photo): (usize, &subsplat::reconstruct::Photo)| {
        let file = format!("images/{i}.png");
        save_png(folder.join(&file), photo.image()).unwrap();
        NamedCamera::new(file, *photo.camera())
    };
    let cameras = shoot.photos.iter().enumerate().map(frame).collect();
    save_cameras_json(
        folder.join("cameras.json"),
        &CameraFile { cameras, units: Default::default(), near_far: None, ..Default::default() },
    )
    .unwrap();
}

/// MiB at the peak of `subsplat run --json` with these arguments.
fn peak(scene: &Path, arguments: &[&str]) -> f64 {
    let out = tempfile::tempdir().unwrap();
    let run = Command::new(env!("CARGO_BIN_EXE_subsplat"))
        .args([
            "run",
            "--json",
            "--path",
            "interpolate",
            "--frames",
            "2",
            "--near",
            "0.4",
            "--far",
            "12",
        ])
        .args(arguments)
        .arg("-o")
        .arg(out.path())
        .arg(scene)
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&run.stderr);
    assert!(run.status.success(), "{said}");
    let report: serde_json::Value = serde_json::from_slice(&run.stdout).unwrap();
    let bytes = report["peak_memory_bytes"].as_f64().unwrap();
    let mib = bytes / f64::from(1 << 20);
    eprintln!("{arguments:?}: {mib:.0} MiB, seconds {}", report["seconds"]);
    // A number that no process of this size could have would be a broken report.
    let gaussians = report["gaussians"].as_f64().unwrap();
    assert!(bytes > gaussians * 60.0, "{mib:.0} MiB for {gaussians} Gaussians");
    mib
}

/// The PyTorch backbone alone takes 2.2 GiB at 2 × 256².
#[test]
fn runs_stay_within_their_memory() {
    let folder = tempfile::tempdir().unwrap();
    scene(folder.path(), 1024, 1024);
    let limits = [("re10k", "2", 1.2), ("re10k", "4", 1.5), ("small", "2", 1.2)];
    for (backbone, upscale, gib) in limits {
        let mib = peak(folder.path(), &["--backbone", backbone, "--upscale", upscale]);
        assert!(mib <= 1024.0 * gib, "{backbone} x{upscale}: {mib:.0} MiB");
    }
}

/// The network starts after photographs at full size, grey images and features are freed. Two
/// photographs of 1080x1920 take 12 MiB, their grey images 16 MiB.
#[test]
fn large_photographs_are_freed_before_the_network() {
    let folder = tempfile::tempdir().unwrap();
    let peaks = [(256, 256), (1080, 1920)].map(|(width, height)| {
        let folder = folder.path().join(width.to_string());
        scene(&folder, width, height);
        // Fit and refinement of large photographs have larger pictures than those of small ones.
        peak(
            &folder,
            &[
                "--backbone",
                "re10k",
                "--crop",
                "square",
                "--detail",
                "off",
                "--fit",
                "0",
                "--refine",
                "off",
            ],
        )
    });
    let [small, large] = peaks;
    assert!(large - small <= LARGE_PHOTOGRAPHS, "{large:.0} MiB instead of {small:.0}");
}

/// MiB of this process that are in memory.
#[cfg(target_os = "linux")]
fn resident() -> f64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find(|line| line.starts_with("VmRSS:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap() / 1024.0
}

/// All numbers of the scene of two photographs, as bits.
fn scene_bits(model: &Reconstructor, photos: &[Photo]) -> Vec<u32> {
    let scene = model.run(photos, &Options::default().with_input_size(64, 64)).unwrap();
    let splats = scene.splats();
    splats.rows().iter().chain(splats.sh()).map(|v| v.to_bits()).collect()
}

/// Scenes one after another, then several at once: each has the bytes of the first, and the memory does not grow with
/// their number. `SUBSPLAT_RUNS` and `SUBSPLAT_THREADS` set the numbers.
#[cfg(target_os = "linux")]
#[test]
fn many_scenes_in_one_process_are_equal_and_leave_nothing() {
    /// MiB by which the least memory of two halves may differ, whatever the number of scenes.
    const NOISE: f64 = 24.0;
    /// Set in a process that runs no other test beside this one.
    const ALONE: &str = "SUBSPLAT_ALONE";
    if std::env::var_os(ALONE).is_none() {
        let name = "many_scenes_in_one_process_are_equal_and_leave_nothing";
        let mut own = Command::new(std::env::current_exe().unwrap());
        let run = own.args(["--exact", name, "--nocapture"]).env(ALONE, "1").output().unwrap();
        let [said, errors] = [&run.stdout, &run.stderr].map(|text| String::from_utf8_lossy(text));
        println!("{said}");
        assert!(run.status.success() && said.contains("1 passed"), "{said}{errors}");
        return;
    }
    let number = |name: &str, few: usize| std::env::var(name).map_or(few, |n| n.parse().unwrap());
    let (runs, threads) = (number("SUBSPLAT_RUNS", 8), number("SUBSPLAT_THREADS", 4));
    let photos = whole::shoot(3, 2, 96, 96).photos;
    let model = Reconstructor::shipped(2).unwrap();
    let first = scene_bits(&model, &photos);
    let half = runs / 2;
    let mut memory = [f64::INFINITY; 2];
    for run in 0..runs {
        assert!(scene_bits(&model, &photos) == first, "scene {run}");
        let least = &mut memory[usize::from(run >= half)];
        *least = least.min(resident());
    }
    println!(
        "{runs} scenes: at least {:.0} MiB in the first half, {:.0} later",
        memory[0], memory[1]
    );
    assert!(memory[1] - memory[0] < NOISE, "{memory:?} MiB");
    std::thread::scope(|scope| {
        let scenes: Vec<_> =
            (0..threads).map(|_| scope.spawn(|| scene_bits(&model, &photos))).collect();
        for (thread, scene) in scenes.into_iter().enumerate() {
            assert!(scene.join().unwrap() == first, "thread {thread}");
        }
    });
    println!("{threads} scenes at once: {:.0} MiB", resident());
}
