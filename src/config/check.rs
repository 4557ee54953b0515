//! Ranges, and keys that must fit each other.

use super::{Backbone, Config, ConfigError, Mvsplat, Points, Small};

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
        let a = self.agg.resolved();
        need(self.embed.dim > 0, "embed.dim", "at least 1", self.embed.dim)?;
        need(
            a.groups > 0 && self.embed.dim.is_multiple_of(a.groups),
            "agg.groups",
            "a divisor of embed.dim",
            a.groups,
        )?;
        need(!a.levels.is_empty(), "agg.levels", "at least one level", &a.levels)?;
        need(
            a.stages_geo <= 8 && a.stages_app <= 8,
            "agg.stages_geo",
            "0 to 8 stages",
            (a.stages_geo, a.stages_app),
        )?;
        need(a.n_fixed <= 7, "agg.n_fixed", "0 to 7", a.n_fixed)?;
        need(
            a.points == Points::Ref || a.n_fixed + a.n_learned > 0,
            "agg.n_learned",
            "at least one point",
            a.n_learned,
        )?;
        need((0.0..1.0).contains(&a.attn_drop), "agg.attn_drop", "in [0, 1)", a.attn_drop)?;
        let s = &self.spgr;
        need(s.hidden > 0, "spgr.hidden", "at least 1", s.hidden)?;
        need(s.beta_z >= 0.0 && s.beta_z.is_finite(), "spgr.beta_z", "at least 0", s.beta_z)?;
        let lambda = s.lambda_s.value(self.children());
        need(lambda > 0.0 && lambda.is_finite(), "spgr.lambda_s", "above 0", lambda)?;
        need((0.0..=1.0).contains(&s.delta), "spgr.delta", "in [0, 1]", s.delta)?;
        need(s.dlog_clamp > 0.0, "spgr.dlog_clamp", "above 0", s.dlog_clamp)?;
        let r = &self.render;
        need(r.lowpass >= 0.0 && r.lowpass.is_finite(), "render.lowpass", "at least 0", r.lowpass)?;
        need(r.sh_degree <= 4, "render.sh_degree", "0 to 4", r.sh_degree)
    }
}

type Need<T> = fn(bool, &'static str, &str, T) -> Result<(), ConfigError>;

fn check_mvsplat(b: &Mvsplat, need: Need<usize>) -> Result<(), ConfigError> {
    let width = b.cnn_channels[2];
    need(
        width > 0 && width.is_multiple_of(4),
        "backbone.cnn_channels",
        "a last stage that is a multiple of 4",
        width,
    )?;
    need(
        (1..=64).contains(&b.transformer_layers),
        "backbone.transformer_layers",
        "1 to 64",
        b.transformer_layers,
    )?;
    need(b.window_splits >= 1, "backbone.window_splits", "at least 1", b.window_splits)?;
    need(b.depth_candidates >= 2, "backbone.depth_candidates", "at least 2", b.depth_candidates)?;
    need(
        b.costvolume_channels > 0 && b.costvolume_channels.is_multiple_of(32),
        "backbone.costvolume_channels",
        "a multiple of 32",
        b.costvolume_channels,
    )?;
    need(
        (1..=3).contains(&b.costvolume_levels),
        "backbone.costvolume_levels",
        "1 to 3",
        b.costvolume_levels,
    )?;
    need(
        b.refine_channels > 0 && b.refine_channels.is_multiple_of(32),
        "backbone.refine_channels",
        "a multiple of 32",
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
            c > 0 && c % 8 == 0,
            "backbone.unet_channels",
            "multiples of 8 (GroupNorm) in cnn_channels and unet_channels",
            c,
        )?;
    }
    need(
        (1..=5).contains(&b.unet_channels.len()),
        "backbone.unet_channels",
        "1 to 5 levels",
        b.unet_channels.len(),
    )?;
    need(b.depth_candidates >= 2, "backbone.depth_candidates", "at least 2", b.depth_candidates)?;
    need(b.match_channels > 0, "backbone.match_channels", "at least 1", b.match_channels)?;
    need(
        b.head_channels > 0 && b.head_channels.is_multiple_of(8),
        "backbone.head_channels",
        "a multiple of 8",
        b.head_channels,
    )
}
