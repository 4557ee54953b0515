//! Device memory: a pool of buffers, uploads, read-back, and division of arrays that exceed a
//! binding.
//!
//! A dropped [`Buffer`] returns to its pool with its bytes unchanged. Free buffers of other sizes than those
//! requested return to the driver, so that the memory stays within a quarter of that in use. A kernel that needs zeros
//! clears the buffer first ([`super::Commands::clear`]).
//!
//! A free buffer serves requests down to four fifths of its size. Free buffers return to the driver where a
//! new one would raise the memory above the most in use by more than a quarter. For two pictures of 256² the
//! network then needs 130 MiB with `small` and 508 MiB with MVSplat, of which 90 and 400 MiB are arrays in use.
//! With free buffers of exactly the requested size it needs 220 and 910 MiB. Parts of one large buffer would
//! waste less, but WebGPU refuses a buffer that one call reads and writes. A test holds 0.2 and 0.6 GiB.

use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::wait;
use bytemuck::Pod;
use std::marker::PhantomData;
use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use wgpu::BufferUsages;

/// Purpose of a buffer of the pool.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Use {
    /// Kernels read and write the buffer.
    Work,
    /// The CPU reads the buffer.
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

/// Granularity of allocations, bytes: no binding and no copy is empty or unaligned.
const SIZE_GRANULARITY: u64 = 256;
/// A free buffer serves a request that is smaller by at most the request over this; free buffers may take
/// the largest memory in use over this.
const SURPLUS: u64 = 4;
/// Size from which free buffers return to the driver, bytes. Smaller ones are many and cost little.
const LARGE: u64 = 1 << 20;
/// Minimum size of a kernel's argument, bytes: an array of one vec4.
const BINDING_BYTES_MIN: u64 = 16;

/// Buffers that the CPU has read, and their sizes together.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ReadBacks {
    /// Buffers.
    pub count: u64,
    /// Bytes.
    pub bytes: u64,
}

/// Free buffers, and the amount of memory allocated.
#[derive(Debug)]
pub(crate) struct Pool {
    free: Mutex<Vec<(Use, wgpu::Buffer)>>,
    allocated: AtomicU64,
    /// The largest value of `allocated` so far.
    allocated_most: AtomicU64,
    /// Bytes of the buffers in use, and their largest value so far.
    used: AtomicU64,
    used_most: AtomicU64,
    /// Count and bytes of [`ReadBacks`].
    read: [AtomicU64; 2],
    buffer_max: u64,
    binding_max: u64,
}

impl Pool {
    pub(crate) fn new(limits: &wgpu::Limits) -> Arc<Self> {
        Arc::new(Self {
            free: Mutex::default(),
            allocated: AtomicU64::new(0),
            allocated_most: AtomicU64::new(0),
            used: AtomicU64::new(0),
            used_most: AtomicU64::new(0),
            read: Default::default(),
            buffer_max: limits.max_buffer_size,
            binding_max: limits.max_storage_buffer_binding_size,
        })
    }

    /// Returns the allocation size for `bytes`. Few distinct sizes exist, so that frames of
    /// slightly different sizes share buffers.
    fn size_class(&self, bytes: u64) -> u64 {
        let bytes = bytes.max(1).next_multiple_of(SIZE_GRANULARITY);
        let step = (bytes.next_power_of_two() / 8).max(SIZE_GRANULARITY);
        bytes.next_multiple_of(step).min(self.buffer_max.max(bytes))
    }

    fn take(&self, purpose: Use, size: u64) -> Option<wgpu::Buffer> {
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        let fits = |(u, b): &(Use, wgpu::Buffer)| {
            *u == purpose && (size..=size + size / SURPLUS).contains(&b.size())
        };
        let fitting = free.iter().enumerate().filter(|(_, entry)| fits(entry));
        let (index, _) = fitting.min_by_key(|(_, (_, b))| b.size())?;
        Some(free.remove(index).1)
    }

    /// Returns free buffers to the driver, those that are free longest first, where a new buffer of
    /// `size` bytes would raise the allocated memory above the most that was in use, and a part of it.
    fn make_room(&self, size: u64) {
        let most = self.used_most.load(Relaxed).max(self.used.load(Relaxed) + size);
        let mut excess =
            (self.allocated.load(Relaxed) + size).saturating_sub(most + most / SURPLUS);
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        free.retain(|(purpose, buffer)| {
            if excess == 0 || *purpose != Use::Work || buffer.size() < LARGE {
                return true;
            }
            excess = excess.saturating_sub(buffer.size());
            self.allocated.fetch_sub(buffer.size(), Relaxed);
            buffer.destroy();
            false
        });
    }

    /// Counts a buffer of `size` bytes that comes into use.
    fn begin_use(&self, size: u64) {
        let used = self.used.fetch_add(size, Relaxed) + size;
        self.used_most.fetch_max(used, Relaxed);
    }
}

#[derive(Debug)]
struct Inner {
    raw: wgpu::Buffer,
    purpose: Use,
    bytes: u64,
    pool: Arc<Pool>,
    /// True if a mapping failed: the state of the buffer is then unknown.
    mapping_failed: AtomicBool,
}

impl Drop for Inner {
    fn drop(&mut self) {
        self.pool.used.fetch_sub(self.raw.size(), Relaxed);
        if self.mapping_failed.load(Relaxed) {
            self.pool.allocated.fetch_sub(self.raw.size(), Relaxed);
            self.raw.destroy();
            return;
        }
        let mut free = self.pool.free.lock().unwrap_or_else(PoisonError::into_inner);
        free.push((self.purpose, self.raw.clone()));
    }
}

/// Device memory of the pool. Clones share the same memory.
#[derive(Clone, Debug)]
pub struct Buffer(Arc<Inner>);

impl Buffer {
    /// Returns the requested size, bytes. The allocation may be larger.
    pub fn bytes(&self) -> u64 {
        self.0.bytes
    }

    pub(crate) fn raw(&self) -> &wgpu::Buffer {
        &self.0.raw
    }

    /// Returns the binding of `range`, bytes, which starts at a multiple of 256.
    pub(crate) fn part(&self, range: Range<u64>) -> Binding {
        Binding { buffer: self.clone(), offset: range.start, bytes: range.end - range.start }
    }
}

/// A buffer, or a part of one, as a kernel's argument.
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
    /// Allocates uninitialised memory for `count` values of `T`.
    ///
    /// # Errors
    /// [`GpuError::TooSmall`] above the binding limit, [`GpuError::OutOfMemory`].
    pub(crate) fn empty<T: Pod>(
        &self,
        label: &'static str,
        count: usize,
    ) -> Result<Buffer, GpuError> {
        let bytes = size_of::<T>() as u64 * count as u64;
        self.check_binding(label, bytes)?;
        self.allocate(label, Use::Work, bytes)
    }

    fn check_binding(&self, resource: &'static str, needed: u64) -> Result<(), GpuError> {
        let limit = self.pool.binding_max.min(self.pool.buffer_max);
        if needed > limit {
            return Err(GpuError::TooSmall { resource, needed, limit });
        }
        Ok(())
    }

    fn allocate(&self, label: &'static str, purpose: Use, bytes: u64) -> Result<Buffer, GpuError> {
        let size = self.pool.size_class(bytes);
        let raw = match self.pool.take(purpose, size) {
            Some(raw) => raw,
            None => {
                let usage = purpose.usages();
                let new = wgpu::BufferDescriptor {
                    label: Some(label),
                    size,
                    usage,
                    mapped_at_creation: false,
                };
                self.pool.make_room(size);
                let raw = self.checked(label, || Ok(self.device.create_buffer(&new)))?;
                let allocated = self.pool.allocated.fetch_add(size, Relaxed) + size;
                self.pool.allocated_most.fetch_max(allocated, Relaxed);
                raw
            }
        };
        self.pool.begin_use(raw.size());
        let bytes = bytes.max(BINDING_BYTES_MIN).next_multiple_of(4);
        let pool = self.pool.clone();
        let mapping_failed = AtomicBool::new(false);
        Ok(Buffer(Arc::new(Inner { raw, purpose, bytes, pool, mapping_failed })))
    }

    /// Copies `data` to device memory.
    ///
    /// # Errors
    /// As [`Gpu::empty`].
    pub(crate) fn upload<T: Pod>(
        &self,
        label: &'static str,
        data: &[T],
    ) -> Result<Buffer, GpuError> {
        let buffer = self.empty::<T>(label, data.len())?;
        if !data.is_empty() {
            self.checked(label, || {
                self.queue.write_buffer(buffer.raw(), 0, bytemuck::cast_slice(data));
                Ok(())
            })?;
        }
        Ok(buffer)
    }

    /// Copies a kernel's uniform to device memory.
    ///
    /// # Errors
    /// As [`Gpu::empty`].
    pub(crate) fn uniform<T: Pod>(&self, value: &T) -> Result<Buffer, GpuError> {
        self.upload("uniform", std::slice::from_ref(value))
    }

    /// Returns how many rows of `floats` numbers one binding holds.
    pub(crate) fn rows_per_binding(&self, floats: usize) -> usize {
        let limit = self.pool.binding_max.min(self.pool.buffer_max);
        (limit / (4 * floats.max(1)) as u64) as usize
    }

    /// Divides `0..rows` into ranges of at most `max_rows` rows.
    pub(crate) fn chunks(rows: usize, max_rows: usize) -> impl Iterator<Item = Range<usize>> {
        let max_rows = max_rows.max(1);
        (0..rows.div_ceil(max_rows)).map(move |i| i * max_rows..((i + 1) * max_rows).min(rows))
    }

    /// Returns the allocated device memory, bytes, free buffers included.
    pub fn allocated_bytes(&self) -> u64 {
        self.pool.allocated.load(Relaxed)
    }

    /// Returns the largest value of [`Gpu::allocated_bytes`] so far.
    pub fn peak_allocated_bytes(&self) -> u64 {
        self.pool.allocated_most.load(Relaxed)
    }

    /// Returns the read-backs since the device was opened.
    pub fn read_backs(&self) -> ReadBacks {
        let [count, bytes] = self.pool.read.each_ref().map(|n| n.load(Relaxed));
        ReadBacks { count, bytes }
    }

    /// Waits until the device has executed all submitted work.
    ///
    /// # Errors
    /// [`GpuError::Lost`]; [`GpuError::Refused`] where the driver reports an error.
    pub(crate) fn finish(&self) -> Result<(), GpuError> {
        self.checked("a wait", || {
            let refused = |reason| GpuError::Refused { operation: "a wait".to_owned(), reason };
            wait::idle(&self.device).map_err(refused)
        })
    }

    /// Returns the free buffers to the driver.
    pub fn trim(&self) {
        let mut free = self.pool.free.lock().unwrap_or_else(PoisonError::into_inner);
        for (_, buffer) in free.drain(..) {
            self.pool.allocated.fetch_sub(buffer.size(), Relaxed);
            buffer.destroy();
        }
    }

    pub(crate) fn staging(&self, bytes: u64) -> Result<Buffer, GpuError> {
        self.allocate("read-back", Use::Staging, bytes)
    }
}

/// A pending read-back; its values are available after the submit of the commands that copy them.
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
    /// [`GpuError::Lost`]; [`GpuError::Refused`] where the driver rejects the mapping.
    pub(crate) fn take(self, gpu: &Gpu) -> Result<Vec<T>, GpuError> {
        let mut out = vec![T::zeroed(); self.count];
        self.take_into(gpu, &mut out)?;
        Ok(out)
    }

    /// Waits as [`Reading::take`] does and copies the values to `out`, whose length is the same.
    ///
    /// # Errors
    /// As [`Reading::take`].
    pub(crate) fn take_into(self, gpu: &Gpu, out: &mut [T]) -> Result<(), GpuError> {
        if self.count == 0 {
            return Ok(());
        }
        gpu.pool.read[0].fetch_add(1, Relaxed);
        gpu.pool.read[1].fetch_add(size_of_val(out) as u64, Relaxed);
        let refused =
            |reason: String| GpuError::Refused { operation: "the read-back".to_owned(), reason };
        let read = gpu.checked("the read-back", || {
            let slice = self.staging.raw().slice(..self.staging.bytes());
            wait::map(&gpu.device, &slice).map_err(refused)?;
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
            self.staging.0.mapping_failed.store(true, Relaxed);
        }
        read
    }
}
