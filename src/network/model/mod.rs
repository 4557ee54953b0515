//! The network as candle modules: from images and cameras to children.
//!
//! Parameter names are PyTorch's, so that a converted checkpoint loads without renaming.
//!
//! The modules are written once, over the trait `ops::Array`: candle's tensors implement it with the CPU kernels
//! and their gradients, arrays of a GPU with WGSL kernels over device memory. A recorded graph was considered: it
//! would need the same set of operations, and a second form of each loop over views and chunks. The trait costs a
//! type parameter on each `forward`, and operators become methods. Modules that neither preset uses
//! (`aggregation/ablated.rs`) take tensors.

pub mod aggregation;
pub mod architecture;
pub mod backbone;
pub mod embed;
pub mod geometry;
mod half_size_pass;
pub mod layers;
pub mod mlp;
pub mod primaries;
pub mod scene_encoding;
pub mod spgr_heads;
pub mod subsplat;
pub mod taped;
pub mod trace;
pub mod trunk;
pub mod weights;

use crate::network::ops::Array;
pub use crate::network::ops::Backend;

use crate::network::config::FeatureLevel;
use candle_core::{Result, Tensor, bail};
use subsplat_kernels::camera::{Camera, NearFar};

/// Overwrites the seeded `values` of tensor `name` if its initial value is one that
/// `candle_nn::Init` cannot express (an identity, an averaging kernel).
pub(crate) fn apply_initial_value(name: &str, shape: &[usize], values: &mut [f32]) {
    backbone::apply_small_initial_value(name, shape, values);
    if let Some(initial) = trunk::initial_value(name, shape) {
        values.copy_from_slice(&initial);
    }
}

/// The network's input: B scenes of V posed images each.
#[derive(Clone, Debug)]
pub struct Views {
    /// `[B, V, 3, H, W]`, f32, RGB in [0, 1].
    pub images: Tensor,
    /// `[B][V]`, intrinsics in pixels of H × W.
    pub cameras: Vec<Vec<Camera>>,
    /// `[B][V]`: nearest and farthest depth candidate (camera z), world units.
    pub near_far: Vec<Vec<NearFar>>,
    /// `[B][V][S]`: views with which each view is compared, ascending; S is the same for all.
    /// [`Views::new`] takes all other views.
    sources: Vec<Vec<Vec<usize>>>,
}

impl Views {
    /// Checks that images, cameras and depth ranges fit one another.
    ///
    /// # Errors
    /// A shape, a number of cameras or depth ranges, an image size or a range is invalid.
    pub fn new(
        images: Tensor,
        cameras: Vec<Vec<Camera>>,
        near_far: Vec<Vec<NearFar>>,
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
            bail!("views: expected {v} depth ranges for each of {b} scenes, got {got:?}");
        }
        for camera in cameras.iter().flatten() {
            let k = camera.intrinsics();
            if (k.width, k.height) != (w, h) {
                let got = (k.width, k.height);
                bail!("views: expected cameras of {w}x{h} pixels like the images, got {got:?}");
            }
        }
        for &range in near_far.iter().flatten() {
            if !range.is_valid() {
                let NearFar { near, far } = range;
                bail!("views: expected 0 < near < far, got near = {near}, far = {far}");
            }
        }
        let all = |i: usize| (0..v).filter(|&j| j != i).collect();
        let sources = vec![(0..v).map(all).collect(); b];
        Ok(Self { images, cameras, near_far, sources })
    }

    /// Sets the views with which each view is compared, `[B][V][S]`. The network's time grows
    /// with V·S.
    ///
    /// # Errors
    /// Lists of different lengths, no source, or a source that is the view itself, twice in a
    /// list or out of range.
    pub fn with_sources(mut self, mut sources: Vec<Vec<Vec<usize>>>) -> Result<Self> {
        let (b, v) = (self.scenes(), self.views());
        let count = sources.first().and_then(|s| s.first()).map_or(0, Vec::len);
        if sources.len() != b || sources.iter().any(|s| s.len() != v) {
            let got: Vec<_> = sources.iter().map(Vec::len).collect();
            bail!("views: expected lists of sources for {b} scenes of {v} views, got {got:?}");
        }
        for (i, list) in sources.iter_mut().flat_map(|s| s.iter_mut().enumerate()) {
            list.sort_unstable();
            let valid = list.iter().all(|&j| j < v && j != i);
            let distinct = list.windows(2).all(|pair| pair[0] != pair[1]);
            if list.len() != count || count == 0 || !valid || !distinct {
                bail!(
                    "views: expected {} different sources below {v} for view {i}, other than the \
                     view itself, got {list:?}",
                    count.max(1)
                );
            }
        }
        self.sources = sources;
        Ok(self)
    }

    /// Returns the views with which each view is compared, `[B][V][S]`, ascending.
    pub fn sources(&self) -> &[Vec<Vec<usize>>] {
        &self.sources
    }

    /// Returns S, the number of views with which each view is compared.
    pub fn sources_per_view(&self) -> usize {
        self.sources.first().and_then(|s| s.first()).map_or(0, Vec::len)
    }

    /// Returns B, the number of scenes.
    pub fn scenes(&self) -> usize {
        self.cameras.len()
    }

    /// Returns V, the number of views per scene.
    pub fn views(&self) -> usize {
        self.cameras.first().map_or(0, Vec::len)
    }

    /// Returns (H, W), px.
    ///
    /// # Errors
    /// None: [`Views::new`] checks the shape.
    pub fn size(&self) -> Result<(usize, usize)> {
        let (_, _, _, h, w) = self.images.dims5()?;
        Ok((h, w))
    }

    /// Returns scene `b` as a batch of one.
    ///
    /// # Errors
    /// `b` is out of range.
    pub fn scene(&self, b: usize) -> Result<Self> {
        Ok(Self {
            images: self.images.narrow(0, b, 1)?,
            cameras: vec![self.cameras[b].clone()],
            near_far: vec![self.near_far[b].clone()],
            sources: vec![self.sources[b].clone()],
        })
    }
}

/// Feature maps that a caller of a backbone reads. Maps of the photographs' size are large: 32 channels of fifty
/// views of 192×352 px take 430 MB, and as much again while they are joined.
pub type Levels<'a> = &'a dyn Fn(FeatureLevel) -> bool;

/// Output of a backbone. The H·W pixels are in row-major order, with G Gaussians each.
#[derive(Clone, Debug)]
pub struct BackboneOutput<A = Tensor> {
    /// `[B, V, H·W, 2 + 3 + 4 + 3·D]`, the raw head of MVSplat's adapter: sub-pixel offset
    /// and scale before the sigmoid; quaternion xyzw, camera frame, not unit; SH,
    /// colour-major, before the degree mask. Only the primaries are made from it.
    pub raw: A,
    /// `[B, V, H·W, G]`: distance along the unit ray, world units.
    pub depths: A,
    /// `[B, V, H·W, G]`: opacity in (0, 1) before the opacity mapping and the
    /// division by G.
    pub densities: A,
    /// `[B, V, C_ℓ, h_ℓ, w_ℓ]` of the levels that were asked for.
    pub features: Vec<(FeatureLevel, A)>,
}

impl<A: Array> BackboneOutput<A> {
    /// Applies `f` to every array.
    fn map<B>(&self, f: impl Fn(&A) -> Result<B>) -> Result<BackboneOutput<B>> {
        let features = self.features.iter().map(|(level, map)| Ok((*level, f(map)?)));
        Ok(BackboneOutput {
            raw: f(&self.raw)?,
            depths: f(&self.depths)?,
            densities: f(&self.densities)?,
            features: features.collect::<Result<_>>()?,
        })
    }

    /// Returns the feature map of `level`.
    ///
    /// # Errors
    /// The backbone does not have `level`.
    pub fn feature(&self, level: FeatureLevel) -> Result<&A> {
        feature_of(&self.features, level)
    }

    /// Returns the same arrays in host memory.
    ///
    /// # Errors
    /// Errors of the device.
    pub fn to_host(&self) -> Result<BackboneOutput> {
        self.map(A::to_host)
    }
}

/// Returns the feature map of `level`.
///
/// # Errors
/// `features` do not have `level`.
fn feature_of<A>(features: &[(FeatureLevel, A)], level: FeatureLevel) -> Result<&A> {
    match features.iter().find(|(l, _)| *l == level) {
        Some((_, map)) => Ok(map),
        None => {
            let have: Vec<_> = features.iter().map(|(l, _)| *l).collect();
            bail!("feature level {level:?}: expected one of {have:?}")
        }
    }
}

impl BackboneOutput {
    /// Returns the same tensors outside the backbone's graph.
    ///
    /// # Errors
    /// None in practice.
    pub fn detach(&self) -> Result<Self> {
        self.map(|t| Ok(t.detach()))
    }

    /// Returns scene `b` as a batch of one.
    ///
    /// # Errors
    /// `b` is out of range.
    pub fn scene(&self, b: usize) -> Result<Self> {
        self.map(|t| t.narrow(0, b, 1))
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
    /// `[B, N, 3, D]`: `sh` before the rotation, in the source view's camera frame.
    pub sh_camera: Tensor,
    /// Basis of `sh`.
    pub sh_basis: subsplat_kernels::layout::ShBasis,
    /// Gaussians per view, H·W·G: the source view of Gaussian `i` is `i / per_view`.
    pub per_view: usize,
}

#[cfg(test)]
mod tests {
    use super::*;
    use candle_core::{DType, Device};
    use glam::Mat4;
    use subsplat_kernels::camera::Intrinsics;

    fn three() -> Views {
        let k = Intrinsics { fx: 8.0, fy: 8.0, cx: 4.0, cy: 4.0, width: 8, height: 8 };
        let camera = Camera::new(k, Mat4::IDENTITY).unwrap();
        let images = Tensor::zeros((1, 3, 3, 8, 8), DType::F32, &Device::Cpu).unwrap();
        Views::new(images, vec![vec![camera; 3]], vec![vec![NearFar::RE10K; 3]]).unwrap()
    }

    #[test]
    fn all_other_views_are_sources_unless_they_are_named() {
        let views = three();
        assert_eq!(views.sources(), [[vec![1, 2], vec![0, 2], vec![0, 1]]]);
        let views = views.with_sources(vec![vec![vec![2], vec![0], vec![1]]]).unwrap();
        assert_eq!(views.sources_per_view(), 1);
        assert_eq!(views.scene(0).unwrap().sources(), [[vec![2], vec![0], vec![1]]]);
        let sorted = three().with_sources(vec![vec![vec![2, 1], vec![2, 0], vec![1, 0]]]).unwrap();
        assert_eq!(sorted.sources(), three().sources());
    }

    #[test]
    fn sources_that_no_view_can_have_are_refused() {
        let bad: [Vec<Vec<usize>>; 6] = [
            vec![vec![1], vec![0]],
            vec![vec![1], vec![0], vec![0, 1]],
            vec![vec![0], vec![0], vec![0]],
            vec![vec![3], vec![0], vec![0]],
            vec![vec![1, 1], vec![0, 2], vec![0, 1]],
            vec![vec![], vec![], vec![]],
        ];
        for sources in bad {
            let text = three().with_sources(vec![sources.clone()]).unwrap_err().to_string();
            assert!(text.contains("expected"), "{sources:?}: {text}");
        }
    }
}
