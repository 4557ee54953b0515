//! `subsplat view` where there is no window to be had: each case one clear line, at once.
//! The camera's part is tests/scenes/navigation.rs; keys and pictures are tested beside them.

use crate::program;
use subsplat_test_support::one_splat;

use one_splat::save_one_splat;
use program::{Called, called};
use std::path::Path;
use std::process::Command;

/// Calls `view` without a display but for `display`.
fn view(folder: &Path, arguments: &str, display: Option<&str>) -> Called {
    let mut command = Command::new(env!("CARGO_BIN_EXE_subsplat"));
    command.arg("view").args(arguments.split_whitespace()).current_dir(folder);
    for name in ["DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET"] {
        command.env_remove(name);
    }
    command.envs(display.map(|d| ("DISPLAY", d)));
    called(&mut command)
}

#[test]
fn wrong_arguments_are_told_before_a_window_is_looked_for() {
    let folder = tempfile::tempdir().unwrap();
    for (arguments, code, hint) in [
        ("a.ply --device cpu", 2, "--device: expected auto, gpu or an adapter's name"),
        ("a.ply --size 0x5", 2, "N or WxH"),
        ("a.ply --frames 0", 2, "expected a whole number from 1 to 100000"),
        ("a.ply --near -1", 2, "expected a finite number above 0"),
        ("a.ply --background 2,0,0", 2, "--background"),
        ("a.ply --save b.png", 2, "--frames"),
        ("a.ply --levels 3", 2, "[possible values: auto, off]"),
        ("", 2, "SPLATS | SCENE | IMG… | DIR"),
    ] {
        let got = view(folder.path(), arguments, None);
        assert_eq!(got.code, code, "{arguments}: {}", got.stderr);
        assert!(got.stderr.contains(hint), "{arguments}: {}", got.stderr);
    }
}

#[test]
fn a_finished_scene_has_no_use_for_the_flags_of_photographs() {
    let folder = tempfile::tempdir().unwrap();
    save_one_splat(&folder.path().join("one.ply"));
    for flag in [
        "--fov 60",
        "--move 1,0,0",
        "--pose-convention opencv-c2w",
        "--upscale 2",
        "--detail off",
        "--no-check",
    ] {
        let got = view(folder.path(), &format!("one.ply {flag}"), None);
        let name = flag.split(' ').next().unwrap();
        let want = format!("error: {name}: only with photographs; one.ply is a finished scene");
        assert_eq!((got.code, got.error()), (1, want.as_str()), "{flag}");
    }
}

/// Told before the scene is read: there is no a.ply.
#[cfg(all(unix, not(target_os = "macos")))]
#[test]
fn a_missing_display_is_one_line() {
    let folder = tempfile::tempdir().unwrap();
    for display in [None, Some(":4711")] {
        let got = view(folder.path(), "a.ply --json", display);
        assert_eq!(got.code, 1, "{}", got.stderr);
        let error = got.error();
        assert!(error.starts_with("error: no display for a window: "), "{error}");
        assert!(!error.contains(".rs:"), "{error}");
        assert_eq!(
            got.json()["error"].as_str().map(|e| format!("error: {e}")).as_deref(),
            Some(error)
        );
    }
}

#[test]
fn the_manual_names_every_key() {
    let got = view(Path::new("."), "--help", None);
    assert_eq!(got.code, 0);
    for key in [
        "left drag",
        "shift drag",
        "wheel",
        "W A S D Q E",
        "1 2 4",
        "  F ",
        "  R ",
        "  L ",
        "  P ",
        "  H ",
        "Esc",
    ] {
        assert!(got.stdout.contains(key), "{key}");
    }
}
