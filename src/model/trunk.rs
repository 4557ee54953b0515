//! What SubSplat adds to the backbone, end to end: embeddings, aggregation, heads,
//! SPGR, in chunks of parents so that no `[N, E]` tensor of all parents exists at
//! inference.
//!
//! Parameters under `subsplat`: `embed`, `agg`, `geo`, `app`; none with SPGR off.

mod recompute;

pub use recompute::Recomputed;

use super::aggregation::{Aggregation, Prepared, ring};
use super::embed::Embeddings;
use super::geometry::{Frames, ParentChunk};
use super::mlp::Mode;
use super::primaries::Packed;
use super::spgr::{Heads, rules};
use super::{BackboneOutput, Primaries, Views};
use crate::abi::{RasterOptions, SPLAT_STRIDE, ShBasis, sh_coefficients};
use crate::camera::Camera;
use crate::config::{Config, FeatureLevel, HeadInput, ShInput, SpgrHead};
use crate::ops::direct::{Footprint, rasterize_footprints, spgr_footprints};
use crate::ops::moves::sum;
use crate::ops::spgr::{Rules, Spgr, spgr_into_on, spgr_on};
use crate::ops::{Backend, rasterize_on};
use crate::splats::Splats;
use candle_core::{DType, Result, Tensor, bail};
use candle_nn::{VarBuilder, VarMap};
use rayon::prelude::*;

/// Parents per chunk at inference. A `[256, 128]` activation stays in a core's L2, and
/// below the 65,536 elements from which candle spreads one elementwise operation over
/// a spinning thread pool of its own, whose lock the chunks would fight for.
pub const CHUNK: usize = 256;

/// Parents per chunk where a GPU gathers: every chunk brings the feature maps over anew,
/// and one at a time is what the device takes. 16384·E floats are 8 MiB at E = 128.
const CHUNK_GPU: usize = 1 << 14;

/// Gaussians of one scene that share SH by parent.
#[derive(Clone, Debug)]
pub struct Children {
    /// `[N·K, 11]`, lanes in [`crate::abi`]; child k of parent n is row n·K + k.
    pub rows: Tensor,
    /// `[N·K]`: γ; or `[N·K, 4]`: γ and the residual δ in RGB.
    pub gain: Tensor,
    /// `[N, D, 3]`: the parents' SH, world frame, RGB innermost.
    pub sh: Tensor,
    /// Functions that `sh` multiplies.
    pub sh_basis: ShBasis,
    /// K.
    pub k: usize,
}

impl Children {
    /// The primaries of one scene themselves, K = 1: what a trunk with SPGR off gives.
    ///
    /// # Errors
    /// Whatever candle says.
    pub fn whole(parents: &Packed) -> Result<Self> {
        let rows = parents.rows().clone();
        Ok(Self {
            gain: Tensor::ones(rows.dim(0)?, rows.dtype(), rows.device())?,
            rows,
            sh: parents.sh()?,
            sh_basis: parents.sh_basis,
            k: 1,
        })
    }

    /// Packed rows for the renderer and the writers.
    ///
    /// # Errors
    /// Tensors that are not `f32` or do not fit one another.
    pub fn to_splats(&self) -> Result<Splats> {
        Splats::from_tensors(&self.rows, &self.sh, &self.gain, self.sh_basis)
    }
}

#[derive(Clone, Debug)]
struct Parts {
    embeddings: Embeddings,
    aggregation: Option<Aggregation>,
    heads: Heads,
}

/// The trunk's parameters.
#[derive(Clone, Debug)]
pub struct Trunk {
    config: Config,
    side: usize,
    /// `None` where SPGR is off.
    parts: Option<Parts>,
    backend: Backend,
}

/// What all chunks of one scene share.
struct Scene<'a> {
    views: &'a Views,
    frames: Frames,
    means: Tensor,
    quats_wxyz: Tensor,
    scales: Tensor,
    opacities: Tensor,
    sh_input: Tensor,
    per_view: usize,
    prepared: Option<Prepared>,
    rules: Rules,
}

impl Trunk {
    /// `channels` of each feature level that the backbone hands over.
    ///
    /// # Errors
    /// A configuration that does not check, a level that the backbone lacks, tensors
    /// missing or of another shape.
    pub fn new(
        config: &Config,
        channels: &[(FeatureLevel, usize)],
        vb: VarBuilder,
    ) -> Result<Self> {
        config.check().map_err(candle_core::Error::wrap)?;
        let vb = vb.pp("subsplat");
        let sh = 3 * sh_coefficients(config.primaries().sh_degree);
        let parts = if config.spgr.enabled {
            let dim = config.embed.dim;
            Some(Parts {
                embeddings: Embeddings::new(&config.embed, sh, vb.pp("embed"))?,
                aggregation: match config.agg.enabled {
                    true => Some(Aggregation::new(&config.agg, dim, channels, vb.pp("agg"))?),
                    false => None,
                },
                heads: Heads::new(config, vb)?,
            })
        } else {
            None
        };
        Ok(Self { config: config.clone(), side: config.upscale, parts, backend: Backend::Cpu })
    }

    /// Where the next calls gather, make children and rasterize.
    pub fn set_backend(&mut self, backend: &Backend) {
        self.backend = backend.clone();
        if let Some(agg) = self.parts.as_mut().and_then(|p| p.aggregation.as_mut()) {
            agg.set_backend(backend);
        }
    }

    /// Whether SPGR is off: children are then the primaries ([`Children::whole`]).
    pub fn is_off(&self) -> bool {
        self.parts.is_none()
    }

    /// r of the next calls; the `coord` head serves any, the others what they have
    /// been made for.
    ///
    /// # Errors
    /// Another r than configured with a head of fixed K.
    pub fn set_upscale(&mut self, side: usize) -> Result<()> {
        let fixed = self.config.spgr.head != SpgrHead::Coord && self.parts.is_some();
        if !(1..=8).contains(&side) || (fixed && side != self.config.upscale) {
            let expected = if fixed { self.config.upscale.to_string() } else { "1 to 8".into() };
            bail!("upscale: expected {expected} (head {:?}), got {side}", self.config.spgr.head);
        }
        self.side = side;
        Ok(())
    }

    /// Children of the one scene in `views`, without gradient; chunks in parallel, or on a
    /// GPU one after the other.
    ///
    /// # Errors
    /// Inputs that do not fit one another or the configuration, or that give numbers
    /// that are not finite.
    pub fn forward(
        &self,
        views: &Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
    ) -> Result<Children> {
        let Some(parts) = &self.parts else { return self.pass_through(views, primaries) };
        let scene = self.scene(parts, views, backbone, primaries)?;
        let sh = interleaved(&primaries.sh)?;
        let chunk = if self.backend.is_cpu() { CHUNK } else { CHUNK_GPU };
        self.children(parts, &scene, (sh, primaries.sh_basis), (chunk, Mode::Infer))
    }

    /// Children with coefficients `sh` outside any graph, `chunk` parents at a time.
    fn children(
        &self,
        parts: &Parts,
        scene: &Scene,
        (sh, sh_basis): (Tensor, ShBasis),
        (chunk, mode): (usize, Mode),
    ) -> Result<Children> {
        let (k, lanes) = (scene.rules.children(), scene.rules.gain_lanes());
        let n = scene.means.dim(0)?;
        if scene.means.dtype() != DType::F32 {
            bail!("primaries: expected f32, got {:?}", scene.means.dtype());
        }
        let mut rows = vec![0f32; n * k * SPLAT_STRIDE];
        let mut gains = vec![0f32; n * k * lanes];
        let mut jobs = Vec::new();
        let (mut rows_left, mut gains_left) = (&mut rows[..], &mut gains[..]);
        for (first, len) in chunks(n, scene.per_view, chunk.max(1)) {
            let (r, rest) = rows_left.split_at_mut(len * k * SPLAT_STRIDE);
            rows_left = rest;
            let (g, rest) = gains_left.split_at_mut(len * k * lanes);
            gains_left = rest;
            jobs.push((first, len, r, g));
        }
        type Job<'a> = (usize, usize, &'a mut [f32], &'a mut [f32]);
        let run = |(first, len, rows, gains): Job| {
            let (head, parents) = self.records(parts, scene, (first, len), mode)?;
            spgr_into_on(&self.backend, &head, &parents, &scene.call(first), (rows, gains))
        };
        match self.backend.is_cpu() {
            true => jobs.into_par_iter().try_for_each(run)?,
            false => jobs.into_iter().try_for_each(run)?,
        }
        let device = scene.means.device();
        let gain = Tensor::from_vec(gains, n * k * lanes, device)?;
        Ok(Children {
            rows: Tensor::from_vec(rows, (n * k, SPLAT_STRIDE), device)?,
            gain: if lanes == 1 { gain } else { gain.reshape((n * k, lanes))? },
            sh,
            sh_basis,
            k,
        })
    }

    /// The picture `[5, H, W]` (R, G, B, alpha, Σ w·z) that `camera` sees of the one
    /// scene in `views`, without children in memory: head records become footprints
    /// chunk by chunk; a GPU makes the children and rasterizes them. The basis of `options`
    /// gives way to the primaries' own.
    ///
    /// # Errors
    /// Those of [`Trunk::forward`] and of the rasterizer.
    pub fn render(
        &self,
        views: &Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Result<Tensor> {
        let options = &RasterOptions { sh_basis: primaries.sh_basis, ..*options };
        let parts = match &self.parts {
            Some(parts) if self.backend.is_cpu() => parts,
            _ => {
                let all = self.forward(views, backbone, primaries)?;
                let (rows, sh, gain) = (&all.rows, &all.sh, &all.gain);
                return rasterize_on(&self.backend, rows, sh, gain, camera, options);
            }
        };
        let scene = self.scene(parts, views, backbone, primaries)?;
        let (k, n) = (scene.rules.children(), scene.means.dim(0)?);
        let sh = primaries.sh.squeeze(0)?;
        let fill = |mut left: &mut [Footprint]| {
            let mut jobs = Vec::new();
            for (first, len) in chunks(n, scene.per_view, CHUNK) {
                let (own, rest) = left.split_at_mut(len * k);
                left = rest;
                jobs.push((first, len, own));
            }
            jobs.into_par_iter().try_for_each(|(first, len, own)| {
                let (head, parents) = self.records(parts, &scene, (first, len), Mode::Infer)?;
                let sh = sh.narrow(0, first, len)?.transpose(1, 2)?;
                spgr_footprints((&head, &parents, &sh), &scene.call(first), camera, options, own)
            })
        };
        rasterize_footprints(n * k, camera, options, fill)
    }

    /// [`Trunk::forward`] for every scene of a batch.
    ///
    /// # Errors
    /// Those of [`Trunk::forward`].
    pub fn forward_scenes(
        &self,
        views: &Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
    ) -> Result<Vec<Children>> {
        let scene = |b: usize| {
            self.forward(&views.scene(b)?, &backbone.scene(b)?, &primaries_of(primaries, b)?)
        };
        (0..views.scenes()).map(scene).collect()
    }

    /// Children of the one scene in `views`, differentiable in every parameter and in
    /// the backbone's outputs, `chunk` parents at a time. `seed` decides what attention
    /// drops.
    ///
    /// # Errors
    /// Those of [`Trunk::forward`].
    pub fn forward_train(
        &self,
        views: &Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
        (chunk, seed): (usize, u64),
    ) -> Result<Children> {
        let Some(parts) = &self.parts else { return self.pass_through(views, primaries) };
        let scene = self.scene(parts, views, backbone, primaries)?;
        let (mut rows, mut gains) = (Vec::new(), Vec::new());
        for span in chunks(scene.means.dim(0)?, scene.per_view, chunk.max(1)) {
            let (head, parents) = self.records(parts, &scene, span, Mode::Train { seed })?;
            let (r, g) = spgr_on(&self.backend, &head, &parents, &scene.call(span.0))?;
            rows.push(r);
            gains.push(g);
        }
        Ok(Children {
            rows: Tensor::cat(&rows, 0)?,
            gain: Tensor::cat(&gains, 0)?,
            sh: interleaved(&primaries.sh)?,
            sh_basis: primaries.sh_basis,
            k: scene.rules.children(),
        })
    }

    fn scene<'a>(
        &self,
        parts: &Parts,
        views: &'a Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
    ) -> Result<Scene<'a>> {
        check_single(views, primaries)?;
        // Whole rows, so that no chunk gathers its own from wider ones.
        let own = |t: &Tensor| t.squeeze(0)?.contiguous();
        let means = own(&primaries.means)?;
        let n = means.dim(0)?;
        let frames = Frames::new(&views.cameras[0], means.dtype(), means.device())?;
        let sh = match self.config.embed.sh {
            ShInput::World => &primaries.sh,
            ShInput::Camera => &primaries.sh_camera,
        };
        let (_, _, channels, d) = sh.dims4()?;
        let expected = sh_coefficients(self.config.primaries().sh_degree);
        if (channels, d) != (3, expected) {
            bail!("primaries SH: expected [1, {n}, 3, {expected}], got {:?}", sh.dims());
        }
        let prepared = match &parts.aggregation {
            Some(agg) => Some(agg.prepare(views, &frames, backbone, primaries)?),
            None => None,
        };
        Ok(Scene {
            views,
            frames,
            means,
            quats_wxyz: own(&primaries.quats_wxyz)?,
            scales: own(&primaries.scales)?,
            opacities: own(&primaries.opacities)?.unsqueeze(1)?,
            sh_input: sh.reshape((n, 3 * d))?,
            per_view: primaries.per_view,
            prepared,
            rules: rules(&self.config, self.side),
        })
    }

    /// Head records `[n, K, 11]` and packed parents `[n, 11]` of one chunk.
    fn records(
        &self,
        parts: &Parts,
        scene: &Scene,
        (first, len): (usize, usize),
        mode: Mode,
    ) -> Result<(Tensor, Tensor)> {
        self.records_of(parts, scene, scene.chunk(first, len)?, mode)
    }

    fn records_of(
        &self,
        parts: &Parts,
        scene: &Scene,
        parents: ParentChunk,
        mode: Mode,
    ) -> Result<(Tensor, Tensor)> {
        let (z_g, z_a) = parts.embeddings.forward(&parents, &scene.frames)?;
        let (geo, app) = match (&parts.aggregation, &scene.prepared) {
            (Some(agg), Some(prepared)) => {
                let z = (&z_g, &z_a);
                let (f_g, f_a) = agg.forward(prepared, &parents, &scene.frames, z, mode)?;
                match self.config.agg.resolved().head_input {
                    HeadInput::FPlusZ => (sum(&f_g, &z_g)?, sum(&f_a, &z_a)?),
                    HeadInput::F => (f_g, f_a),
                }
            }
            // Without aggregation f = 0 and the heads read z, whatever they read else
            // (spec 1.6).
            _ => (z_g, z_a),
        };
        let head = parts.heads.forward(&geo, &app, self.side)?;
        Ok((head, parents.rows()?))
    }

    /// The primaries themselves, K = 1 (SPGR off).
    fn pass_through(&self, views: &Views, primaries: &Primaries) -> Result<Children> {
        check_single(views, primaries)?;
        let opacities = primaries.opacities.unsqueeze(2)?;
        let rows = [&primaries.means, &primaries.quats_wxyz, &primaries.scales, &opacities];
        let rows = Tensor::cat(&rows, 2)?.squeeze(0)?;
        Ok(Children {
            gain: Tensor::ones(rows.dim(0)?, rows.dtype(), rows.device())?,
            rows,
            sh: interleaved(&primaries.sh)?,
            sh_basis: primaries.sh_basis,
            k: 1,
        })
    }
}

impl Scene<'_> {
    fn chunk(&self, first: usize, len: usize) -> Result<ParentChunk> {
        Ok(ParentChunk {
            first,
            source: first / self.per_view,
            means: self.means.narrow(0, first, len)?,
            quats_wxyz: self.quats_wxyz.narrow(0, first, len)?,
            scales: self.scales.narrow(0, first, len)?,
            opacities: self.opacities.narrow(0, first, len)?,
            sh: self.sh_input.narrow(0, first, len)?,
        })
    }

    fn call(&self, first: usize) -> Spgr {
        Spgr {
            rules: self.rules,
            cameras: self.views.cameras[0].clone(),
            near: self.views.near_far[0].iter().map(|&(near, _)| near).collect(),
            per_view: self.per_view,
            first,
        }
    }
}

/// Runs (first, length) of at most `size` parents that never straddle two views.
fn chunks(n: usize, per_view: usize, size: usize) -> impl Iterator<Item = (usize, usize)> {
    let views = n / per_view.max(1);
    (0..views).flat_map(move |v| {
        (0..per_view.div_ceil(size)).map(move |i| {
            let first = v * per_view + i * size;
            (first, size.min((v + 1) * per_view - first))
        })
    })
}

fn check_single(views: &Views, primaries: &Primaries) -> Result<()> {
    let (b, n, _) = primaries.means.dims3()?;
    if views.scenes() != 1 || b != 1 {
        bail!("trunk: expected one scene, got {} of views and {b} of primaries", views.scenes());
    }
    if primaries.per_view == 0 || n != primaries.per_view * views.views() {
        bail!(
            "primaries: expected {} views of {} parents, got {n} parents",
            views.views(),
            primaries.per_view
        );
    }
    let fits = primaries.quats_wxyz.dims() == [1, n, 4]
        && primaries.scales.dims() == [1, n, 3]
        && primaries.opacities.dims() == [1, n];
    if !fits {
        bail!(
            "primaries: expected quaternions [1, {n}, 4], scales [1, {n}, 3], opacities [1, {n}], got {:?}, {:?}, {:?}",
            primaries.quats_wxyz.dims(),
            primaries.scales.dims(),
            primaries.opacities.dims()
        );
    }
    Ok(())
}

/// `[1, N, 3, D]` to `[N, D, 3]`.
fn interleaved(sh: &Tensor) -> Result<Tensor> {
    sh.squeeze(0)?.transpose(1, 2)?.contiguous()
}

fn primaries_of(p: &Primaries, b: usize) -> Result<Primaries> {
    let one = |t: &Tensor| t.narrow(0, b, 1);
    Ok(Primaries {
        means: one(&p.means)?,
        quats_wxyz: one(&p.quats_wxyz)?,
        scales: one(&p.scales)?,
        opacities: one(&p.opacities)?,
        sh: one(&p.sh)?,
        sh_camera: one(&p.sh_camera)?,
        ..p.clone()
    })
}

/// The initial value of a tensor of this room where `candle_nn::Init` cannot express
/// it (spec 1.6): W_k the identity (as far as it is not square), the `cat` layer
/// f + o, learned map offsets a ring. `None`: as hinted to the builder.
///
/// `name` is the full tensor name, such as `subsplat.agg.g0.wk.0.weight`.
pub fn initial_value(name: &str, shape: &[usize]) -> Option<Vec<f32>> {
    let parts: Vec<&str> = name.rsplit('.').collect();
    let in_stage = |depth: usize| parts.get(depth + 1) == Some(&"agg");
    match (parts.as_slice(), shape) {
        (["weight", _, "wk", ..], &[rows, columns]) if in_stage(3) => {
            Some(eye(rows, columns, columns))
        }
        (["weight", "cat", ..], &[rows, columns]) if in_stage(2) => Some(eye(rows, columns, rows)),
        (["bias", "offsets", ..], &[len]) if in_stage(2) => Some(ring(len)),
        _ => None,
    }
}

/// Row-major 1 where the column is the row modulo `period`.
fn eye(rows: usize, columns: usize, period: usize) -> Vec<f32> {
    let one = |i: usize| (i % columns.max(1)) % period.max(1) == i / columns.max(1);
    (0..rows * columns).map(|i| if one(i) { 1.0 } else { 0.0 }).collect()
}

/// Sets every variable of `variables` that [`initial_value`] knows: call once after
/// building a fresh model from a `VarMap`.
///
/// # Errors
/// Whatever candle says of the assignment.
pub fn set_initial_values(variables: &VarMap) -> Result<()> {
    let Ok(data) = variables.data().lock() else { bail!("variables: lock poisoned") };
    for (name, var) in data.iter() {
        if let Some(value) = initial_value(name, var.dims()) {
            let value = Tensor::from_vec(value, var.dims(), var.device())?;
            var.set(&value.to_dtype(var.dtype())?)?;
        }
    }
    Ok(())
}
