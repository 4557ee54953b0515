//! Calls, parents and head records for the tests of SPGR, and every rule of its
//! configuration.

use crate::scenes::{LocalPrimaries, Random, cameras};
use candle_core::{DType, Tensor};
use subsplat::network::config;
use subsplat::network::config::*;
use subsplat::network::model::spgr_heads::rules;
use subsplat::network::ops::spgr::Spgr;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::HEAD_STRIDE;

/// [`call`] for K = `children`, which need not be that of `config`.
pub fn call_of(config: &Config, size: usize, children: usize) -> Spgr {
    Spgr { rules: rules(config, children), ..call(config, size) }
}

/// A call for parents of two views of `size` px, one parent per pixel.
pub fn call(config: &Config, size: usize) -> Spgr {
    Spgr {
        rules: rules(config, config.children()),
        cameras: cameras(2, size, size),
        near: vec![1.0; 2],
        per_view: size * size,
        first: 0,
    }
}

/// Parents `[n, 11]` as a backbone gives them, f32.
pub fn parents(cameras: &[Camera], r: &mut Random) -> Tensor {
    let p = LocalPrimaries::random(cameras, 1, r).place(cameras);
    let alpha = p.opacities.unsqueeze(2).unwrap();
    Tensor::cat(&[&p.means, &p.quats_wxyz, &p.scales, &alpha], 2).unwrap().squeeze(0).unwrap()
}

pub fn head(n: usize, k: usize, scale: f64, dtype: DType, r: &mut Random) -> Tensor {
    r.tensor(&[n, k, HEAD_STRIDE], scale, dtype)
}

/// Every rule of the configuration, one at a time and in mixture.
pub fn variants(side: usize) -> Vec<(String, Config)> {
    let mut all = Vec::new();
    for preset in [Preset::Paper, Preset::Tuned] {
        let base = Config::re10k(preset, side);
        type Change = (&'static str, fn(&mut config::Spgr));
        let changes: [Change; 22] = [
            ("as is", |_| {}),
            ("nearest", |s| s.primary_view = PrimaryView::NearestVisible),
            ("source", |s| s.primary_view = PrimaryView::Source),
            ("unbounded", |s| s.offset_bound = None),
            ("bounded", |s| s.offset_bound = Some(0.5)),
            ("axis", |s| s.depth_dir = DepthDir::Axis),
            ("ray", |s| s.depth_dir = DepthDir::Ray),
            ("world", |s| (s.depth_unit, s.beta_z) = (DepthUnit::World, 9.0)),
            ("relative", |s| (s.depth_unit, s.beta_z) = (DepthUnit::Relative, 1.0)),
            ("disc", |s| s.ablations.slide = Slide::Disc),
            ("lambda", |s| s.lambda_s = LambdaS::OverSqrtK(1.2)),
            ("at parent", |s| s.ablations.area_at = AreaAt::Parent),
            ("a_min px", |s| s.ablations.a_min = AMin::TargetPx(2.0)),
            ("a_min in", |s| s.ablations.a_min = AMin::InputPx(0.5)),
            ("a_min off", |s| s.ablations.a_min = AMin::Off),
            ("two axis", |s| {
                (s.ablations.a_min, s.ablations.a_min_mode) =
                    (AMin::TargetPx(2.0), AMinMode::TwoAxis)
            }),
            ("linear", |s| s.opacity = OpacityRule::Linear),
            ("depth", |s| s.opacity = OpacityRule::OpticalDepth),
            ("through", |s| s.opacity = OpacityRule::Transmittance),
            ("area", |s| s.opacity = OpacityRule::Area),
            ("none", |s| s.opacity = OpacityRule::None),
            ("rgb", |s| s.ablations.gain_space = GainSpace::Rgb),
        ];
        for (name, change) in changes {
            let mut config = base.clone();
            change(&mut config.spgr);
            config.check().unwrap();
            all.push((format!("{preset:?} {name} r={side}"), config));
        }
    }
    all
}
