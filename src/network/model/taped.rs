//! Results of the backbone for training, on either executor.
//!
//! On a GPU the results are copies in host memory, and leaves of candle's graph. candle's backward
//! pass ends at them; [`Taped::backward`] continues it on the device.

use super::BackboneOutput;
use super::backbone::small::DepthMaps;
use crate::network::ops::{Array, Executor, TapeArray};
use candle_core::Var;
use candle_core::backprop::GradStore;
use candle_core::{Result, Tensor};
use std::sync::Arc;

/// Tensors of a forward pass, and its tape where a GPU computed them.
pub struct Taped<T> {
    /// The tensors.
    pub value: T,
    tape: Option<Tape>,
}

/// Copies of results in host memory, and the results.
pub(super) struct Tape {
    executor: Arc<Executor>,
    results: Vec<(Var, TapeArray)>,
}

impl<T> Taped<T> {
    /// Returns tensors whose graph is candle's.
    pub(super) fn on_host(value: T) -> Self {
        Self { value, tape: None }
    }

    /// Returns the tensors of [`Tape::copy`].
    pub(super) fn on_device(value: T, tape: Tape) -> Self {
        Self { value, tape: Some(tape) }
    }

    /// Replaces the tensors, with which the tape stays.
    pub fn map<U>(self, f: impl FnOnce(T) -> U) -> Taped<U> {
        Taped { value: f(self.value), tape: self.tape }
    }

    /// Continues the backward pass whose gradients are in `store`. Returns scalars, to whose sum
    /// the caller applies candle's `backward` for the gradients of the parameters; none where
    /// `store` has them.
    ///
    /// # Errors
    /// Errors of the device.
    pub fn backward(self, store: &GradStore) -> Result<Vec<Tensor>> {
        if let Some(tape) = self.tape {
            return tape.backward(store);
        }
        Ok(Vec::new())
    }
}

impl Tape {
    pub(super) fn new(executor: &Arc<Executor>) -> Self {
        Self { executor: executor.clone(), results: Vec::new() }
    }

    /// Copies a result to host memory.
    pub(super) fn copy(&mut self, result: &TapeArray) -> Result<Tensor> {
        let leaf = Var::from_tensor(&result.to_host()?)?;
        let tensor = leaf.as_tensor().clone();
        if result.track_op() {
            self.results.push((leaf, result.clone()));
        }
        Ok(tensor)
    }

    fn backward(self, store: &GradStore) -> Result<Vec<Tensor>> {
        let mut pairs = Vec::new();
        for (leaf, result) in self.results {
            if let Some(gradient) = store.get(&leaf) {
                pairs.push((result, self.executor.upload(&gradient.detach())?));
            }
        }
        let pairs: Vec<_> = pairs.iter().map(|(result, gradient)| (result, gradient)).collect();
        self.executor.backward(&pairs)?.scalars()
    }
}

impl BackboneOutput<TapeArray> {
    /// Returns copies in host memory that `tape` knows.
    pub(super) fn copied(&self, tape: &mut Tape) -> Result<BackboneOutput> {
        let features = self.features.iter().map(|(level, map)| Ok((*level, tape.copy(map)?)));
        Ok(BackboneOutput {
            features: features.collect::<Result<_>>()?,
            raw: tape.copy(&self.raw)?,
            depths: tape.copy(&self.depths)?,
            densities: tape.copy(&self.densities)?,
        })
    }
}

impl DepthMaps<TapeArray> {
    /// Returns copies in host memory that `tape` knows.
    pub(super) fn copied(&self, tape: &mut Tape) -> Result<DepthMaps> {
        Ok(DepthMaps {
            logits: tape.copy(&self.logits)?,
            index: tape.copy(&self.index)?,
            confidence: tape.copy(&self.confidence)?,
        })
    }
}
