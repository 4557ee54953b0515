//! The operations of the network on a GPU ([`super::Array`] for arrays in device memory).
//!
//! An [`Executor`] keeps the network's parameters on the device. An array that a tracked parameter
//! reaches holds a node of a tape (`tape.rs`), from which [`Executor::backward`] computes
//! gradients; other arrays hold none. The gradients are those of the CPU ops
//! (tests/gpu/array_gradients.rs).
//!
//! Parameters stay on the device by their candle id. A parameter that training can change is uploaded at
//! each use, unless the optimizer keeps it there (`adam.rs`). A parameter that eight passes did not use is
//! freed, because heads for another number of children are new tensors.

mod adam;
mod array;
mod rules;
mod scene;
mod small_array;
mod tape;

pub use adam::DeviceAdam;
pub use tape::DeviceGradients;

use super::Backend;
use candle_core::{Error, Result, Tensor, TensorId};
use std::collections::HashMap;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, PoisonError};
use subsplat_kernels::gpu;
use subsplat_kernels::gpu::{GpuError, Recorder};
use tape::Node;

/// A result of a call of the device.
type OnDevice<T> = std::result::Result<T, GpuError>;

/// Passes after whose end an unused parameter leaves the device.
const PASSES_KEPT: u64 = 8;

/// A GPU that runs the network, with the network's parameters.
#[derive(Debug)]
pub struct Executor {
    recorder: Arc<Recorder>,
    parameters: Mutex<Parameters>,
    /// Parameters in training, by the tensors of which they are copies.
    trained: Mutex<HashMap<TensorId, gpu::Array>>,
    /// The first error of the device since [`Executor::attempt`] began.
    failure: Mutex<Option<GpuError>>,
    /// Number of nodes of tapes so far.
    nodes: AtomicU64,
}

/// Parameters on the device, with the pass that used them last.
#[derive(Debug, Default)]
struct Parameters {
    pass: u64,
    arrays: HashMap<TensorId, (u64, gpu::Array)>,
}

impl Executor {
    /// Returns an executor on the GPU of `backend`, if it is one.
    pub fn new(backend: &Backend) -> Option<Arc<Self>> {
        let recorder = Recorder::new(backend.gpu()?.clone());
        Some(Arc::new(Self {
            recorder,
            parameters: Mutex::default(),
            trained: Mutex::default(),
            failure: Mutex::default(),
            nodes: AtomicU64::default(),
        }))
    }

    /// Runs `f`, one pass of the network. `None`: the device failed, and `backend` knows the
    /// reason.
    ///
    /// # Errors
    /// Those of `f` that do not come from the device.
    pub fn attempt<R, E>(
        &self,
        backend: &Backend,
        f: impl FnOnce() -> std::result::Result<R, E>,
    ) -> Option<std::result::Result<R, E>> {
        self.failure.lock().unwrap_or_else(PoisonError::into_inner).take();
        let result = f();
        let mut parameters = self.parameters.lock().unwrap_or_else(PoisonError::into_inner);
        parameters.pass += 1;
        let now = parameters.pass;
        parameters.arrays.retain(|_, (used, _)| *used + PASSES_KEPT >= now);
        let failure = self.failure.lock().unwrap_or_else(PoisonError::into_inner).take();
        match (&result, failure) {
            (Err(_), Some(error)) => {
                // A lost device first refuses a command; the loss is the reason.
                let error = self.recorder.gpu().check().err().unwrap_or(error);
                backend.offload(|_| Err::<(), _>(error));
                None
            }
            _ => Some(result),
        }
    }

    /// Returns the recorder of all operations, which counts them.
    pub fn recorder(&self) -> &Arc<Recorder> {
        &self.recorder
    }

    /// Copies `tensor`, f32, to the device. A tensor of candle's graph becomes a leaf of a tape
    /// ([`DeviceGradients::scalars`]).
    ///
    /// # Errors
    /// Another dtype; errors of the device.
    pub fn upload(self: &Arc<Self>, tensor: &Tensor) -> Result<TapeArray> {
        let values = tensor.flatten_all()?.to_vec1::<f32>()?;
        let array = self.array(self.recorder.upload(&values, tensor.dims()))?;
        if tensor.track_op() {
            return Ok(array.with_leaf(Some(tensor.clone())));
        }
        Ok(array)
    }

    fn array(self: &Arc<Self>, result: OnDevice<gpu::Array>) -> Result<TapeArray> {
        let array = self.checked(result)?;
        Ok(TapeArray { array, executor: self.clone(), node: None })
    }

    /// Keeps the first error of the device for [`Executor::attempt`].
    fn checked<R>(&self, result: OnDevice<R>) -> Result<R> {
        result.map_err(|error| {
            let mut failure = self.failure.lock().unwrap_or_else(PoisonError::into_inner);
            failure.get_or_insert_with(|| error.clone());
            Error::wrap(error)
        })
    }

    /// Returns `parameter` on the device, where it is kept unless its values can change outside
    /// [`Executor::keep_trained`].
    fn parameter(self: &Arc<Self>, parameter: &Tensor) -> Result<TapeArray> {
        if parameter.track_op() {
            let trained = self.trained.lock().unwrap_or_else(PoisonError::into_inner);
            return match trained.get(&parameter.id()) {
                Some(array) => {
                    let own = self.array(Ok(array.clone()))?;
                    Ok(own.with_leaf(Some(parameter.clone())))
                }
                None => {
                    drop(trained);
                    self.upload(parameter)
                }
            };
        }
        let mut kept = self.parameters.lock().unwrap_or_else(PoisonError::into_inner);
        let now = kept.pass;
        if let Some((used, array)) = kept.arrays.get_mut(&parameter.id()) {
            *used = now;
            return Ok(TapeArray { array: array.clone(), executor: self.clone(), node: None });
        }
        let uploaded = self.upload(parameter)?;
        kept.arrays.insert(parameter.id(), (now, uploaded.array.clone()));
        Ok(uploaded)
    }
}

/// An array in the memory of an [`Executor`]'s GPU, with its place on the tape of gradients.
#[derive(Clone, Debug)]
pub struct TapeArray {
    array: gpu::Array,
    executor: Arc<Executor>,
    /// The operation that made the array, where a gradient must reach it.
    node: Option<Arc<Node>>,
}
