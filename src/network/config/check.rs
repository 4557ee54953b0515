//! Checks of a configuration: ranges, and keys that must fit each other.

use super::{AMin, Aggregation, Backbone, Config, ConfigError, Mvsplat, Points, Small, Spgr};
use std::ops::RangeInclusive;

/// Channels and hidden widths. The published networks have at most 512. A larger value
/// than this range allows comes from a damaged or hostile file.
const WIDTHS: RangeInclusive<usize> = 1..=4096;
/// Numbers of repeated blocks.
const BLOCKS: RangeInclusive<usize> = 0..=64;
/// D: depth candidates.
const CANDIDATES: RangeInclusive<usize> = 2..=1024;

/// Refuses `got` of `key` unless `ok`.
fn need(
    ok: bool,
    key: &'static str,
    expected: &str,
    got: impl std::fmt::Debug,
) -> Result<(), ConfigError> {
    if ok {
        return Ok(());
    }
    Err(ConfigError::Value { key, expected: expected.to_owned(), got: format!("{got:?}") })
}

/// [`need`] for an integer in `range`.
fn within(range: RangeInclusive<usize>, key: &'static str, got: usize) -> Result<(), ConfigError> {
    let (low, high) = (range.start(), range.end());
    need(range.contains(&got), key, &format!("{low} to {high}"), got)
}

impl Config {
    /// Checks every range and every pair of keys that must fit each other.
    ///
    /// # Errors
    /// [`ConfigError::Value`] names the key.
    pub fn check(&self) -> Result<(), ConfigError> {
        within(1..=8, "upscale", self.upscale)?;
        match &self.backbone {
            Backbone::Mvsplat(b) => check_mvsplat(b)?,
            Backbone::Small(b) => check_small(b)?,
        }
        let p = self.primaries();
        need(p.sh_degree <= 4, "backbone.primaries.sh_degree", "0 to 4", p.sh_degree)?;
        need(
            p.scale_min > 0.0 && p.scale_max > p.scale_min && p.scale_max.is_finite(),
            "backbone.primaries.scale_max",
            "0 < scale_min < scale_max",
            (p.scale_min, p.scale_max),
        )?;
        need(
            p.opacity_exponent.is_finite(),
            "backbone.primaries.opacity_exponent",
            "a finite number",
            p.opacity_exponent,
        )?;
        within(WIDTHS, "embed.dim", self.embed.dim)?;
        check_aggregation(&self.agg.resolved(), self.embed.dim)?;
        check_spgr(&self.spgr, self.children())?;
        let r = &self.render;
        need(r.lowpass >= 0.0 && r.lowpass.is_finite(), "render.lowpass", "at least 0", r.lowpass)?;
        need(r.sh_degree <= 4, "render.sh_degree", "0 to 4", r.sh_degree)
    }
}

/// `a`: the keys in force.
fn check_aggregation(a: &Aggregation, dim: usize) -> Result<(), ConfigError> {
    let x = &a.ablations;
    need(
        x.groups > 0 && dim.is_multiple_of(x.groups),
        "agg.groups",
        "a divisor of embed.dim",
        x.groups,
    )?;
    need((1..=8).contains(&a.levels.len()), "agg.levels", "1 to 8 levels", &a.levels)?;
    need(
        a.stages_geo <= 8 && a.stages_app <= 8,
        "agg.stages_geo",
        "0 to 8 stages",
        (a.stages_geo, a.stages_app),
    )?;
    need(x.n_fixed <= 7, "agg.n_fixed", "0 to 7", x.n_fixed)?;
    within(BLOCKS, "agg.n_learned", x.n_learned)?;
    within(1..=64, "agg.gate_views", a.gate_views)?;
    need(
        x.points == Points::Ref || x.n_fixed + x.n_learned > 0,
        "agg.n_learned",
        "at least one point",
        x.n_learned,
    )?;
    need((0.0..1.0).contains(&x.attn_drop), "agg.attn_drop", "in [0, 1)", x.attn_drop)
}

fn check_spgr(s: &Spgr, children: usize) -> Result<(), ConfigError> {
    within(WIDTHS, "spgr.hidden", s.hidden)?;
    need(
        s.offset_bound.is_none_or(|rho| rho > 0.0 && rho.is_finite()),
        "spgr.offset_bound",
        "above 0, or null",
        s.offset_bound,
    )?;
    need(s.beta_z >= 0.0 && s.beta_z.is_finite(), "spgr.beta_z", "at least 0", s.beta_z)?;
    let lambda = s.lambda_s.value(children);
    need(lambda > 0.0 && lambda.is_finite(), "spgr.lambda_s", "above 0", lambda)?;
    let area = match s.ablations.a_min {
        AMin::TargetPx(area) | AMin::InputPx(area) => area,
        AMin::OverK | AMin::Off => 0.0,
    };
    need(area >= 0.0 && area.is_finite(), "spgr.a_min", "an area of 0 or more", area)?;
    need((0.0..=1.0).contains(&s.delta), "spgr.delta", "in [0, 1]", s.delta)?;
    need(s.dlog_clamp > 0.0 && s.dlog_clamp.is_finite(), "spgr.dlog_clamp", "above 0", s.dlog_clamp)
}

fn check_mvsplat(b: &Mvsplat) -> Result<(), ConfigError> {
    for c in b.cnn_channels {
        within(WIDTHS, "backbone.cnn_channels", c)?;
    }
    let width = b.cnn_channels[2];
    need(
        width.is_multiple_of(4),
        "backbone.cnn_channels",
        "a last stage that is a multiple of 4",
        width,
    )?;
    within(1..=64, "backbone.ffn_expansion", b.ffn_expansion)?;
    within(1..=64, "backbone.transformer_layers", b.transformer_layers)?;
    within(1..=64, "backbone.window_splits", b.window_splits)?;
    within(CANDIDATES, "backbone.depth_candidates", b.depth_candidates)?;
    need(
        WIDTHS.contains(&b.costvolume_channels) && b.costvolume_channels.is_multiple_of(32),
        "backbone.costvolume_channels",
        "a multiple of 32, at most 4096",
        b.costvolume_channels,
    )?;
    within(1..=3, "backbone.costvolume_levels", b.costvolume_levels)?;
    need(
        WIDTHS.contains(&b.refine_channels) && b.refine_channels.is_multiple_of(32),
        "backbone.refine_channels",
        "a multiple of 32, at most 4096",
        b.refine_channels,
    )?;
    within(1..=6, "backbone.refine_levels", b.refine_levels)?;
    within(1..=64, "backbone.gaussians_per_pixel", b.gaussians_per_pixel)
}

fn check_small(b: &Small) -> Result<(), ConfigError> {
    for c in b.cnn_channels.into_iter().chain(b.unet_channels.iter().copied()) {
        need(
            WIDTHS.contains(&c) && c % 8 == 0,
            "backbone.unet_channels",
            "multiples of 8 (GroupNorm), at most 4096, in cnn_channels and unet_channels",
            c,
        )?;
    }
    need(
        (1..=5).contains(&b.unet_channels.len()),
        "backbone.unet_channels",
        "1 to 5 levels",
        b.unet_channels.len(),
    )?;
    within(CANDIDATES, "backbone.depth_candidates", b.depth_candidates)?;
    within(BLOCKS, "backbone.cnn_blocks", b.cnn_blocks)?;
    within(WIDTHS, "backbone.match_channels", b.match_channels)?;
    within(0..=*WIDTHS.end(), "backbone.stem_channels", b.stem_channels)?;
    within(0..=*CANDIDATES.end(), "backbone.mode_window", b.mode_window)?;
    need(
        WIDTHS.contains(&b.head_channels) && b.head_channels.is_multiple_of(8),
        "backbone.head_channels",
        "a multiple of 8, at most 4096",
        b.head_channels,
    )
}
