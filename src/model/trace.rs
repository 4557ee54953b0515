//! Recording of intermediate tensors, for `subsplat compare` and tests. A trace that is
//! off costs nothing.

use candle_core::{Result, Tensor};

/// Receives name and tensor of each stage.
type Observer<'a> = dyn FnMut(&str, &Tensor) -> Result<()> + 'a;

/// A recorder of stages, or none.
pub struct Trace<'a>(Option<&'a mut Observer<'a>>);

impl<'a> Trace<'a> {
    /// Returns a trace that records nothing.
    pub fn off() -> Self {
        Self(None)
    }

    /// Returns a trace that passes every stage to `observer`, in the order of computation.
    pub fn to(observer: &'a mut Observer<'a>) -> Self {
        Self(Some(observer))
    }

    /// Returns true if stages are recorded.
    pub fn is_on(&self) -> bool {
        self.0.is_some()
    }

    /// Records `tensor`, which the computation needs anyway.
    ///
    /// # Errors
    /// Those of the observer.
    pub fn put(&mut self, name: &str, tensor: &Tensor) -> Result<()> {
        match &mut self.0 {
            Some(observer) => observer(name, tensor),
            None => Ok(()),
        }
    }

    /// Records the tensor of `make`, which runs only if stages are recorded.
    ///
    /// # Errors
    /// Those of the observer and of `make`.
    pub fn put_with(&mut self, name: &str, make: impl FnOnce() -> Result<Tensor>) -> Result<()> {
        match &mut self.0 {
            Some(observer) => observer(name, &make()?),
            None => Ok(()),
        }
    }
}
