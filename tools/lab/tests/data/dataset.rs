//! Tests of training examples from disk: their order, their contents, mirroring, and errors.

use subsplat_test_support as common;
use subsplat_test_support::chunk_files;
use subsplat_test_support::made_up;
use subsplat_test_support::noise;

use chunk_files::{Video, frame, video, write};
use glam::{Mat4, Quat, Vec3};
use std::collections::BTreeSet;
use std::path::Path;
use subsplat::files::poses::cameras_json::{CameraFile, save_cameras_json};
use subsplat::files::poses::scene::{Units, is_scene};
use subsplat::reconstruct::inputs::crop::{CropOptions, CropRule, LrFrom, crop};
use subsplat::scene::pictures::Rgb;
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};
use subsplat_kernels::layout::{Convention, RasterOptions, ShBasis};
use subsplat_lab::data::chunks::Chunk;
use subsplat_lab::data::dataset::{Dataset, ExampleOptions, Posed, TrainingExample};
use subsplat_lab::data::sampler::{GapMode, ViewSampler};

fn options(flip: bool) -> ExampleOptions {
    let crop = CropOptions::square(16, 2, 16);
    ExampleOptions { sampler: ViewSampler::constant(2, 4, 3), crop, flip, near_far: None }
}

/// Writes two chunks of three and four videos.
fn seven() -> (tempfile::TempDir, [Vec<Video>; 2]) {
    let folder = tempfile::tempdir().unwrap();
    let videos = |keys: &[&str], frames| keys.iter().map(|k| video(k, frames)).collect();
    let chunks: [Vec<Video>; 2] = [videos(&["a", "b", "c"], 7), videos(&["d", "e", "f", "g"], 9)];
    write(&folder.path().join("train"), &[&chunks[0], &chunks[1]]);
    (folder, chunks)
}

fn open(path: &Path, options: ExampleOptions) -> Dataset {
    Dataset::open(path, options).unwrap()
}

#[test]
fn a_seed_and_an_index_determine_the_example() {
    let (folder, _) = seven();
    let data = open(folder.path(), options(true));
    assert_eq!(data.len(), 7);
    let mut stream = data.stream(5, 0);
    let first: Vec<TrainingExample> = (0..16).map(|_| stream.next_example(0).unwrap()).collect();
    assert_eq!(stream.index(), 16);
    // Equal from any index, in any order, in another data set object.
    let again = open(&folder.path().join("train"), options(true));
    for i in [11u64, 3, 15, 0, 8] {
        assert_eq!(again.example(5, i, 0).unwrap().unwrap(), first[i as usize], "{i}");
    }
    let mut restarted = again.stream(5, 9);
    assert_eq!(restarted.next_example(0).unwrap(), first[9]);
    assert_eq!(restarted.next_example(0).unwrap(), first[10]);
    // A round visits every video once, chunk by chunk. The next round has another order and other
    // frames.
    let names = |e: &[TrainingExample]| e.iter().map(|e| e.name.clone()).collect::<Vec<_>>();
    let rounds = [names(&first[..7]), names(&first[7..14])];
    for round in &rounds {
        assert_eq!(round.iter().collect::<BTreeSet<_>>().len(), 7, "{round:?}");
        let chunk: Vec<bool> = round.iter().map(|n| n.as_str() < "d").collect();
        assert_eq!(chunk.windows(2).filter(|w| w[0] != w[1]).count(), 1, "{round:?}");
    }
    let orders: BTreeSet<Vec<String>> = (0..20)
        .map(|seed| {
            let mut stream = again.stream(seed, 0);
            (0..7).map(|_| stream.next_example(0).unwrap().name).collect()
        })
        .collect();
    assert!(orders.len() > 15, "{} orders of 20 seeds", orders.len());
    let frames: BTreeSet<String> = first.iter().map(|e| format!("{:?}", e.frames)).collect();
    assert!(frames.len() > 12, "{frames:?}");
    let flipped = first.iter().filter(|e| e.flipped).count();
    assert!((2..15).contains(&flipped), "{flipped} of 16 mirrored");
    assert!(
        (0..16).all(|i| !open(folder.path(), options(false))
            .example(5, i, 0)
            .unwrap()
            .unwrap()
            .flipped)
    );
}

/// Inputs and targets are the crops of the example's frames.
#[test]
fn views_are_the_crops_of_their_frames() {
    let (folder, chunks) = seven();
    for lr_from in [LrFrom::HrCrop, LrFrom::Independent] {
        let mut wanted = options(false);
        wanted.crop.lr_from = lr_from;
        wanted.crop.rule = CropRule::Mvsplat;
        let data = open(folder.path(), wanted.clone());
        for index in 0..7 {
            let e = data.example(1, index, 0).unwrap().unwrap();
            let file = usize::from(e.name.as_str() >= "d");
            let path = folder.path().join(format!("train/{file:06}.torch"));
            let chunk = Chunk::open(&path).unwrap();
            let example = chunk.find(&e.name).unwrap();
            let made = chunks[file].iter().find(|v| v.key == e.name).unwrap();
            let [left, right] = e.frames.context;
            assert!((2..=4).contains(&(right - left)) && right < made.frames);
            assert_eq!((e.context.len(), e.targets.len()), (2, 3));
            assert_eq!(e.near_far, NearFar::RE10K);
            for (view, i) in e.context.iter().zip(e.frames.context) {
                let (photo, camera) = chunk.load(example, i).unwrap();
                assert_eq!(photo, frame(made, i));
                let c = crop(&photo, &camera, &wanted.crop).unwrap();
                assert_eq!(*view, Posed { image: c.input, camera: c.input_camera });
                assert_eq!((view.image.width, view.image.height), (16, 16));
            }
            for (view, &i) in e.targets.iter().zip(&e.frames.targets) {
                let (photo, camera) = chunk.load(example, i).unwrap();
                let c = crop(&photo, &camera, &wanted.crop).unwrap();
                assert_eq!(*view, Posed { image: c.target, camera: c.target_camera });
                assert!((view.camera.position().x - 0.1 * i as f32).abs() < 1e-6);
                assert_eq!((view.image.width, view.image.height), (32, 32));
            }
        }
    }
}

#[test]
fn unusable_videos_are_skipped() {
    let folder = tempfile::tempdir().unwrap();
    let wide = Video { fx: 0.4, ..video("wide", 9) };
    let small = Video { size: (40, 30), ..video("small", 9) };
    let videos = [video("short", 2), wide, small, video("good", 5)];
    write(folder.path(), &[&videos]);
    let data = open(folder.path(), options(false));
    let mut stream = data.stream(0, 0);
    for round in 1..4 {
        assert_eq!(stream.next_example(0).unwrap().name, "good");
        assert!(stream.index() <= 4 * round && stream.index() > 4 * (round - 1));
    }
    let usable: Vec<bool> = (0..4).map(|i| data.example(0, i, 0).unwrap().is_some()).collect();
    assert_eq!(usable.iter().filter(|u| **u).count(), 1);
    // A step whose gap is longer than every video.
    let mut long = options(false);
    long.sampler = ViewSampler::re10k(GapMode::Mvs);
    let data = open(folder.path(), long);
    let e = data.stream(0, 0).next_example(0).unwrap_err().to_string();
    for words in ["more than 25 frames", "32x32", "100 degrees", "none among 4"] {
        assert!(e.contains(words), "{e}");
    }
}

#[test]
fn broken_data_sets_are_refused_with_a_reason() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |words: &[&str]| {
        let e = match Dataset::open(folder.path(), options(false)) {
            Err(e) => e.to_string(),
            Ok(data) => data.stream(0, 0).next_example(0).unwrap_err().to_string(),
        };
        for word in words {
            assert!(e.contains(word), "`{word}` is not in: {e}");
        }
    };
    refused(&["a scene, a folder of scenes, or chunks", "none of them"]);
    std::fs::write(folder.path().join("index.json"), "{}").unwrap();
    refused(&["index.json", "at least one example"]);
    std::fs::write(folder.path().join("index.json"), r#"{"z": "000000.torch"}"#).unwrap();
    refused(&["000000.torch", "No such file"]);
    std::fs::write(folder.path().join("000000.torch"), chunk_files::chunk(&[video("a", 5)]))
        .unwrap();
    refused(&["000000.torch", "`z`", "index.json says"]);
    let missing = Dataset::open(folder.path().join("none"), options(false));
    assert!(missing.err().unwrap().to_string().contains("none"));
}

fn scene_folder(folder: &Path, frames: usize, units: Units, near_far: Option<NearFar>) {
    std::fs::create_dir_all(folder).unwrap();
    let (made, cameras) = made_up::made_up(frames);
    std::fs::rename(made.path().join("images"), folder.join("images")).unwrap();
    save_cameras_json(
        folder.join("cameras.json"),
        &CameraFile { cameras, units, near_far, ..Default::default() },
    )
    .unwrap();
}

#[test]
fn folders_of_scenes_are_data_sets() {
    let folder = tempfile::tempdir().unwrap();
    scene_folder(&folder.path().join("one"), 4, Units::RealEstate10k, None);
    scene_folder(&folder.path().join("two"), 5, Units::Unknown, Some(NearFar::new(0.5, 7.0)));
    scene_folder(&folder.path().join("three"), 5, Units::Unknown, None);
    std::fs::create_dir(folder.path().join("notes")).unwrap();
    assert!(is_scene(folder.path().join("one")) && !is_scene(folder.path().join("notes")));
    let data = open(folder.path(), options(false));
    let mut stream = data.stream(2, 0);
    let mut names = BTreeSet::new();
    for _ in 0..3 {
        let e = stream.next_example(0).unwrap();
        let baseline = e.context[0].camera.position().distance(e.context[1].camera.position());
        let expected = match e.name.as_str() {
            "one" => (1.0, 100.0),
            "two" => (0.5, 7.0),
            _ => (0.5 * baseline, 30.0 * baseline),
        };
        assert!(
            (e.near_far.near - expected.0).abs() < 1e-4
                && (e.near_far.far - expected.1).abs() < 1e-3
        );
        names.insert(e.name);
    }
    assert_eq!(names.len(), 3);
    let fixed_range = ExampleOptions { near_far: Some(NearFar::new(2.0, 3.0)), ..options(false) };
    let one = open(&folder.path().join("one"), fixed_range);
    assert_eq!(
        (one.len(), one.stream(0, 0).next_example(0).unwrap().near_far),
        (1, NearFar::new(2.0, 3.0))
    );
}

/// A constant camera position determines no depth. Such pairs are skipped, and the stream
/// continues.
#[test]
fn pairs_without_a_baseline_are_skipped() {
    let folder = tempfile::tempdir().unwrap();
    let still = |name: &str, moves: usize| {
        let path = folder.path().join(name);
        scene_folder(&path, 12, Units::Unknown, None);
        let file = path.join("cameras.json");
        let mut json: serde_json::Value =
            serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
        let first = json["frames"][0]["c2w"].clone();
        for frame in json["frames"].as_array_mut().unwrap().iter_mut().skip(moves) {
            frame["c2w"] = first.clone();
        }
        std::fs::write(file, json.to_string()).unwrap();
        path
    };
    let (half, all) = (still("half", 3), still("all", 0));
    let data = open(&half, options(false));
    assert!((0..40).any(|i| data.example(1, i, 0).unwrap().is_none()));
    for i in 0..40 {
        let e = data.example_from(1, i, 0).unwrap().1;
        assert!(e.context[0].camera.position() != e.context[1].camera.position());
    }
    let e = open(&all, options(false)).example_from(1, 0, 0).unwrap_err().to_string();
    assert!(e.contains("a camera that moves or with near and far"), "{e}");
    let fixed_range = ExampleOptions { near_far: Some(NearFar::new(2.0, 3.0)), ..options(false) };
    assert_eq!(
        open(&all, fixed_range).example_from(1, 0, 0).unwrap().1.near_far,
        NearFar::new(2.0, 3.0)
    );
}

fn posed() -> Posed {
    let (w, h) = (48, 32);
    let k = Intrinsics { fx: 50.0, fy: 47.0, cx: 20.3, cy: 17.1, width: w, height: h };
    let turn = Quat::from_euler(glam::EulerRot::XYZ, 0.1, -0.3, 0.2);
    let pose = Mat4::from_rotation_translation(turn, Vec3::new(0.4, -0.2, -3.0));
    Posed { image: noise::noise(w, h), camera: Camera::new(k, pose).unwrap() }
}

#[test]
fn mirroring_twice_restores_the_view() {
    let view = posed();
    let mirrored_view = view.flipped();
    assert_ne!(mirrored_view, view);
    assert!(
        Camera::new(mirrored_view.camera.intrinsics(), mirrored_view.camera.world_from_camera())
            .is_ok()
    );
    for c in 0..3 {
        let at = |p: &Posed, x: usize, y: usize| p.image.data[3 * (y * 48 + x) + c];
        assert_eq!(at(&mirrored_view, 5, 7), at(&view, 42, 7));
    }
    let back = mirrored_view.flipped();
    assert_eq!(back.image, view.image);
    assert_eq!(back.camera.world_from_camera(), view.camera.world_from_camera());
    assert!((back.camera.intrinsics().cx - view.camera.intrinsics().cx).abs() < 1e-5);
    let (folder, _) = seven();
    let e = open(folder.path(), options(false)).example(0, 0, 0).unwrap().unwrap();
    assert_eq!(e.flipped().flipped(), e);
    assert_ne!(e.flipped().targets[0].image, e.targets[0].image);
}

/// Mirrored Gaussians, seen by the mirrored camera, give the mirrored picture.
#[test]
fn a_mirrored_scene_renders_to_the_mirrored_picture() {
    let mut state = 9u32;
    let mut number = |low: f32, high: f32| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        low + (high - low) * (state >> 8) as f32 / (1 << 24) as f32
    };
    let (mut rows, mut mirrored, mut sh) = (Vec::new(), Vec::new(), Vec::new());
    for _ in 0..60 {
        let mean = [number(-1.5, 1.5), number(-1.0, 1.0), number(-0.5, 2.0)];
        let q = [number(0.2, 1.0), number(-1.0, 1.0), number(-1.0, 1.0), number(-1.0, 1.0)];
        let rest = [number(0.05, 0.4), number(0.05, 0.4), number(0.05, 0.4), number(0.2, 0.9)];
        rows.extend(mean.into_iter().chain(q).chain(rest));
        // S·R·S with S = diag(−1, 1, 1): rotations about y and z change their sign.
        let (m, r) = ([-mean[0], mean[1], mean[2]], [q[0], q[1], -q[2], -q[3]]);
        mirrored.extend(m.into_iter().chain(r).chain(rest));
        sh.extend([number(-1.0, 1.0), number(-1.0, 1.0), number(-1.0, 1.0)]);
    }
    let splats =
        |rows: Vec<f32>| Splats::new(rows, sh.clone(), Vec::new(), 0, ShBasis::Standard).unwrap();
    let view = posed();
    let options = RasterOptions::new(Convention::Standard);
    let picture = |splats: &Splats, camera: &Camera| {
        let picture = subsplat::scene::render(splats, camera, &options);
        Rgb::from_unit(&picture.rgb, picture.width, picture.height).unwrap()
    };
    let image = picture(&splats(rows), &view.camera);
    let bright = image.data.iter().filter(|v| **v > 25).count();
    assert!(bright > 1000, "an empty picture proves nothing");
    let expected = Posed { image, ..view }.flipped();
    let got = picture(&splats(mirrored), &expected.camera);
    let apart = got.data.iter().zip(&expected.image.data).map(|(g, w)| g.abs_diff(*w));
    // The last digit of a float may round differently.
    assert!(apart.max() <= Some(1));
}

/// The synthetic data set of the reference loader.
#[test]
fn the_synthetic_re10k_streams() {
    let Some(folder) = common::shared("golden/re10k_synth") else { return };
    let crop = CropOptions { rule: CropRule::Mvsplat, ..CropOptions::square(128, 2, 32) };
    let sampler = ViewSampler::constant(2, 6, 4);
    let data = open(&folder, ExampleOptions { sampler, crop, flip: true, near_far: None });
    assert_eq!(data.len(), 2);
    let mut stream = data.stream(0, 0);
    let names: BTreeSet<String> = (0..2).map(|_| stream.next_example(0).unwrap().name).collect();
    println!("{names:?} in {} indices", stream.index());
    assert!(names.iter().all(|n| n == "aaaa0000bbbb1111" || n == "cccc2222dddd3333"));
}
