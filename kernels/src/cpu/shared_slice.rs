//! A mutable slice that threads share, each writing places of its own.

use std::marker::PhantomData;
use std::ops::Range;

/// A borrowed slice whose callers guarantee that no two threads write one place.
pub(crate) struct SharedSliceMut<'a, T> {
    start: *mut T,
    len: usize,
    slice: PhantomData<&'a mut [T]>,
}

// SAFETY: a thread can use it as a part of the `&mut [T]` that it borrows; the callers of the
// methods below guarantee that the parts are disjoint.
unsafe impl<T: Send> Sync for SharedSliceMut<'_, T> {}
// SAFETY: as above.
unsafe impl<T: Send> Send for SharedSliceMut<'_, T> {}

impl<'a, T> SharedSliceMut<'a, T> {
    /// Shares `slice`.
    pub(crate) fn new(slice: &'a mut [T]) -> Self {
        Self { start: slice.as_mut_ptr(), len: slice.len(), slice: PhantomData }
    }

    /// Returns the address of place `i`, for a prefetch or a kernel.
    #[inline(always)]
    pub(crate) fn address(&self, i: usize) -> *const T {
        self.start.wrapping_add(i)
    }

    /// Writes `v` at place `i`; does nothing if that lies outside.
    ///
    /// # Safety
    /// No other thread reads or writes place `i` at the same time.
    #[inline(always)]
    pub(crate) unsafe fn write(&self, i: usize, v: T) {
        if i < self.len {
            // SAFETY: inside the slice, and this thread's alone (the caller guarantees it).
            unsafe { self.start.add(i).write(v) }
        }
    }

    /// Borrows the places of `range`, clipped to the slice.
    ///
    /// # Safety
    /// No other reference to any of these places is used while this one lives.
    #[inline(always)]
    #[expect(clippy::mut_from_ref, reason = "the purpose of this type")]
    pub(crate) unsafe fn part(&self, range: Range<usize>) -> &mut [T] {
        let past = range.end.min(self.len);
        let first = range.start.min(past);
        // SAFETY: inside the slice, and not aliased (the caller guarantees it).
        unsafe { std::slice::from_raw_parts_mut(self.start.add(first), past - first) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_those_of_the_slice() {
        let mut v: Vec<u32> = (0..10).collect();
        let shared = SharedSliceMut::new(&mut v);
        // SAFETY: one thread, and no two parts alive at once.
        unsafe {
            shared.write(3, 30);
            shared.write(10, 1);
            shared.part(8..20).fill(7);
            assert_eq!(shared.part(12..20).len(), 0);
        }
        assert_eq!(v, [0, 1, 2, 30, 4, 5, 6, 7, 7, 7]);
    }
}
