//! Device memory: a pool of buffers, uploads, read-back, and cutting what exceeds a
//! binding.
//!
//! A [`Buffer`] goes back to its pool when its last owner drops it, and its bytes stay as
//! they are: a kernel that needs zeros clears them ([`super::Commands::clear`]).

use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use bytemuck::Pod;
use std::marker::PhantomData;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use wgpu::BufferUsages;

/// What a buffer of the pool is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Use {
    /// Kernels read and write it.
    Work,
    /// The CPU reads it.
    Staging,
}

impl Use {
    fn usages(self) -> BufferUsages {
        match self {
            Use::Work => {
                BufferUsages::STORAGE
                    | BufferUsages::UNIFORM
                    | BufferUsages::INDIRECT
                    | BufferUsages::COPY_SRC
                    | BufferUsages::COPY_DST
            }
            Use::Staging => BufferUsages::MAP_READ | BufferUsages::COPY_DST,
        }
    }
}

/// Bytes are a multiple of this: no binding and no copy is empty or odd.
const GRAIN: u64 = 256;
/// Bytes of a kernel's smallest argument, an array of one vec4.
const LEAST: u64 = 16;
/// How long a thread whose poll found the device idle waits for another thread, whose
/// poll took the mapping's answer, to hand it over.
const HANDOVER: Duration = Duration::from_secs(60);

/// Buffers that wait for their next use.
#[derive(Debug)]
pub(crate) struct Pool {
    free: Mutex<Vec<(Use, wgpu::Buffer)>>,
    held: AtomicU64,
    buffer_max: u64,
    binding_max: u64,
}

impl Pool {
    pub(crate) fn new(limits: &wgpu::Limits) -> Arc<Self> {
        Arc::new(Self {
            free: Mutex::default(),
            held: AtomicU64::new(0),
            buffer_max: limits.max_buffer_size,
            binding_max: limits.max_storage_buffer_binding_size,
        })
    }

    /// Bytes that are allocated for `bytes`: few sizes, so that frames of slightly
    /// different sizes share buffers.
    fn size_class(&self, bytes: u64) -> u64 {
        let bytes = bytes.max(1).next_multiple_of(GRAIN);
        let step = (bytes.next_power_of_two() / 8).max(GRAIN);
        bytes.next_multiple_of(step).min(self.buffer_max.max(bytes))
    }

    fn take(&self, purpose: Use, size: u64) -> Option<wgpu::Buffer> {
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        let place = free.iter().position(|(u, b)| *u == purpose && b.size() == size)?;
        Some(free.swap_remove(place).1)
    }
}

#[derive(Debug)]
struct Inner {
    raw: wgpu::Buffer,
    purpose: Use,
    bytes: u64,
    pool: Arc<Pool>,
    /// Its mapping failed, so no one can say what state it is in.
    spoilt: AtomicBool,
}

impl Drop for Inner {
    fn drop(&mut self) {
        if self.spoilt.load(Relaxed) {
            self.pool.held.fetch_sub(self.raw.size(), Relaxed);
            self.raw.destroy();
            return;
        }
        let mut free = self.pool.free.lock().unwrap_or_else(PoisonError::into_inner);
        free.push((self.purpose, self.raw.clone()));
    }
}

/// Device memory on loan from the pool. Clones are the same memory.
#[derive(Clone, Debug)]
pub struct Buffer(Arc<Inner>);

impl Buffer {
    /// Bytes asked for (the allocation may be larger).
    pub fn bytes(&self) -> u64 {
        self.0.bytes
    }

    pub(crate) fn raw(&self) -> &wgpu::Buffer {
        &self.0.raw
    }

    /// The part that holds `range` (bytes; starts at a multiple of 256).
    pub(crate) fn part(&self, range: Range<u64>) -> Binding {
        Binding { buffer: self.clone(), offset: range.start, bytes: range.end - range.start }
    }
}

/// A buffer, or a part of it, as a kernel's argument.
#[derive(Clone, Debug)]
pub(crate) struct Binding {
    pub(crate) buffer: Buffer,
    pub(crate) offset: u64,
    pub(crate) bytes: u64,
}

impl From<&Buffer> for Binding {
    fn from(buffer: &Buffer) -> Self {
        buffer.part(0..buffer.bytes())
    }
}

impl Binding {
    pub(crate) fn resource(&self) -> wgpu::BindingResource<'_> {
        wgpu::BindingResource::Buffer(wgpu::BufferBinding {
            buffer: self.buffer.raw(),
            offset: self.offset,
            size: std::num::NonZeroU64::new(self.bytes.next_multiple_of(4).max(4)),
        })
    }
}

impl Gpu {
    /// Memory for `count` values of `T`, whatever it held before.
    ///
    /// # Errors
    /// [`GpuError::TooSmall`] above the binding limit, [`GpuError::OutOfMemory`].
    pub(crate) fn empty<T: Pod>(
        &self,
        what: &'static str,
        count: usize,
    ) -> Result<Buffer, GpuError> {
        let bytes = size_of::<T>() as u64 * count as u64;
        self.fits(what, bytes)?;
        self.allocate(what, Use::Work, bytes)
    }

    fn fits(&self, what: &'static str, needed: u64) -> Result<(), GpuError> {
        let limit = self.pool.binding_max.min(self.pool.buffer_max);
        if needed > limit {
            return Err(GpuError::TooSmall { what, needed, limit });
        }
        Ok(())
    }

    fn allocate(&self, what: &'static str, purpose: Use, bytes: u64) -> Result<Buffer, GpuError> {
        let size = self.pool.size_class(bytes);
        let raw = match self.pool.take(purpose, size) {
            Some(raw) => raw,
            None => {
                let usage = purpose.usages();
                let label = Some(what);
                let new = wgpu::BufferDescriptor { label, size, usage, mapped_at_creation: false };
                let raw = self.checked(what, || Ok(self.device.create_buffer(&new)))?;
                self.pool.held.fetch_add(size, Relaxed);
                raw
            }
        };
        let bytes = bytes.max(LEAST).next_multiple_of(4);
        let (pool, spoilt) = (self.pool.clone(), AtomicBool::new(false));
        Ok(Buffer(Arc::new(Inner { raw, purpose, bytes, pool, spoilt })))
    }

    /// `data` in device memory.
    ///
    /// # Errors
    /// As [`Gpu::empty`].
    pub(crate) fn upload<T: Pod>(
        &self,
        what: &'static str,
        data: &[T],
    ) -> Result<Buffer, GpuError> {
        let buffer = self.empty::<T>(what, data.len())?;
        if !data.is_empty() {
            self.checked(what, || {
                self.queue.write_buffer(buffer.raw(), 0, bytemuck::cast_slice(data));
                Ok(())
            })?;
        }
        Ok(buffer)
    }

    /// A kernel's uniform.
    ///
    /// # Errors
    /// As [`Gpu::empty`].
    pub(crate) fn uniform<T: Pod>(&self, value: &T) -> Result<Buffer, GpuError> {
        self.upload("uniform", std::slice::from_ref(value))
    }

    /// How many rows of `floats` numbers fit one binding.
    pub(crate) fn rows_per_binding(&self, floats: usize) -> usize {
        let limit = self.pool.binding_max.min(self.pool.buffer_max);
        (limit / (4 * floats.max(1)) as u64) as usize
    }

    /// Row ranges of at most `most` rows that together are `rows`.
    pub(crate) fn chunks(rows: usize, most: usize) -> impl Iterator<Item = Range<usize>> {
        let most = most.max(1);
        (0..rows.div_ceil(most)).map(move |i| i * most..((i + 1) * most).min(rows))
    }

    /// Bytes of device memory that are allocated, in use or waiting.
    pub fn held_bytes(&self) -> u64 {
        self.pool.held.load(Relaxed)
    }

    /// Gives the memory that no one uses back to the driver.
    pub fn trim(&self) {
        let mut free = self.pool.free.lock().unwrap_or_else(PoisonError::into_inner);
        for (_, buffer) in free.drain(..) {
            self.pool.held.fetch_sub(buffer.size(), Relaxed);
            buffer.destroy();
        }
    }

    pub(crate) fn staging(&self, bytes: u64) -> Result<Buffer, GpuError> {
        self.allocate("read-back", Use::Staging, bytes)
    }
}

/// Values on their way back; taken after the commands that copy them were submitted.
#[derive(Debug)]
pub(crate) struct Reading<T> {
    pub(crate) staging: Buffer,
    pub(crate) count: usize,
    pub(crate) kind: PhantomData<T>,
}

impl<T: Pod> Reading<T> {
    /// Waits for the device and returns the values.
    ///
    /// # Errors
    /// [`GpuError::Lost`], or what the driver had against the mapping.
    pub(crate) fn take(self, gpu: &Gpu) -> Result<Vec<T>, GpuError> {
        let mut out = vec![T::zeroed(); self.count];
        self.take_into(gpu, &mut out)?;
        Ok(out)
    }

    /// [`Reading::take`] into `out`, which is as long.
    ///
    /// # Errors
    /// As [`Reading::take`].
    pub(crate) fn take_into(self, gpu: &Gpu, out: &mut [T]) -> Result<(), GpuError> {
        if self.count == 0 {
            return Ok(());
        }
        let refused =
            |reason: String| GpuError::Refused { what: "the read-back".to_owned(), reason };
        let read = gpu.checked("the read-back", || {
            let slice = self.staging.raw().slice(..self.staging.bytes());
            let (answer, answered) = channel();
            slice.map_async(wgpu::MapMode::Read, move |done| {
                // The receiver is gone only where this read-back was given up.
                answer.send(done).ok();
            });
            let waited = gpu.device.poll(wgpu::PollType::wait_indefinitely());
            waited.map_err(|e| refused(e.to_string()))?;
            match answered.recv_timeout(HANDOVER) {
                Ok(done) => done.map_err(|e| refused(e.to_string()))?,
                Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => {
                    return Err(refused("the device did not answer".to_owned()));
                }
            }
            let view = slice.get_mapped_range().map_err(|e| refused(e.to_string()))?;
            let to: &mut [u8] = bytemuck::cast_slice_mut(out);
            for (to, from) in to.iter_mut().zip(view.iter()) {
                *to = *from;
            }
            drop(view);
            self.staging.raw().unmap();
            Ok(())
        });
        if read.is_err() {
            self.staging.0.spoilt.store(true, Relaxed);
        }
        read
    }
}
