//! The trunk's gradient without its graph. A graph over all parents would hold dozens
//! of `[N, E]` tensors; here the children are made once, forgetting how, and when their
//! gradient is known each chunk of parents is walked again, with a graph that is gone
//! before the next one's. A chunk's tensors stay in a core's cache.

use super::{Children, Parts, Scene, Trunk, chunks, interleaved};
use crate::abi::SPLAT_STRIDE;
use crate::model::geometry::ParentChunk;
use crate::model::mlp::Mode;
use crate::model::{BackboneOutput, Primaries, Views};
use crate::ops::attention_gather::Deferred;
use crate::ops::given::given;
use crate::ops::spgr::spgr_on;
use candle_core::backprop::GradStore;
use candle_core::{Result, Tensor, Var, bail};
use rayon::prelude::*;

/// What [`Trunk::forward_recomputed`] keeps for the way back.
pub struct Recomputed<'a> {
    trunk: &'a Trunk,
    parts: &'a Parts,
    /// With the backbone's graph.
    scene: Scene<'a>,
    chunk: usize,
    seed: u64,
    children: Children,
}

/// What a chunk's walk found.
struct Walked {
    store: GradStore,
    /// Gradients of its parents' rows, in the order of [`inputs`]; empty where nobody asks.
    inputs: Vec<Vec<f32>>,
    deferred: Vec<Deferred>,
}

/// The tensors of a scene's parents that the trunk reads.
fn inputs<'s>(scene: &'s Scene) -> [&'s Tensor; 5] {
    [&scene.means, &scene.quats_wxyz, &scene.scales, &scene.opacities, &scene.sh_input]
}

impl Trunk {
    /// Children of the one scene in `views`, f32, whose rows and gains are outside any
    /// graph; [`Recomputed::backward`] takes their gradient back, `chunk` parents at a
    /// time. The coefficients `sh` are the primaries' own, in their graph. `seed` decides
    /// what attention drops.
    ///
    /// # Errors
    /// Those of [`Trunk::forward`]; SPGR off, which leaves nothing to walk.
    pub fn forward_recomputed<'a>(
        &'a self,
        views: &'a Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
        (chunk, seed): (usize, u64),
    ) -> Result<Recomputed<'a>> {
        let Some(parts) = &self.parts else { bail!("trunk: expected SPGR on, got it off") };
        let scene = self.scene(parts, views, backbone, primaries)?;
        let sh = (interleaved(&primaries.sh)?, primaries.sh_basis);
        let outside = scene.leaves();
        let mode = Mode::Train { seed };
        let children = self.children(parts, &outside, sh, (super::CHUNK, mode))?;
        Ok(Recomputed { trunk: self, parts, scene, chunk: chunk.max(1), seed, children })
    }
}

impl<'a> Scene<'a> {
    /// The same numbers outside any graph, the maps' gradients deferred.
    fn leaves(&self) -> Scene<'a> {
        Scene {
            views: self.views,
            frames: self.frames.clone(),
            means: self.means.detach(),
            quats_wxyz: self.quats_wxyz.detach(),
            scales: self.scales.detach(),
            opacities: self.opacities.detach(),
            sh_input: self.sh_input.detach(),
            per_view: self.per_view,
            prepared: self.prepared.as_ref().map(|p| p.deferring()),
            rules: self.rules,
        }
    }
}

impl Recomputed<'_> {
    /// The children.
    pub fn children(&self) -> &Children {
        &self.children
    }

    /// Takes `rows` (of `[N·K, 11]`) and `gain` (of `[N·K]` or `[N·K, 4]`), the gradients
    /// of the children, back through the trunk. `each` gets the parameters' gradients of
    /// every chunk, in order. The scalars that are returned carry the rest, to the
    /// backbone and to the maps' projections: their sum is to go through candle's
    /// `backward`. The sums do not depend on the number of threads.
    ///
    /// # Errors
    /// Gradients of another length; those of `each`.
    pub fn backward<E: From<candle_core::Error>>(
        self,
        [rows, gain]: [&[f32]; 2],
        mut each: impl FnMut(&GradStore) -> std::result::Result<(), E>,
    ) -> std::result::Result<Vec<Tensor>, E> {
        let n = self.scene.means.dim(0)?;
        let expected = (
            n * self.children.k * SPLAT_STRIDE,
            n * self.children.k * self.scene.rules.gain_lanes(),
        );
        if (rows.len(), gain.len()) != expected {
            let got = (rows.len(), gain.len());
            let text = format!("trunk: expected gradients of {expected:?} floats, got {got:?}");
            return Err(candle_core::Error::Msg(text).into());
        }
        let wanted = inputs(&self.scene).iter().any(|t| t.track_op());
        let zeros = |t: &Tensor| vec![0f32; t.elem_count()];
        let mut inputs_sum: Vec<Vec<f32>> = match wanted {
            true => inputs(&self.scene).into_iter().map(zeros).collect(),
            false => Vec::new(),
        };
        let maps: Vec<Tensor> =
            self.scene.prepared.iter().flat_map(|p| p.maps()).cloned().collect();
        let mut maps_sum: Vec<Vec<f32>> = maps.iter().map(zeros).collect();
        let spans: Vec<_> = chunks(n, self.scene.per_view, self.chunk).collect();
        // As many at a time as there are threads: results of all would be a graph again.
        for wave in spans.chunks(rayon::current_num_threads().max(1)) {
            let walked: Vec<Result<Walked>> =
                wave.par_iter().map(|&span| self.walk(span, [rows, gain], wanted)).collect();
            for (&(first, _), walked) in wave.iter().zip(walked) {
                let walked = walked?;
                each(&walked.store)?;
                for (sum, own) in inputs_sum.iter_mut().zip(&walked.inputs) {
                    let width = sum.len() / n;
                    sum[first * width..][..own.len()].copy_from_slice(own);
                }
                maps_sum
                    .par_iter_mut()
                    .zip(&walked.deferred)
                    .try_for_each(|(sum, deferred)| deferred.add_to(sum))?;
            }
        }
        let mut rest = Vec::new();
        let whole = inputs(&self.scene).into_iter().zip(inputs_sum);
        for (tensor, gradient) in whole.chain(maps.iter().zip(maps_sum)) {
            if tensor.track_op() {
                rest.push(given(tensor, 0.0, gradient)?);
            }
        }
        Ok(rest)
    }

    /// One chunk, there and back.
    fn walk(
        &self,
        (first, len): (usize, usize),
        [rows, gain]: [&[f32]; 2],
        wanted: bool,
    ) -> Result<Walked> {
        let scene = self.scene.leaves();
        let own = scene.chunk(first, len)?;
        let leaf = |t: &Tensor| -> Result<Tensor> {
            match wanted {
                true => Ok(Var::from_tensor(&t.contiguous()?)?.into_inner()),
                false => Ok(t.clone()),
            }
        };
        let own = ParentChunk {
            means: leaf(&own.means)?,
            quats_wxyz: leaf(&own.quats_wxyz)?,
            scales: leaf(&own.scales)?,
            opacities: leaf(&own.opacities)?,
            sh: leaf(&own.sh)?,
            ..own
        };
        let leaves =
            [&own.means, &own.quats_wxyz, &own.scales, &own.opacities, &own.sh].map(Tensor::clone);
        let mode = Mode::Train { seed: self.seed };
        let (head, parents) = self.trunk.records_of(self.parts, &scene, own, mode)?;
        let (r, g) = spgr_on(&self.trunk.backend, &head, &parents, &scene.call(first))?;
        let part = |all: &[f32], t: &Tensor| {
            let width = t.elem_count() / len;
            all[first * width..(first + len) * width].to_vec()
        };
        let total = (given(&r, 0.0, part(rows, &r))? + given(&g, 0.0, part(gain, &g))?)?;
        let store = total.backward()?;
        let gradient = |t: &Tensor| match store.get(t) {
            Some(g) => g.flatten_all()?.to_vec1::<f32>(),
            None => Ok(vec![0.0; t.elem_count()]),
        };
        let inputs = match wanted {
            true => leaves.iter().map(gradient).collect::<Result<_>>()?,
            false => Vec::new(),
        };
        let deferred = scene.prepared.iter().flat_map(|p| p.deferred()).cloned().collect();
        Ok(Walked { store, inputs, deferred })
    }
}
