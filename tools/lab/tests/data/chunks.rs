//! Tests of pixelSplat's chunks: a synthetic data set in the original format against the output of
//! pixelSplat's loader, and malformed rows.

use subsplat_test_support as common;
use subsplat_test_support::torch_writer as writer;

use common::shared;
use std::path::Path;
use subsplat::reconstruct::inputs::crop::{CropOptions, CropRule, crop};
use subsplat_kernels::camera::NearFar;
use subsplat_lab::data::chunks::{Chunk, load_index};
use writer::*;

/// Largest difference between two JPEG decoders, grey levels. The inverse transform, the upsampling
/// of the chroma and the colour transform differ by one or two each, and the blue channel
/// multiplies the chroma's by 1.77. Measured: 5.
const MAX_JPEG_DIFFERENCE: u8 = 8;

/// A safetensors file of expected values.
struct Expected(Vec<u8>);

impl Expected {
    fn file(&self) -> safetensors::SafeTensors<'_> {
        safetensors::SafeTensors::deserialize(&self.0).unwrap()
    }

    fn floats(&self, name: &str) -> Vec<f32> {
        let file = self.file();
        let data = file.tensor(name).unwrap().data().to_vec();
        data.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
    }

    fn ints(&self, name: &str) -> Vec<usize> {
        let file = self.file();
        let data = file.tensor(name).unwrap().data().to_vec();
        data.chunks_exact(8).map(|b| i64::from_le_bytes(b.try_into().unwrap()) as usize).collect()
    }
}

fn assert_near(got: &[f32], want: &[f32], tolerance: f32, name: &str) {
    assert_eq!(got.len(), want.len(), "{name}");
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        assert!((g - w).abs() <= tolerance, "{name}[{i}]: {g} {w}");
    }
}

/// Reads a chunk by the index and compares everything with the expected tensors. Cameras are exact.
/// Pictures differ by a few grey levels in single values, because JPEG leaves the last bit of the
/// inverse transform and of the chroma upsampling to the decoder.
#[test]
fn a_chunk_equals_the_output_of_pixelsplats_loader() {
    let Some(folder) = shared("golden/re10k_synth/test") else { return };
    let Some(expected) = shared("golden/re10k_synth_expected.safetensors") else { return };
    let expected = Expected(std::fs::read(expected).unwrap());
    let index = load_index(&folder).unwrap();
    assert_eq!(index.len(), 2);
    let key = "eeee4444ffff5555";
    let chunk = Chunk::open(&index[key]).unwrap();
    assert!(chunk.examples().len() == 2 && chunk.find("0123456789abcdef").is_some());
    let example = chunk.find(key).unwrap();
    assert_eq!((example.frames(), example.timestamps.len()), (12, 12));
    assert!(example.timestamps.windows(2).all(|t| t[0] < t[1]), "{:?}", example.timestamps);
    assert!(example.url.contains("://"), "{}", example.url);

    for (row, camera) in expected.floats("cameras").chunks_exact(18).zip(&example.cameras) {
        assert_eq!(camera.normalised, row[..4]);
        let back = camera.world_from_camera.inverse().transpose().to_cols_array();
        assert_near(&back[..12], &row[6..], 1e-5, "camera from world");
    }
    for frame in [1, 9] {
        let file = expected.file();
        let want = file.tensor(&format!("decoded_u8_hwc.{frame}")).unwrap();
        let (got, camera) = chunk.load(example, frame).unwrap();
        assert_eq!((got.height, got.width), (360, 640));
        assert_near(
            &camera.intrinsics().normalised(),
            &example.cameras[frame].normalised,
            1e-6,
            "fractions",
        );
        let differences = got.data.iter().zip(want.data()).map(|(g, w)| g.abs_diff(*w));
        let (largest, sum) = differences.fold((0, 0u64), |(m, s), d| (m.max(d), s + u64::from(d)));
        let mean = sum as f64 / got.data.len() as f64;
        println!("frame {frame}: largest {largest}, mean {mean:.4} grey levels");
        assert!(
            largest <= MAX_JPEG_DIFFERENCE && mean < 0.5,
            "frame {frame}: largest {largest}, mean {mean}"
        );
    }
    for side in ["context", "target"] {
        check_views(&chunk, key, &expected, side);
    }
    // The augmentation of the training mirrors pictures left to right, together with camera and
    // world.
    let poses = expected.ints("context.index").into_iter().flat_map(|frame| {
        let mirror = glam::Mat4::from_scale(glam::Vec3::new(-1.0, 1.0, 1.0));
        let pose = mirror * example.cameras[frame].world_from_camera * mirror;
        pose.transpose().to_cols_array()
    });
    let poses: Vec<f32> = poses.collect();
    assert_near(&poses, &expected.floats("reflected.extrinsics"), 1e-5, "reflected poses");
}

fn check_views(chunk: &Chunk, key: &str, expected: &Expected, side: &str) {
    let example = chunk.find(key).unwrap();
    let get = |name: &str| expected.floats(&format!("{side}.{name}"));
    let (images, ks, poses) = (get("image"), get("intrinsics"), get("extrinsics"));
    let area = 3 * 256 * 256;
    for (view, frame) in expected.ints(&format!("{side}.index")).into_iter().enumerate() {
        let (photo, camera) = chunk.load(example, frame).unwrap();
        let options = CropOptions { rule: CropRule::Mvsplat, ..CropOptions::square(256, 1, 16) };
        let c = crop(&photo, &camera, &options).unwrap();
        let [fx, fy, cx, cy] = c.input_camera.intrinsics().normalised();
        let k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0];
        assert_near(&k, &ks[9 * view..][..9], 1e-6, "intrinsics");
        let pose = c.input_camera.world_from_camera().transpose().to_cols_array();
        assert_near(&pose, &poses[16 * view..][..16], 1e-5, "pose");
        // The differences of the decoders; resampling averages them.
        assert_near(
            &c.input.to_planes(),
            &images[area * view..][..area],
            (f32::from(MAX_JPEG_DIFFERENCE) + 0.01) / 255.0,
            "image",
        );
    }
    assert!(get("near").iter().all(|n| *n == NearFar::RE10K.near));
    assert!(get("far").iter().all(|f| *f == NearFar::RE10K.far));
}

/// Writes a chunk of one example of one frame; `part` replaces the part `change`.
fn chunk_with(change: &str, part: Py) -> Vec<u8> {
    let mut file = Checkpoint::default();
    let camera: [f32; 18] =
        [0.9, 1.6, 0.5, 0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, 0.2, 0.0, 0.0, 1.0, 0.3];
    let mut pairs = vec![
        ("key", text("aa")),
        ("url", text("https://example.org")),
        ("timestamps", file.tensor("torch LongStorage", &7i64.to_le_bytes(), &[1])),
        ("cameras", file.floats(&camera, &[1, 18])),
        ("images", Py::List(vec![file.tensor("torch ByteStorage", b"no picture", &[10])])),
    ];
    // Storages 3 and 4: invalid cameras, too many columns.
    let mut bent = camera;
    bent[6] = 2.0;
    let bent = file.floats(&bent, &[1, 18]);
    let mut nan = camera;
    nan[9] = f32::NAN;
    let nan = file.floats(&nan, &[1, 18]);
    let mut flat = camera;
    flat[0] = 0.0;
    let flat = file.floats(&flat, &[1, 18]);
    let wide = file.floats(&[0.0; 19], &[1, 19]);
    let two = file.floats(&[camera, camera].concat(), &[2, 18]);
    for pair in &mut pairs {
        if pair.0 == change {
            pair.1 = match &part {
                Py::Str(s) if s == "bent" => bent.clone(),
                Py::Str(s) if s == "nan" => nan.clone(),
                Py::Str(s) if s == "flat" => flat.clone(),
                Py::Str(s) if s == "wide" => wide.clone(),
                Py::Str(s) if s == "two" => two.clone(),
                other => other.clone(),
            };
        }
    }
    pairs.retain(|(name, value)| *name != change || !matches!(value, Py::None));
    file.file(&Py::List(vec![dict(pairs)]))
}

#[test]
fn malformed_rows_are_named() {
    let name = Path::new("000000.torch");
    let good = Chunk::parse(chunk_with("", Py::None), name).unwrap();
    let example = &good.examples()[0];
    assert_eq!((example.timestamps.as_slice(), example.frames()), (&[7i64][..], 1));
    assert_eq!(
        example.cameras[0].world_from_camera.w_axis.truncate().to_array(),
        [-0.1, -0.2, -0.3]
    );
    assert_eq!(good.encoded(example, 0).unwrap(), b"no picture");
    let e = good.load(example, 0).unwrap_err().to_string();
    assert!(e.contains("example `aa` frame 0") && e.contains("picture"), "{e}");
    assert!(good.encoded(example, 1).unwrap_err().to_string().contains("a frame below 1"));

    for (change, part, words) in [
        ("key", Py::None, &["example 0", "without `key`"][..]),
        ("key", Py::Int(3), &["a text as `key`", "an integer"]),
        ("cameras", Py::None, &["example `aa`", "without `cameras`"]),
        ("cameras", Py::Int(3), &["`cameras` as float32 [frames, 18]", "an integer"]),
        ("cameras", text("wide"), &["[frames, 18]", "[1, 19]"]),
        ("cameras", text("bent"), &["example `aa` frame 0", "rigid"]),
        ("cameras", text("nan"), &["example `aa` frame 0", "finite"]),
        ("cameras", text("flat"), &["example `aa` frame 0", "focal"]),
        ("cameras", text("two"), &["as many timestamps as cameras and images", "1, 2 and 1"]),
        ("timestamps", text("bent"), &["`timestamps` as int64", "float32"]),
        ("images", text("bent"), &["`images`, a list", "float32 tensor"]),
        ("images", Py::List(vec![Py::Int(1)]), &["an integer as picture 0"]),
        ("images", Py::List(vec![]), &["1, 1 and 0"]),
        ("images", Py::List(vec![Py::Call("os system", vec![])]), &["os.system as picture 0"]),
    ] {
        let e = Chunk::parse(chunk_with(change, part), name).unwrap_err().to_string();
        assert!(e.starts_with("000000.torch") && !e.contains('\n'), "{e}");
        for word in words {
            assert!(e.contains(word), "{change}: `{word}` is not in: {e}");
        }
    }
    let e = Chunk::parse(Checkpoint::default().file(&dict(vec![])), name).unwrap_err().to_string();
    assert!(e.contains("a list of examples") && e.contains("a dictionary of 0"), "{e}");
}

#[test]
fn an_index_stays_in_its_folder() {
    let folder = tempfile::tempdir().unwrap();
    let load = |text: &str| {
        std::fs::write(folder.path().join("index.json"), text).unwrap();
        load_index(folder.path()).map_err(|e| e.to_string())
    };
    assert_eq!(load(r#"{"a": "000000.torch"}"#).unwrap()["a"], folder.path().join("000000.torch"));
    for name in ["../a.torch", "/a.torch", "x/a.torch", "", "..", ".", "a/"] {
        let e = load(&format!(r#"{{"a": "{name}"}}"#)).unwrap_err();
        assert!(e.contains("names of files in the index's folder"), "{name}: {e}");
    }
    for text in ["[]", "{\"a\": 1}", "{", ""] {
        assert!(load(text).unwrap_err().contains("an object from keys"), "{text}");
    }
}
