//! The README's Rust program: its text, and its results beside those of `subsplat run`.

use crate::program::{called, files, without_photographs};
use crate::readme_snippet;
use std::path::{Path, PathBuf};
use std::process::Command;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

#[test]
fn the_readme_quotes_the_program() {
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    let quoted = readme.split("```rust\n").nth(1).and_then(|rest| rest.split("```").next());
    // A module of this test program needs a public `main`.
    let program = include_str!("readme_snippet.rs").replace("pub fn main", "fn main");
    assert_eq!(quoted.unwrap(), program);
}

/// Runs the README's program in the current folder. The test below starts it as a process of
/// its own, because a folder belongs to a whole process.
#[test]
#[ignore = "the_readme_program_and_run_give_the_same_bytes starts it"]
fn readme_program() {
    readme_snippet::main().unwrap();
}

#[test]
fn the_readme_program_and_run_give_the_same_bytes() {
    let place = tempfile::tempdir().unwrap();
    let room = place.path().join("examples/room");
    for file in files(&root().join("examples/room")) {
        let to = room.join(&file);
        std::fs::create_dir_all(to.parent().unwrap()).unwrap();
        std::fs::copy(root().join("examples/room").join(&file), to).unwrap();
    }
    let mut program = Command::new(std::env::current_exe().unwrap());
    program.args(["--exact", "readme::readme_program", "--ignored"]).current_dir(place.path());
    let own = called(&mut program);
    assert!(own.code == 0 && own.stdout.contains("1 passed"), "{}\n{}", own.stdout, own.stderr);
    let mut run = Command::new(env!("CARGO_BIN_EXE_subsplat"));
    run.args(["run", "examples/room", "--target", "2", "-o", "out"]).current_dir(place.path());
    let run = called(&mut run);
    assert_eq!(run.code, 0, "{}", run.stderr);
    let images = files(&place.path().join("out/images"));
    let [image] = images.as_slice() else { panic!("{images:?}") };
    let image = Path::new("out/images").join(image);
    for (ours, theirs) in [("room.ply", "out/scene.ply"), ("view.png", image.to_str().unwrap())] {
        let [ours, theirs] = [ours, theirs].map(|f| without_photographs(&place.path().join(f)));
        assert!(ours == theirs, "the README's program and `subsplat run` differ");
    }
}
