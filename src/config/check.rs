//! Ranges, and keys that must fit each other.

use super::{AMin, Backbone, Config, ConfigError, Mvsplat, Points, Small};
use std::ops::RangeInclusive;

/// Channels and hidden widths. The published networks have 512 at most; beyond the upper
/// end a file is damaged or means harm, and its tensors would not fit into memory.
const WIDTHS: RangeInclusive<usize> = 1..=4096;
/// Repeated parts.
const BLOCKS: RangeInclusive<usize> = 0..=64;
/// Depth candidates, D.
const CANDIDATES: RangeInclusive<usize> = 2..=1024;

impl Config {
    /// Checks every range and every pair of keys that must fit.
    ///
    /// # Errors
    /// [`ConfigError::Value`] names the key.
    pub fn check(&self) -> Result<(), ConfigError> {
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
        need((1..=8).contains(&self.upscale), "upscale", "1 to 8", self.upscale)?;
        match &self.backbone {
            Backbone::Mvsplat(b) => check_mvsplat(b, need)?,
            Backbone::Small(b) => check_small(b, need)?,
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
        let a = self.agg.resolved();
        need(WIDTHS.contains(&self.embed.dim), "embed.dim", "1 to 4096", self.embed.dim)?;
        need(
            a.groups > 0 && self.embed.dim.is_multiple_of(a.groups),
            "agg.groups",
            "a divisor of embed.dim",
            a.groups,
        )?;
        need((1..=8).contains(&a.levels.len()), "agg.levels", "1 to 8 levels", &a.levels)?;
        need(
            a.stages_geo <= 8 && a.stages_app <= 8,
            "agg.stages_geo",
            "0 to 8 stages",
            (a.stages_geo, a.stages_app),
        )?;
        need(a.n_fixed <= 7, "agg.n_fixed", "0 to 7", a.n_fixed)?;
        need(BLOCKS.contains(&a.n_learned), "agg.n_learned", "0 to 64", a.n_learned)?;
        need((1..=64).contains(&a.gate_views), "agg.gate_views", "1 to 64", a.gate_views)?;
        need(
            a.points == Points::Ref || a.n_fixed + a.n_learned > 0,
            "agg.n_learned",
            "at least one point",
            a.n_learned,
        )?;
        need((0.0..1.0).contains(&a.attn_drop), "agg.attn_drop", "in [0, 1)", a.attn_drop)?;
        let s = &self.spgr;
        need(WIDTHS.contains(&s.hidden), "spgr.hidden", "1 to 4096", s.hidden)?;
        need(
            s.offset_bound.is_none_or(|rho| rho > 0.0 && rho.is_finite()),
            "spgr.offset_bound",
            "above 0, or null",
            s.offset_bound,
        )?;
        need(s.beta_z >= 0.0 && s.beta_z.is_finite(), "spgr.beta_z", "at least 0", s.beta_z)?;
        let lambda = s.lambda_s.value(self.children());
        need(lambda > 0.0 && lambda.is_finite(), "spgr.lambda_s", "above 0", lambda)?;
        let least = match s.a_min {
            AMin::TargetPx(area) | AMin::InputPx(area) => area,
            _ => 0.0,
        };
        need(least >= 0.0 && least.is_finite(), "spgr.a_min", "an area of 0 or more", least)?;
        need((0.0..=1.0).contains(&s.delta), "spgr.delta", "in [0, 1]", s.delta)?;
        need(
            s.dlog_clamp > 0.0 && s.dlog_clamp.is_finite(),
            "spgr.dlog_clamp",
            "above 0",
            s.dlog_clamp,
        )?;
        let r = &self.render;
        need(r.lowpass >= 0.0 && r.lowpass.is_finite(), "render.lowpass", "at least 0", r.lowpass)?;
        need(r.sh_degree <= 4, "render.sh_degree", "0 to 4", r.sh_degree)
    }
}

type Need<T> = fn(bool, &'static str, &str, T) -> Result<(), ConfigError>;

fn check_candidates(d: usize, need: Need<usize>) -> Result<(), ConfigError> {
    need(CANDIDATES.contains(&d), "backbone.depth_candidates", "2 to 1024", d)
}

fn check_mvsplat(b: &Mvsplat, need: Need<usize>) -> Result<(), ConfigError> {
    for c in b.cnn_channels {
        need(WIDTHS.contains(&c), "backbone.cnn_channels", "1 to 4096", c)?;
    }
    let width = b.cnn_channels[2];
    need(
        width.is_multiple_of(4),
        "backbone.cnn_channels",
        "a last stage that is a multiple of 4",
        width,
    )?;
    need(
        (1..=64).contains(&b.ffn_expansion),
        "backbone.ffn_expansion",
        "1 to 64",
        b.ffn_expansion,
    )?;
    need(
        (1..=64).contains(&b.transformer_layers),
        "backbone.transformer_layers",
        "1 to 64",
        b.transformer_layers,
    )?;
    need(
        (1..=64).contains(&b.window_splits),
        "backbone.window_splits",
        "1 to 64",
        b.window_splits,
    )?;
    check_candidates(b.depth_candidates, need)?;
    need(
        WIDTHS.contains(&b.costvolume_channels) && b.costvolume_channels.is_multiple_of(32),
        "backbone.costvolume_channels",
        "a multiple of 32, at most 4096",
        b.costvolume_channels,
    )?;
    need(
        (1..=3).contains(&b.costvolume_levels),
        "backbone.costvolume_levels",
        "1 to 3",
        b.costvolume_levels,
    )?;
    need(
        WIDTHS.contains(&b.refine_channels) && b.refine_channels.is_multiple_of(32),
        "backbone.refine_channels",
        "a multiple of 32, at most 4096",
        b.refine_channels,
    )?;
    need((1..=6).contains(&b.refine_levels), "backbone.refine_levels", "1 to 6", b.refine_levels)?;
    need(
        (1..=64).contains(&b.gaussians_per_pixel),
        "backbone.gaussians_per_pixel",
        "1 to 64",
        b.gaussians_per_pixel,
    )
}

fn check_small(b: &Small, need: Need<usize>) -> Result<(), ConfigError> {
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
    check_candidates(b.depth_candidates, need)?;
    need(BLOCKS.contains(&b.cnn_blocks), "backbone.cnn_blocks", "0 to 64", b.cnn_blocks)?;
    need(
        WIDTHS.contains(&b.match_channels),
        "backbone.match_channels",
        "1 to 4096",
        b.match_channels,
    )?;
    need(b.stem_channels <= *WIDTHS.end(), "backbone.stem_channels", "0 to 4096", b.stem_channels)?;
    need(b.mode_window <= *CANDIDATES.end(), "backbone.mode_window", "0 to 1024", b.mode_window)?;
    need(
        WIDTHS.contains(&b.head_channels) && b.head_channels.is_multiple_of(8),
        "backbone.head_channels",
        "a multiple of 8, at most 4096",
        b.head_channels,
    )
}
