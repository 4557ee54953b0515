//! The trunk over primaries that a GPU placed and keeps: from the backbone's arrays to Gaussians in
//! device memory, without a gradient.

use super::{
    CHUNK_GPU, Children, Chunking, Mode, ParentArrays, Parts, Records, Scene, Span, Trunk,
    check_views, chunks,
};
use crate::network::config::{FeatureLevel, Primaries as Settings, ShInput};
use crate::network::model::primaries::{adapter_of, basis_of};
use crate::network::model::trace::Checkpoint;
use crate::network::model::{BackboneOutput, Views, feature_of};
use crate::network::ops::{Array, ColourLayout, DeviceSplats, Executor, TapeArray};
use crate::scene::splats::Splats;
use candle_core::{DType, Device, Result, Tensor, bail};
use std::sync::Arc;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{
    MEAN_OFFSET, OPACITY_OFFSET, QUAT_OFFSET, RasterOptions, SCALE_OFFSET, ShBasis,
};

/// Primaries of one scene in device memory.
#[derive(Clone, Debug)]
pub struct DeviceParents {
    /// `[N, 11]`, columns as in [`subsplat_kernels::layout`].
    rows: TapeArray,
    /// `[N, D, 3]`, world frame.
    sh: TapeArray,
    /// `[N, 3·D]`, colour-major, in the frame of [`crate::network::config::Embed::sh`].
    sh_input: TapeArray,
    sh_basis: ShBasis,
    /// `[1, V, H·W, G]`: distance along the unit ray, world units.
    pub(in crate::network::model) depths: TapeArray,
    /// The backbone's feature maps.
    features: Vec<(FeatureLevel, TapeArray)>,
    /// Primaries of a view.
    pub(in crate::network::model) per_view: usize,
}

/// Gaussians of one scene in device memory.
#[derive(Clone, Debug)]
pub struct DeviceChildren {
    /// In the order of the parents.
    parts: Vec<DeviceSplats>,
    /// `[N, D, 3]`: SH of all parents.
    sh: TapeArray,
    sh_basis: ShBasis,
    /// K.
    k: usize,
}

impl DeviceParents {
    /// Places the primaries of `output`, whose scene `views` holds. `sh_input` is the frame in which
    /// the embeddings read SH.
    ///
    /// # Errors
    /// Shapes that do not fit; errors of the device.
    pub(in crate::network::model) fn new(
        output: BackboneOutput<TapeArray>,
        views: &Views,
        settings: &Settings,
        sh_input: ShInput,
    ) -> Result<Self> {
        let adapter = adapter_of(&output, views, settings)?;
        let rows = output.raw.placed(&output.depths, &output.densities, &adapter)?;
        let layout = match sh_input {
            ShInput::World => ColourLayout::WorldByColour,
            ShInput::Camera => ColourLayout::Camera,
        };
        let [n, _] = rows.sizes()?;
        let input = output.raw.placed_colours(&adapter, layout)?;
        Ok(Self {
            sh: output.raw.placed_colours(&adapter, ColourLayout::World)?,
            sh_input: input.reshape((n, 3 * adapter.functions))?,
            sh_basis: basis_of(settings),
            per_view: n / views.views().max(1),
            depths: output.depths,
            features: output.features,
            rows,
        })
    }

    /// The primaries with other rows `[N, 11]`.
    ///
    /// # Errors
    /// Errors of the device.
    pub(in crate::network::model) fn with_rows(
        &self,
        executor: &Arc<Executor>,
        rows: &Tensor,
    ) -> Result<Self> {
        Ok(Self { rows: executor.upload(rows)?, ..self.clone() })
    }

    /// Returns copies in host memory: the primaries as their own children.
    ///
    /// # Errors
    /// A number that is not finite; errors of the device.
    pub(in crate::network::model) fn to_host(&self, executor: &Executor) -> Result<Splats> {
        let (children, _) = self.whole().to_host(executor, &[])?;
        children.to_splats()
    }

    /// Returns the primaries as their own children.
    fn whole(&self) -> DeviceChildren {
        let part = DeviceSplats { rows: self.rows.clone(), sh: self.sh.clone(), gain: None };
        DeviceChildren { parts: vec![part], sh: self.sh.clone(), sh_basis: self.sh_basis, k: 1 }
    }
}

impl DeviceChildren {
    /// Copies the Gaussians and `more` arrays to host memory, with one wait for all.
    ///
    /// # Errors
    /// Errors of the device.
    pub(in crate::network::model) fn to_host(
        &self,
        executor: &Executor,
        more: &[&TapeArray],
    ) -> Result<(Children, Vec<Tensor>)> {
        let rows = self.parts.iter().map(|part| &part.rows);
        let gains = self.parts.iter().filter_map(|part| part.gain.as_ref());
        let arrays: Vec<_> =
            rows.chain(gains).chain([&self.sh]).chain(more.iter().copied()).collect();
        let mut read = executor.read(&arrays)?;
        let more = read.split_off(read.len() - more.len());
        let Some(sh) = read.pop() else { bail!("children: expected SH, got none") };
        let gains = read.split_off(self.parts.len());
        let rows = Tensor::cat(&read, 0)?;
        let gain = if gains.is_empty() {
            Tensor::ones(rows.dim(0)?, DType::F32, &Device::Cpu)?
        } else {
            Tensor::cat(&gains, 0)?
        };
        // One channel has no axis of its own.
        let gain = if gain.dims().last() == Some(&1) { gain.squeeze(1)? } else { gain };
        Ok((Children { rows, gain, sh, sh_basis: self.sh_basis, k: self.k }, more))
    }

    /// Renders the Gaussians from `camera`: `[5, H, W]` ([`Trunk::render`]).
    ///
    /// # Errors
    /// Those of [`Executor::rasterize`].
    pub(in crate::network::model) fn render(
        &self,
        executor: &Arc<Executor>,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Result<Tensor> {
        let options = RasterOptions { sh_basis: self.sh_basis, ..*options };
        executor.rasterize(&self.parts, self.k, camera, &options)
    }
}

impl Trunk {
    /// Computes the children of primaries in device memory. With `waits`, the device has executed a
    /// chunk before the checkpoint that follows it.
    ///
    /// # Errors
    /// Those of [`Trunk::forward_with`], except that numbers are not checked.
    pub(in crate::network::model) fn device_children(
        &self,
        views: &Views,
        parents: &DeviceParents,
        (checkpoint, waits): (Checkpoint<'_>, bool),
    ) -> Result<DeviceChildren> {
        let Some(parts) = self.parts() else { return Ok(parents.whole()) };
        let scene = self.device_scene(parts, views, parents)?;
        checkpoint()?;
        let step = || {
            if let Some(executor) = self.executor.as_ref().filter(|_| waits) {
                executor.finish()?;
            }
            checkpoint()
        };
        let [n, _] = scene.means.sizes()?;
        let sh = &parents.sh;
        let of_chunk = |span: Span| {
            let Records { head, parents } = self.records(parts, &scene, span, Mode::Infer)?;
            let [rows, gain] = head.children(&parents, &scene.call(span))?;
            step()?;
            Ok(DeviceSplats { rows, gain: Some(gain), sh: sh.narrow(0, span.first, span.len)? })
        };
        let spans = chunks(n, scene.per_view, CHUNK_GPU);
        let k = scene.rules.children();
        let sh_basis = parents.sh_basis;
        let parts = spans.map(of_chunk).collect::<Result<_>>()?;
        Ok(DeviceChildren { parts, sh: sh.clone(), sh_basis, k })
    }

    /// Reports the first child that is not finite, with its parent and head record.
    ///
    /// # Errors
    /// That child; errors of the device.
    pub(in crate::network::model) fn check_device_children(
        &self,
        views: &Views,
        parents: &DeviceParents,
    ) -> Result<()> {
        let Some(parts) = self.parts() else { return Ok(()) };
        let scene = self.device_scene(parts, views, parents)?;
        let how = Chunking { size: CHUNK_GPU, mode: Mode::Infer, checkpoint: &|| Ok(()) };
        let sh = Tensor::zeros((0, 0, 3), DType::F32, &Device::Cpu)?;
        self.children(parts, &scene, (sh, parents.sh_basis), &how).map(drop)
    }

    /// The scene of primaries in device memory.
    pub(super) fn device_scene<'a>(
        &self,
        parts: &Parts,
        views: &'a Views,
        parents: &DeviceParents,
    ) -> Result<Scene<'a, TapeArray>> {
        let [n, _] = parents.rows.sizes()?;
        check_views(views, n, parents.per_view)?;
        let columns = |first: usize, count: usize| parents.rows.narrow(1, first, count);
        let own = ParentArrays {
            means: columns(MEAN_OFFSET, 3)?,
            quats_wxyz: columns(QUAT_OFFSET, 4)?,
            scales: columns(SCALE_OFFSET, 3)?,
            opacities: columns(OPACITY_OFFSET, 1)?,
            sh_input: parents.sh_input.clone(),
            per_view: parents.per_view,
        };
        let feature = |level| feature_of(&parents.features, level).cloned();
        self.scene_from(parts, views, own, (DType::F32, &Device::Cpu), feature)
    }
}
