//! Goldens of the witness (`tools/witness/golden.py` says what stands in them): inputs
//! and weights for a module, and the comparison of what it gives with what onnxruntime
//! gave for a graph that was written from the specification.

pub mod formula;
pub mod tolerances;

use candle_core::{DType, Device, Tensor};
use glam::Mat4;
use serde::Deserialize;
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use subsplat::network::model::Views;
use subsplat::network::model::weights::Weights;
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};

/// Metadata `witness` of a golden.
#[derive(Debug, Deserialize)]
pub struct About {
    pub seed: u64,
    pub weights: Vec<(String, Vec<usize>)>,
    pub drawn: Vec<(String, Vec<usize>, f64, f64)>,
    pub outputs: BTreeMap<String, Held>,
    /// The configuration that the graph stands for, in the crate's JSON.
    #[serde(default)]
    pub notes: serde_json::Value,
}

/// How much of an output the golden holds.
#[derive(Debug, Deserialize)]
pub struct Held {
    pub shape: Vec<usize>,
    pub stride: usize,
}

pub struct Golden {
    pub name: String,
    pub about: About,
    tensors: BTreeMap<String, Tensor>,
    compared: RefCell<BTreeSet<String>>,
}

/// Names of the committed goldens that begin with `prefix`, in order; at least one.
pub fn names(prefix: &str) -> Vec<String> {
    let files = std::fs::read_dir(folder()).unwrap().map(|e| e.unwrap().path());
    let stems = files.filter(|p| p.extension().is_some_and(|e| e == "safetensors"));
    let stems = stems.map(|p| p.file_stem().unwrap().to_string_lossy().into_owned());
    let mut found: Vec<String> = stems.filter(|n| n.starts_with(prefix)).collect();
    found.sort();
    assert!(!found.is_empty(), "no golden {prefix}*");
    found
}

/// Where the committed goldens lie.
pub fn folder() -> PathBuf {
    crate::repository().join("tests/goldens/witness")
}

/// Says loudly that a test checked nothing.
pub fn skip(why: &str) {
    // Not `eprintln!`, which cargo hides for tests that pass.
    std::io::Write::write_all(&mut std::io::stderr(), format!("SKIP: {why}\n").as_bytes()).ok();
}

impl Golden {
    pub fn load(name: &str) -> Self {
        Self::load_from(&folder(), name)
    }

    pub fn load_from(folder: &Path, name: &str) -> Self {
        let path = folder.join(format!("{name}.safetensors"));
        let bytes = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        let (_, header) = safetensors::SafeTensors::read_metadata(&bytes).unwrap();
        let about = &header.metadata().as_ref().expect("metadata")["witness"];
        Self {
            name: name.to_owned(),
            about: serde_json::from_str(about).unwrap(),
            tensors: candle_core::safetensors::load_buffer(&bytes, &Device::Cpu)
                .unwrap()
                .into_iter()
                .collect(),
            compared: RefCell::default(),
        }
    }

    /// The weights that the graph took, under the names that it gave them.
    pub fn weights(&self) -> Weights {
        let weight = |(name, shape): &(String, Vec<usize>)| {
            let values = formula::weight(self.about.seed, name, shape);
            let tensor = Tensor::from_vec(values, shape.as_slice(), &Device::Cpu).unwrap();
            (name.clone(), tensor)
        };
        Weights::from_tensors(self.about.weights.iter().map(weight).collect())
    }

    /// An input of the graph: stored, or by formula.
    pub fn input(&self, name: &str) -> Tensor {
        if let Some(stored) = self.tensors.get(&format!("in.{name}")) {
            return stored.clone();
        }
        let (_, shape, low, high) = (self.about.drawn.iter().find(|d| d.0 == name))
            .unwrap_or_else(|| panic!("{}: no input {name}", self.name));
        let values = formula::drawn(self.about.seed, name, shape.iter().product(), [*low, *high]);
        Tensor::from_vec(values, shape.as_slice(), &Device::Cpu).unwrap()
    }

    /// Returns the golden's values of an output, in the output's shape (of stride 1).
    pub fn output(&self, name: &str) -> Tensor {
        let held = &self.about.outputs[name];
        self.tensors[&format!("out.{name}")].reshape(held.shape.as_slice()).unwrap()
    }

    /// Numbers that stand in the golden for the test alone.
    pub fn aside(&self, name: &str) -> Tensor {
        let found = self.tensors.get(&format!("aside.{name}"));
        found.unwrap_or_else(|| panic!("{}: no aside {name}", self.name)).clone()
    }

    /// The cameras of `Case.cameras`, for pictures of `width` × `height`, and their
    /// (near, far).
    pub fn cameras(&self, width: usize, height: usize) -> (Vec<Camera>, Vec<NearFar>) {
        let rows = |t: Tensor| t.flatten_from(1).unwrap().to_vec2::<f32>().unwrap();
        let (poses, k) = (rows(self.aside("poses")), rows(self.aside("intrinsics")));
        let camera = |(pose, k): (&Vec<f32>, &Vec<f32>)| {
            let intrinsics = Intrinsics { fx: k[0], fy: k[1], cx: k[2], cy: k[3], width, height };
            let pose = Mat4::from_cols_slice(pose).transpose();
            Camera::new(intrinsics, pose).unwrap()
        };
        let near_far =
            rows(self.aside("near_far")).iter().map(|r| NearFar::new(r[0], r[1])).collect();
        (poses.iter().zip(&k).map(camera).collect(), near_far)
    }

    /// The part of the notes called `key`.
    pub fn note<T: serde::de::DeserializeOwned>(&self, key: &str) -> T {
        let value = self.about.notes.get(key).cloned();
        let value = value.unwrap_or_else(|| panic!("{}: no note {key}", self.name));
        serde_json::from_value(value).unwrap_or_else(|e| panic!("{}: {key}: {e}", self.name))
    }

    /// One scene: input `images` `[V, 3, H, W]` with the golden's cameras.
    pub fn views(&self) -> Views {
        let images = self.input("images");
        let (_, _, h, w) = images.dims4().unwrap();
        let (cameras, near_far) = self.cameras(w, h);
        Views::new(images.unsqueeze(0).unwrap(), vec![cameras], vec![near_far]).unwrap()
    }

    /// Holds `got`, the whole output, against what the golden keeps of it: no element is
    /// farther off than the table's tolerance times the largest magnitude kept.
    pub fn compare(&self, output: &str, got: &Tensor) {
        let tolerance = tolerances::of(&self.name, output);
        let far = self.distance(output, got);
        println!("{}.{output}: {far:.1e} of {tolerance:.0e}", self.name);
        assert!(
            far <= tolerance,
            "{}.{output}: expected within {tolerance:.1e} of the largest magnitude, got {far:.2e}",
            self.name
        );
    }

    /// Largest difference over largest magnitude; NaN counts as infinite.
    pub fn distance(&self, output: &str, got: &Tensor) -> f64 {
        self.distances(output, got).into_iter().fold(0.0, f64::max)
    }

    /// Differences of all elements kept, over the largest magnitude; NaN counts as infinite.
    pub fn distances(&self, output: &str, got: &Tensor) -> Vec<f64> {
        let held = (self.about.outputs.get(output))
            .unwrap_or_else(|| panic!("{}: no output {output}", self.name));
        assert_eq!(got.dims(), held.shape, "{}.{output}", self.name);
        self.compared.borrow_mut().insert(output.to_owned());
        let flat = |t: &Tensor| -> Vec<f64> {
            let t = t.to_dtype(DType::F32).unwrap().flatten_all().unwrap();
            t.to_vec1::<f32>().unwrap().into_iter().map(f64::from).collect()
        };
        let want = flat(&self.tensors[&format!("out.{output}")]);
        let got: Vec<f64> = flat(got).into_iter().step_by(held.stride).collect();
        assert_eq!(got.len(), want.len(), "{}.{output}", self.name);
        let size = want.iter().fold(0f64, |m, v| m.max(v.abs()));
        let differences = got.iter().zip(&want).map(|(a, b)| (a - b).abs() / size);
        differences.map(|d| if d.is_nan() { f64::INFINITY } else { d }).collect()
    }

    /// Every output was compared, and the modules asked for every weight.
    pub fn done(&self, weights: &Weights) {
        let all: BTreeSet<String> = self.about.outputs.keys().cloned().collect();
        assert_eq!(*self.compared.borrow(), all, "{}: outputs compared", self.name);
        let left = weights.unexpected();
        assert!(
            left.is_empty(),
            "{}: {} weights never asked for, {}",
            self.name,
            left.len(),
            left[0]
        );
    }
}
