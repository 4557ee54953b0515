//! Runs that end early or are disturbed: killed, without space for a file, without memory, without their folder, with
//! another run in it. What stands under a final name is whole, and the program says one line where it can.

use crate::program::{Called, call_in, called, files, workplace};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use subsplat::Splats;
use subsplat::files::photos::image::{load, load_depth_png};
use subsplat::files::poses::colmap;
use subsplat::files::weights::tensors::TensorFile;
use subsplat::reconstruct::Stage;

/// A small run of each kind of file.
const RUN: &str = "run scene --context 0,2 --target 1 --input-size 64 --quality fast --save ply,spz,html,glb -o out";

/// Calls the program in `folder` with limits that `shell` sets first, in bash.
fn limited(folder: &Path, shell: &str, arguments: &str) -> Called {
    let program = env!("CARGO_BIN_EXE_subsplat");
    let line = format!("{shell}; exec \"{program}\" {arguments}");
    let output = Command::new("bash").args(["-c", &line]).current_dir(folder).output().unwrap();
    Called {
        code: output.status.code().unwrap_or(-1),
        stdout: String::from_utf8(output.stdout).unwrap(),
        stderr: String::from_utf8(output.stderr).unwrap(),
    }
}

/// Number of files under `folder` with their final names. Each must be whole.
#[track_caller]
fn whole_files(folder: &Path) -> usize {
    let mut count = 0;
    for file in files(folder) {
        let path = folder.join(&file);
        let read = || std::fs::read(&path).unwrap();
        let problem = match path.extension().and_then(|e| e.to_str()).unwrap_or_default() {
            "part" => continue,
            "ply" | "spz" | "glb" | "sog" | "splat" => {
                Splats::load(&path).err().map(|e| e.to_string())
            }
            "png" if file.starts_with("depth") => {
                load_depth_png(&path, 1e-4).err().map(|e| e.to_string())
            }
            "png" => load(&path).err().map(|e| e.to_string()),
            "json" => {
                serde_json::from_slice::<serde_json::Value>(&read()).err().map(|e| e.to_string())
            }
            "safetensors" => tensors(&path).err().map(|e| e.to_string()),
            "txt" => colmap_text(&path, &read()).err().map(|e| e.to_string()),
            "html" => {
                let ends = read().trim_ascii_end().ends_with(b"</html>");
                (!ends).then(|| "no </html> at the end".to_owned())
            }
            other => panic!("{}: a file of the kind {other}", file.display()),
        };
        assert_eq!(problem, None, "{}", file.display());
        count += 1;
    }
    count
}

/// Reads every tensor of a file.
fn tensors(path: &Path) -> subsplat::files::Result<()> {
    let file = TensorFile::open(path)?;
    file.specs().iter().try_for_each(|spec| file.read(&spec.name).map(drop))
}

/// Reads a file of COLMAP's text model.
fn colmap_text(path: &Path, bytes: &[u8]) -> subsplat::files::Result<()> {
    match path.file_stem().and_then(|s| s.to_str()) {
        Some("cameras") => colmap::parse_cameras_txt(path, bytes).map(drop),
        Some("images") => colmap::parse_images_txt(path, bytes, &mut Vec::new()).map(drop),
        _ => colmap::parse_points_txt(path, bytes).map(drop),
    }
}

/// Number of kills of each command. `SUBSPLAT_KILLS` sets it.
fn kills(few: u32) -> u32 {
    std::env::var("SUBSPLAT_KILLS").map_or(few, |n| n.parse().unwrap())
}

/// The program in `folder`, with OUT in its arguments replaced by `out`.
fn command(program: &str, folder: &Path, arguments: &str, out: &str) -> Command {
    let mut command = Command::new(program);
    let arguments = arguments.replace("OUT", out);
    command.args(arguments.split_whitespace()).current_dir(folder);
    command
}

fn spawned(mut command: Command) -> Child {
    command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap()
}

/// Kills a call that writes into the folder OUT at moments that are spread over a whole call. Each killed call leaves
/// whole files, and the same call in the folder of a killed one writes them all.
fn kill(program: &str, folder: &Path, arguments: &str, kills: u32) {
    std::fs::create_dir(folder.join("whole")).unwrap();
    let start = Instant::now();
    let whole = called(&mut command(program, folder, arguments, "whole"));
    assert_eq!(whole.code, 0, "{arguments}: {}", whole.stderr);
    let time = start.elapsed();
    let all = whole_files(&folder.join("whole"));
    let mut fewer = 0;
    for kill in 0..kills {
        let out = format!("killed{kill}");
        std::fs::create_dir(folder.join(&out)).unwrap();
        let mut child = spawned(command(program, folder, arguments, &out));
        // Half of the moments lie in the last fifth, in which files are written.
        let part = f64::from(kill / 2 + 1) / f64::from(kills / 2 + 1);
        let part = if kill % 2 == 0 { part } else { 0.8 + 0.25 * part };
        std::thread::sleep(Duration::from_secs_f64(time.as_secs_f64() * part));
        child.kill().unwrap();
        child.wait().unwrap();
        fewer += usize::from(whole_files(&folder.join(&out)) < all);
    }
    // A folder that a killed call left is no obstacle.
    let again = called(&mut command(program, folder, arguments, "killed0"));
    assert_eq!((again.code, whole_files(&folder.join("killed0"))), (0, all), "{}", again.stderr);
    println!("{arguments}: {kills} kills, {fewer} of them before the last file");
}

#[test]
fn a_killed_run_leaves_whole_files() {
    let place = workplace();
    let arguments = RUN.replace("-o out", "-o OUT");
    kill(env!("CARGO_BIN_EXE_subsplat"), place.path(), &arguments, kills(6));
}

/// Ctrl-C during a refinement of a hundred thousand steps: the scene so far and its pictures are written. A curve has the scores of
/// the photograph that the scene is not made from.
#[cfg(unix)]
#[test]
fn ctrl_c_keeps_the_scene_of_the_steps_so_far() {
    let place = workplace();
    let arguments = "--json run scene --context 0,2 --target 1 --input-size 64 --refine 100000 --save ply -o out";
    let mut command = command(env!("CARGO_BIN_EXE_subsplat"), place.path(), arguments, "");
    let mut child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map(Result::unwrap);
    let stage = format!("reconstruction: {}", Stage::Refine.description());
    assert!(lines.by_ref().any(|line| line.starts_with(&stage)));
    let id = child.id().to_string();
    assert!(Command::new("kill").args(["-INT", &id]).status().unwrap().success());
    let rest: Vec<String> = lines.collect();
    let output = child.wait_with_output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{rest:?}");
    assert!(rest.iter().any(|line| line.starts_with("Ctrl-C ended the refinement")), "{rest:?}");
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let curve = report["refine"]["curve"].as_array().unwrap();
    let psnr = |point: &serde_json::Value| point["psnr"].as_f64().unwrap();
    let of = |point: &serde_json::Value| (point["steps"].as_u64(), point["seconds"].as_f64());
    assert!(curve.len() > 2 && curve.windows(2).all(|w| of(&w[0]) < of(&w[1])), "{curve:?}");
    let end = report["psnr"].as_f64().unwrap();
    assert!(curve.iter().all(|p| (psnr(p) - end).abs() < 1.0), "{end} after {curve:?}");
    assert!(report["refine"]["steps"].as_u64() >= of(curve.last().unwrap()).0, "{report}");
    assert!(whole_files(&place.path().join("out")) > 5);
}

/// The photographs of the example, without their cameras.
fn photographs(folder: &Path) -> String {
    let images = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/room/images");
    for name in ["input_0.png", "input_1.png"] {
        std::fs::copy(images.join(name), folder.join(name)).unwrap();
    }
    "poses input_0.png input_1.png --fov 68 -o OUT".to_owned()
}

#[test]
fn killed_poses_leave_whole_files() {
    let place = tempfile::tempdir().unwrap();
    let arguments = photographs(place.path());
    kill(env!("CARGO_BIN_EXE_subsplat"), place.path(), &arguments, kills(4));
}

/// A scene of 40,000 Gaussians in the folder, as a .ply.
fn save_scene(folder: &Path) {
    let place = workplace();
    assert_eq!(call_in(place.path(), RUN).code, 0);
    std::fs::copy(place.path().join("out/scene.ply"), folder.join("scene.ply")).unwrap();
}

#[test]
fn killed_exports_leave_whole_files() {
    let place = tempfile::tempdir().unwrap();
    save_scene(place.path());
    for format in ["ply", "sog", "html"] {
        let folder = place.path().join(format);
        std::fs::create_dir(&folder).unwrap();
        let arguments = format!("export ../scene.ply -o OUT/a.{format}");
        kill(env!("CARGO_BIN_EXE_subsplat"), &folder, &arguments, kills(4));
    }
}

fn shipped_weights() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../src/network/shipped/small.safetensors")
}

#[test]
fn killed_conversions_leave_whole_files() {
    let place = tempfile::tempdir().unwrap();
    std::fs::copy(shipped_weights(), place.path().join("in.safetensors")).unwrap();
    let arguments = "in.safetensors OUT/w.safetensors --force";
    kill(env!("CARGO_BIN_EXE_subsplat-convert"), place.path(), arguments, kills(4));
}

/// Two runs at once into one folder write the scene that one run writes.
#[test]
fn two_runs_into_one_folder_leave_whole_files() {
    let place = workplace();
    let folder = place.path();
    let alone = call_in(folder, RUN);
    assert_eq!(alone.code, 0, "{}", alone.stderr);
    let all = whole_files(&folder.join("out"));
    let run = |_| {
        let arguments = RUN.replace("-o out", "-o OUT");
        spawned(command(env!("CARGO_BIN_EXE_subsplat"), folder, &arguments, "both"))
    };
    let codes = [0, 1].map(run).map(|mut child| child.wait().unwrap().code());
    assert_eq!(codes, [Some(0); 2]);
    assert_eq!(whole_files(&folder.join("both")), all);
    assert!(files(&folder.join("both")).iter().all(|f| f.extension() != Some("part".as_ref())));
    for file in ["scene.ply", "scene.spz", "scene.glb"] {
        let read = |out: &str| std::fs::read(folder.join(out).join(file)).unwrap();
        assert!(read("both") == read("out"), "{file}");
    }
}

/// One line names the place, nothing panics, and no half-written file stays.
#[track_caller]
fn assert_refused(called: &Called, place: &str) {
    assert_eq!(called.code, 1, "{}", called.stderr);
    assert!(called.error().contains(place), "{}", called.stderr);
    assert!(!called.stderr.contains("panicked"), "{}", called.stderr);
}

/// The folder of a run is moved away while the run works.
#[test]
fn a_folder_that_disappears_is_one_error() {
    let place = workplace();
    let folder = place.path();
    let mut command = command(env!("CARGO_BIN_EXE_subsplat"), folder, RUN, "");
    let child = command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let start = Instant::now();
    // The last folder that a run makes before it works.
    while !folder.join("out/inputs").is_dir() {
        assert!(start.elapsed() < Duration::from_secs(60), "no folder");
        std::thread::sleep(Duration::from_millis(1));
    }
    std::fs::rename(folder.join("out"), folder.join("moved")).unwrap();
    let output = child.wait_with_output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    let code = output.status.code().unwrap_or(-1);
    let called = Called { code, stdout: text(output.stdout), stderr: text(output.stderr) };
    assert_refused(&called, "out");
    whole_files(&folder.join("moved"));
    assert!(!folder.join("out").exists() || whole_files(&folder.join("out")) == 0);
}

/// A folder of the system, in which nobody may write, is refused by every command.
#[cfg(target_os = "linux")]
#[test]
fn a_read_only_folder_is_one_error() {
    let place = workplace();
    let folder = place.path();
    let poses = photographs(folder);
    subsplat_test_support::one_splat::save_one_splat(&folder.join("scene.ply"));
    let program = env!("CARGO_BIN_EXE_subsplat");
    let weights = format!("{} OUT/w.safetensors", shipped_weights().display());
    for (program, arguments) in [
        (program, RUN.replace("-o out", "-o OUT")),
        (program, poses),
        (program, "export scene.ply -o OUT/a.spz".to_owned()),
        (env!("CARGO_BIN_EXE_subsplat-convert"), weights),
    ] {
        for out in ["/sys", "/sys/new"] {
            assert_refused(&called(&mut command(program, folder, &arguments, out)), "/sys");
        }
    }
}

/// File systems of a few sizes, each full before the run ends: one error and no half-written file. Only where the
/// system lets a user mount one.
#[cfg(target_os = "linux")]
#[test]
fn a_full_disk_is_one_error_and_no_half_file() {
    let place = workplace();
    let folder = place.path();
    let mount = ["-rm", "mount", "-t", "tmpfs", "none", "/mnt"];
    let may_mount = Command::new("unshare").args(mount).output();
    if !may_mount.is_ok_and(|output| output.status.success()) {
        println!("SKIP: no file system can be mounted here");
        return;
    }
    let program = env!("CARGO_BIN_EXE_subsplat");
    std::fs::create_dir(folder.join("out")).unwrap();
    for kibibytes in [8, 64, 256] {
        // The files are copied out of the file system, which is gone when the shell ends.
        let copy = format!("copy{kibibytes}");
        let line = format!(
            "mount -t tmpfs -o size={kibibytes}k none out && \"{program}\" {RUN}; code=$?; cp -r out {copy}; exit $code"
        );
        let mut command = Command::new("unshare");
        let full = called(command.args(["-rm", "bash", "-c", &line]).current_dir(folder));
        assert_refused(&full, "out");
        whole_files(&folder.join(&copy));
        let parts = files(&folder.join(&copy));
        assert!(parts.iter().all(|f| f.extension() != Some("part".as_ref())), "{parts:?}");
    }
}

/// A limit of the size of a file fails a write as a full disk does.
#[cfg(target_os = "linux")]
#[test]
fn a_file_without_space_is_one_error_and_no_half_file() {
    let place = workplace();
    let folder = place.path();
    assert_eq!(call_in(folder, RUN).code, 0);
    let all = whole_files(&folder.join("out"));
    for (i, blocks) in [0, 8, 64, 400].into_iter().enumerate() {
        let out = format!("full{i}");
        // bash counts blocks of 1024 bytes. The signal of the limit is ignored, and the write fails instead.
        let shell = format!("trap '' XFSZ; ulimit -f {blocks}");
        let called = limited(folder, &shell, &RUN.replace("-o out", &format!("-o {out}")));
        assert_eq!(called.code, 1, "{blocks}: {}", called.stderr);
        assert!(called.error().contains(&out), "{blocks}: {}", called.stderr);
        assert!(!called.stderr.contains("panicked"), "{blocks}: {}", called.stderr);
        assert!(whole_files(&folder.join(&out)) < all, "{blocks} are enough");
        let parts = files(&folder.join(&out));
        assert!(parts.iter().all(|f| f.extension() != Some("part".as_ref())), "{parts:?}");
    }
}

/// A limit of memory ends the program with one line, or is enough.
#[cfg(target_os = "linux")]
#[test]
fn little_memory_is_one_error() {
    let place = workplace();
    let folder = place.path();
    let mut refused = 0;
    for mebibytes in [150, 200, 250, 300, 400, 600] {
        let shell = format!("ulimit -v {}", mebibytes * 1024);
        let called = limited(folder, &shell, RUN);
        assert!([0, 1].contains(&called.code), "{mebibytes}: {}: {}", called.code, called.stderr);
        assert!(!called.stderr.contains("panicked"), "{mebibytes}: {}", called.stderr);
        if called.code == 1 {
            assert!(called.error().contains("not enough memory"), "{mebibytes}: {}", called.stderr);
            refused += 1;
        }
        whole_files(&folder.join("out"));
    }
    assert!(refused > 0, "the limits were enough");
}
