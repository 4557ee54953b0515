//! One opened GPU: device, queue, limits, and the errors that its driver reports.
//!
//! [`Gpu::open`] requests WebGPU's default limits, so that the kernels also run in a browser.
//! Only the sizes of bindings, buffers and textures are those of the adapter ([`limits_of`]). Timestamps
//! and subgroup operations are used where the adapter has them ([`features_of`]).
//! [`Gpu::from_device`] takes an application's own device.
//!
//! Softmax, layer norm and group norm, and their gradients, reduce over a workgroup with subgroup operations
//! where the adapter has them. The two forms are one shared WGSL file each (`place.wgsl`, `place_subgroups.wgsl`) and add in the
//! same order, so every subgroup size gives the same bytes. A reduction has 8 barriers with 64 threads and
//! 10 with 256; with subgroups of 32 it has 2. On lavapipe (subgroups of 8, `cargo bench --bench device --
//! --subgroups`) layer norm takes 27.4 ms instead of 31.9, its gradient 58 instead of 68, softmax of 32 numbers
//! 184 instead of 204, and group norm 23.5 instead of 22.8. `SUBSPLAT_SUBGROUPS=off` takes the form without.
//! Browsers take it always, because naga 30 does not read `enable subgroups;`.
//!
//! Other kernels use no subgroup operations. In the rasterizer's backward pass a splat's ten sums would need 50
//! shuffles a thread, where a thread stores ten numbers and reads about ten. In sort and prefix sum a
//! subgroup may lack threads, so the tables in workgroup memory would remain. Attention would save 2
//! of its 19 barriers a step at width 128.

use crate::device::DeviceChoice;
use crate::gpu::adapter::{AdapterSummary, find};
use crate::gpu::buffers::Pool;
use crate::gpu::error::GpuError;
use crate::gpu::pipelines::Pipelines;
use crate::gpu::wait;
use crate::gpu::wait::Scopes;
use std::fmt;
use std::sync::atomic::AtomicUsize;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

/// Maximum size of a binding or buffer, bytes: kernels count words in 32 bits, and some drivers
/// count bytes in 31.
const BINDING_MAX: u64 = 1 << 30;

/// Returns the limits that [`Gpu::open`] requests: WebGPU's defaults with the adapter's own
/// sizes.
pub fn limits_of(adapter: &wgpu::Adapter) -> wgpu::Limits {
    let own = adapter.limits();
    let default = wgpu::Limits::default();
    let binding = own.max_storage_buffer_binding_size.min(BINDING_MAX);
    wgpu::Limits {
        max_storage_buffer_binding_size: binding.max(default.max_storage_buffer_binding_size),
        max_buffer_size: own.max_buffer_size.min(BINDING_MAX).max(default.max_buffer_size),
        max_texture_dimension_2d: own.max_texture_dimension_2d,
        ..default
    }
}

/// The environment variable that turns subgroup operations off.
const SUBGROUPS_VARIABLE: &str = "SUBSPLAT_SUBGROUPS";
/// Kernels use subgroup operations. naga 30 reads no `enable subgroups;`, without which a browser refuses
/// them, so there they are never used.
const USES_SUBGROUPS: bool = !cfg!(all(target_family = "wasm", target_os = "unknown"));

/// Returns the features that [`Gpu::open`] requests: timestamps and subgroup operations where the adapter
/// has them. The environment variable `SUBSPLAT_SUBGROUPS=off` leaves out the second.
///
/// # Errors
/// [`GpuError::Argument`] for another value of `SUBSPLAT_SUBGROUPS`.
pub fn features_of(adapter: &wgpu::Adapter) -> Result<wgpu::Features, GpuError> {
    let mut wanted = wgpu::Features::TIMESTAMP_QUERY;
    let value = std::env::var_os(SUBGROUPS_VARIABLE).unwrap_or_default();
    wanted.set(wgpu::Features::SUBGROUP, subgroups_allowed(&value.to_string_lossy())?);
    Ok(adapter.features() & wanted)
}

/// Returns whether a value of `SUBSPLAT_SUBGROUPS` allows subgroup operations.
fn subgroups_allowed(value: &str) -> Result<bool, GpuError> {
    match value {
        "" => Ok(USES_SUBGROUPS),
        "off" => Ok(false),
        _ => Err(GpuError::Argument {
            kernel: "device",
            argument: SUBGROUPS_VARIABLE,
            expected: "off, or no value".to_owned(),
            got: value.to_owned(),
        }),
    }
}

/// An opened GPU with its buffers and compiled kernels. Threads share it in an [`Arc`].
pub struct Gpu {
    pub(crate) device: wgpu::Device,
    pub(crate) queue: wgpu::Queue,
    pub(crate) limits: wgpu::Limits,
    pub(crate) pool: Arc<Pool>,
    pub(crate) pipelines: Pipelines,
    /// Largest capacity for (splat, tile) pairs of any frame: the start value of new rasterizers.
    pub(crate) pairs: AtomicUsize,
    summary: AdapterSummary,
    timestamps: bool,
    subgroups: bool,
    health: Arc<Health>,
}

/// Errors that the driver reports asynchronously.
#[derive(Debug, Default)]
struct Health {
    lost: OnceLock<String>,
    /// The first error outside every error scope; later ones follow from it.
    stray: Mutex<Option<String>>,
}

impl fmt::Debug for Gpu {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.debug_struct("Gpu")
            .field("adapter", &self.summary)
            .field("timestamps", &self.timestamps)
            .field("subgroups", &self.subgroups)
            .field("lost", &self.health.lost.get())
            .finish_non_exhaustive()
    }
}

impl Gpu {
    /// Opens the device that `choice` selects; `None` for the CPU kernels.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`] where `choice` requires a GPU and no adapter matches;
    /// [`GpuError::Device`] where the driver opens no device; [`features_of`].
    pub fn open(choice: &DeviceChoice) -> Result<Option<Arc<Self>>, GpuError> {
        match find(choice)? {
            Some(adapter) => Self::from_adapter(&adapter).map(|gpu| Some(Arc::new(gpu))),
            None => Ok(None),
        }
    }

    fn from_adapter(adapter: &wgpu::Adapter) -> Result<Self, GpuError> {
        let summary = AdapterSummary::of(&adapter.get_info());
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("subsplat"),
            required_features: features_of(adapter)?,
            required_limits: limits_of(adapter),
            ..wgpu::DeviceDescriptor::default()
        };
        let refused = |reason| GpuError::Device { adapter: summary.to_string(), reason };
        let opened = wait::block_on(adapter.request_device(&descriptor)).map_err(refused)?;
        let (device, queue) = opened.map_err(|e| refused(single_line(&e)))?;
        let health = Arc::new(Health::default());
        let stray = health.clone();
        // wgpu's own handler panics.
        device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| {
            let mut first = stray.stray.lock().unwrap_or_else(PoisonError::into_inner);
            first.get_or_insert_with(|| single_line(&e));
        }));
        Ok(Self::assemble(device, queue, summary, health))
    }

    /// Wraps a device of the application, which keeps its own error handler. Frames can be drawn
    /// to textures of that device. Kernels use the features that it was opened with. In a browser the
    /// device's errors reach that handler alone.
    pub fn from_device(device: wgpu::Device, queue: wgpu::Queue) -> Arc<Self> {
        let summary = AdapterSummary::of(&device.adapter_info());
        Arc::new(Self::assemble(device, queue, summary, Arc::default()))
    }

    fn assemble(
        device: wgpu::Device,
        queue: wgpu::Queue,
        summary: AdapterSummary,
        health: Arc<Health>,
    ) -> Self {
        let lost = health.clone();
        device.set_device_lost_callback(move |reason, message| {
            let text = if message.is_empty() { format!("{reason:?}") } else { message };
            lost.lost.get_or_init(|| text.trim_end_matches('.').to_owned());
        });
        let limits = device.limits();
        let timestamps = device.features().contains(wgpu::Features::TIMESTAMP_QUERY);
        let subgroups = USES_SUBGROUPS && device.features().contains(wgpu::Features::SUBGROUP);
        let pool = Pool::new(&limits);
        Self {
            device,
            queue,
            limits,
            pool,
            pipelines: Pipelines::default(),
            pairs: AtomicUsize::new(0),
            summary,
            timestamps,
            subgroups,
            health,
        }
    }

    /// Returns the adapter of the device.
    pub fn adapter(&self) -> &AdapterSummary {
        &self.summary
    }

    /// Returns the wgpu device, for an application's own commands.
    pub fn device(&self) -> &wgpu::Device {
        &self.device
    }

    /// Returns the wgpu queue of [`Gpu::device`].
    pub fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }

    /// Returns the limits of the device: [`limits_of`] its adapter, unless the application opened
    /// it.
    pub fn limits(&self) -> &wgpu::Limits {
        &self.limits
    }

    /// Returns whether the device supports timestamps.
    pub fn has_timestamps(&self) -> bool {
        self.timestamps
    }

    /// Returns whether kernels use subgroup operations.
    pub fn has_subgroups(&self) -> bool {
        self.subgroups
    }

    /// Checks that the device is usable.
    ///
    /// # Errors
    /// [`GpuError::Lost`] after the driver reported the loss; [`GpuError::Refused`] for an error
    /// that no call has returned yet, once.
    pub fn check(&self) -> Result<(), GpuError> {
        if let Some(reason) = self.health.lost.get() {
            return Err(GpuError::Lost { reason: reason.clone() });
        }
        let stray = self.health.stray.lock().unwrap_or_else(PoisonError::into_inner).take();
        match stray {
            Some(reason) => Err(GpuError::Refused { operation: "a command".to_owned(), reason }),
            None => Ok(()),
        }
    }

    /// Runs `f`, which sends commands to the device, and returns the errors of the device.
    pub(crate) fn checked<T>(
        &self,
        operation: &str,
        f: impl FnOnce() -> Result<T, GpuError>,
    ) -> Result<T, GpuError> {
        self.check()?;
        let scopes = Scopes::open(&self.device);
        let result = f();
        let errors = scopes.close(operation);
        if errors.is_err() {
            // A lost device reports its loss only when it is polled; until then it rejects every
            // command.
            self.device.poll(wgpu::PollType::Poll).ok();
        }
        self.check()?;
        errors?;
        result
    }
}

/// Joins the lines of wgpu's message and its causes.
pub(super) fn single_line(error: &impl fmt::Display) -> String {
    let text = error.to_string();
    let lines = text.lines().map(|l| l.trim().trim_end_matches('.'));
    lines.filter(|l| !l.is_empty() && *l != "Caused by:").collect::<Vec<_>>().join(": ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_variable_turns_subgroups_off() {
        assert_eq!(subgroups_allowed("off"), Ok(false));
        assert_eq!(subgroups_allowed(""), Ok(USES_SUBGROUPS));
        let error = subgroups_allowed("no").unwrap_err().to_string();
        assert!(
            error.contains("SUBSPLAT_SUBGROUPS: expected off") && error.ends_with("got no"),
            "{error}"
        );
    }
}
