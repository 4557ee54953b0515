//! Splats far from the origin, splats beyond the range of a format, and files that are not what their name says.

use glam::DVec3;
use std::io::Write;
use std::path::Path;
use subsplat::files::{
    SaveOptions, SplatFile, load_splat_file, load_splats, read, save_splats, splat_info,
};
use subsplat::scene::render::origin_of_comments;
use subsplat::scene::splats::Splats;
use subsplat_kernels::layout::ShBasis;

/// A binary .ply of splats at `places`, whose positions have the type `kind`.
fn ply(kind: &str, places: &[DVec3], more: &str) -> Vec<u8> {
    let mut text =
        format!("ply\nformat binary_little_endian 1.0\n{more}element vertex {}\n", places.len());
    ["x", "y", "z"].iter().for_each(|name| text += &format!("property {kind} {name}\n"));
    for name in [
        "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1",
        "rot_2", "rot_3",
    ] {
        text += &format!("property float {name}\n");
    }
    let mut bytes = (text + "end_header\n").into_bytes();
    for place in places {
        for v in place.to_array() {
            match kind {
                "double" => bytes.extend(v.to_le_bytes()),
                _ => bytes.extend((v as f32).to_le_bytes()),
            }
        }
        for v in [0.1f32, 0.2, 0.3, 1.0, -3.0, -3.0, -3.0, 1.0, 0.0, 0.0, 0.0] {
            bytes.extend(v.to_le_bytes());
        }
    }
    bytes
}

fn load(bytes: &[u8]) -> SplatFile {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.ply");
    std::fs::write(&path, bytes).unwrap();
    load_splat_file(&path).unwrap()
}

/// Splats within 3 units.
fn near_places() -> Vec<DVec3> {
    (0..90).map(f64::from).map(|t| DVec3::new(t.sin(), 0.02 * t, (1.7 * t).cos())).collect()
}

#[test]
fn doubles_far_from_the_origin_keep_their_digits() {
    let offset = DVec3::new(448_260.25, 5_411_933.0, 36.5);
    let mut far: Vec<DVec3> = near_places().into_iter().map(|place| place + offset).collect();
    // A row that was never written, and a splat of the sky.
    far[0] = DVec3::ZERO;
    far[1] = offset * 3.0;
    let file = load(&ply("double", &far, ""));
    let origin = origin_of_comments(&file.comments);
    assert!(origin.distance(offset) < 3.0 && origin == origin.round(), "{origin}");
    assert!(file.notes.len() == 1 && file.notes[0].contains("relative to"), "{:?}", file.notes);
    for (i, place) in far.iter().enumerate().skip(2) {
        let found = DVec3::from(file.splats.mean(i).map(f64::from));
        assert!((found + origin - *place).length() < 1e-6, "{i}: {found}");
    }
    // A file with an origin of its own.
    let again = load(&ply("double", &far, "comment subsplat origin: 1000,0,-2\ncomment mine\n"));
    let shift = DVec3::new(1000.0, 0.0, -2.0);
    assert_eq!(origin_of_comments(&again.comments), origin + shift);
    assert_eq!(again.comments[0], "mine");
    // A written file has the origin.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("b.ply");
    let options = SaveOptions { comments: file.comments.clone(), ..SaveOptions::default() };
    save_splats(&path, &file.splats, &options).unwrap();
    let back = load_splat_file(&path).unwrap();
    assert_eq!(origin_of_comments(&back.comments), origin);
    assert!(back.notes.is_empty(), "{:?}", back.notes);
}

#[test]
fn near_doubles_are_read_as_they_are_and_far_floats_have_a_note() {
    let near = near_places();
    let shifted: Vec<DVec3> = near.iter().map(|place| *place + 100.0).collect();
    for places in [&near, &shifted] {
        let file = load(&ply("double", places, ""));
        assert!(file.notes.is_empty() && file.comments.is_empty(), "{:?}", file.notes);
        for (i, place) in places.iter().enumerate() {
            assert_eq!(file.splats.mean(i), place.as_vec3().to_array());
        }
        assert!(load(&ply("float", places, "")).notes.is_empty());
    }
    let far: Vec<DVec3> = near.iter().map(|place| *place + 5e6).collect();
    let file = load(&ply("float", &far, ""));
    assert!(file.notes.len() == 1 && file.notes[0].contains("32-bit"), "{:?}", file.notes);
    assert_eq!(file.splats.mean(3), far[3].as_vec3().to_array());
}

/// `n` splats, of which the first `outside` lie at 10¹².
fn with_outliers(n: usize, outside: usize) -> Splats {
    let row = |i: usize| {
        let x = if i < outside { -1e12 } else { i as f32 };
        [x, 1.0, 2.0, 1.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.9]
    };
    let rows = (0..n).flat_map(row).collect();
    Splats::new(rows, vec![0.1; 3 * n], Vec::new(), 0, ShBasis::Standard).unwrap()
}

#[test]
fn splats_beyond_the_range_of_spz_are_left_out_with_their_number() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.spz");
    let save = |splats: &Splats| save_splats(&path, splats, &SaveOptions::default());
    let report = save(&with_outliers(100, 5)).unwrap();
    assert_eq!((report.count, report.out_of_range, report.pruned), (95, 5, 0));
    let notes = report.notes();
    assert!(notes.len() == 1 && notes[0].contains("5 of 100 splats"), "{notes:?}");
    let back = load_splats(&path).unwrap();
    assert_eq!(back.len(), 95);
    assert!((back.mean(0)[0] - 5.0).abs() < 1e-3, "{:?}", back.mean(0));
    assert_eq!(save(&with_outliers(100, 50)).unwrap().count, 50);
    let error = save(&with_outliers(100, 51)).unwrap_err().to_string();
    assert!(error.contains("a.spz") && error.contains("51 of 100"), "{error}");
    assert!(save(&with_outliers(3, 0)).unwrap().notes().is_empty());
    // Other formats hold them.
    let report =
        save_splats(folder.path().join("a.ply"), &with_outliers(9, 5), &SaveOptions::default());
    assert_eq!(report.unwrap().count, 9);
}

#[track_caller]
fn refused(path: &Path, bytes: &[u8], words: &[&str]) {
    std::fs::write(path, bytes).unwrap();
    for error in [load_splat_file(path).map(drop), splat_info(path).map(drop)] {
        let error = error.unwrap_err().to_string();
        let named = error.contains(&path.display().to_string());
        assert!(named && words.iter().all(|word| error.contains(word)), "{error}");
    }
}

#[test]
fn downloads_that_are_no_scenes_are_named() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let mut packed = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::default());
    packed.write_all(&ply("float", &near_places(), "")).unwrap();
    refused(&at("a.ply.gz"), &packed.finish().unwrap(), &["a .ply compressed by gzip", "unpack"]);
    for page in ["<!DOCTYPE html>\n<html>", "\u{feff}\n <HTML lang=\"en\"><body>404</body>"] {
        refused(&at("a.ply"), page.as_bytes(), &["a web page (HTML)"]);
        refused(&at("a.spz"), page.as_bytes(), &["a web page (HTML)"]);
    }
    let pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 12345\n";
    refused(&at("b.ply"), pointer, &["git-lfs", "git lfs pull"]);
}

/// The opening of a pipe without a writer does not end.
#[cfg(unix)]
#[test]
fn pipes_are_refused_at_once() {
    use subsplat::files::photos::photograph::probe_photograph;
    use subsplat::files::poses::scene::load_scene;

    let folder = tempfile::tempdir().unwrap();
    for name in ["a.ply", "a.jpg", "a.json", "a.mp4", "z.txt", "list.json", "z.xml"] {
        let made = std::process::Command::new("mkfifo").arg(folder.path().join(name)).status();
        assert!(made.unwrap().success());
    }
    let (send, receive) = std::sync::mpsc::channel();
    let path = folder.path().to_owned();
    std::thread::spawn(move || {
        let at = |name: &str| path.join(name);
        let words = |error: subsplat::files::Error| error.to_string();
        let errors = [
            load_splat_file(at("a.ply")).map(drop).map_err(words),
            splat_info(at("a.ply")).map(drop).map_err(words),
            probe_photograph(at("a.jpg")).map(drop).map_err(words),
            load_scene(at("a.json")).map(drop).map_err(words),
            read(at("a.mp4")).map(drop).map_err(words),
        ];
        // The pipes in a folder are passed over.
        let folder = words(load_scene(&path).unwrap_err());
        send.send((errors.map(Result::unwrap_err), folder)).unwrap();
    });
    let (errors, folder) = receive.recv_timeout(std::time::Duration::from_secs(20)).unwrap();
    for error in errors {
        assert!(error.contains("a regular file, got a pipe"), "{error}");
    }
    assert!(folder.contains("a folder with none of them"), "{folder}");
}
