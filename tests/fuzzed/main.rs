//! The committed corpus of the fuzz targets (`tests/fuzz/corpus`) through the functions that the fuzzer calls: no panic,
//! no wrong round trip, no slow input, without a nightly toolchain.

#[path = "../fuzz/src/targets.rs"]
mod targets;

use flate2::read::DeflateDecoder;
use std::collections::BTreeSet;
use std::io::{Cursor, Read};
use std::panic::catch_unwind;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// Longest time of one input. The inputs are below 64 KiB, and the slowest takes a few milliseconds.
const LIMIT: Duration = Duration::from_secs(2);

fn fuzz() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fuzz")
}

/// Names in a folder without extension, sorted.
fn stems(folder: &Path) -> BTreeSet<String> {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    entries.map(|path| path.file_stem().unwrap().to_str().unwrap().to_owned()).collect()
}

#[test]
fn every_input_of_the_corpus_is_answered() {
    let mut wrong = Vec::new();
    for &(name, target) in targets::TARGETS {
        let archive = std::fs::read(fuzz().join(format!("corpus/{name}.zip"))).unwrap();
        let mut inputs = zip::ZipArchive::new(Cursor::new(archive)).unwrap();
        assert!(!inputs.is_empty(), "{name}: no input");
        for i in 0..inputs.len() {
            // The crate's features leave decompression to flate2.
            let mut input = inputs.by_index_raw(i).unwrap();
            let mut bytes = Vec::new();
            DeflateDecoder::new(&mut input).read_to_end(&mut bytes).unwrap();
            assert_eq!(bytes.len() as u64, input.size());
            let start = Instant::now();
            let answered = catch_unwind(|| target(&bytes)).is_ok();
            let time = start.elapsed();
            if !answered || time > LIMIT {
                wrong.push(format!(
                    "{name}, {}: answered {answered}, {time:?}",
                    input.name().unwrap()
                ));
            }
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// A corpus without its target would not be read, and a target without its corpus would begin from nothing.
#[test]
fn targets_and_corpora_have_the_same_names() {
    let names: BTreeSet<String> =
        targets::TARGETS.iter().map(|(name, _)| (*name).to_owned()).collect();
    assert_eq!(names.len(), targets::TARGETS.len());
    assert!(names.iter().all(|name| targets::target(name).is_some()));
    assert_eq!(stems(&fuzz().join("corpus")), names);
    let readme = std::fs::read_to_string(fuzz().join("README.md")).unwrap();
    names.iter().for_each(|name| {
        assert!(readme.contains(&format!("`{name}`")), "{name} is not in the README")
    });
}
