//! The trunk's gradient by recomputation. A graph over all parents would hold dozens of
//! `[N, E]` tensors. The forward pass therefore computes the children without a graph; the
//! backward pass recomputes each chunk of parents with a graph of its own. The tensors of a
//! chunk fit into a core's cache.
//!
//! A GPU computes both passes ([`Trunk::trains_on_device`]). The gradients of parameters and inputs
//! then return as scalars of candle's graph.
//!
//! The maps' gradient is kept as factors ([`Deferred`]) and added where parents sampled the maps;
//! a dense gradient of a chunk would be mostly zeros.

use super::{Children, Parts, Records, Scene, Span, TrainPass, Trunk, chunks, interleaved};
use crate::network::model::aggregation::Prepared;
use crate::network::model::geometry::ParentChunk;
use crate::network::model::mlp::Mode;
use crate::network::model::{BackboneOutput, Primaries, Views};
use crate::network::ops::attention_gather::Deferred;
use crate::network::ops::precomputed_gradient::precomputed_gradient;
use crate::network::ops::spgr::spgr_on;
use crate::network::ops::{Array, TapeArray};
use candle_core::backprop::GradStore;
use candle_core::{Result, Tensor, Var, bail};
use rayon::prelude::*;
use subsplat_kernels::layout::SPLAT_STRIDE;

/// Parents per chunk on a GPU. The tape of a chunk holds about 30 activations `[8192, 128]`, 4 MiB
/// each.
const CHUNK_GPU: usize = 1 << 13;

/// State of [`Trunk::forward_recomputed`] for the backward pass.
pub struct Recomputed<'a> {
    trunk: &'a Trunk,
    parts: &'a Parts,
    /// Parents and maps, in the backbone's graph.
    scene: Scene<'a>,
    chunk: usize,
    seed: u64,
    children: Children,
    /// The same parents on the GPU that computed the children.
    device: Option<Scene<'a, TapeArray>>,
}

/// Gradients of one chunk.
struct ChunkGradients {
    store: GradStore,
    /// Gradients of its parents' attributes, in the order of [`inputs`]; empty if none of
    /// them is in a graph.
    inputs: Vec<Vec<f32>>,
    deferred: Vec<Deferred>,
}

/// The tensors of the scene's parents that the trunk reads.
fn inputs<'s>(scene: &'s Scene) -> [&'s Tensor; 5] {
    [&scene.means, &scene.quats_wxyz, &scene.scales, &scene.opacities, &scene.sh_input]
}

impl Trunk {
    /// Returns whether the trunk's GPU computes its training pass. The CPU computes that of an
    /// aggregation that neither preset uses.
    pub fn trains_on_device(&self) -> bool {
        if self.executor.is_some() {
            let aggregation = self.parts().and_then(|parts| parts.aggregation.as_ref());
            return aggregation
                .is_none_or(crate::network::model::aggregation::Aggregation::trains_on_device);
        }
        false
    }

    /// Computes the children of the one scene in `views`, f32. Their rows and gains are
    /// outside any graph: [`Recomputed::backward`] propagates their gradient. The
    /// coefficients `sh` are those of `primaries`, in their graph.
    ///
    /// # Errors
    /// Those of [`Trunk::forward`]; [`Trunk::is_off`].
    pub fn forward_recomputed<'a>(
        &'a self,
        views: &'a Views,
        backbone: &BackboneOutput,
        primaries: &Primaries,
        TrainPass { chunk, seed }: TrainPass,
    ) -> Result<Recomputed<'a>> {
        let Some(parts) = self.parts() else {
            bail!("trunk: recomputation expected heads, got children that are their parents")
        };
        let scene = self.scene(parts, views, backbone, primaries)?;
        let sh = interleaved(&primaries.sh)?;
        let mode = Mode::Train { seed };
        if self.trains_on_device()
            && let Some(result) = self.on_device(|executor| {
                // Feature maps are leaves of the tape; the parents' gradients are requested by chunk.
                let device = self
                    .scene_on(parts, views, backbone, primaries, |t: &Tensor| executor.upload(t))?;
                let device = device.without_parents_tape();
                let how = super::Chunking { size: CHUNK_GPU, mode, checkpoint: &|| Ok(()) };
                let sh = (sh.clone(), primaries.sh_basis);
                let children = self.children(parts, &device, sh, &how)?;
                Ok((children, device))
            })
        {
            let (children, device) = result?;
            let trunk = self;
            let device = Some(device);
            return Ok(Recomputed { trunk, parts, scene, chunk, seed, children, device });
        }
        let outside = scene.leaves();
        let how = super::Chunking { size: super::CHUNK, mode, checkpoint: &|| Ok(()) };
        let children = self.children(parts, &outside, (sh, primaries.sh_basis), &how)?;
        Ok(Recomputed {
            trunk: self,
            parts,
            scene,
            chunk: chunk.max(1),
            seed,
            children,
            device: None,
        })
    }
}

impl<'a> Scene<'a> {
    /// Returns the same tensors outside any graph, with the maps' gradients deferred.
    pub(super) fn leaves(&self) -> Scene<'a> {
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
            heads: self.heads.clone(),
            rules: self.rules,
        }
    }
}

impl Scene<'_, TapeArray> {
    /// Returns the same arrays, of which only the maps belong to a tape.
    fn without_parents_tape(self) -> Self {
        Self {
            means: self.means.detach(),
            quats_wxyz: self.quats_wxyz.detach(),
            scales: self.scales.detach(),
            opacities: self.opacities.detach(),
            sh_input: self.sh_input.detach(),
            ..self
        }
    }
}

impl Recomputed<'_> {
    /// Returns the children.
    pub fn children(&self) -> &Children {
        &self.children
    }

    /// Propagates the gradients of the children back through the trunk: `rows` of
    /// `[N·K, 11]` and `gain` of `[N·K]` or `[N·K, 4]`.
    ///
    /// `each` receives the parameters' gradients of every chunk, in order. The returned
    /// scalars carry the gradients of the backbone and of the maps' projections, on a GPU also
    /// those of the parameters: the caller applies candle's `backward` to their sum. The order of summation does not depend on
    /// the number of threads.
    ///
    /// # Errors
    /// Gradients have another length; those of `each`.
    pub fn backward<E: From<candle_core::Error>>(
        self,
        [rows, gain]: [&[f32]; 2],
        mut each: impl FnMut(&GradStore) -> std::result::Result<(), E>,
    ) -> std::result::Result<Vec<Tensor>, E> {
        let n = self.scene.means.dim(0)?;
        let expected = (
            n * self.children.k * SPLAT_STRIDE,
            n * self.children.k * self.scene.rules.gain_channels(),
        );
        if (rows.len(), gain.len()) != expected {
            let got = (rows.len(), gain.len());
            let text = format!("trunk: expected gradients of {expected:?} floats, got {got:?}");
            return Err(candle_core::Error::Msg(text).into());
        }
        let wanted = inputs(&self.scene).iter().any(|t| t.track_op());
        if let Some(scene) = &self.device {
            return Ok(self.backward_on(scene, [rows, gain], wanted)?);
        }
        let zeros = |t: &Tensor| vec![0f32; t.elem_count()];
        let mut inputs_sum: Vec<Vec<f32>> =
            if wanted { inputs(&self.scene).into_iter().map(zeros).collect() } else { Vec::new() };
        let maps: Vec<Tensor> =
            self.scene.prepared.iter().flat_map(|p| p.maps()).cloned().collect();
        let mut maps_sum: Vec<Vec<f32>> = maps.iter().map(zeros).collect();
        let spans: Vec<_> = chunks(n, self.scene.per_view, self.chunk).collect();
        // One chunk a thread at a time: gradients of all chunks need as much memory as the
        // graph.
        for batch in spans.chunks(rayon::current_num_threads().max(1)) {
            let gradients: Vec<Result<ChunkGradients>> = batch
                .par_iter()
                .map(|&span| self.chunk_gradients(span, [rows, gain], wanted))
                .collect();
            for (span, gradients) in batch.iter().zip(gradients) {
                let gradients = gradients?;
                each(&gradients.store)?;
                for (sum, own) in inputs_sum.iter_mut().zip(&gradients.inputs) {
                    let width = sum.len() / n;
                    sum[span.first * width..][..own.len()].copy_from_slice(own);
                }
                maps_sum
                    .par_iter_mut()
                    .zip(&gradients.deferred)
                    .try_for_each(|(sum, deferred)| deferred.add_to(sum))?;
            }
        }
        let mut rest = Vec::new();
        let whole = inputs(&self.scene).into_iter().zip(inputs_sum);
        for (tensor, gradient) in whole.chain(maps.iter().zip(maps_sum)) {
            if tensor.track_op() {
                rest.push(precomputed_gradient(tensor, 0.0, gradient)?);
            }
        }
        Ok(rest)
    }

    /// Computes [`Recomputed::backward`] on the GPU of `scene`. The scalars carry the parameters'
    /// gradients too.
    fn backward_on(
        &self,
        scene: &Scene<'_, TapeArray>,
        [rows, gain]: [&[f32]; 2],
        wanted: bool,
    ) -> Result<Vec<Tensor>> {
        let [n, _] = scene.means.sizes()?;
        let tensors = inputs(&self.scene);
        let mut sums: Vec<Vec<f32>> =
            tensors.iter().map(|t| vec![0.0; if wanted { t.elem_count() } else { 0 }]).collect();
        let mut scalars = Vec::new();
        // The maps' own tape is passed once, after all chunks.
        let prepared = scene.prepared.as_ref().map(Prepared::leaves);
        let mut of_maps: Vec<Option<TapeArray>> =
            prepared.iter().flat_map(|p| p.maps()).map(|_| None).collect();
        let whole = scene;
        let scene = &Scene { prepared, ..whole.clone() };
        for span in chunks(n, scene.per_view, CHUNK_GPU) {
            let own = scene.chunk(span)?;
            let leaf = |array: &TapeArray| if wanted { array.leaf() } else { array.clone() };
            let own = ParentChunk {
                means: leaf(&own.means),
                quats_wxyz: leaf(&own.quats_wxyz),
                scales: leaf(&own.scales),
                opacities: leaf(&own.opacities),
                sh: leaf(&own.sh),
                ..own
            };
            let leaves = [&own.means, &own.quats_wxyz, &own.scales, &own.opacities, &own.sh]
                .map(TapeArray::clone);
            let mode = Mode::Train { seed: self.seed };
            let Records { head, parents } = self.trunk.records_of(self.parts, scene, own, mode)?;
            let part = |all: &[f32]| {
                let width = all.len() / n;
                all[span.first * width..(span.first + span.len) * width].to_vec()
            };
            let children = [part(rows), part(gain)];
            let gradients = head.children_backward(&parents, &scene.call(span), children)?;
            scalars.extend(gradients.scalars()?);
            for (sum, map) in of_maps.iter_mut().zip(scene.prepared.iter().flat_map(|p| p.maps())) {
                *sum = match (sum.take(), gradients.of(map)) {
                    (Some(sum), Some(own)) => Some(sum.add(&own)?),
                    (sum, own) => sum.or(own),
                };
            }
            for (sum, leaf) in sums.iter_mut().zip(&leaves).filter(|_| wanted) {
                let width = sum.len() / n;
                if let Some(gradient) = gradients.of(leaf) {
                    let own = gradient.to_host()?.flatten_all()?.to_vec1::<f32>()?;
                    sum[span.first * width..][..own.len()].copy_from_slice(&own);
                }
            }
        }
        let maps = whole.prepared.iter().flat_map(|p| p.maps()).zip(&of_maps);
        let maps: Vec<_> = maps.filter_map(|(map, sum)| Some((map, sum.as_ref()?))).collect();
        if let Some((map, _)) = maps.first() {
            scalars.extend(map.executor().backward(&maps)?.scalars()?);
        }
        for (tensor, gradient) in tensors.into_iter().zip(sums) {
            if tensor.track_op() {
                scalars.push(precomputed_gradient(tensor, 0.0, gradient)?);
            }
        }
        Ok(scalars)
    }

    /// Forward and backward pass of one chunk.
    fn chunk_gradients(
        &self,
        span: Span,
        [rows, gain]: [&[f32]; 2],
        wanted: bool,
    ) -> Result<ChunkGradients> {
        let Span { first, len } = span;
        let scene = self.scene.leaves();
        let own = scene.chunk(span)?;
        let leaf = |t: &Tensor| -> Result<Tensor> {
            if wanted {
                Ok(Var::from_tensor(&t.contiguous()?)?.into_inner())
            } else {
                Ok(t.clone())
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
        let Records { head, parents } = self.trunk.records_of(self.parts, &scene, own, mode)?;
        let (r, g) = spgr_on(&self.trunk.backend, &head, &parents, &scene.call(span))?;
        let part = |all: &[f32], t: &Tensor| {
            let width = t.elem_count() / len;
            all[first * width..(first + len) * width].to_vec()
        };
        let total = (precomputed_gradient(&r, 0.0, part(rows, &r))?
            + precomputed_gradient(&g, 0.0, part(gain, &g))?)?;
        let store = total.backward()?;
        let gradient = |t: &Tensor| match store.get(t) {
            Some(g) => g.flatten_all()?.to_vec1::<f32>(),
            None => Ok(vec![0.0; t.elem_count()]),
        };
        let inputs =
            if wanted { leaves.iter().map(gradient).collect::<Result<_>>()? } else { Vec::new() };
        let deferred = scene.prepared.iter().flat_map(|p| p.deferred()).cloned().collect();
        Ok(ChunkGradients { store, inputs, deferred })
    }
}
