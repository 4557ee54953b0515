//! Intermediate tensors for whoever wants to look (`subsplat compare`, tests), at
//! no cost where nobody does.

use candle_core::{Result, Tensor};

/// Takes (name, tensor) as they arise.
type Observer<'a> = dyn FnMut(&str, &Tensor) -> Result<()> + 'a;

/// Hands stages to an observer, or to nobody.
pub struct Trace<'a>(Option<&'a mut Observer<'a>>);

impl<'a> Trace<'a> {
    /// Nobody looks.
    pub fn off() -> Self {
        Self(None)
    }

    /// Every stage goes to `observer`, in the order of computation.
    pub fn to(observer: &'a mut Observer<'a>) -> Self {
        Self(Some(observer))
    }

    /// Whether anybody looks.
    pub fn is_on(&self) -> bool {
        self.0.is_some()
    }

    /// Hands over a tensor that exists anyway.
    ///
    /// # Errors
    /// The observer's.
    pub fn put(&mut self, name: &str, tensor: &Tensor) -> Result<()> {
        match &mut self.0 {
            Some(observer) => observer(name, tensor),
            None => Ok(()),
        }
    }

    /// Hands over a tensor that is made only if somebody looks.
    ///
    /// # Errors
    /// The observer's, or `make`'s.
    pub fn put_with(&mut self, name: &str, make: impl FnOnce() -> Result<Tensor>) -> Result<()> {
        match &mut self.0 {
            Some(observer) => observer(name, &make()?),
            None => Ok(()),
        }
    }
}
