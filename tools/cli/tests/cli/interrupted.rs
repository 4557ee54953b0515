//! Runs that end early: killed, without space for a file, without memory. What stands under a final name is
//! whole, and the program says one line where it can.

use crate::program::{Called, call_in, files, workplace};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};
use subsplat::Splats;
use subsplat::files::photos::image::{load, load_depth_png};

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
            "ply" | "spz" | "glb" => Splats::load(&path).err().map(|e| e.to_string()),
            "png" if file.starts_with("depth") => {
                load_depth_png(&path, 1e-4).err().map(|e| e.to_string())
            }
            "png" => load(&path).err().map(|e| e.to_string()),
            "json" => {
                serde_json::from_slice::<serde_json::Value>(&read()).err().map(|e| e.to_string())
            }
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

/// Kills the program at moments that are spread over a whole run. `SUBSPLAT_KILLS` sets their number.
#[test]
fn a_killed_run_leaves_whole_files() {
    let place = workplace();
    let folder = place.path();
    let start = Instant::now();
    let whole = call_in(folder, RUN);
    assert_eq!(whole.code, 0, "{}", whole.stderr);
    let time = start.elapsed();
    let all = whole_files(&folder.join("out"));
    let kills: u32 = std::env::var("SUBSPLAT_KILLS").map_or(6, |n| n.parse().unwrap());
    let mut fewer = 0;
    for kill in 0..kills {
        let out = format!("killed{kill}");
        let arguments = RUN.replace("-o out", &format!("-o {out}"));
        let mut child = Command::new(env!("CARGO_BIN_EXE_subsplat"))
            .args(arguments.split_whitespace())
            .current_dir(folder)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        // Half of the moments lie in the last fifth, in which files are written.
        let part = f64::from(kill / 2 + 1) / f64::from(kills / 2 + 1);
        let part = if kill % 2 == 0 { part } else { 0.8 + 0.25 * part };
        std::thread::sleep(Duration::from_secs_f64(time.as_secs_f64() * part));
        child.kill().unwrap();
        child.wait().unwrap();
        if folder.join(&out).is_dir() {
            fewer += usize::from(whole_files(&folder.join(&out)) < all);
        }
    }
    // A folder that a killed run left is no obstacle.
    let again = call_in(folder, &RUN.replace("-o out", "-o killed0"));
    assert_eq!((again.code, whole_files(&folder.join("killed0"))), (0, all), "{}", again.stderr);
    println!("{kills} kills, {fewer} of them before the last file");
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
