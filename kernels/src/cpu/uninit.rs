//! Output buffers that threads write for the first time: no pass of zeros by one thread.
//!
//! Programs, not the library, declare an allocator with huge pages (`tools/cli/src/pages.rs`).

use rayon::prelude::*;
use std::mem::MaybeUninit;

/// A buffer of `n` uninitialised numbers.
pub(crate) struct UninitBuffer<T> {
    data: Vec<T>,
    n: usize,
}

/// A part of an [`UninitBuffer`].
pub(crate) type UninitSlice<T> = [MaybeUninit<T>];

impl<T: Copy + Default + Send> UninitBuffer<T> {
    /// Allocates memory for `n` numbers.
    pub(crate) fn new(n: usize) -> Self {
        Self { data: Vec::with_capacity(n), n }
    }

    /// Iterates over blocks of `size` ≥ 1 in parallel; the last may be shorter.
    pub(crate) fn par_chunks_mut(
        &mut self,
        size: usize,
    ) -> rayon::slice::ChunksMut<'_, MaybeUninit<T>> {
        self.as_mut_slice().par_chunks_mut(size)
    }

    /// Borrows all places.
    pub(crate) fn as_mut_slice(&mut self) -> &mut UninitSlice<T> {
        let room = self.data.spare_capacity_mut();
        let n = self.n.min(room.len());
        &mut room[..n]
    }

    /// Returns the buffer as initialised.
    ///
    /// # Safety
    /// The caller has written every place.
    pub(crate) unsafe fn assume_init(mut self) -> Vec<T> {
        // SAFETY: within the capacity, and written (the caller guarantees it).
        unsafe { self.data.set_len(self.n) };
        self.data
    }
}

/// Fills a block with zeros and returns it as initialised. The calling thread takes the page
/// faults and then has the block in its cache.
#[inline]
pub(crate) fn zeroed<T: Copy + Default>(block: &mut UninitSlice<T>) -> &mut [T] {
    block.fill(MaybeUninit::new(T::default()));
    // SAFETY: the line above wrote every place.
    unsafe { &mut *(block as *mut UninitSlice<T> as *mut [T]) }
}

/// Copies `from` to a block of equal length and returns it as initialised.
///
/// # Panics
/// If the lengths differ.
#[inline]
pub(crate) fn filled<'a, T: Copy>(block: &'a mut UninitSlice<T>, from: &[T]) -> &'a mut [T] {
    assert_eq!(block.len(), from.len(), "uninitialised slice: lengths");
    for (to, from) in block.iter_mut().zip(from) {
        *to = MaybeUninit::new(*from);
    }
    // SAFETY: the line above wrote every place.
    unsafe { &mut *(block as *mut UninitSlice<T> as *mut [T]) }
}

/// Borrows initialised numbers as an uninitialised slice.
///
/// # Safety
/// The caller writes initialised numbers only.
#[inline(always)]
pub(crate) unsafe fn as_uninit<T>(numbers: &mut [T]) -> &mut UninitSlice<T> {
    // SAFETY: the same layout; every place stays written (the caller guarantees it).
    unsafe { &mut *(numbers as *mut [T] as *mut UninitSlice<T>) }
}

/// [`zeros`] uses one thread below this many numbers.
const SMALL: usize = 1 << 17;
/// Numbers per task.
const PART: usize = 1 << 16;

/// Returns the first `n` numbers of `kept`, with the values of its last use. The vector grows
/// and never shrinks, so that each number is initialised once.
pub(crate) fn grown(kept: &mut Vec<f32>, n: usize) -> &mut [f32] {
    if kept.len() < n {
        kept.resize(n, 0.0);
    }
    &mut kept[..n]
}

/// Returns `n` zeros; all threads write them if they are many, because clearing memory and
/// page faults take time.
pub fn zeros(n: usize) -> Vec<f32> {
    if n < SMALL {
        return vec![0.0; n];
    }
    let mut buffer = UninitBuffer::new(n);
    buffer.par_chunks_mut(PART).for_each(|block| {
        zeroed::<f32>(block);
    });
    // SAFETY: the line above initialised every block.
    unsafe { buffer.assume_init() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zeros_are_zeros() {
        for n in [0, 5, SMALL, SMALL + PART + 3] {
            drop(vec![1f32; n]);
            assert_eq!(zeros(n), vec![0.0; n]);
        }
    }

    #[test]
    fn blocks_make_the_whole() {
        for n in [0, 1, 7, 64, 65] {
            let mut buffer = UninitBuffer::<f32>::new(n);
            buffer.par_chunks_mut(8).enumerate().for_each(|(i, block)| {
                let block = zeroed(block);
                assert!(block.iter().all(|v| *v == 0.0));
                block.iter_mut().enumerate().for_each(|(j, v)| *v = (8 * i + j) as f32);
            });
            // SAFETY: the loop above initialised every block.
            let all = unsafe { buffer.assume_init() };
            assert_eq!(all, (0..n).map(|i| i as f32).collect::<Vec<_>>());
        }
    }
}
