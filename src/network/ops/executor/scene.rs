//! From head rows to a picture on a GPU: primaries, children and the rasterizer, without a gradient.
//!
//! CPU versions: [`crate::network::ops::adapter`], [`crate::network::ops::spgr`], [`crate::network::ops::rasterize`]. Tests:
//! tests/gpu/primaries.rs, tests/gpu/model.rs.

use super::{Executor, TapeArray};
use crate::network::ops::adapter::{Adapter, Turn, View};
use crate::network::ops::check_raster_options;
use crate::network::ops::device::{ColourLayout, DeviceSplats};
use crate::network::ops::spgr::Spgr;
use candle_core::{Device, Result, Tensor};
use std::sync::Arc;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::gpu;
use subsplat_kernels::gpu::{AdapterCall, AdapterView, SceneArrays};
use subsplat_kernels::layout::RasterOptions;

fn call(adapter: &Adapter) -> AdapterCall {
    AdapterCall {
        views: adapter.views.len(),
        size: adapter.size,
        per_pixel: adapter.per_pixel,
        functions: adapter.functions,
        exponent: adapter.exponent.exp2() as f32,
    }
}

fn constants(view: &View) -> AdapterView {
    let ([fx, fy], [cx, cy]) = (view.focal, view.centre);
    let row = |i: usize| {
        let [x, y, z] = view.rotation[i];
        [x, y, z, view.origin[i]].map(|v| v as f32)
    };
    AdapterView {
        focal_centre: [fx, fy, cx, cy].map(|v| v as f32),
        scale: view.scale.map(|v| v as f32),
        world: [row(0), row(1), row(2)],
        quat: view.quat.map(|row| row.map(|v| v as f32)),
    }
}

impl TapeArray {
    /// Computes packed rows `[N, 11]` of raw head rows `[…, 9 + 3·D]`, `depths` and `densities`
    /// `[…, G]` ([`crate::network::ops::adapter::place`]).
    ///
    /// # Errors
    /// Sizes that do not fit `adapter`; errors of the device.
    pub fn placed(&self, depths: &Self, densities: &Self, adapter: &Adapter) -> Result<Self> {
        let views: Vec<AdapterView> = adapter.views.iter().map(constants).collect();
        self.of(self.array.placed(&depths.array, &densities.array, &views, call(adapter)))
    }

    /// Computes the SH of the same head rows.
    ///
    /// # Errors
    /// Those of [`TapeArray::placed`].
    pub fn placed_colours(&self, adapter: &Adapter, layout: ColourLayout) -> Result<Self> {
        let dense = |turn: &Turn| turn.dense().into_iter().map(|v| v as f32);
        let matrices: Vec<f32> = match layout {
            ColourLayout::Camera => {
                adapter.views.iter().flat_map(|_| dense(&adapter.camera)).collect()
            }
            _ => adapter.views.iter().flat_map(|view| dense(&view.turn)).collect(),
        };
        let interleaved = layout == ColourLayout::World;
        self.of(self.array.placed_colours(&matrices, interleaved, call(adapter)))
    }

    /// Computes the children `[N·K, 11]` and gains of head records `[N, K, 11]` and `parents`
    /// `[N, 11]`. Numbers that are not finite stay.
    ///
    /// # Errors
    /// Sizes that do not fit; errors of the device.
    pub fn children(&self, parents: &Self, call: &Spgr) -> Result<[Self; 2]> {
        let made = self.array.spgr(&parents.array, &call.on_gpu(&[], &[]));
        let [rows, gains] = self.executor.checked(made)?;
        Ok([self.of(Ok(rows))?, self.of(Ok(gains))?])
    }
}

impl Executor {
    /// Copies arrays to host memory, with one wait for all.
    ///
    /// # Errors
    /// Errors of the device.
    pub fn read(&self, arrays: &[&TapeArray]) -> Result<Vec<Tensor>> {
        let own: Vec<_> = arrays.iter().map(|a| &a.array).collect();
        let values = self.checked(self.recorder.read(&own))?.into_iter().zip(&own);
        values.map(|(v, array)| Tensor::from_vec(v, array.dims(), &Device::Cpu)).collect()
    }

    /// Waits until the device has executed all operations so far.
    ///
    /// # Errors
    /// Errors of the device.
    pub fn finish(&self) -> Result<()> {
        self.checked(self.recorder.finish())
    }

    /// Renders the Gaussians of `parts`, K of which share a parent: `[5, H, W]` planes R, G, B, alpha,
    /// Σ w·z. The picture is all that the host reads, with the number of (splat, tile) pairs.
    ///
    /// # Errors
    /// An option outside its range; sizes that do not fit; errors of the device.
    pub fn rasterize(
        self: &Arc<Self>,
        parts: &[DeviceSplats],
        children: usize,
        camera: &Camera,
        options: &RasterOptions,
    ) -> Result<Tensor> {
        check_raster_options(options)?;
        let arrays = parts.iter().map(|part| SceneArrays {
            rows: &part.rows.array,
            sh: &part.sh.array,
            gain: part.gain.as_ref().map(|gain| &gain.array),
        });
        let parts: Vec<_> = arrays.collect();
        let picture = self.recorder.flush().and_then(|()| {
            let scene = gpu::Scene::from_arrays(&parts, children)?;
            let mut rasterizer = gpu::Rasterizer::new(self.recorder.gpu().clone());
            rasterizer.render_scene_planes(&scene, camera, options)
        });
        let k = camera.intrinsics();
        Tensor::from_vec(self.checked(picture)?, (5, k.height, k.width), &Device::Cpu)
    }
}
