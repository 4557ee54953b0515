//! SubSplat's own modules against graphs written from the specification
//! (`tools/witness/modules/subsplat_*.py`), run by onnxruntime in double precision: embeddings,
//! attention, heads, reparameterization and the trunk that joins them.

use subsplat_test_support::spgr_reference;
use subsplat_test_support::witness as witness_common;

use candle_core::{DType, Device, Result, Tensor};
use glam::{DMat3, DQuat, DVec3};
use std::collections::BTreeMap;
use subsplat::network::config;
use subsplat::network::config::{Config, FeatureLevel, LowpassRef, Preset};
use subsplat::network::model::aggregation::Aggregation;
use subsplat::network::model::embed::{Descriptors, Embeddings};
use subsplat::network::model::geometry::{Frames, ParentChunk};
use subsplat::network::model::mlp::Mode;
use subsplat::network::model::spgr_heads::{Head, rules};
use subsplat::network::model::trunk::{Children, TrainPass, Trunk};
use subsplat::network::model::{BackboneOutput, Primaries, Views};
use subsplat::network::ops::spgr::{Spgr, spgr};
use subsplat_kernels::camera::{Camera, NearFar};
use subsplat_kernels::cpu::raster::sh;
use subsplat_kernels::cpu::{Geometry, Rasterizer, SplatSlices};
use subsplat_kernels::layout::{
    Convention, MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, RasterOptions, SCALE_OFFSET, ShBasis,
};
use witness_common::{Golden, names};

/// Goldens are double precision rounded to `f32`: kernels in `f64` lie this close.
const ROUNDING: f64 = 2e-7;
const MODES: [Mode; 2] = [Mode::Infer, Mode::Train { seed: 7 }];

/// Cameras and parents of a golden. Its pictures are as large as it has parents.
struct Scene {
    cameras: Vec<Camera>,
    near: Vec<f32>,
    frames: Frames,
    per_view: usize,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
}

impl Scene {
    fn new(golden: &Golden) -> Result<Self> {
        let [width, height] = golden.note("size");
        let (cameras, near_far) = golden.cameras(width, height);
        let parent = |name: &str| golden.input(&format!("parent.{name}"));
        Ok(Self {
            near: near_far.iter().map(|n| n.near).collect(),
            frames: Frames::new(&cameras, DType::F32, &Device::Cpu)?,
            cameras,
            per_view: width * height,
            means: parent("means"),
            quats: parent("quats"),
            scales: parent("scales"),
            opacities: parent("opacities"),
        })
    }

    /// `[N, 11]`.
    fn rows(&self) -> Result<Tensor> {
        Tensor::cat(&[&self.means, &self.quats, &self.scales, &self.opacities], 1)
    }

    /// The parents of view `v`, their colour and which rows of the scene they are.
    fn chunk(&self, v: usize, sh: &Tensor) -> Result<ParentChunk> {
        let part = |t: &Tensor| t.narrow(0, v * self.per_view, self.per_view);
        Ok(ParentChunk {
            first: v * self.per_view,
            source: v,
            means: part(&self.means)?,
            quats_wxyz: part(&self.quats)?,
            scales: part(&self.scales)?,
            opacities: part(&self.opacities)?,
            sh: part(sh)?,
        })
    }

    fn views(&self) -> Result<Views> {
        let k = self.cameras[0].intrinsics();
        let shape = (1, self.cameras.len(), 3, k.height, k.width);
        let near_far = self.near.iter().map(|&near| NearFar::new(near, 100.0)).collect();
        let images = Tensor::zeros(shape, DType::F32, &Device::Cpu)?;
        Views::new(images, vec![self.cameras.clone()], vec![near_far])
    }

    /// As a backbone hands them over; `sh` `[N, 3·D]` stands in `frame`, nothing in the other.
    fn primaries(&self, sh: &Tensor, frame: config::ShInput) -> Result<Primaries> {
        let n = self.means.dim(0)?;
        let sh = sh.reshape((1, n, 3, ()))?;
        let (world, camera) = match frame {
            config::ShInput::World => (sh.clone(), sh.zeros_like()?),
            config::ShInput::Camera => (sh.zeros_like()?, sh),
        };
        Ok(Primaries {
            means: self.means.unsqueeze(0)?,
            quats_wxyz: self.quats.unsqueeze(0)?,
            scales: self.scales.unsqueeze(0)?,
            opacities: self.opacities.reshape((1, n))?,
            sh: world,
            sh_camera: camera,
            sh_basis: ShBasis::Standard,
            per_view: self.per_view,
        })
    }
}

/// Two tensors per view, joined over the views.
fn joined(scene: &Scene, each: impl Fn(usize) -> Result<Descriptors>) -> Result<[Tensor; 2]> {
    let views = (0..scene.cameras.len()).map(each).collect::<Result<Vec<_>>>()?;
    let join = |part: fn(&Descriptors) -> &Tensor| {
        Tensor::cat(&views.iter().map(part).collect::<Vec<_>>(), 0)
    };
    Ok([join(|d| &d.geometry)?, join(|d| &d.appearance)?])
}

/// Maps of `levels` as a backbone's, and their channels.
fn backbone(
    golden: &Golden,
    levels: &[FeatureLevel],
) -> Result<(BackboneOutput, Vec<(FeatureLevel, usize)>)> {
    let none = Tensor::zeros((1, 2, 1, 1), DType::F32, &Device::Cpu)?;
    let map = |level: &FeatureLevel| {
        let name = serde_json::to_value(level).unwrap();
        let map = golden.input(&format!("map.{}", name.as_str().unwrap()));
        Ok((*level, map.unsqueeze(0)?))
    };
    let features = levels.iter().map(map).collect::<Result<Vec<_>>>()?;
    let channels = features.iter().map(|(l, m)| Ok((*l, m.dim(2)?)));
    let channels = channels.collect::<Result<Vec<_>>>()?;
    let (raw, depths, densities) = (none.clone(), none.clone(), none);
    Ok((BackboneOutput { raw, depths, densities, features }, channels))
}

/// Children as the goldens split them: steps from the parents' means, quaternions, ln σ,
/// opacities.
fn split(rows: &Tensor, parents: &Tensor) -> Result<BTreeMap<&'static str, Tensor>> {
    let (count, n) = (rows.dim(0)?, parents.dim(0)?);
    let (rows, parents) = (rows.to_dtype(DType::F64)?, parents.to_dtype(DType::F64)?);
    let means = rows.narrow(1, MEAN_OFFSET, 3)?.reshape((n, count / n, 3))?;
    let steps = means.broadcast_sub(&parents.narrow(1, MEAN_OFFSET, 3)?.unsqueeze(1)?)?;
    Ok(BTreeMap::from([
        ("steps", steps.reshape((count, 3))?),
        ("quats", rows.narrow(1, QUAT_OFFSET, 4)?),
        ("log_scales", rows.narrow(1, SCALE_OFFSET, 3)?.log()?),
        ("opacities", rows.narrow(1, OPACITY_OFFSET, 1)?.squeeze(1)?),
    ]))
}

#[test]
fn embeddings() -> Result<()> {
    for name in names("sub_embed_") {
        let golden = Golden::load(&name);
        let (scene, weights) = (Scene::new(&golden)?, golden.weights());
        let keys: config::Embed = golden.note("embed");
        let embed = Embeddings::new(&keys, 75, weights.builder().pp("subsplat").pp("embed"))?;
        let colour = golden.input("sh");
        let each = |v| embed.forward(&scene.chunk(v, &colour)?, &scene.frames);
        let [z_g, z_a] = joined(&scene, each)?;
        golden.compare("z_g", &z_g);
        golden.compare("z_a", &z_a);
        golden.done(&weights);
    }
    Ok(())
}

#[test]
fn attention() -> Result<()> {
    for name in names("sub_agg_") {
        let golden = Golden::load(&name);
        let (scene, weights) = (Scene::new(&golden)?, golden.weights());
        let keys: config::Aggregation = golden.note("agg");
        let (backbone, channels) = backbone(&golden, &keys.levels)?;
        let z = [golden.input("z_g"), golden.input("z_a")];
        let vb = weights.builder().pp("subsplat").pp("agg");
        let agg = Aggregation::new(&keys, z[0].dim(1)?, &channels, vb)?;
        let sh = Tensor::zeros((z[0].dim(0)?, 3), DType::F32, &Device::Cpu)?;
        let primaries = scene.primaries(&sh, config::ShInput::World)?;
        let prepared = agg.prepare(
            &scene.views()?,
            &scene.frames,
            |level| backbone.feature(level).cloned(),
            &primaries.means.squeeze(0)?,
        )?;
        for mode in MODES {
            let [f_g, f_a] = joined(&scene, |v| {
                let part = |t: &Tensor| t.narrow(0, v * scene.per_view, scene.per_view);
                let z = Descriptors { geometry: part(&z[0])?, appearance: part(&z[1])? };
                agg.forward(&prepared, &scene.chunk(v, &sh)?, &scene.frames, &z, mode)
            })?;
            golden.compare("f_g", &f_g);
            golden.compare("f_a", &f_a);
        }
        golden.done(&weights);
    }
    Ok(())
}

#[test]
fn heads() -> Result<()> {
    for name in names("sub_head_") {
        let golden = Golden::load(&name);
        let weights = golden.weights();
        let side: usize = golden.note("side");
        let mut config = Config::re10k(Preset::Paper, side);
        config.spgr = golden.note("spgr");
        config.embed.dim = golden.note("dim");
        let vb = weights.builder().pp("subsplat").pp("geo");
        let head = Head::new(&config, golden.note("lanes"), vb)?;
        golden.compare("record", &head.forward(&golden.input("x"), side * side)?);
        golden.done(&weights);
    }
    Ok(())
}

/// The fused kernel and the graph of tensor operations, in `f32` and in `f64`.
#[test]
fn reparameterization() -> Result<()> {
    for name in names("sub_spgr_") {
        let golden = Golden::load(&name);
        let scene = Scene::new(&golden)?;
        let side: usize = golden.note("side");
        let mut config = Config::re10k(Preset::Paper, side);
        config.spgr = golden.note("spgr");
        let lowpass: [f32; 2] = golden.note("lowpass");
        config.render.lowpass = lowpass[1];
        if lowpass[0] != lowpass[1] {
            config.render.lowpass_ref = LowpassRef::Input;
        }
        let call = Spgr {
            rules: rules(&config, side * side),
            cameras: scene.cameras.clone(),
            near: scene.near.clone(),
            per_view: scene.per_view,
            first: 0,
        };
        for dtype in [DType::F32, DType::F64] {
            let (record, parents) =
                (golden.input("record").to_dtype(dtype)?, scene.rows()?.to_dtype(dtype)?);
            for (form, (rows, gain)) in [
                ("fused", spgr(&record, &parents, &call)?),
                ("graph", spgr_reference::spgr(&record, &parents, &call)?),
            ] {
                let mut parts = split(&rows, &parents)?;
                parts.insert("gain", gain);
                for (part, got) in parts {
                    if dtype == DType::F32 {
                        golden.compare(part, &got);
                    } else {
                        let far = golden.distance(part, &got);
                        assert!(far <= ROUNDING, "{name}.{part} {form} in f64: {far:.1e}");
                    }
                }
            }
        }
        golden.done(&golden.weights());
    }
    Ok(())
}

/// Embeddings to children, in chunks at inference and in one graph for training.
#[test]
fn trunk() -> Result<()> {
    for name in names("sub_trunk_") {
        let golden = Golden::load(&name);
        let (scene, weights) = (Scene::new(&golden)?, golden.weights());
        let mut config = Config::re10k(Preset::Paper, golden.note("upscale"));
        config.embed = golden.note("embed");
        config.agg = golden.note("agg");
        config.spgr = golden.note("spgr");
        let (backbone, channels) = backbone(&golden, &config.agg.levels)?;
        let trunk = Trunk::new(&config, &channels, weights.builder())?;
        let (views, primaries) =
            (scene.views()?, scene.primaries(&golden.input("sh"), config.embed.sh)?);
        let compare = |children: Children| -> Result<()> {
            let mut parts = split(&children.rows, &scene.rows()?)?;
            parts.insert("gain", children.gain);
            parts.into_iter().for_each(|(part, got)| golden.compare(part, &got));
            Ok(())
        };
        compare(trunk.forward(&views, &backbone, &primaries)?)?;
        compare(trunk.forward_train(
            &views,
            &backbone,
            &primaries,
            TrainPass { chunk: 16, seed: 3 },
        )?)?;
        golden.done(&weights);
    }
    Ok(())
}

/// Colour by direction: both bases, degrees 0 to 4.
#[test]
fn harmonics() -> Result<()> {
    let golden = Golden::load("sub_sh");
    let directions = golden.input("direction").to_vec2::<f32>()?;
    let coefficients = golden.input("sh").flatten_from(1)?.to_vec2::<f32>()?;
    for (name, basis) in [("standard", ShBasis::Standard), ("mvsplat", ShBasis::Mvsplat)] {
        for degree in 0..=4 {
            let one = |(d, sh): (&Vec<f32>, &Vec<f32>)| {
                sh::radiance(basis, degree, sh::direction([d[0], d[1], d[2]]), sh)
            };
            let got: Vec<f32> = directions.iter().zip(&coefficients).flat_map(one).collect();
            let got = Tensor::from_vec(got, (directions.len(), 3), &Device::Cpu)?;
            golden.compare(&format!("{name}_{degree}"), &got);
        }
    }
    golden.done(&golden.weights());
    Ok(())
}

/// Footprints of splats, given as quaternion and σ and as covariance.
#[test]
fn projection() -> Result<()> {
    for name in names("sub_ewa_") {
        let golden = Golden::load(&name);
        let scene = Scene::new(&golden)?;
        let convention: Convention = golden.note("convention");
        let [width, height] = golden.note("picture");
        let size: f32 = golden.note("scale");
        let intrinsics = scene.cameras[0].intrinsics().resized(width, height);
        let camera = Camera::new(intrinsics, scene.cameras[0].world_from_camera()).unwrap();
        let options = RasterOptions {
            lowpass: golden.note("lowpass"),
            antialiased: golden.note("antialiased"),
            // World units, or a camera's near plane.
            near: scene.near[0] * if convention == Convention::Mvsplat { 10.0 } else { 2.0 },
            ..RasterOptions::new(convention)
        };
        let mut rows = scene.rows()?.to_vec2::<f32>()?;
        let (mut means, mut cov6, mut opacities) = (Vec::new(), Vec::new(), Vec::new());
        for row in &mut rows {
            row[SCALE_OFFSET..SCALE_OFFSET + 3].iter_mut().for_each(|s| *s *= size);
            let part = |at: usize| [row[at], row[at + 1], row[at + 2]];
            let quat = [
                row[QUAT_OFFSET],
                row[QUAT_OFFSET + 1],
                row[QUAT_OFFSET + 2],
                row[QUAT_OFFSET + 3],
            ];
            means.extend(part(MEAN_OFFSET));
            cov6.extend(covariance(quat, part(SCALE_OFFSET)));
            opacities.push(row[OPACITY_OFFSET]);
        }
        let packed = rows.concat();
        let forms = [
            Geometry::Packed(&packed),
            Geometry::Cov6 { means: &means, cov6: &cov6, opacities: &opacities },
        ];
        let sh = vec![0.0; means.len()];
        let mut quads: BTreeMap<&str, [Vec<f32>; 2]> = BTreeMap::new();
        for (form, geometry) in forms.into_iter().enumerate() {
            let slices = SplatSlices { geometry, sh: &sh, gain: &[], sh_degree: 0 };
            let mut rasterizer = Rasterizer::new();
            rasterizer.render(&slices, &camera, &options);
            for f in rasterizer.footprints() {
                let (conic, opacity) =
                    if f.visible() { (f.conic(), f.opacity()) } else { ([0.0; 3], 0.0) };
                let edges = [f.x0, f.y0, f.x1, f.y1].map(|v| v as f32);
                let mut put = |name, v: &[f32]| quads.entry(name).or_default()[form].extend(v);
                put("means2d", &[f.u, f.v]);
                put("conic", &conic);
                put("depth", &[f.z]);
                put("half", &[f.half_width, f.half_height]);
                put("opacity", &[opacity]);
                put("pixels", &edges);
                put("wide", &edges);
            }
        }
        for (output, forms) in quads {
            for (form, got) in forms.iter().enumerate() {
                let got = Tensor::from_vec(
                    got.clone(),
                    (rows.len(), got.len() / rows.len()),
                    &Device::Cpu,
                )?;
                if output == "pixels" || output == "wide" {
                    // No pixel less than the exact support, none farther out than the wide one.
                    let sign = if output == "wide" { 1.0 } else { -1.0 };
                    let excess = outward(&got, &golden.output(output))?.affine(sign, 0.0)?;
                    assert!(excess.max_all()?.to_scalar::<f32>()? <= 0.0, "{name}.{output}");
                }
                golden.compare(output, &got);
                // Cauchy-Binet keeps a needle's short axis; a covariance in `f32` has lost it.
                let far = golden.distance(output, &got);
                let exact = form == 0 && ["conic", "opacity"].contains(&output);
                assert!(!exact || far < 1e-6, "{name}.{output} of quaternion and σ: {far:.1e}");
            }
        }
        golden.done(&golden.weights());
    }
    Ok(())
}

/// Pixels by which `a` reaches farther out than `b` at each edge (x0, y0, x1, y1).
fn outward(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    let signs = Tensor::new(&[[-1f32, -1.0, 1.0, 1.0]], &Device::Cpu)?;
    (a - b)?.broadcast_mul(&signs)
}

/// World covariance (00, 01, 02, 11, 12, 22) of a unit quaternion wxyz and σ.
fn covariance(quat: [f32; 4], scale: [f32; 3]) -> [f32; 6] {
    let [w, x, y, z] = quat.map(f64::from);
    let m = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize())
        * DMat3::from_diagonal(DVec3::from_array(scale.map(f64::from)));
    let c = m * m.transpose();
    [c.x_axis.x, c.x_axis.y, c.x_axis.z, c.y_axis.y, c.y_axis.z, c.z_axis.z].map(|v| v as f32)
}

/// The witness's presets, typed from the specification, are the crate's.
#[test]
fn presets_are_the_specification_s() {
    for (preset, name) in [(Preset::Paper, "paper"), (Preset::Tuned, "tuned")] {
        let ours = Config::re10k(preset, 2);
        let golden = Golden::load(&format!("sub_trunk_{name}"));
        let (mut embed, mut spgr): (config::Embed, config::Spgr) =
            (golden.note("embed"), golden.note("spgr"));
        (embed.dim, spgr.hidden) = (ours.embed.dim, ours.spgr.hidden);
        assert_eq!(embed, ours.embed);
        assert_eq!(spgr, ours.spgr);
        assert_eq!(golden.note::<config::Aggregation>("agg"), ours.agg);
    }
}
