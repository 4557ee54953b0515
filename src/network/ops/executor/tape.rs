//! The tape: operations whose gradients are requested, and the backward pass.
//!
//! A node refers to the nodes of its operation's inputs, as in candle. The backward pass visits
//! nodes in the reverse order of their numbers, and adds gradients of one node in that order, so
//! that the bytes depend on the operations alone. A rule owns the arrays it needs and is dropped
//! once it has run, so that their memory returns to the pool during the pass.
//!
//! A leaf of the tape is a copy of a tensor of candle, and its gradient returns as a scalar of candle's
//! graph (`precomputed_gradient`). Losses, adapter and rasterizer of a training therefore stay candle's, and layers
//! that are sums of parameters (`polynomial` heads) need no rule here. The alternative, all of a step on one
//! tape, would need the losses as kernels too.

use super::{Executor, OnDevice, TapeArray};
use crate::network::ops::precomputed_gradient::precomputed_gradient;
use candle_core::{Result, Tensor, bail};
use std::collections::BTreeMap;
use std::fmt;
use std::sync::atomic::Ordering;
use std::sync::{Arc, Mutex, PoisonError};
use subsplat_kernels::gpu;
use subsplat_kernels::gpu::Function;

/// Computes the gradients of an operation's inputs from that of its result; `None` for inputs
/// without a node.
type Rule = Box<dyn FnOnce(&gpu::Array) -> OnDevice<Vec<Option<gpu::Array>>> + Send + Sync>;

/// A leaf or a recorded operation.
pub(super) struct Node {
    /// Number in the order of creation.
    number: u64,
    origin: Origin,
}

enum Origin {
    /// An array whose gradient is requested, with the tensor of which it is a copy.
    Leaf(Option<Tensor>),
    Operation {
        name: &'static str,
        inputs: Vec<Option<Arc<Node>>>,
        rule: Mutex<Option<Rule>>,
    },
}

impl fmt::Debug for Node {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.debug_struct("Node").field("number", &self.number).finish_non_exhaustive()
    }
}

/// Gradients of the leaves of a tape.
#[derive(Debug)]
pub struct DeviceGradients {
    executor: Arc<Executor>,
    leaves: BTreeMap<u64, (Option<Tensor>, gpu::Array)>,
}

impl Executor {
    fn node(&self, origin: Origin) -> Option<Arc<Node>> {
        let number = self.nodes.fetch_add(1, Ordering::Relaxed);
        Some(Arc::new(Node { number, origin }))
    }

    /// Computes the gradients of all leaves from those of `results`: pairs of a result and its
    /// gradient. Each operation is passed once, and then forgotten.
    ///
    /// # Errors
    /// A second pass over an operation; a rule without a gradient of an input, named; gradients of
    /// other sizes; errors of the device.
    pub fn backward(
        self: &Arc<Self>,
        results: &[(&TapeArray, &TapeArray)],
    ) -> Result<DeviceGradients> {
        let mut open: BTreeMap<u64, (Arc<Node>, gpu::Array)> = BTreeMap::new();
        let mut leaves = BTreeMap::new();
        for (result, gradient) in results {
            if result.array.dims() != gradient.array.dims() {
                let (expected, got) = (result.array.dims(), gradient.array.dims());
                bail!("backward: expected a gradient of sizes {expected:?}, got {got:?}");
            }
            if let Some(node) = &result.node {
                self.add(&mut open, node, gradient.array.clone())?;
            }
        }
        while let Some((number, (node, gradient))) = open.pop_last() {
            match &node.origin {
                Origin::Leaf(tensor) => {
                    leaves.insert(number, (tensor.clone(), gradient));
                }
                Origin::Operation { name, inputs, rule } => {
                    let rule = rule.lock().unwrap_or_else(PoisonError::into_inner).take();
                    let Some(rule) = rule else {
                        bail!("backward: expected one pass over `{name}`, got a second one")
                    };
                    let gradients = self.checked(rule(&gradient))?;
                    for (i, input) in inputs.iter().enumerate() {
                        let Some(input) = input else { continue };
                        let Some(Some(gradient)) = gradients.get(i) else {
                            bail!(
                                "backward: expected a gradient of input {i} of `{name}`, got none"
                            )
                        };
                        self.add(&mut open, input, gradient.clone())?;
                    }
                }
            }
        }
        Ok(DeviceGradients { executor: self.clone(), leaves })
    }

    /// Adds `gradient` to that of `node`.
    fn add(
        &self,
        open: &mut BTreeMap<u64, (Arc<Node>, gpu::Array)>,
        node: &Arc<Node>,
        gradient: gpu::Array,
    ) -> Result<()> {
        let sum = match open.remove(&node.number) {
            Some((_, before)) => self.checked(before.with(&gradient, Function::Plus))?,
            None => gradient,
        };
        open.insert(node.number, (node.clone(), sum));
        Ok(())
    }
}

impl TapeArray {
    /// Returns the executor of the array.
    pub fn executor(&self) -> &Arc<Executor> {
        &self.executor
    }

    /// Returns the same elements as a leaf of a tape, whose gradient [`DeviceGradients::of`]
    /// returns.
    #[must_use]
    pub fn leaf(&self) -> Self {
        self.with_leaf(None)
    }

    pub(super) fn with_leaf(&self, tensor: Option<Tensor>) -> Self {
        Self { node: self.executor.node(Origin::Leaf(tensor)), ..self.clone() }
    }

    /// Returns `result` of an operation of `inputs`. `rule` makes its gradient's rule, if a
    /// gradient must reach an input; it receives which ones.
    pub(super) fn recorded<const N: usize, R>(
        &self,
        name: &'static str,
        result: OnDevice<gpu::Array>,
        inputs: [&Self; N],
        rule: impl FnOnce([bool; N], &gpu::Array) -> R,
    ) -> Result<Self>
    where
        R: FnOnce(&gpu::Array) -> OnDevice<[Option<gpu::Array>; N]> + Send + Sync + 'static,
    {
        let array = self.executor.checked(result)?;
        let tracked = inputs.map(|input| input.node.is_some());
        let node = if tracked.contains(&true) {
            let rule = rule(tracked, &array);
            let rule: Rule = Box::new(move |dy| Ok(rule(dy)?.into()));
            let inputs = inputs.iter().map(|input| input.node.clone()).collect();
            self.executor.node(Origin::Operation { name, inputs, rule: Mutex::new(Some(rule)) })
        } else {
            None
        };
        Ok(Self { array, executor: self.executor.clone(), node })
    }

    /// [`TapeArray::recorded`] for an operation of this array alone; `rule` receives this array
    /// and the result.
    pub(super) fn recorded_alone<R>(
        &self,
        name: &'static str,
        result: OnDevice<gpu::Array>,
        rule: impl FnOnce(&gpu::Array, &gpu::Array) -> R,
    ) -> Result<Self>
    where
        R: FnOnce(&gpu::Array) -> OnDevice<gpu::Array> + Send + Sync + 'static,
    {
        self.recorded(name, result, [self], |_, y| {
            let rule = rule(&self.array, y);
            move |dy| Ok([Some(rule(dy)?)])
        })
    }

    /// [`TapeArray::recorded`] for any number of inputs; `rule` computes the gradient of the
    /// input with a given index.
    pub(super) fn recorded_parts(
        &self,
        name: &'static str,
        result: OnDevice<gpu::Array>,
        inputs: &[&Self],
        rule: impl Fn(&gpu::Array, usize) -> OnDevice<gpu::Array> + Send + Sync + 'static,
    ) -> Result<Self> {
        let array = self.executor.checked(result)?;
        let inputs: Vec<_> = inputs.iter().map(|input| input.node.clone()).collect();
        let tracked: Vec<bool> = inputs.iter().map(Option::is_some).collect();
        let node = if tracked.contains(&true) {
            let rule: Rule = Box::new(move |dy| {
                let one = |(i, wanted): (usize, &bool)| wanted.then(|| rule(dy, i)).transpose();
                tracked.iter().enumerate().map(one).collect()
            });
            self.executor.node(Origin::Operation { name, inputs, rule: Mutex::new(Some(rule)) })
        } else {
            None
        };
        Ok(Self { array, executor: self.executor.clone(), node })
    }
}

impl DeviceGradients {
    /// Returns the gradient of a leaf; `None` where no gradient reached it.
    pub fn of(&self, leaf: &TapeArray) -> Option<TapeArray> {
        let (_, array) = self.leaves.get(&leaf.node.as_ref()?.number)?;
        Some(TapeArray { array: array.clone(), executor: self.executor.clone(), node: None })
    }

    /// Returns for each leaf that is a copy of a tensor of candle's graph a scalar, whose gradient
    /// is that of the tensor. candle's `backward` of their sum continues the pass.
    ///
    /// # Errors
    /// Errors of the device.
    pub fn scalars(&self) -> Result<Vec<Tensor>> {
        let mut scalars = Vec::new();
        for (tensor, array) in self.leaves.values() {
            if let Some(tensor) = tensor {
                let gradient = self.executor.checked(array.to_vec())?;
                scalars.push(precomputed_gradient(tensor, 0.0, gradient)?);
            }
        }
        Ok(scalars)
    }
}
