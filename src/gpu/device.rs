//! One opened GPU: device, queue, limits, and what has gone wrong with it.
//!
//! A [`Gpu`] opened here asks for WebGPU's default limits, so that what runs on it runs
//! in a browser too, but for sizes: bindings, buffers and textures are as large as the
//! adapter has them ([`limits_of`]). An application hands in its own device with
//! [`Gpu::from_device`].

use crate::device::DeviceChoice;
use crate::gpu::adapter::{AdapterSummary, find};
use crate::gpu::buffers::Pool;
use crate::gpu::error::GpuError;
use crate::gpu::pipelines::Pipelines;
use std::fmt;
use std::sync::atomic::AtomicUsize;
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

/// Most bytes of a binding or buffer, where the adapter has more: kernels count words in 32
/// bits, and some drivers bytes in 31.
const BINDING_MAX: u64 = 1 << 30;

/// What devices are asked for: WebGPU's default limits, and the adapter's own sizes.
pub fn limits_of(adapter: &wgpu::Adapter) -> wgpu::Limits {
    let (own, usual) = (adapter.limits(), wgpu::Limits::default());
    let binding = own.max_storage_buffer_binding_size.min(BINDING_MAX);
    wgpu::Limits {
        max_storage_buffer_binding_size: binding.max(usual.max_storage_buffer_binding_size),
        max_buffer_size: own.max_buffer_size.min(BINDING_MAX).max(usual.max_buffer_size),
        max_texture_dimension_2d: own.max_texture_dimension_2d,
        ..usual
    }
}

/// An opened GPU with its buffers and compiled kernels. Share it in an [`Arc`].
pub struct Gpu {
    pub(crate) device: wgpu::Device,
    pub(crate) queue: wgpu::Queue,
    pub(crate) limits: wgpu::Limits,
    pub(crate) pool: Arc<Pool>,
    pub(crate) pipelines: Pipelines,
    /// (splat, tile) pairs that frames have needed room for: where the next rasterizer
    /// begins.
    pub(crate) pairs: AtomicUsize,
    summary: AdapterSummary,
    timestamps: bool,
    health: Arc<Health>,
}

/// What the driver reported out of turn.
#[derive(Debug, Default)]
struct Health {
    lost: OnceLock<String>,
    /// An error outside any scope.
    stray: Mutex<Option<String>>,
}

impl fmt::Debug for Gpu {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.debug_struct("Gpu")
            .field("adapter", &self.summary)
            .field("timestamps", &self.timestamps)
            .field("lost", &self.health.lost.get())
            .finish_non_exhaustive()
    }
}

impl Gpu {
    /// Opens what `choice` means; `None` for the CPU kernels.
    ///
    /// # Errors
    /// [`GpuError::NoAdapter`] where a GPU was asked for and none answers;
    /// [`GpuError::Device`] where its driver gives no device.
    pub fn open(choice: &DeviceChoice) -> Result<Option<Arc<Self>>, GpuError> {
        match find(choice)? {
            Some(adapter) => Self::from_adapter(&adapter).map(|gpu| Some(Arc::new(gpu))),
            None => Ok(None),
        }
    }

    fn from_adapter(adapter: &wgpu::Adapter) -> Result<Self, GpuError> {
        let summary = AdapterSummary::of(&adapter.get_info());
        let wanted = adapter.features() & wgpu::Features::TIMESTAMP_QUERY;
        let descriptor = wgpu::DeviceDescriptor {
            label: Some("subsplat"),
            required_features: wanted,
            required_limits: limits_of(adapter),
            ..wgpu::DeviceDescriptor::default()
        };
        let (device, queue) =
            pollster::block_on(adapter.request_device(&descriptor)).map_err(|e| {
                GpuError::Device { adapter: summary.to_string(), reason: e.to_string() }
            })?;
        let health = Arc::new(Health::default());
        let stray = health.clone();
        // wgpu's own handler panics.
        device.on_uncaptured_error(Arc::new(move |e: wgpu::Error| {
            stray.stray.lock().unwrap_or_else(PoisonError::into_inner).replace(in_one_line(&e));
        }));
        Ok(Self::assemble(device, queue, summary, health))
    }

    /// A device that belongs to the application, which keeps its own error handler.
    /// Pictures can then be drawn to the application's textures.
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
            lost.lost.get_or_init(|| text);
        });
        let limits = device.limits();
        let timestamps = device.features().contains(wgpu::Features::TIMESTAMP_QUERY);
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
            health,
        }
    }

    /// The adapter behind it.
    pub fn adapter(&self) -> &AdapterSummary {
        &self.summary
    }

    /// The wgpu device, for an application that draws beside us.
    pub fn device(&self) -> &wgpu::Device {
        &self.device
    }

    /// The wgpu queue of [`Gpu::device`].
    pub fn queue(&self) -> &wgpu::Queue {
        &self.queue
    }

    /// Limits of the device: [`limits_of`] its adapter unless the application opened it.
    pub fn limits(&self) -> &wgpu::Limits {
        &self.limits
    }

    /// Whether stages can be timed on the device itself.
    pub fn has_timestamps(&self) -> bool {
        self.timestamps
    }

    /// Whether the device still answers.
    ///
    /// # Errors
    /// [`GpuError::Lost`] once the driver has said so; [`GpuError::Refused`] for an
    /// error that no call has returned, once.
    pub fn check(&self) -> Result<(), GpuError> {
        if let Some(reason) = self.health.lost.get() {
            return Err(GpuError::Lost { reason: reason.clone() });
        }
        let stray = self.health.stray.lock().unwrap_or_else(PoisonError::into_inner).take();
        match stray {
            Some(reason) => Err(GpuError::Refused { what: "a command".to_owned(), reason }),
            None => Ok(()),
        }
    }

    /// Runs `f`, which talks to the device, and returns what the device had against it.
    pub(crate) fn checked<T>(
        &self,
        what: &str,
        f: impl FnOnce() -> Result<T, GpuError>,
    ) -> Result<T, GpuError> {
        self.check()?;
        let scopes = Scopes::open(&self.device);
        let done = f();
        let found = scopes.close(what);
        if found.is_err() {
            // A device that is gone tells so when it is polled, and refuses all before.
            self.device.poll(wgpu::PollType::Poll).ok();
        }
        self.check()?;
        found?;
        done
    }
}

/// wgpu's words and their causes, which it puts on lines of their own.
fn in_one_line(error: &wgpu::Error) -> String {
    let text = error.to_string();
    let lines = text.lines().map(str::trim).filter(|l| !l.is_empty() && *l != "Caused by:");
    lines.collect::<Vec<_>>().join(": ")
}

/// Error scopes around calls to a device.
pub(crate) struct Scopes([wgpu::ErrorScopeGuard; 3]);

impl Scopes {
    pub(crate) fn open(device: &wgpu::Device) -> Self {
        use wgpu::ErrorFilter::{Internal, OutOfMemory, Validation};
        Self([Internal, Validation, OutOfMemory].map(|filter| device.push_error_scope(filter)))
    }

    pub(crate) fn close(self, what: &str) -> Result<(), GpuError> {
        let what = what.to_owned();
        let [internal, validation, memory] = self.0;
        // The last opened goes first.
        let memory = pollster::block_on(memory.pop());
        let validation = pollster::block_on(validation.pop());
        let internal = pollster::block_on(internal.pop());
        match (memory, validation.or(internal)) {
            (Some(_), _) => Err(GpuError::OutOfMemory { what }),
            (None, Some(e)) => Err(GpuError::Refused { what, reason: in_one_line(&e) }),
            (None, None) => Ok(()),
        }
    }
}
