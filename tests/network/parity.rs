//! The encoder against the reference outputs of the public MVSplat, and the
//! comparison engine against itself: it must turn red for a wrong weight.

use subsplat_test_support as common;

use candle_core::{DType, Device, Tensor};
use common::shared;
use std::collections::BTreeMap;
use std::path::PathBuf;
use subsplat::network::config::Mvsplat as Settings;
use subsplat::network::model::backbone::Mvsplat;
use subsplat::network::model::primaries::primaries;
use subsplat::network::model::trace::Trace;
use subsplat::network::model::weights::{Weights, read_tensors};
use subsplat::network::model::{Backend, Views};
use subsplat_kernels::camera::NearFar;
use subsplat_lab::compare::{Report, compare, compare_encoder, views};

fn golden() -> Option<(PathBuf, PathBuf)> {
    Some((
        shared("golden/mvsplat_weights.safetensors")?,
        shared("golden/mvsplat_64x64_b1v2.safetensors")?,
    ))
}

fn show(report: &Report) -> String {
    let bad = report.rows.iter().filter(|r| !r.ok);
    bad.map(|r| format!("{r:?}\n")).collect()
}

#[test]
fn every_stage_agrees_with_the_reference() {
    let Some((weights, reference)) = golden() else { return };
    let report = compare(&Weights::load(&weights).unwrap(), &reference, &Backend::Cpu).unwrap();
    assert!(report.ok(), "{}", show(&report));
    assert_eq!(report.not_produced, [""; 0]);
    assert_eq!(report.unexpected_weights, [""; 0]);
    // Every tensor but the five inputs, and the derived row of disparities.
    let (tensors, _) = read_tensors(&reference).unwrap();
    assert_eq!(report.rows.len(), tensors.len() - 5 + 1);
}

#[test]
fn a_wrong_weight_turns_the_comparison_red() {
    let Some((weights, reference)) = golden() else { return };
    let (good, _) = read_tensors(&weights).unwrap();
    let (tensors, _) = read_tensors(&reference).unwrap();
    // One tensor of each part, and the first stage that must notice a change of 0.1 %.
    for (name, stage) in [
        ("backbone.backbone.layer2.0.conv1.weight", None),
        ("backbone.backbone.conv2.weight", Some("cnn.out_bv")),
        (
            "backbone.transformer.layers.3.cross_attn_ffn.norm2.weight",
            Some("transformer.layer3.out_vb"),
        ),
        ("depth_predictor.regressor_residual.weight", Some("cv.regressor_residual_vb")),
        ("depth_predictor.refine_unet.3.out.1.weight", Some("depth.refine_unet.3.out")),
        ("depth_predictor.to_disparity.2.weight", Some("depth.to_disparity_vb")),
        ("depth_predictor.to_gaussians.2.weight", Some("depth.to_gaussians_vb")),
    ] {
        let key = format!("encoder.{name}");
        let mut changed = good.clone();
        changed.insert(key.clone(), (&good[&key] * 1.001).unwrap());
        let encoder =
            Mvsplat::new(&Settings::re10k(), Weights::from_tensors(changed).builder()).unwrap();
        let report =
            compare_encoder(&encoder, &Settings::re10k(), &tensors, &Backend::Cpu).unwrap();
        let first = report.rows.iter().find(|r| !r.ok).map(|r| r.tensor.as_str());
        // A convolution before an InstanceNorm may be scaled freely: nothing to notice.
        assert_eq!(first, stage, "{name}");
    }
}

#[test]
fn missing_and_misshapen_inputs_are_named() {
    let Some((weights, reference)) = golden() else { return };
    let weights = Weights::load(&weights).unwrap();
    let encoder = Mvsplat::new(&Settings::re10k(), weights.builder()).unwrap();
    let (mut tensors, _) = read_tensors(&reference).unwrap();
    // Another shape in the file is a failed row, not a crash.
    tensors.insert("out.means".into(), Tensor::zeros((1, 5, 3), DType::F32, &Device::Cpu).unwrap());
    tensors.insert("made.up".into(), Tensor::zeros(1, DType::F32, &Device::Cpu).unwrap());
    let report = compare_encoder(&encoder, &Settings::re10k(), &tensors, &Backend::Cpu).unwrap();
    let row = report.rows.iter().find(|r| r.tensor == "out.means").unwrap();
    assert!(!row.ok && row.note.as_ref().unwrap().contains("[1, 5, 3]"));
    assert_eq!(report.not_produced, ["made.up"]);
    tensors.remove("in.near");
    let e = compare_encoder(&encoder, &Settings::re10k(), &tensors, &Backend::Cpu)
        .unwrap_err()
        .to_string();
    assert!(e.contains("in.near"), "{e}");
}

/// Largest |a − b| over largest |b|.
fn relative(a: &Tensor, b: &Tensor) -> f32 {
    let top = |t: Tensor| {
        t.abs().unwrap().flatten_all().unwrap().max(0).unwrap().to_scalar::<f32>().unwrap()
    };
    top((a - b).unwrap()) / top(b.clone())
}

/// Two different scenes from the reference's inputs: as they are, and mirrored with
/// another depth range.
fn two_scenes(tensors: &BTreeMap<String, Tensor>) -> Views {
    let one = views(tensors).unwrap();
    let other = one.images.contiguous().unwrap().flip(&[4]).unwrap();
    let images = Tensor::cat(&[&one.images, &other], 0).unwrap();
    let mut cameras = one.cameras.clone();
    let mut turned = one.cameras[0].clone();
    turned.reverse();
    cameras.push(turned);
    let near_far =
        vec![one.near_far[0].clone(), vec![NearFar::new(0.8, 60.0), NearFar::new(1.2, 80.0)]];
    Views::new(images, cameras, near_far).unwrap()
}

#[test]
fn a_batch_equals_its_parts() {
    let Some((weights, reference)) = golden() else { return };
    let weights = Weights::load(&weights).unwrap();
    let settings = Settings::re10k();
    let encoder = Mvsplat::new(&settings, weights.builder()).unwrap();
    let (tensors, _) = read_tensors(&reference).unwrap();
    let both = two_scenes(&tensors);
    let run = |v: &Views| {
        let out = encoder.forward(v, &mut Trace::off()).unwrap();
        let p = primaries(&out, v, &settings.primaries, &mut Trace::off()).unwrap();
        (out, p)
    };
    let (out, p) = run(&both);
    let mut alone = Vec::new();
    for i in 0..2 {
        let (one, q) = run(&both.scene(i).unwrap());
        let part = |t: &Tensor| t.narrow(0, i, 1).unwrap();
        assert!(relative(&part(&out.raw), &one.raw) < 1e-5);
        assert!(relative(&part(&out.depths).recip().unwrap(), &one.depths.recip().unwrap()) < 1e-5);
        assert!(relative(&part(&out.densities), &one.densities) < 1e-5);
        for ((level, a), (_, b)) in out.features.iter().zip(&one.features) {
            assert!(relative(&part(a), b) < 1e-5, "{level:?}");
        }
        assert!(relative(&part(&p.quats_wxyz), &q.quats_wxyz) < 1e-4);
        assert!(relative(&part(&p.sh), &q.sh) < 1e-5);
        alone.push(one);
    }
    // The scenes differ, so that the equalities above are not trivial.
    assert!(relative(&alone[0].raw, &alone[1].raw) > 1e-2);
}

#[test]
fn sizes_that_do_not_fit_are_refused() {
    let settings = Settings::re10k();
    let encoder = Mvsplat::new(&settings, Weights::seeded(1).builder()).unwrap();
    let image = Tensor::zeros((1, 2, 3, 64, 72), DType::F32, &Device::Cpu).unwrap();
    let k = subsplat_kernels::camera::Intrinsics::from_fov_x(1.0, 72, 64);
    let camera = subsplat_kernels::camera::Camera::new(k, glam::Mat4::IDENTITY).unwrap();
    let views =
        Views::new(image, vec![vec![camera; 2]], vec![vec![NearFar::new(1.0, 10.0); 2]]).unwrap();
    let e = encoder.forward(&views, &mut Trace::off()).unwrap_err().to_string();
    assert!(e.contains("multiples of 16") && e.contains("64x72"), "{e}");
}
