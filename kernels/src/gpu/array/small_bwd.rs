//! Gradients of the small backbone's own parts.
//!
//! CPU version: [`crate::cpu::small`]. WGSL: wgsl/network/expectation_bwd.wgsl, wgsl/network/convex_bwd.wgsl,
//! wgsl/network/convex_maps_bwd.wgsl. Tests: tests/gpu/array_gradients.rs.

use super::{Array, misfit};
use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::{ConvexUniform, ExpectationUniform};

pub(crate) static EXPECTATION_BWD: Kernel = Kernel {
    name: "expectation_bwd",
    entry: "main",
    source: wgsl!(ExpectationUniform; "shared/grid", "shared/expectation", "network/expectation_bwd"),
};

pub(crate) static CONVEX_BWD: Kernel = Kernel {
    name: "convex_bwd",
    entry: "main",
    source: wgsl!(ConvexUniform; "shared/grid", "network/convex_bwd"),
};

pub(crate) static CONVEX_MAPS_BWD: Kernel = Kernel {
    name: "convex_maps_bwd",
    entry: "main",
    source: wgsl!(ConvexUniform; "shared/grid", "network/convex_maps_bwd"),
};

const THREADS: usize = 64;

impl Array {
    /// Computes the gradient of the logits of [`Array::expectation`], this array, from the
    /// gradient `dy` `[2, B, 1, h, w]` of mean and mass.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for other sizes; errors of the device.
    pub fn expectation_backward(
        &self,
        window: usize,
        window_alone: bool,
        dy: &Self,
    ) -> Result<Self, GpuError> {
        let (b, d, h, w) = match self.dims.as_slice() {
            &[b, d, h, w] if dy.count() == 2 * b * h * w => (b, d, h, w),
            _ => {
                let expected = "gradients of two maps".to_owned();
                return Err(misfit(EXPECTATION_BWD.name, expected, &dy.dims));
            }
        };
        let dx = self.recorder.empty(&self.dims)?;
        let uniform = ExpectationUniform {
            pictures: b as u32,
            candidates: d as u32,
            pixels: (h * w) as u32,
            window: window as u32,
            window_alone: u32::from(window_alone),
            ..ExpectationUniform::default()
        };
        let bindings = [self.binding(), dy.binding(), dx.binding()];
        let groups = Groups::of(b * h * w, THREADS);
        self.recorder.call(&EXPECTATION_BWD, &[], &uniform, &bindings, groups)?;
        Ok(dx)
    }

    /// Computes the gradients of the masks of [`Array::upsample_convex`], this array, and of
    /// both maps from the gradient `dy` `[2, B, 1, 4h, 4w]` of the results.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn upsample_convex_backward(
        &self,
        maps: [&Self; 2],
        start: &[f32],
        dy: &Self,
    ) -> Result<[Self; 3], GpuError> {
        let (b, h, w) = match self.dims.as_slice() {
            &[b, 144, h, w]
                if dy.count() == 32 * b * h * w && maps.iter().all(|m| m.dims == [b, 1, h, w]) =>
            {
                (b, h, w)
            }
            _ => {
                let expected = "masks [B, 144, h, w] and gradients of two maps".to_owned();
                return Err(misfit(CONVEX_BWD.name, expected, &self.dims));
            }
        };
        GpuError::check_lengths(CONVEX_BWD.name, [("start", start.len(), 144)])?;
        let masks = self.recorder.empty(&self.dims)?;
        let sums = self.recorder.empty(&[2, b, 9, h, w])?;
        let [pictures, height, width] = [b, h, w].map(|n| n as u32);
        let uniform = ConvexUniform { pictures, height, width, pad: 0 };
        let start = self.recorder.gpu.upload("start", start)?;
        let bindings = [
            self.binding(),
            maps[0].binding(),
            maps[1].binding(),
            Binding::from(&start),
            dy.binding(),
            masks.binding(),
            sums.binding(),
        ];
        let groups = Groups::of(b * h * w, THREADS);
        self.recorder.call(&CONVEX_BWD, &[], &uniform, &bindings, groups)?;
        let both = self.recorder.empty(&[2, b, 1, h, w])?;
        let bindings = [sums.binding(), both.binding()];
        let groups = Groups::of(both.count(), THREADS);
        self.recorder.call(&CONVEX_MAPS_BWD, &[], &uniform, &bindings, groups)?;
        let [first, second] = both.halves(&[b, 1, h, w])?;
        Ok([masks, first, second])
    }
}
