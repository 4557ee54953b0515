//! Recording of intermediate tensors, for `subsplat-lab compare` and tests, and checkpoints at which
//! a caller can cancel. A trace without either costs nothing.

use crate::network::ops::Array;
use candle_core::{Result, Tensor};

/// Receives name and tensor of each stage.
type Observer<'a> = dyn FnMut(&str, &Tensor) -> Result<()> + 'a;

/// Runs after each step of the network, on any thread. Its error ends the computation.
pub type Checkpoint<'a> = &'a (dyn Fn() -> Result<()> + Sync);

/// A recorder of stages, a checkpoint between them, or neither.
pub struct Trace<'a> {
    observer: Option<&'a mut Observer<'a>>,
    checkpoint: Option<Checkpoint<'a>>,
}

impl<'a> Trace<'a> {
    /// Returns a trace that records nothing.
    pub fn off() -> Self {
        Self { observer: None, checkpoint: None }
    }

    /// Returns a trace that passes every stage to `observer`, in the order of computation.
    pub fn to(observer: &'a mut Observer<'a>) -> Self {
        Self { observer: Some(observer), checkpoint: None }
    }

    /// Returns a trace that records nothing and calls `checkpoint` after each stage.
    pub fn with_checkpoint(checkpoint: Checkpoint<'a>) -> Self {
        Self { observer: None, checkpoint: Some(checkpoint) }
    }

    /// Returns true if stages are recorded.
    pub fn is_on(&self) -> bool {
        self.observer.is_some()
    }

    /// Records `array`, which the computation needs anyway, and ends a step.
    ///
    /// # Errors
    /// Those of the observer and of the checkpoint.
    pub fn put<A: Array>(&mut self, name: &str, array: &A) -> Result<()> {
        if let Some(observer) = &mut self.observer {
            observer(name, &array.to_host()?)?;
        }
        self.step()
    }

    /// Records the array of `make`, which runs only if stages are recorded, and ends a step.
    ///
    /// # Errors
    /// Those of the observer, of the checkpoint and of `make`.
    pub fn put_with<A: Array>(
        &mut self,
        name: &str,
        make: impl FnOnce() -> Result<A>,
    ) -> Result<()> {
        if let Some(observer) = &mut self.observer {
            observer(name, &make()?.to_host()?)?;
        }
        self.step()
    }

    /// Ends a step that records nothing.
    ///
    /// # Errors
    /// Those of the checkpoint.
    pub fn step(&self) -> Result<()> {
        self.checkpoint.map_or(Ok(()), |checkpoint| checkpoint())
    }
}
