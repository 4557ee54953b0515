//! Arrays of the network in device memory, and its operations.
//!
//! An operation allocates its result and records the call of a kernel. [`Recorder`] submits calls
//! in groups; a buffer returns to the pool after the submit of the last call that reads it, so
//! that the memory in use is that of the arrays alive and of one group. Arrays are contiguous;
//! [`Array::reshape`] and whole leading parts share memory.
//!
//! Gradients (`*_backward`) are operations too; `subsplat::network::ops::TapeArray` has the tape that calls them.
//!
//! CPU versions: [`crate::cpu`], tensor operations of candle. Tests: tests/gpu/array.rs,
//! tests/gpu/array_gradients.rs.
//!
//! Work of the networks for two pictures of 256×256 with four children, from photographs to children in
//! host memory, counted by `cargo bench --bench device -- --count`:
//!
//! | network | calls | Gflop | arguments | device memory | integrated, laptop, desktop, H200 |
//! |---|---|---|---|---|---|
//! | small | 399 | 32 | 2.36 GB | 130 MiB | 89, 21, 8.4, 4.2 ms |
//! | MVSplat | 1,375 | 363 | 13.5 GB | 508 MiB | 845, 184, 67, 30 ms |
//!
//! Times are estimates from data sheets, with 30 % of the f32 rate, 70 % of the memory's rate and 5 µs a
//! call: 2 Tflop/s and 60 GB/s, 10 and 250, 30 and 700, 60 and 4800. No GPU was at hand. Memory is the most
//! that was allocated, parameters and buffers of the read-back included.
//!
//! Bytes do not depend on the grouping of the calls.
//!
//! Decisions, all for two pictures of 256×256:
//!
//! * An activation runs in the call of the convolution, linear layer or sum before it, except on a tape, which needs the
//!   value between. Without this `small` would have 432 calls and 3.2 GB of arguments. Calls that compute something
//!   (all but copies, sums and activations) have 1.85 GB, so that the whole is 1.27 times this minimum. Norms and the
//!   attention's gather take the residual as an argument (`NormSum` in `norm.rs`), on a tape too, because the residual's
//!   gradient is the result's. MVSplat's 13.46 GB are 1.44 times its minimum (with sums of their own 1,485 calls, 14.8 GB
//!   and 1.71 times); 3.57 GB of them are copies and 0.52 GB sums. 80 % of the calls of `small` and 86 % of MVSplat's
//!   have 132 workgroups or more, one for each core of an H200.
//! * Arrays and parameters are f32. f16 arrays with f32 sums would halve the bytes. By the same counts they would take 17 to
//!   19 % off the expected times of `small` (5 % on an H200) and 15 to 17 % off MVSplat's (5 %). With the results of
//!   convolutions, linear layers and other calls with an activation rounded to f16, `small` kept 64.1 dB (f32: 97.0) to
//!   the CPU's picture (128², shipped room). 93 of MVSplat's 99 tensors failed, by 280 to 5,100 times the noise floor, and its
//!   depths were off by up to 11 % of the largest. f16 could serve `small` alone, and every kernel would need a second type.
//! * f16 parameters would change no bit of `small`, whose file stores f16. They would save 4.2 of 2,357 MB a pass and 3.1
//!   of 130 MiB, for a second form of convolution and linear layer. MVSplat's parameters are no f16 numbers.
//! * A convolution is a matrix product of 64 × 64 outputs a workgroup, whose second factor is read from the picture: no
//!   `im2col`, no transforms. Winograd's transforms would need twice the memory, which WebGPU's default limits do not
//!   allow at 512².

mod adam;
mod adapter;
mod attention;
mod elementwise;
mod norm;
mod norm_bwd;
mod product;
mod product_bwd;
mod rows;
mod rows_bwd;
mod small;
mod small_bwd;
mod trunk;
mod trunk_bwd;

pub(super) use adam::ADAM;
pub use adam::{ADAM_BLOCK, AdamCall};
pub(super) use adapter::{ADAPTER, ADAPTER_COLOURS};
pub use adapter::{AdapterCall, AdapterView};
pub(super) use attention::ATTENTION;
pub use attention::AttentionCall;
pub(super) use elementwise::ELEMENTWISE;
pub use elementwise::{Function, PointwiseFunction};
pub use norm::NormSum;
pub(super) use norm::{LAYER_NORM, NORM_APPLY, NORM_STATISTICS};
pub(super) use norm_bwd::{LAYER_NORM_BWD, NORM_BWD, NORM_SUMS_BWD};
pub use product::ConvolutionCall;
pub(super) use product::{CONVOLUTION, LINEAR};
pub(super) use product_bwd::{CONVOLUTION_WEIGHT_BWD, LINEAR_WEIGHT_BWD};
pub use rows::Reduction;
pub(super) use rows::{REDUCE, RESIZE, SELECT_ROWS, SOFTMAX};
pub(super) use rows_bwd::{RESIZE_BWD, SELECT_ROWS_BWD, SUM_PARTS};
pub(super) use small::{
    CONVEX, CROSS_CHECK, DEPTH_CONSENSUS, EXPECTATION, HEAD_OUTPUT, RAW_MATCHING_BLOCKS,
    RAW_MATCHING_SCORES,
};
pub use small::{CrossCheckCall, DepthConsensusCall, HeadOutputCall, RawMatchingCall};
pub(super) use small_bwd::{CONVEX_BWD, CONVEX_MAPS_BWD, EXPECTATION_BWD};
pub(super) use trunk::{ATTRIBUTES, OCCLUSION};
pub(super) use trunk_bwd::ATTRIBUTES_BWD;

use crate::gpu::buffers::{Binding, Buffer};
use crate::gpu::commands::{Commands, Groups, Pending};
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::Kernel;
use crate::gpu::pipelines::Constants;
use bytemuck::Pod;
use std::collections::BTreeMap;
use std::fmt;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};

/// Calls of one submit.
const CALLS_MAX: usize = 48;
/// Bytes of the results of one submit, which keeps their memory and that of their arguments.
const BYTES_MAX: u64 = 4 << 20;
/// Name of the calls in errors and traces.
const NAME: &str = "network";

/// Records calls for a GPU and submits them in groups, in order.
pub struct Recorder {
    gpu: Arc<Gpu>,
    pending: Mutex<(Pending, u64)>,
    work: Mutex<BTreeMap<&'static str, Work>>,
    /// Calls are counted and dropped.
    counts_only: AtomicBool,
}

/// Workgroups that occupy every core of the largest adapter of the table above at once (an H200: 132 cores).
pub const FULL_GRID: u64 = 132;

/// Work of all calls of one kernel, counted from their sizes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Work {
    /// Calls.
    pub calls: u64,
    /// Calls of at least [`FULL_GRID`] workgroups.
    pub full_calls: u64,
    /// Workgroups.
    pub workgroups: u64,
    /// Additions and multiplications of convolutions, linear layers and attention; 0 for others.
    pub flops: u64,
    /// Bytes of the arguments, each counted once a call.
    pub bytes: u64,
}

impl fmt::Debug for Recorder {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.debug_struct("Recorder").field("gpu", &self.gpu).finish_non_exhaustive()
    }
}

impl Recorder {
    /// Creates a recorder without calls.
    pub fn new(gpu: Arc<Gpu>) -> Arc<Self> {
        let (pending, work, counts_only) = Default::default();
        Arc::new(Self { gpu, pending, work, counts_only })
    }

    /// Sets whether calls are only counted. Memory is then allocated and returned as at execution, no
    /// call runs, and read-backs return zeros.
    pub fn set_counts_only(&self, counts_only: bool) {
        self.counts_only.store(counts_only, Relaxed);
    }

    /// Returns the device.
    pub fn gpu(&self) -> &Arc<Gpu> {
        &self.gpu
    }

    /// Copies `values` to the device; `dims` are their dimensions.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for another number of values; errors of the device.
    pub fn upload(self: &Arc<Self>, values: &[f32], dims: &[usize]) -> Result<Array, GpuError> {
        let lengths = [("values", values.len(), dims.iter().product())];
        GpuError::check_lengths(NAME, lengths)?;
        let buffer = self.gpu.upload(NAME, values)?;
        Ok(Array { recorder: self.clone(), buffer, offset: 0, dims: dims.to_vec() })
    }

    /// Allocates an array whose elements the next call writes.
    pub(super) fn empty(self: &Arc<Self>, dims: &[usize]) -> Result<Array, GpuError> {
        let buffer = self.gpu.empty::<f32>(NAME, dims.iter().product())?;
        Ok(Array { recorder: self.clone(), buffer, offset: 0, dims: dims.to_vec() })
    }

    /// Allocates an array of zeros.
    pub(super) fn zeros(self: &Arc<Self>, dims: &[usize]) -> Result<Array, GpuError> {
        let array = self.empty(dims)?;
        self.record(array.buffer.bytes(), |commands| {
            commands.clear(&array.buffer);
            Ok(())
        })?;
        Ok(array)
    }

    /// Returns the work of each kernel since the recorder was created.
    pub fn work(&self) -> BTreeMap<&'static str, Work> {
        self.work.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Counts the additions and multiplications of a call of `kernel`.
    fn count_flops(&self, kernel: &'static Kernel, flops: usize) {
        let mut work = self.work.lock().unwrap_or_else(PoisonError::into_inner);
        work.entry(kernel.name).or_default().flops += flops as u64;
    }

    /// Counts a call.
    fn count(&self, name: &'static str, bindings: &[Binding], groups: &Groups) {
        let mut work = self.work.lock().unwrap_or_else(PoisonError::into_inner);
        let own = work.entry(name).or_default();
        own.calls += 1;
        own.bytes += bindings.iter().map(|b| b.bytes).sum::<u64>();
        if let Groups::Of(sizes) = groups {
            let workgroups = sizes.iter().map(|n| u64::from(*n)).product::<u64>();
            own.workgroups += workgroups;
            own.full_calls += u64::from(workgroups >= FULL_GRID);
        }
    }

    /// Uploads `uniform` and records a call with it and `arguments`. Submits all recorded calls if
    /// they are many or hold much memory.
    pub(super) fn call<T: Pod>(
        &self,
        kernel: &'static Kernel,
        constants: Constants,
        uniform: &T,
        arguments: &[Binding],
        groups: Groups,
    ) -> Result<(), GpuError> {
        self.call_named((kernel.name, kernel), constants, uniform, arguments, groups)
    }

    /// [`Recorder::call`], counted under another name.
    pub(super) fn call_named<T: Pod>(
        &self,
        (name, kernel): (&'static str, &'static Kernel),
        constants: Constants,
        uniform: &T,
        arguments: &[Binding],
        groups: Groups,
    ) -> Result<(), GpuError> {
        let mut bindings = vec![Binding::from(&self.gpu.uniform(uniform)?)];
        bindings.extend_from_slice(arguments);
        self.count(name, &bindings, &groups);
        let bytes = bindings.last().map_or(0, |result| result.bytes);
        self.record(bytes, |commands| commands.run(kernel, constants, &bindings, groups))
    }

    /// Records the commands of `f`, whose results have `bytes` bytes. Submits all recorded commands
    /// if they are many or hold much memory.
    pub(super) fn record<R>(
        &self,
        bytes: u64,
        f: impl FnOnce(&mut Commands<'_>) -> Result<R, GpuError>,
    ) -> Result<R, GpuError> {
        let mut pending = self.pending.lock().unwrap_or_else(PoisonError::into_inner);
        let (calls, before) = std::mem::take(&mut *pending);
        let mut commands = self.gpu.resume(NAME, calls);
        let result = f(&mut commands)?;
        let calls = commands.suspend();
        let bytes = before + bytes;
        if calls.len() < CALLS_MAX && bytes < BYTES_MAX {
            *pending = (calls, bytes);
            return Ok(result);
        }
        self.submit(self.gpu.resume(NAME, calls))?;
        Ok(result)
    }

    /// Submits `commands`, or drops them if they are only counted.
    fn submit(&self, commands: Commands<'_>) -> Result<(), GpuError> {
        if !self.counts_only.load(Relaxed) {
            return commands.submit().map(drop);
        }
        drop(commands);
        // An empty submit ends the uploads so far, whose memory would grow.
        self.gpu.commands(NAME, false).submit().map(drop)
    }

    /// Submits all recorded calls, so that calls of others find their results.
    ///
    /// # Errors
    /// Errors of the device.
    pub fn flush(&self) -> Result<(), GpuError> {
        let mut pending = self.pending.lock().unwrap_or_else(PoisonError::into_inner);
        let (calls, _) = std::mem::take(&mut *pending);
        match calls.len() {
            0 => Ok(()),
            _ => self.submit(self.gpu.resume(NAME, calls)),
        }
    }

    /// Submits all recorded calls and waits until the device has executed them. A browser waits at
    /// the next read-back instead.
    ///
    /// # Errors
    /// Errors of the device.
    pub fn finish(&self) -> Result<(), GpuError> {
        self.flush()?;
        self.gpu.finish()
    }

    /// Waits for all operations and returns the elements of `arrays`, with one wait for all.
    ///
    /// # Errors
    /// Errors of the device.
    pub fn read(&self, arrays: &[&Array]) -> Result<Vec<Vec<f32>>, GpuError> {
        let aligned = |array: &&Array| match array.offset {
            0 => Ok((*array).clone()),
            _ => array.copied(),
        };
        let arrays = arrays.iter().map(aligned).collect::<Result<Vec<_>, _>>()?;
        let mut pending = self.pending.lock().unwrap_or_else(PoisonError::into_inner);
        let (calls, _) = std::mem::take(&mut *pending);
        let mut commands = self.gpu.resume(NAME, calls);
        let readings = arrays.iter().map(|a| commands.read::<f32>(&a.buffer, a.count()));
        let readings = readings.collect::<Result<Vec<_>, _>>()?;
        self.submit(commands)?;
        if self.counts_only.load(Relaxed) {
            return Ok(arrays.iter().map(|array| vec![0.0; array.count()]).collect());
        }
        readings.into_iter().map(|reading| reading.take(&self.gpu)).collect()
    }
}

/// An f32 array in device memory, row-major. Clones share the memory; operations make new arrays.
#[derive(Clone)]
pub struct Array {
    recorder: Arc<Recorder>,
    buffer: Buffer,
    /// First element; a multiple of [`ALIGNMENT`].
    offset: usize,
    dims: Vec<usize>,
}

impl fmt::Debug for Array {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.debug_struct("Array").field("dims", &self.dims).finish_non_exhaustive()
    }
}

/// Alignment of a binding, floats (WebGPU: 256 bytes).
const ALIGNMENT: usize = 64;

impl Array {
    /// Returns the dimensions.
    pub fn dims(&self) -> &[usize] {
        &self.dims
    }

    /// Returns the recorder of this array's operations.
    pub fn recorder(&self) -> &Arc<Recorder> {
        &self.recorder
    }

    /// Returns the number of elements.
    pub fn count(&self) -> usize {
        self.dims.iter().product()
    }

    /// Waits for all operations and returns the elements.
    ///
    /// # Errors
    /// Errors of the device.
    pub fn to_vec(&self) -> Result<Vec<f32>, GpuError> {
        Ok(self.recorder.read(&[self])?.pop().unwrap_or_default())
    }

    /// Returns the same elements under other dimensions.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for another number of elements.
    pub fn reshape(&self, dims: &[usize]) -> Result<Self, GpuError> {
        GpuError::check_lengths("reshape", [("elements", self.count(), dims.iter().product())])?;
        Ok(Self { dims: dims.to_vec(), ..self.clone() })
    }

    /// Returns the binding of the elements.
    pub(super) fn binding(&self) -> Binding {
        let at = 4 * self.offset as u64;
        self.buffer.part(at..at + 4 * self.count() as u64)
    }

    /// Returns a binding of the first elements, for an argument that the kernel does not read.
    pub(super) fn first_binding(&self) -> Binding {
        let at = 4 * self.offset as u64;
        self.buffer.part(at..at + 4 * self.count().min(4) as u64)
    }

    /// Returns a kernel's constant and argument of a residual, an array that is added to its result.
    fn residual_argument(&self, residual: Option<&Self>) -> ((&'static str, f64), Binding) {
        let binding = residual.map_or_else(|| self.first_binding(), Self::binding);
        (("HAS_RESIDUAL", f64::from(u32::from(residual.is_some()))), binding)
    }

    /// Returns the product of the sizes before dimension `dim`, its size, and the product of the
    /// sizes after it.
    fn around(&self, dim: usize) -> Result<[usize; 3], GpuError> {
        let Some(&length) = self.dims.get(dim) else {
            return Err(GpuError::Argument {
                kernel: NAME,
                argument: "dimension",
                expected: format!("below {}", self.dims.len()),
                got: dim.to_string(),
            });
        };
        let product = |dims: &[usize]| dims.iter().product();
        Ok([product(&self.dims[..dim]), length, product(&self.dims[dim + 1..])])
    }
}

/// Refuses a residual of other dimensions than `dims`.
fn check_residual(
    kernel: &'static str,
    dims: &[usize],
    residual: Option<&Array>,
) -> Result<(), GpuError> {
    match residual.filter(|residual| residual.dims != dims) {
        Some(other) => Err(misfit(kernel, format!("a residual of {dims:?}"), &other.dims)),
        None => Ok(()),
    }
}

/// The error of an argument of `kernel` whose dimensions do not fit.
fn misfit(kernel: &'static str, expected: String, got: &[usize]) -> GpuError {
    GpuError::Argument { kernel, argument: "dimensions", expected, got: format!("{got:?}") }
}
