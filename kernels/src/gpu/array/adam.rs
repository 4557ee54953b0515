//! Adam on all parameters at once.
//!
//! CPU version: [`crate::cpu::adam`]. WGSL: wgsl/network/adam.wgsl. Tests: tests/gpu/optimizer.rs.

use super::Array;
use crate::gpu::buffers::Binding;
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::AdamUniform;

pub(crate) static ADAM: Kernel = Kernel {
    name: "adam",
    entry: "main",
    source: wgsl!(AdamUniform; "shared/grid", "network/adam"),
};

/// Elements of a block, which belong to one parameter; so many threads a workgroup has.
pub const ADAM_BLOCK: usize = 64;

/// Constants of [`Array::adam`].
#[derive(Clone, Copy, Debug)]
pub struct AdamCall<'a> {
    /// Factor of the gradients.
    pub clip: f32,
    /// Decay of the first and of the second moment.
    pub betas: [f32; 2],
    /// Term added to the root of the second moment.
    pub epsilon: f32,
    /// Decay of the moving average.
    pub average: f32,
    /// Parameter of each block of [`ADAM_BLOCK`] elements.
    pub owners: &'a [u32],
    /// Of each parameter: learning rate and factor of the root, both with bias correction; factor of
    /// the values; 1 if the parameter takes the step, else 0.
    pub parameters: &'a [[f32; 4]],
}

impl Array {
    /// Takes a step with gradients `self`: `state` are values, first and second moments and moving
    /// averages, all of the same length, and change in place.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for lengths that do not fit, or a block of no parameter; errors of the
    /// device.
    pub fn adam(&self, state: [&Self; 4], call: AdamCall) -> Result<(), GpuError> {
        let count = self.count();
        let most = call.owners.iter().max().map_or(0, |owner| *owner as usize + 1);
        let lengths = [
            ("gradients", count, ADAM_BLOCK * call.owners.len()),
            ("values", state[0].count(), count),
            ("first moments", state[1].count(), count),
            ("second moments", state[2].count(), count),
            ("averages", state[3].count(), count),
            ("parameters", call.parameters.len(), most.max(call.parameters.len())),
        ];
        GpuError::check_lengths(ADAM.name, lengths)?;
        if count == 0 {
            return Ok(());
        }
        let gpu = &self.recorder.gpu;
        let owners = gpu.upload("owners of blocks", call.owners)?;
        let parameters = gpu.upload("parameters", call.parameters)?;
        let uniform = AdamUniform {
            count: count as u32,
            clip: call.clip,
            first_decay: call.betas[0],
            second_decay: call.betas[1],
            epsilon: call.epsilon,
            average: call.average,
            ..AdamUniform::default()
        };
        let inputs = [self.binding(), Binding::from(&owners), Binding::from(&parameters)];
        let bindings = [inputs.to_vec(), state.map(Self::binding).to_vec()].concat();
        self.recorder.call(&ADAM, &[], &uniform, &bindings, Groups::of(count, ADAM_BLOCK))
    }
}
