//! Primaries in world frame from raw head rows (MVSplat's Gaussian adapter).
//!
//! CPU version: cpu/adapter. WGSL: wgsl/network/adapter.wgsl, adapter_colours.wgsl. Oracle and tests:
//! tests/gpu/primaries.rs.

use super::{Array, misfit};
use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::AdapterUniform;
use crate::layout::SPLAT_STRIDE;

pub(crate) static ADAPTER: Kernel = Kernel {
    name: "adapter",
    entry: "main",
    source: wgsl!(
        AdapterUniform; "shared/grid", "shared/activation", "network/adapter"
    ),
};

pub(crate) static ADAPTER_COLOURS: Kernel = Kernel {
    name: "adapter_colours",
    entry: "main",
    source: wgsl!(AdapterUniform; "shared/grid", "network/adapter_colours"),
};

const THREADS: usize = 64;
/// Numbers of a raw row before its SH.
const GEOMETRY: usize = 9;

/// Constants of one view.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AdapterView {
    /// f_x, f_y, c_x, c_y, px.
    pub focal_centre: [f32; 4],
    /// σ at distance 1: the minimum, and the amount that a sigmoid of 1 adds.
    pub scale: [f32; 2],
    /// Rows of R, world from camera, each with a coordinate of the eye.
    pub world: [[f32; 4]; 3],
    /// Row i: image of the i-th of x, y, z, w, as wxyz in world frame.
    pub quat: [[f32; 4]; 4],
}

/// Constants of [`Array::placed`] and [`Array::placed_colours`].
#[derive(Clone, Copy, Debug)]
pub struct AdapterCall {
    /// Views.
    pub views: usize,
    /// H, W, px.
    pub size: [usize; 2],
    /// G: Gaussians of a pixel.
    pub per_pixel: usize,
    /// D: SH functions.
    pub functions: usize,
    /// e of the opacity mapping.
    pub exponent: f32,
}

impl AdapterCall {
    fn pixels(&self) -> usize {
        self.views * self.size[0] * self.size[1]
    }

    fn uniform(&self) -> AdapterUniform {
        let [height, width] = self.size;
        AdapterUniform {
            gaussians: (self.pixels() * self.per_pixel) as u32,
            pixels: (height * width) as u32,
            width: width as u32,
            per_pixel: self.per_pixel as u32,
            lanes: (GEOMETRY + 3 * self.functions) as u32,
            functions: self.functions as u32,
            interleaved: 0,
            exponent: self.exponent,
        }
    }

    /// Refuses raw rows of another number of elements.
    fn check(&self, kernel: &'static str, raw: &Array) -> Result<(), GpuError> {
        let row = GEOMETRY + 3 * self.functions;
        if raw.count() == self.pixels() * row && self.pixels() > 0 && self.per_pixel > 0 {
            Ok(())
        } else {
            let expected = format!("raw rows [{}, {row}], of at least one", self.pixels());
            Err(misfit(kernel, expected, &raw.dims))
        }
    }
}

impl Array {
    /// Computes the packed rows `[N, 11]` of raw rows `[views·H·W, 9 + 3·D]`, `depths` and `densities`
    /// `[views·H·W, G]`; N is views·H·W·G.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for other sizes; errors of the device.
    pub fn placed(
        &self,
        depths: &Self,
        densities: &Self,
        views: &[AdapterView],
        call: AdapterCall,
    ) -> Result<Self, GpuError> {
        call.check(ADAPTER.name, self)?;
        let n = call.pixels() * call.per_pixel;
        let lengths = [
            ("depths", depths.count(), n),
            ("densities", densities.count(), n),
            ("views", views.len(), call.views),
        ];
        GpuError::check_lengths(ADAPTER.name, lengths)?;
        let result = self.recorder.empty(&[n, SPLAT_STRIDE])?;
        let constants = |view: &AdapterView| {
            let [least, span] = view.scale;
            let first = [view.focal_centre, [least, span, 0.0, 0.0]];
            first.into_iter().chain(view.world).chain(view.quat)
        };
        let constants: Vec<[f32; 4]> = views.iter().flat_map(constants).collect();
        let constants = self.recorder.gpu.upload("views", &constants)?;
        let bindings = [
            self.binding(),
            depths.binding(),
            densities.binding(),
            Binding::from(&constants),
            result.binding(),
        ];
        let groups = Groups::of(n, THREADS);
        self.recorder.call(&ADAPTER, &[], &call.uniform(), &bindings, groups)?;
        Ok(result)
    }

    /// Computes the SH of the same raw rows: `[N, D, 3]` if `interleaved`, else `[N, 3, D]`.
    /// `matrices` `[views, D, D]` map raw SH of each view.
    ///
    /// # Errors
    /// As [`Array::placed`].
    pub fn placed_colours(
        &self,
        matrices: &[f32],
        interleaved: bool,
        call: AdapterCall,
    ) -> Result<Self, GpuError> {
        call.check(ADAPTER_COLOURS.name, self)?;
        let n = call.pixels() * call.per_pixel;
        let d = call.functions;
        let lengths = [("matrices", matrices.len(), call.views * d * d)];
        GpuError::check_lengths(ADAPTER_COLOURS.name, lengths)?;
        let result = self.recorder.empty(&if interleaved { [n, d, 3] } else { [n, 3, d] })?;
        let matrices = self.recorder.gpu.upload("SH matrices", matrices)?;
        let uniform = AdapterUniform { interleaved: u32::from(interleaved), ..call.uniform() };
        let bindings = [self.binding(), Binding::from(&matrices), result.binding()];
        let groups = Groups::of(n * d, THREADS);
        self.recorder.call(&ADAPTER_COLOURS, &[], &uniform, &bindings, groups)?;
        Ok(result)
    }
}
