//! Large results without a pass of zeros by one thread before the kernel's own.

use rayon::prelude::*;
use std::mem::MaybeUninit;

/// `n` numbers that are yet to be written.
pub(crate) struct UninitBuffer<T> {
    data: Vec<T>,
    n: usize,
}

/// A part of a [`UninitBuffer`].
pub(crate) type UninitSlice<T> = [MaybeUninit<T>];

impl<T: Copy + Default + Send> UninitBuffer<T> {
    /// Room for `n`.
    pub(crate) fn new(n: usize) -> Self {
        Self { data: Vec::with_capacity(n), n }
    }

    /// Blocks of `size` ≥ 1, the last one maybe shorter.
    pub(crate) fn par_chunks_mut(
        &mut self,
        size: usize,
    ) -> rayon::slice::ChunksMut<'_, MaybeUninit<T>> {
        self.as_mut_slice().par_chunks_mut(size)
    }

    /// All places at once.
    pub(crate) fn as_mut_slice(&mut self) -> &mut UninitSlice<T> {
        let room = self.data.spare_capacity_mut();
        let n = self.n.min(room.len());
        &mut room[..n]
    }

    /// All of it.
    ///
    /// # Safety
    /// Every place was written.
    pub(crate) unsafe fn assume_init(mut self) -> Vec<T> {
        // SAFETY: within the capacity, and written (the caller's promise).
        unsafe { self.data.set_len(self.n) };
        self.data
    }
}

/// A block filled with zeros, while it lies in the cache of the thread that goes on
/// with it. First writes, and so page faults, fall on all threads.
#[inline]
pub(crate) fn zeroed<T: Copy + Default>(block: &mut UninitSlice<T>) -> &mut [T] {
    block.fill(MaybeUninit::new(T::default()));
    // SAFETY: every place was just written.
    unsafe { &mut *(block as *mut UninitSlice<T> as *mut [T]) }
}

/// A block with the numbers of `from`, which is as long.
///
/// # Panics
/// Where it is not.
#[inline]
pub(crate) fn filled<'a, T: Copy>(block: &'a mut UninitSlice<T>, from: &[T]) -> &'a mut [T] {
    assert_eq!(block.len(), from.len(), "fresh block: lengths");
    for (to, from) in block.iter_mut().zip(from) {
        *to = MaybeUninit::new(*from);
    }
    // SAFETY: every place was just written.
    unsafe { &mut *(block as *mut UninitSlice<T> as *mut [T]) }
}

/// Numbers that are there already, to be written over.
///
/// # Safety
/// What is written are numbers, never memory that nobody wrote.
#[inline(always)]
pub(crate) unsafe fn as_uninit<T>(numbers: &mut [T]) -> &mut UninitSlice<T> {
    // SAFETY: the same layout; every place stays written (the caller's promise).
    unsafe { &mut *(numbers as *mut [T] as *mut UninitSlice<T>) }
}

/// Numbers below which [`zeros`] is not worth several threads.
const SMALL: usize = 1 << 17;
/// Numbers a task.
const PART: usize = 1 << 16;

/// The first `n` of what `kept` holds, with what the last use left there: it never
/// shrinks, so that no use fills again what another one has made.
pub(crate) fn grown(kept: &mut Vec<f32>, n: usize) -> &mut [f32] {
    if kept.len() < n {
        kept.resize(n, 0.0);
    }
    &mut kept[..n]
}

/// `n` zeros, written by all threads where there are many: memory that was used before
/// is to be cleared, new memory to be faulted in.
pub fn zeros(n: usize) -> Vec<f32> {
    if n < SMALL {
        return vec![0.0; n];
    }
    let mut buffer = UninitBuffer::new(n);
    buffer.par_chunks_mut(PART).for_each(|block| {
        zeroed::<f32>(block);
    });
    // SAFETY: the line above started every block.
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
            // SAFETY: the loop above started every block.
            let all = unsafe { buffer.assume_init() };
            assert_eq!(all, (0..n).map(|i| i as f32).collect::<Vec<_>>());
        }
    }
}
