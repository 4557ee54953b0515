//! Parameters in training with the state of Adam, in device memory.
//!
//! The values are one array, of which each parameter has a part that begins at a multiple of
//! [`ADAM_BLOCK`]. The network reads these parts without an upload ([`Executor::keep_trained`]).
//! Tests: tests/gpu/optimizer.rs.
//!
//! One call updates all parameters. The norm of the gradients is a sum of parts in a fixed order. The sum of the
//! gradients comes from the host, because groups of scenes and ranks add theirs in a fixed order, and layers
//! that are sums of parameters have candle's gradients. Copies of the state return after each step. They
//! cost 16 bytes a parameter; with them checkpoints are the same files as the CPU's, and a lost device loses no step.

use super::{Executor, TapeArray};
use crate::network::ops::Array;
use crate::network::ops::device::{ParameterStep, SharedStep};
use candle_core::{Result, Tensor, bail};
use std::ops::Range;
use std::sync::{Arc, PoisonError};
use subsplat_kernels::gpu::{ADAM_BLOCK, AdamCall, Function};

/// Values, moments and moving averages of all parameters in device memory.
#[derive(Debug)]
pub struct DeviceAdam {
    executor: Arc<Executor>,
    /// Ranges of the parameters in arrays without gaps, in order.
    spans: Vec<Range<usize>>,
    /// Parameter of each block.
    owners: Vec<u32>,
    /// Values, first moments, second moments, averages.
    state: [TapeArray; 4],
}

impl DeviceAdam {
    /// Copies `state`, arrays without gaps of the parameters `spans`, to the device.
    ///
    /// # Errors
    /// Arrays of another length than the spans; errors of the device.
    pub fn new(
        executor: &Arc<Executor>,
        spans: Vec<Range<usize>>,
        state: [&[f32]; 4],
    ) -> Result<Self> {
        let blocks = |span: &Range<usize>| span.len().div_ceil(ADAM_BLOCK);
        let owners = (0u32..).zip(&spans).flat_map(|(i, s)| std::iter::repeat_n(i, blocks(s)));
        let owners: Vec<u32> = owners.collect();
        let upload = |row: &[f32]| upload(executor, &spans, row);
        let [values, first, second, averages] = state;
        let state = [upload(values)?, upload(first)?, upload(second)?, upload(averages)?];
        Ok(Self { executor: executor.clone(), spans, owners, state })
    }

    /// Returns the part of the values that belongs to parameter `index`, which has `dims`.
    ///
    /// # Errors
    /// Dimensions of another number of elements.
    pub fn value(&self, index: usize, dims: &[usize]) -> Result<TapeArray> {
        let Some(span) = self.spans.get(index) else {
            bail!("parameter: expected an index below {}, got {index}", self.spans.len())
        };
        let blocks = self.owners.partition_point(|owner| (*owner as usize) < index);
        self.state[0].narrow(0, blocks * ADAM_BLOCK, span.len())?.reshape(dims)
    }

    /// Returns the norm of `gradients`, an array without gaps. The order of the sum depends on the
    /// number of elements alone.
    ///
    /// # Errors
    /// Another number of gradients; errors of the device.
    pub fn norm(&self, gradients: &[f32]) -> Result<f64> {
        if gradients.is_empty() {
            return Ok(0.0);
        }
        let gradients = upload(&self.executor, &self.spans, gradients)?;
        let squares = gradients.array.map(Function::Square).and_then(|squares| squares.sum_over(0));
        let sum = self.executor.checked(squares.and_then(|sum| sum.to_vec()))?;
        Ok(sum.iter().map(|v| f64::from(*v)).sum::<f64>().sqrt())
    }

    /// Takes a step, with `None` for a parameter that does not change, and returns copies of values, first and second moments and averages, without gaps.
    ///
    /// # Errors
    /// Lengths that do not fit; errors of the device. The state is then unknown.
    pub fn step(
        &self,
        gradients: &[f32],
        shared: SharedStep,
        parameters: &[Option<ParameterStep>],
    ) -> Result<[Vec<f32>; 4]> {
        if parameters.len() != self.spans.len() {
            let (expected, got) = (self.spans.len(), parameters.len());
            bail!("optimizer: expected constants of {expected} parameters, got {got}");
        }
        let gradients = upload(&self.executor, &self.spans, gradients)?;
        let own = |step: &Option<ParameterStep>| match step {
            Some(ParameterStep { rate, root, keep }) => [*rate, *root, *keep, 1.0],
            None => [0.0; 4],
        };
        let parameters: Vec<[f32; 4]> = parameters.iter().map(own).collect();
        let SharedStep { clip, betas, epsilon, average } = shared;
        let (owners, parameters) = (&*self.owners, &*parameters);
        let call = AdamCall { clip, betas, epsilon, average, owners, parameters };
        let arrays = self.state.each_ref().map(|array| &array.array);
        self.executor.checked(gradients.array.adam(arrays, call))?;
        let read = self.executor.checked(self.executor.recorder.read(&arrays))?;
        let rows: Vec<Vec<f32>> = read.iter().map(|row| without_gaps(&self.spans, row)).collect();
        match rows.try_into() {
            Ok(rows) => Ok(rows),
            Err(_) => bail!("optimizer: expected four arrays of the device"),
        }
    }
}

impl Executor {
    /// Makes the network read `parameters`, tensors of candle's graph, from these arrays of the same
    /// values, and no longer those of an earlier call. An empty list ends that: each use uploads the
    /// parameter again.
    ///
    /// # Errors
    /// An array of other dimensions than its tensor.
    pub fn keep_trained(&self, parameters: &[(Tensor, TapeArray)]) -> Result<()> {
        if let Some((tensor, array)) = parameters.iter().find(|(t, a)| t.dims() != a.dims()) {
            bail!("parameter: expected an array {:?}, got {:?}", tensor.dims(), array.dims());
        }
        let own = parameters.iter().map(|(tensor, array)| (tensor.id(), array.array.clone()));
        *self.trained.lock().unwrap_or_else(PoisonError::into_inner) = own.collect();
        Ok(())
    }
}

/// Copies an array without gaps to the device, each parameter from a multiple of [`ADAM_BLOCK`] on;
/// gaps are 0.
fn upload(executor: &Arc<Executor>, spans: &[Range<usize>], row: &[f32]) -> Result<TapeArray> {
    let expected = spans.last().map_or(0, |span| span.end);
    if row.len() != expected {
        bail!("optimizer: expected {expected} elements, got {}", row.len());
    }
    let mut spread = Vec::with_capacity(expected + ADAM_BLOCK * spans.len());
    for span in spans {
        spread.extend_from_slice(&row[span.clone()]);
        spread.resize(spread.len().next_multiple_of(ADAM_BLOCK), 0.0);
    }
    executor.array(executor.recorder.upload(&spread, &[spread.len()]))
}

/// The inverse of [`upload`] for a copy in host memory.
fn without_gaps(spans: &[Range<usize>], spread: &[f32]) -> Vec<f32> {
    let mut row = Vec::with_capacity(spans.last().map_or(0, |span| span.end));
    let mut first = 0;
    for span in spans {
        row.extend_from_slice(&spread[first..first + span.len()]);
        first += span.len().next_multiple_of(ADAM_BLOCK);
    }
    row
}
