//! `subsplat compare` of rasterizer cases: every conformance case passes, a damaged
//! one does not, a malformed one is refused by name.

use crate::program;
use subsplat_test_support as common;
#[cfg(feature = "gpu")]
use subsplat_test_support::gpu as adapter;

use common::{raster_cases, shared};
use program::{Called, call_with};
use safetensors::tensor::TensorView;
use safetensors::{Dtype, SafeTensors};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use subsplat_kernels::cpu::SimdLevel;

/// Not ours: it holds no camera and no metadata (tests/raster/raster.rs has its test).
const FOREIGN: &str = "brush_tiny";

fn compare(reference: &Path, more: &[&str]) -> Called {
    let words = ["--json", "compare", "--reference", reference.to_str().unwrap()];
    call_with(Path::new("."), &[&words[..], more].concat(), &[])
}

#[test]
fn every_case_passes() {
    for path in raster_cases().iter().filter(|p| p.file_stem().unwrap() != FOREIGN) {
        for (level, threads) in SimdLevel::available().iter().zip(["1", "2", "3", "4"]) {
            let called = compare(path, &["--threads", threads, "--simd", level.name()]);
            assert_eq!(called.code, 0, "{}: {} {}", path.display(), called.stdout, called.stderr);
            let report = called.json();
            assert_eq!(report["ok"], true);
            let tensors = report["tensors"].as_array().unwrap();
            let names: Vec<_> = tensors.iter().map(|t| t["tensor"].as_str().unwrap()).collect();
            assert!(names.starts_with(&["rgb", "alpha", "depth_sum", "depth"]), "{names:?}");
            assert!(names.contains(&"grad.sh") && names.len() >= 9, "{names:?}");
        }
    }
}

/// The GPU's picture and gradients of every case, by the program.
#[cfg(feature = "gpu")]
#[test]
fn every_case_passes_on_a_gpu() {
    if adapter::gpu().is_none() {
        return;
    }
    for path in raster_cases().iter().filter(|p| p.file_stem().unwrap() != FOREIGN) {
        let called = compare(path, &["--device", "gpu"]);
        assert_eq!(called.code, 0, "{}: {} {}", path.display(), called.stdout, called.stderr);
        let report = called.json();
        assert_eq!(report["ok"], true);
        let tensors = report["tensors"].as_array().unwrap();
        let names: Vec<_> = tensors.iter().map(|t| t["tensor"].as_str().unwrap()).collect();
        assert!(names.starts_with(&["rgb", "alpha", "depth_sum", "depth"]), "{names:?}");
        assert!(names.contains(&"grad.sh") && names.len() >= 9, "{names:?}");
    }
    let Some(path) = shared("fixtures/raster/gain.safetensors") else { return };
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("off.safetensors");
    let mut off = Copy::read(&path);
    off.scale("grad.quats", 1.002);
    off.write(&file);
    let called = compare(&file, &["--device", "gpu"]);
    assert_eq!(called.code, 3, "{} {}", called.stdout, called.stderr);
    let Some(path) = raster_cases().pop() else { return };
    let called = compare(&path, &["--device", "no such adapter"]);
    assert_eq!(called.code, 1, "{}", called.stdout);
    assert!(called.json()["error"].to_string().contains("no such adapter"), "{}", called.stdout);
}

/// A case that can be changed and written again.
struct Copy {
    metadata: HashMap<String, String>,
    tensors: BTreeMap<String, (Dtype, Vec<usize>, Vec<u8>)>,
}

impl Copy {
    fn read(path: &Path) -> Self {
        let bytes = std::fs::read(path).unwrap();
        let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
        let metadata = header.metadata().clone().unwrap();
        let all = SafeTensors::deserialize(&bytes).unwrap();
        let own = |(name, t): (String, TensorView)| {
            (name, (t.dtype(), t.shape().to_vec(), t.data().to_vec()))
        };
        Self { metadata, tensors: all.tensors().into_iter().map(own).collect() }
    }

    fn write(&self, path: &Path) {
        let views = self.tensors.iter().map(|(name, (dtype, shape, data))| {
            (name.as_str(), TensorView::new(*dtype, shape.clone(), data).unwrap())
        });
        let bytes = safetensors::serialize(views, Some(self.metadata.clone())).unwrap();
        std::fs::write(path, bytes).unwrap();
    }

    /// Adds `by` to the number at `index` of a tensor.
    fn shift(&mut self, name: &str, index: usize, by: f32) {
        let data = &mut self.tensors.get_mut(name).unwrap().2;
        let at = &mut data[4 * index..4 * index + 4];
        let value = f32::from_le_bytes(at.try_into().unwrap()) + by;
        at.copy_from_slice(&value.to_le_bytes());
    }

    /// Multiplies a tensor.
    fn scale(&mut self, name: &str, by: f32) {
        for at in self.tensors.get_mut(name).unwrap().2.chunks_exact_mut(4) {
            let value = by * f32::from_le_bytes((&*at).try_into().unwrap());
            at.copy_from_slice(&value.to_le_bytes());
        }
    }

    /// Index of a pixel that is no boundary.
    fn inner(&self) -> usize {
        let boundary = &self.tensors["boundary"].2;
        boundary.iter().skip(300).position(|&b| b == 0).unwrap() + 300
    }
}

#[test]
fn a_case_that_is_a_little_off_fails() {
    let Some(path) = shared("fixtures/raster/gain.safetensors") else { return };
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("off.safetensors");
    let case = Copy::read(&path);
    let pixel = case.inner();
    type Change = fn(&mut Copy, usize);
    let changes: [(&str, Change); 9] = [
        ("rgb", |c, pixel| c.shift("rgb", 3 * pixel + 1, 6e-5)),
        ("alpha", |c, pixel| c.shift("alpha", pixel, -6e-5)),
        ("depth", |c, pixel| c.shift("depth", pixel, 5e-3)),
        ("depth_sum", |c, pixel| c.shift("depth_sum", pixel, f32::NAN)),
        ("rgb", |c, _| c.shift("background", 2, 1e-3)),
        ("grad.scales", |c, _| c.scale("grad.scales", 1.002)),
        ("grad.gain", |c, _| c.scale("grad.gain", 0.998)),
        ("grad.background", |c, _| c.scale("grad.background", 1.002)),
        ("grad.sh", |c, pixel| c.shift("v_rgb", 3 * pixel, 1.0)),
    ];
    for (tensor, change) in changes {
        let mut off = Copy { metadata: case.metadata.clone(), tensors: case.tensors.clone() };
        change(&mut off, pixel);
        off.write(&file);
        let called = compare(&file, &[]);
        assert_eq!(called.code, 3, "{tensor}: {} {}", called.stdout, called.stderr);
        let report = called.json();
        assert_eq!(report["ok"], false);
        let row = report["tensors"].as_array().unwrap().iter().find(|r| r["tensor"] == tensor);
        assert_eq!(row.unwrap()["ok"], false, "{tensor}: {report}");
    }
}

#[test]
fn boundary_pixels_are_left_out() {
    let Some(path) = shared("fixtures/raster/saturated.safetensors") else { return };
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("flip.safetensors");
    let mut case = Copy::read(&path);
    let at = case.tensors["boundary"].2.iter().position(|&b| b == 1).unwrap();
    case.shift("rgb", 3 * at, 0.1);
    case.write(&file);
    assert_eq!(compare(&file, &[]).code, 0);
    case.tensors.get_mut("boundary").unwrap().2[at] = 0;
    case.write(&file);
    assert_eq!(compare(&file, &[]).code, 3);
}

/// Pictures and gradients are optional: the others are compared, and the report names the
/// absent ones.
#[test]
fn absent_tensors_are_reported() {
    let Some(path) = shared("fixtures/raster/gain.safetensors") else { return };
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("part.safetensors");
    let good = Copy::read(&path);
    let without = |names: &[&str]| {
        let mut case = Copy { metadata: good.metadata.clone(), tensors: good.tensors.clone() };
        for name in names {
            assert!(case.tensors.remove(*name).is_some(), "{name}");
        }
        case.write(&file);
        compare(&file, &[])
    };
    let listed = |report: &serde_json::Value, key: &str, field: Option<&str>| -> Vec<String> {
        let all = report[key].as_array().unwrap().iter();
        all.map(|v| field.map_or(v, |f| &v[f]).as_str().unwrap().to_owned()).collect()
    };
    let whole = without(&[]).json();
    assert_eq!(whole["absent"], serde_json::json!([]));
    let all = listed(&whole, "tensors", Some("tensor"));
    assert_eq!(all.len(), 11, "{all:?}");
    let grads: Vec<&str> =
        all.iter().map(String::as_str).filter(|n| n.starts_with("grad.")).collect();
    let pictures = ["rgb", "alpha", "depth_sum", "depth"];
    for names in [
        &["depth_sum"][..],
        &["rgb"],
        &["alpha", "depth"],
        &["boundary"],
        &["grad.gain"],
        &["v_alpha"],
        &pictures,
        &grads,
        &["v_rgb", "v_alpha"],
    ] {
        // Gradients without those of the picture are refused below.
        let more = if names.contains(&"v_rgb") { &grads[..] } else { &[] };
        let names = [names, more].concat();
        let called = without(&names);
        // Without a mask, a boundary pixel may be out of tolerance; without v_alpha, the
        // gradients are others.
        let exact =
            !names.contains(&"boundary") && !names.contains(&"v_alpha") || names.contains(&"v_rgb");
        assert!(called.code == 0 || !exact, "{names:?}: {} {}", called.stdout, called.stderr);
        let report = called.json();
        let mut absent = listed(&report, "absent", None);
        let mut wanted: Vec<String> = names.iter().map(|n| (*n).to_owned()).collect();
        absent.sort();
        wanted.sort();
        assert_eq!(absent, wanted);
        let kept: Vec<String> =
            all.iter().filter(|n| !names.contains(&n.as_str())).cloned().collect();
        assert_eq!(listed(&report, "tensors", Some("tensor")), kept);
    }
    // Half of the loss alone is compared too: the gradient of the background is that of rgb.
    let report = without(&["v_alpha"]).json();
    let row = |r: &serde_json::Value| r["tensor"] == "grad.background";
    assert_eq!(report["tensors"].as_array().unwrap().iter().find(|r| row(r)).unwrap()["ok"], true);
    let refused = |names: &[&str], words: &[&str]| {
        let called = without(names);
        assert_eq!(called.code, 1, "{names:?}: {} {}", called.stdout, called.stderr);
        for word in words {
            assert!(called.error().contains(word), "{} lacks {word}", called.error());
        }
    };
    let v = ["v_rgb", "v_alpha"];
    refused(&v, &["grad.means", "v_rgb or v_alpha"]);
    refused(&[&pictures[..], &grads].concat(), &["a tensor to compare", "rgb", "grad.sh"]);
    refused(
        &[&pictures[..], &grads, &v, &["boundary"]].concat(),
        &["a picture to compare", "neither"],
    );
    // The text for people names them too.
    let words = ["compare", "--reference", file.to_str().unwrap()];
    without(&["depth_sum"]);
    let called = call_with(Path::new("."), &words, &[]);
    assert!(
        called.stdout.contains("not in the file, not compared: depth_sum"),
        "{}",
        called.stdout
    );
}

#[test]
fn malformed_cases_are_refused_by_name() {
    let Some(path) = shared("fixtures/raster/gain.safetensors") else { return };
    let place = tempfile::tempdir().unwrap();
    let file = place.path().join("bad.safetensors");
    let good = Copy::read(&path);
    let refused = |case: &Copy, words: &[&str]| {
        case.write(&file);
        let called = compare(&file, &[]);
        assert_eq!(called.code, 1, "{words:?}: {} {}", called.stdout, called.stderr);
        for word in words.iter().chain(&["bad.safetensors"]) {
            assert!(called.error().contains(word), "{} lacks {word}", called.error());
        }
    };
    let copy = || Copy { metadata: good.metadata.clone(), tensors: good.tensors.clone() };
    for (key, value, words) in [
        ("convention", "brush", &["convention", "standard or mvsplat", "brush"][..]),
        ("alpha_max", "0.99", &["alpha_max", "0.999", "0.99"]),
        ("width", "many", &["width", "many"]),
        ("width", "47", &["rgb", "[40, 47, 3]", "[40, 48, 3]"]),
        ("height", "18446744073709551615", &["32768", "18446744073709551615"]),
        ("children", "0", &["opacities", "0 children"]),
        ("near", "-1", &["near", "-1"]),
        ("lowpass", "inf", &["lowpass", "inf"]),
        ("sh_degree", "9", &["sh_degree", "0 to 4", "9"]),
    ] {
        let mut case = copy();
        case.metadata.insert(key.to_owned(), value.to_owned());
        refused(&case, words);
    }
    for name in ["means", "quats", "scales", "opacities", "sh", "intrinsics"] {
        let mut case = copy();
        case.tensors.remove(name);
        refused(&case, &[name]);
    }
    let mut case = copy();
    case.metadata.remove("near");
    refused(&case, &["`near`"]);
    let mut case = copy();
    case.tensors.get_mut("boundary").unwrap().2.fill(1);
    refused(&case, &["boundary"]);
    let mut case = copy();
    case.shift("world_from_camera", 0, 1.0);
    refused(&case, &["pose"]);
    let mut case = copy();
    case.metadata.clear();
    refused(&case, &["convention", "--weights"]);
    std::fs::write(&file, "text").unwrap();
    let called = compare(&file, &[]);
    assert_eq!(called.code, 1);
    assert!(called.error().contains("bad.safetensors: expected a safetensors file"));
    assert!(compare(&place.path().join("none"), &[]).error().contains("none"));
}

#[test]
fn an_instruction_set_that_is_not_here_is_refused() {
    let Some(path) = shared("fixtures/raster/gain.safetensors") else { return };
    let all = [SimdLevel::Baseline, SimdLevel::Avx2, SimdLevel::Avx512, SimdLevel::Neon];
    let absent: Vec<_> = all.into_iter().filter(|t| !t.is_available()).collect();
    assert!(!absent.is_empty());
    for level in absent {
        let called = compare(&path, &["--simd", level.name()]);
        assert_eq!(called.code, 1);
        assert!(called.error().contains("--simd") && called.error().contains(level.name()));
    }
}
