//! The network as candle modules: images and cameras to children.
//!
//! Parameter names are PyTorch's, so that a converted checkpoint loads as it is.

pub mod aggregation;
pub mod architecture;
pub mod backbone;
pub mod compare;
pub mod embed;
mod floors;
pub mod geometry;
pub mod layers;
mod look;
pub mod lpips;
pub mod mlp;
pub mod primaries;
pub mod primaries_ref;
pub mod spgr;
pub mod spgr_ref;
pub mod subsplat;
pub mod trace;
pub mod trunk;
pub mod weights;

pub use crate::ops::Backend;

use crate::camera::Camera;
use crate::config::FeatureLevel;
use candle_core::{Result, Tensor, bail};

/// Gives a seeded tensor the start that an initialisation hint cannot say (an
/// identity, a kernel that averages); `values` come as drawn from the hint.
pub(crate) fn start_value(name: &str, shape: &[usize], values: &mut [f32]) {
    backbone::small_start(name, shape, values);
    if let Some(start) = trunk::initial_value(name, shape) {
        values.copy_from_slice(&start);
    }
}

/// B scenes of V posed pictures each, as the network takes them.
#[derive(Clone, Debug)]
pub struct Views {
    /// `[B, V, 3, H, W]`, f32, RGB in [0, 1].
    pub images: Tensor,
    /// `[B][V]`, intrinsics in pixels of H × W.
    pub cameras: Vec<Vec<Camera>>,
    /// `[B][V]`: nearest and farthest depth candidate, world units.
    pub near_far: Vec<Vec<(f32, f32)>>,
}

impl Views {
    /// Checks that pictures, cameras and depth ranges fit one another.
    ///
    /// # Errors
    /// Names what does not fit, what was expected and what came.
    pub fn new(
        images: Tensor,
        cameras: Vec<Vec<Camera>>,
        near_far: Vec<Vec<(f32, f32)>>,
    ) -> Result<Self> {
        let (b, v, c, h, w) = images.dims5()?;
        if c != 3 {
            bail!("views: expected images [B, V, 3, H, W], got {:?}", images.dims());
        }
        if v < 2 {
            bail!("views: expected at least 2 views, got {v}");
        }
        if cameras.len() != b || cameras.iter().any(|s| s.len() != v) {
            let got: Vec<_> = cameras.iter().map(Vec::len).collect();
            bail!("views: expected {v} cameras for each of {b} scenes, got {got:?}");
        }
        if near_far.len() != b || near_far.iter().any(|s| s.len() != v) {
            let got: Vec<_> = near_far.iter().map(Vec::len).collect();
            bail!("views: expected {v} (near, far) pairs for each of {b} scenes, got {got:?}");
        }
        for camera in cameras.iter().flatten() {
            let k = camera.intrinsics;
            if (k.width, k.height) != (w, h) {
                let got = (k.width, k.height);
                bail!("views: expected cameras of {w}x{h} pixels like the images, got {got:?}");
            }
        }
        for &(near, far) in near_far.iter().flatten() {
            if !(near > 0.0 && far > near && far.is_finite()) {
                bail!("views: expected 0 < near < far, got near = {near}, far = {far}");
            }
        }
        Ok(Self { images, cameras, near_far })
    }

    /// B: scenes.
    pub fn scenes(&self) -> usize {
        self.cameras.len()
    }

    /// V: views per scene.
    pub fn views(&self) -> usize {
        self.cameras.first().map_or(0, Vec::len)
    }

    /// (H, W), px.
    pub fn size(&self) -> Result<(usize, usize)> {
        let (_, _, _, h, w) = self.images.dims5()?;
        Ok((h, w))
    }

    /// Scene `b` alone, still batched (B = 1).
    ///
    /// # Errors
    /// `b` out of range.
    pub fn scene(&self, b: usize) -> Result<Self> {
        Ok(Self {
            images: self.images.narrow(0, b, 1)?,
            cameras: vec![self.cameras[b].clone()],
            near_far: vec![self.near_far[b].clone()],
        })
    }
}

/// What any backbone hands over. N = H·W pixels in row-major order, G Gaussians
/// per pixel.
#[derive(Clone, Debug)]
pub struct BackboneOutput {
    /// `[B, V, H·W, 2 + 3 + 4 + 3·D]`: sub-pixel offset (before the sigmoid), scale
    /// (before the sigmoid), quaternion (x, y, z, w, camera frame, not unit), SH
    /// (colour-major, before the degree mask): the raw head of MVSplat's adapter.
    pub raw: Tensor,
    /// `[B, V, H·W, G]`: distance along the unit ray, world units.
    pub depths: Tensor,
    /// `[B, V, H·W, G]`: opacity in (0, 1) before the opacity mapping and the
    /// division by G.
    pub densities: Tensor,
    /// `[B, V, C_ℓ, h_ℓ, w_ℓ]` for every level that the backbone has.
    pub features: Vec<(FeatureLevel, Tensor)>,
}

impl BackboneOutput {
    /// Every tensor through `f`.
    fn map(&self, f: impl Fn(&Tensor) -> Result<Tensor>) -> Result<Self> {
        let features = self.features.iter().map(|(level, map)| Ok((*level, f(map)?)));
        Ok(Self {
            raw: f(&self.raw)?,
            depths: f(&self.depths)?,
            densities: f(&self.densities)?,
            features: features.collect::<Result<_>>()?,
        })
    }

    /// The same numbers, from which no gradient goes back to the backbone.
    ///
    /// # Errors
    /// None in practice.
    pub fn detach(&self) -> Result<Self> {
        self.map(|t| Ok(t.detach()))
    }

    /// Scene `b` alone.
    ///
    /// # Errors
    /// There is none of this index.
    pub fn scene(&self, b: usize) -> Result<Self> {
        self.map(|t| t.narrow(0, b, 1))
    }

    /// The feature map of `level`.
    ///
    /// # Errors
    /// The backbone has no such level.
    pub fn feature(&self, level: FeatureLevel) -> Result<&Tensor> {
        match self.features.iter().find(|(l, _)| *l == level) {
            Some((_, map)) => Ok(map),
            None => {
                let have: Vec<_> = self.features.iter().map(|(l, _)| *l).collect();
                bail!("feature level {level:?}: expected one of {have:?}")
            }
        }
    }
}

/// Primary Gaussians in world frame: B scenes of N = V·H·W·G, index
/// ((v·H + row)·W + column)·G + g.
#[derive(Clone, Debug)]
pub struct Primaries {
    /// `[B, N, 3]`, world.
    pub means: Tensor,
    /// `[B, N, 4]`: (w, x, y, z), world frame, unit, w ≥ 0.
    pub quats_wxyz: Tensor,
    /// `[B, N, 3]`: σ, world units.
    pub scales: Tensor,
    /// `[B, N]`: in [0, 1].
    pub opacities: Tensor,
    /// `[B, N, 3, D]`: colour-major SH in world frame, masked by degree.
    pub sh: Tensor,
    /// `[B, N, 3, D]`: the same before the rotation, camera frame of the source view.
    pub sh_camera: Tensor,
    /// Functions that `sh` multiplies.
    pub sh_basis: crate::abi::ShBasis,
    /// Gaussians per view, H·W·G: the source view of Gaussian `i` is `i / per_view`.
    pub per_view: usize,
}
