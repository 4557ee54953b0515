//! The backbone and the whole network against an independent implementation: graphs
//! written from the specification in `tools/witness`, run by onnxruntime. No Python is
//! needed here; `tools/witness/verify.py` holds the goldens against onnxruntime.

use subsplat_test_support::gpu::gpu;
use subsplat_test_support::witness as witness_common;

use candle_core::{DType, Device, Result, Tensor};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use subsplat::network::config;
use subsplat::network::config::{Backbone, Config, FeatureLevel, Mvsplat as Settings, Preset};
use subsplat::network::model::backbone::Mvsplat;
use subsplat::network::model::backbone::cnn::Cnn;
use subsplat::network::model::backbone::cost_volume::{correlation, disparities};
use subsplat::network::model::backbone::depth::{DepthPredictor, Input};
use subsplat::network::model::backbone::transformer::Transformer;
use subsplat::network::model::backbone::unet::UNet;
use subsplat::network::model::primaries::primaries;
use subsplat::network::model::subsplat::{SceneOutput, SubSplat};
use subsplat::network::model::trace::Trace;
use subsplat::network::model::weights::Weights;
use subsplat::network::model::{BackboneOutput, Backend, Primaries, Views};
use witness_common::{Golden, folder, skip, tolerances};

#[test]
fn cnn() -> Result<()> {
    for name in ["cnn", "cnn_dim"] {
        let golden = Golden::load(name);
        let weights = golden.weights();
        let cnn = Cnn::new([8, 12, 16], weights.builder().pp("backbone.backbone"))?;
        let out = cnn.forward(&golden.input("images"), &mut Trace::off())?;
        golden.compare("half", &out.half);
        golden.compare("quarter", &out.quarter);
        golden.done(&weights);
    }
    Ok(())
}

/// The widths of `tools/witness/modules/{backbone,depth}.py`; the structure is the
/// released one.
fn narrow() -> Settings {
    Settings {
        cnn_channels: [8, 12, 16],
        transformer_layers: 2,
        depth_candidates: 24,
        costvolume_channels: 32,
        ..Settings::re10k()
    }
}

/// Tensors that `run` traces, by name.
fn traced(run: impl FnOnce(&mut Trace<'_>) -> Result<()>) -> Result<BTreeMap<String, Tensor>> {
    let mut seen = BTreeMap::new();
    let mut look = |name: &str, t: &Tensor| {
        seen.insert(name.to_owned(), t.clone());
        Ok(())
    };
    run(&mut Trace::to(&mut look))?;
    Ok(seen)
}

#[test]
fn transformer_plain_shifted_and_with_three_views() -> Result<()> {
    for name in ["transformer", "transformer3"] {
        let golden = Golden::load(name);
        let weights = golden.weights();
        let net = Transformer::new(&narrow(), weights.builder().pp("backbone.transformer"))?;
        let x = golden.input("features").unsqueeze(0)?;
        let views = x.dim(1)?;
        let others = |i: usize| (0..views).filter(|&j| j != i).collect::<Vec<_>>();
        let sources = vec![(0..views).map(others).collect::<Vec<_>>()];
        let seen = traced(|trace| {
            golden.compare("out", &net.forward(&x, &sources, trace)?.squeeze(0)?);
            Ok(())
        })?;
        for i in 0..2 {
            let own = &seen[&format!("transformer.layer{i}.self_attn_vb")];
            golden.compare(&format!("self{i}"), own);
            golden.compare(&format!("layer{i}"), &seen[&format!("transformer.layer{i}.out_vb")]);
        }
        golden.done(&weights);
    }
    Ok(())
}

#[test]
fn plane_sweep() -> Result<()> {
    let cases = [("sweep", 48, 64), ("sweep3", 40, 48), ("sweep_close", 48, 64)];
    for (name, height, width) in cases {
        let golden = Golden::load(name);
        let features = golden.input("features");
        let (cameras, near_far) = golden.cameras(width, height);
        let blank = Tensor::zeros((1, cameras.len(), 3, height, width), DType::F32, &Device::Cpu)?;
        let views = Views::new(blank, vec![cameras], vec![near_far])?;
        let candidates = disparities(&views, 24);
        let volume = correlation(
            &subsplat::network::ops::Backend::Cpu,
            &views,
            &candidates,
            &features,
            &mut Trace::off(),
        )?;
        golden.compare("disparities", &Tensor::new(candidates, &Device::Cpu)?);
        golden.compare("correlation", &volume);
        golden.done(&golden.weights());
    }
    Ok(())
}

#[test]
fn unet_with_attention_across_views() -> Result<()> {
    for (name, channels, levels) in [("unet", 64, 3), ("unet_dim", 32, 2)] {
        let golden = Golden::load(name);
        let weights = golden.weights();
        let net = UNet::new(channels, levels, weights.builder().pp("net"))?;
        golden.compare("out", &net.forward(&golden.input("x"), 2, &mut Trace::off(), "")?);
        golden.done(&weights);
    }
    Ok(())
}

#[test]
fn depth_predictor_stage_by_stage() -> Result<()> {
    let golden = Golden::load("depth");
    let weights = golden.weights();
    let net = DepthPredictor::new(&narrow(), weights.builder().pp("depth_predictor"))?;
    let views = golden.views();
    let seen = traced(|trace| {
        let input = Input {
            views: &views,
            images: golden.input("images"),
            cnn: golden.input("cnn"),
            trans: golden.input("trans"),
        };
        let out = net.forward(input, trace)?;
        golden.compare("refine", &out.refined);
        golden.compare("raw", &out.raw);
        golden.compare("depths", &out.depths);
        golden.compare("disparity", &out.depths.recip()?);
        golden.compare("densities", &out.densities);
        Ok(())
    })?;
    for (output, stage) in [
        ("correlation", "cv.raw_correlation_vb"),
        ("refined_volume", "cv.refined_correlation_vb"),
        ("pdf", "depth.pdf_vb"),
        ("coarse_disp", "depth.coarse_disp_vb"),
        ("pdf_max", "depth.pdf_max_vb"),
        ("fullres_disp", "depth.fullres_disp_vb"),
        ("upsampled", "depth.upsampler_vb"),
        ("projected", "depth.proj_feature_vb"),
        ("delta", "depth.to_disparity_vb"),
    ] {
        golden.compare(output, &seen[stage]);
    }
    golden.done(&weights);
    Ok(())
}

fn compare_primaries(golden: &Golden, p: &Primaries) -> Result<()> {
    golden.compare("means", &p.means.squeeze(0)?);
    golden.compare("quats", &p.quats_wxyz.squeeze(0)?);
    golden.compare("scales", &p.scales.squeeze(0)?);
    golden.compare("opacities", &p.opacities.squeeze(0)?);
    golden.compare("sh", &p.sh.squeeze(0)?);
    golden.compare("sh_camera", &p.sh_camera.squeeze(0)?);
    Ok(())
}

#[test]
fn gaussian_adapter() -> Result<()> {
    let golden = Golden::load("adapter");
    let (cameras, near_far) = golden.cameras(20, 12);
    let blank = Tensor::zeros((1, 2, 3, 12, 20), DType::F32, &Device::Cpu)?;
    let views = Views::new(blank, vec![cameras], vec![near_far])?;
    let out = BackboneOutput {
        raw: golden.input("raw").unsqueeze(0)?,
        depths: golden.input("depths").unsqueeze(0)?,
        densities: golden.input("densities").unsqueeze(0)?,
        features: Vec::new(),
    };
    let settings = config::Primaries { opacity_exponent: 0.7, ..narrow().primaries };
    compare_primaries(&golden, &primaries(&out, &views, &settings, &mut Trace::off())?)?;
    golden.done(&golden.weights());
    Ok(())
}

/// Three non-square views through the whole encoder, pictures to primaries.
#[test]
fn whole_backbone() -> Result<()> {
    let golden = Golden::load("backbone");
    let weights = golden.weights();
    let views = golden.views();
    let net = Mvsplat::new(&narrow(), weights.builder())?;
    let out = net.forward(&views, &mut Trace::off())?;
    let levels = [
        ("cnn2", FeatureLevel::Cnn2),
        ("cnn4", FeatureLevel::Cnn4),
        ("trans4", FeatureLevel::Trans4),
        ("trans8", FeatureLevel::Trans8),
        ("trans16", FeatureLevel::Trans16),
        ("refine1", FeatureLevel::Refine1),
    ];
    for (output, level) in levels {
        golden.compare(output, &out.feature(level)?.squeeze(0)?);
    }
    golden.compare("raw", &out.raw.squeeze(0)?);
    golden.compare("disparity", &out.depths.squeeze(0)?.recip()?);
    golden.compare("densities", &out.densities.squeeze(0)?);
    compare_primaries(&golden, &primaries(&out, &views, &narrow().primaries, &mut Trace::off())?)?;
    golden.done(&weights);
    Ok(())
}

/// The preset with the backbone of [`narrow`] and the golden's own settings.
fn configured(golden: &Golden, preset: Preset) -> Config {
    fn part<T: serde::de::DeserializeOwned>(golden: &Golden, name: &str) -> T {
        serde_json::from_value(golden.about.notes[name].clone()).unwrap()
    }
    Config {
        backbone: Backbone::Mvsplat(narrow()),
        embed: part(golden, "embed"),
        agg: part(golden, "agg"),
        spgr: part(golden, "spgr"),
        ..Config::re10k(preset, part(golden, "upscale"))
    }
}

/// Pictures to children, through the crate's front door; outputs by name.
fn whole(
    golden: &Golden,
    preset: Preset,
    weights: &Weights,
    backend: &Backend,
) -> Result<BTreeMap<&'static str, Tensor>> {
    let model = SubSplat::new(&configured(golden, preset), weights.builder())?;
    let model = model.with_backend(backend);
    let views = golden.views();
    let parents = model.primaries(&views, &model.encode(&views)?)?.means.squeeze(0)?;
    let mut scenes = model.forward(&views, &mut |_| ())?;
    let SceneOutput { children, depths } = scenes.remove(0);
    let rows = |from: usize, len: usize| children.rows.narrow(1, from, len);
    let (means, (n, _)) = (rows(0, 3)?, parents.dims2()?);
    let steps = means.reshape((n, children.k, 3))?.broadcast_sub(&parents.unsqueeze(1)?)?;
    Ok(BTreeMap::from([
        ("depths", Tensor::new(depths, &Device::Cpu)?),
        ("steps", steps.reshape((n * children.k, 3))?),
        ("means", means),
        ("quats", rows(3, 4)?),
        ("log_scales", rows(7, 3)?.log()?),
        ("opacities", rows(10, 1)?.squeeze(1)?),
        ("gain", children.gain.clone()),
        ("sh", children.sh.clone()),
    ]))
}

const WHOLE: [(&str, Preset); 2] = [("whole_paper", Preset::Paper), ("whole_tuned", Preset::Tuned)];

#[test]
fn whole_network() -> Result<()> {
    for (name, preset) in WHOLE {
        let golden = Golden::load(name);
        let weights = golden.weights();
        for (output, got) in whole(&golden, preset, &weights, &Backend::Cpu)? {
            golden.compare(output, &got);
        }
        golden.done(&weights);
    }
    Ok(())
}

/// `tools/witness/verify.py --fresh DIR` draws pictures, cameras and weights anew;
/// SUBSPLAT_WITNESS names DIR. One element in 500 may be off: a parent on the edge of
/// another view's picture, or equally near to two views, may fall on either side.
fn check_fresh(backend: &Backend, factor: f64) -> Result<()> {
    let Some(folder) = std::env::var_os("SUBSPLAT_WITNESS") else {
        skip("SUBSPLAT_WITNESS is not set; nothing drawn anew was checked");
        return Ok(());
    };
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join(folder);
    for (name, preset) in WHOLE {
        let golden = Golden::load_from(&folder, name);
        let weights = golden.weights();
        for (output, got) in whole(&golden, preset, &weights, backend)? {
            let far = golden.distances(output, &got);
            let tolerance = factor * tolerances::of(name, output);
            let off = far.iter().filter(|&&d| d > tolerance).count();
            let worst = far.iter().copied().fold(0.0, f64::max);
            let what = format!(
                "seed {}, {name}.{output}: {off} of {} beyond {tolerance:.0e}, worst {worst:.1e}",
                golden.about.seed,
                far.len()
            );
            println!("{what}");
            assert!(off * 500 <= far.len() && worst.is_finite(), "{what}");
        }
        golden.done(&weights);
    }
    Ok(())
}

#[test]
fn fresh_inputs() -> Result<()> {
    check_fresh(&Backend::Cpu, 1.0)
}

/// The tolerances are four times those of the CPU, whose elementary functions are more exact.
#[test]
fn fresh_inputs_on_a_gpu() -> Result<()> {
    let Some(gpu) = gpu() else { return Ok(()) };
    let backend = Backend::from(gpu);
    check_fresh(&backend, 4.0)?;
    assert_eq!(backend.warning(), None);
    Ok(())
}

/// Goldens and the table of tolerances name the same outputs.
#[test]
fn every_output_has_a_tolerance_and_every_tolerance_an_output() {
    let mut outputs = BTreeSet::new();
    for entry in std::fs::read_dir(folder()).unwrap() {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|e| e == "safetensors") {
            let name = path.file_stem().unwrap().to_string_lossy().into_owned();
            let golden = Golden::load(&name);
            outputs.extend(golden.about.outputs.keys().map(|output| format!("{name}.{output}")));
        }
    }
    let rows: BTreeSet<String> = tolerances::table().map(|row| row.0).collect();
    let odd: Vec<_> = outputs.symmetric_difference(&rows).collect();
    assert!(odd.is_empty(), "output without a tolerance, or the reverse: {odd:?}");
    assert_eq!(rows.len(), tolerances::table().count(), "a row stands twice");
}
