//! An allocator for programs that run the network: large blocks lie on huge pages and
//! are used again.
//!
//! Tensors of megabytes come and go by the hundred. The system's allocator asks the
//! kernel for each, which clears it in pages of 4 KiB, a fault each: a seventh of the
//! time of two photographs to a picture. Here a block that is freed waits, one piece
//! with its neighbours, and the shortest piece that is long enough gives its front to
//! the next request: a call after the first hardly asks the kernel. What waits never
//! makes the process larger than its largest set of living blocks: a request that
//! finds nothing fitting first returns to the kernel as much as it asks for, as far as
//! there is any.
//!
//! A program declares it; a library must not:
//! ```ignore
//! #[global_allocator]
//! static PAGES: subsplat_cli::pages::Pages = subsplat_cli::pages::Pages;
//! ```
//! Elsewhere than on Linux on x86-64 and AArch64 it is the system's allocator.

use std::alloc::{GlobalAlloc, Layout, System};

/// The allocator (module doc).
#[derive(Clone, Copy, Debug, Default)]
pub struct Pages;

/// Least bytes of a block that is kept: what a huge page holds on x86-64 and most
/// AArch64 kernels.
const HUGE: usize = 2 << 20;

/// Whether a block of this layout is ours.
fn ours(layout: &Layout) -> bool {
    cfg!(all(target_os = "linux", any(target_arch = "x86_64", target_arch = "aarch64")))
        && layout.size() >= HUGE
        && layout.align() <= 4096
}

// SAFETY: small blocks are the system's. A large one is a mapping of its own, as long
// as the layout in whole pages, so its length is known when it comes back; it is
// handed out again, whole or in parts, only after that.
unsafe impl GlobalAlloc for Pages {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        match ours(&layout) {
            true => large::take(layout.size()).0,
            // SAFETY: the caller's.
            false => unsafe { System.alloc(layout) },
        }
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        match ours(&layout) {
            true => large::give(at, layout.size()),
            // SAFETY: the caller's; small blocks came from there.
            false => unsafe { System.dealloc(at, layout) },
        }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        if !ours(&layout) {
            // SAFETY: the caller's.
            return unsafe { System.alloc_zeroed(layout) };
        }
        let (at, used) = large::take(layout.size());
        if used && !at.is_null() {
            // SAFETY: a block of this size.
            unsafe { at.write_bytes(0, layout.size()) };
        }
        at
    }

    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: the caller's: `size` fits a layout of this alignment.
        let wanted = unsafe { Layout::from_size_align_unchecked(size, layout.align()) };
        match ours(&layout) || ours(&wanted) {
            // SAFETY: the caller's; both are small.
            false => unsafe { System.realloc(at, layout, size) },
            // SAFETY: the new block holds the lesser of both sizes, and the old one
            // came from here.
            true => unsafe {
                let to = self.alloc(wanted);
                if !to.is_null() {
                    to.copy_from_nonoverlapping(at, layout.size().min(size));
                    self.dealloc(at, layout);
                }
                to
            },
        }
    }
}

#[cfg(not(all(target_os = "linux", any(target_arch = "x86_64", target_arch = "aarch64"))))]
mod large {
    /// Never called: no block is ours.
    pub(super) fn take(_: usize) -> (*mut u8, bool) {
        (std::ptr::null_mut(), false)
    }

    pub(super) fn give(_: *mut u8, _: usize) {}

    #[cfg(test)]
    pub(super) fn forget() {}
}

#[cfg(all(target_os = "linux", any(target_arch = "x86_64", target_arch = "aarch64")))]
mod large {
    use super::HUGE;
    use std::ffi::{c_int, c_void};
    use std::sync::{Mutex, MutexGuard, PoisonError};

    // Linux's PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS and MADV_HUGEPAGE.
    const READ_WRITE: c_int = 3;
    const PRIVATE_ANONYMOUS: c_int = 0x22;
    const HUGE_PAGES: c_int = 14;

    unsafe extern "C" {
        fn mmap(
            at: *mut c_void,
            length: usize,
            protection: c_int,
            flags: c_int,
            file: c_int,
            offset: i64,
        ) -> *mut c_void;
        fn munmap(at: *mut c_void, length: usize) -> c_int;
        fn madvise(at: *mut c_void, length: usize, advice: c_int) -> c_int;
    }

    /// Most pieces that wait.
    const SLOTS: usize = 128;
    /// Lengths are multiples of the largest page size that these kernels have.
    const PAGE: usize = 1 << 16;

    /// Memory that waits, resident for the most part.
    #[derive(Clone, Copy)]
    struct Piece {
        at: usize,
        length: usize,
        /// When it came: the least goes first.
        stamp: u64,
    }

    /// What waits, by address; neighbours are one piece, whatever mappings they came from.
    struct Waiting {
        pieces: [Piece; SLOTS],
        n: usize,
        stamp: u64,
    }

    static WAITING: Mutex<Waiting> = Mutex::new(Waiting {
        pieces: [Piece { at: 0, length: 0, stamp: 0 }; SLOTS],
        n: 0,
        stamp: 0,
    });

    impl Waiting {
        fn remove(&mut self, i: usize) -> Piece {
            let piece = self.pieces[i];
            self.pieces.copy_within(i + 1..self.n, i);
            self.n -= 1;
            piece
        }

        fn oldest(&self) -> Option<usize> {
            (0..self.n).min_by_key(|&i| self.pieces[i].stamp)
        }

        /// The front of the shortest piece that is long enough.
        fn take(&mut self, length: usize) -> Option<usize> {
            let fits = |&i: &usize| self.pieces[i].length >= length;
            let i = (0..self.n).filter(fits).min_by_key(|&i| self.pieces[i].length)?;
            let piece = &mut self.pieces[i];
            let at = piece.at;
            piece.at += length;
            piece.length -= length;
            if piece.length == 0 {
                self.remove(i);
            }
            Some(at)
        }

        /// Takes a block back; what has no room is for the caller to unmap.
        fn give(&mut self, at: usize, length: usize) -> Option<Piece> {
            self.stamp += 1;
            let mut new = Piece { at, length, stamp: self.stamp };
            let mut i = self.pieces[..self.n].partition_point(|p| p.at < at);
            if i < self.n && self.pieces[i].at == at + length {
                new.length += self.remove(i).length;
            }
            if i > 0 && self.pieces[i - 1].at + self.pieces[i - 1].length == at {
                i -= 1;
                let before = self.remove(i);
                new = Piece { at: before.at, length: before.length + new.length, ..new };
            }
            let out = match self.n == SLOTS {
                true => self.oldest().map(|oldest| {
                    i -= usize::from(oldest < i);
                    self.remove(oldest)
                }),
                false => None,
            };
            self.pieces.copy_within(i..self.n, i + 1);
            self.pieces[i] = new;
            self.n += 1;
            out
        }

        /// Up to `length` bytes of what waits, the oldest piece's.
        fn part(&mut self, length: usize) -> Option<Piece> {
            let i = self.oldest()?;
            let piece = &mut self.pieces[i];
            if piece.length <= length {
                return Some(self.remove(i));
            }
            piece.length -= length;
            Some(Piece { at: piece.at + piece.length, length, ..*piece })
        }
    }

    fn waiting() -> MutexGuard<'static, Waiting> {
        WAITING.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// A block of `size` bytes, and whether it was used before (else it is zero). Null if
    /// there is no memory.
    pub(super) fn take(size: usize) -> (*mut u8, bool) {
        let Some(length) = size.checked_next_multiple_of(PAGE) else {
            return (std::ptr::null_mut(), false);
        };
        if let Some(at) = waiting().take(length) {
            return (at as *mut u8, true);
        }
        let mut left = length;
        while left > 0 {
            let Some(piece) = waiting().part(left) else { break };
            left -= piece.length;
            unmap(piece.at, piece.length);
        }
        (map(length), false)
    }

    /// Takes a block back.
    pub(super) fn give(at: *mut u8, size: usize) {
        let out = waiting().give(at as usize, size.next_multiple_of(PAGE));
        if let Some(piece) = out {
            unmap(piece.at, piece.length);
        }
    }

    /// Sends all that waits back to the kernel.
    #[cfg(test)]
    pub(super) fn forget() {
        while let Some(piece) = waiting().part(usize::MAX) {
            unmap(piece.at, piece.length);
        }
    }

    /// New pages at a multiple of [`HUGE`]; null if there are none.
    fn map(length: usize) -> *mut u8 {
        let Some(room) = length.checked_add(HUGE) else { return std::ptr::null_mut() };
        // SAFETY: a new mapping, at no address asked for.
        let all = unsafe { mmap(std::ptr::null_mut(), room, READ_WRITE, PRIVATE_ANONYMOUS, -1, 0) };
        // MAP_FAILED.
        if all as isize == -1 {
            return std::ptr::null_mut();
        }
        let first = all as usize;
        let at = first.next_multiple_of(HUGE);
        // The parts before and after the block.
        unmap(first, at - first);
        unmap(at + length, first + room - at - length);
        // SAFETY: advice about the mapping just made, whole huge pages of it, so that
        // the end does not hold more than it must. A refusal changes nothing.
        unsafe { madvise(at as *mut c_void, length / HUGE * HUGE, HUGE_PAGES) };
        at as *mut u8
    }

    fn unmap(at: usize, length: usize) {
        if length > 0 {
            // SAFETY: pages of a mapping of ours that nobody holds any more.
            unsafe { munmap(at as *mut c_void, length) };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Blocks that wait are one list for the process: what one test takes may send
    /// another's away.
    static ALONE: std::sync::Mutex<()> = std::sync::Mutex::new(());

    fn alone() -> std::sync::MutexGuard<'static, ()> {
        let guard = ALONE.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        large::forget();
        guard
    }

    fn filled(layout: Layout, value: u8) -> *mut u8 {
        // SAFETY: the layout is not empty; the block is as long.
        unsafe {
            let at = Pages.alloc(layout);
            assert!(!at.is_null());
            at.write_bytes(value, layout.size());
            at
        }
    }

    #[test]
    fn blocks_are_used_again_and_zeroed_when_asked() {
        let _alone = alone();
        let layout = Layout::from_size_align(3 * HUGE + 12_345, 64).unwrap();
        let first = filled(layout, 7);
        // SAFETY: allocated above with this layout; then blocks as long as they are read.
        unsafe {
            Pages.dealloc(first, layout);
            let again = Pages.alloc_zeroed(layout);
            if ours(&layout) {
                assert_eq!(again, first, "the block that waits is the one that is given");
            }
            let all = std::slice::from_raw_parts(again, layout.size());
            assert!(all.iter().all(|v| *v == 0));
            Pages.dealloc(again, layout);
        }
    }

    #[test]
    fn pieces_are_cut_and_joined() {
        let _alone = alone();
        let layout = |huge: usize| Layout::from_size_align(huge * HUGE, 8).unwrap();
        let long = filled(layout(6), 1);
        // SAFETY: each block comes back with the layout that it was asked for with.
        unsafe {
            Pages.dealloc(long, layout(6));
            let parts = [filled(layout(2), 2), filled(layout(3), 3)];
            if ours(&layout(1)) {
                assert_eq!(parts[0], long, "the front of the piece that waits");
                assert_eq!(parts[1], long.add(2 * HUGE), "then what is left of it");
            }
            let all = std::slice::from_raw_parts(parts[0], 2 * HUGE);
            assert!(all.iter().all(|v| *v == 2));
            // The one before joins what waits behind it, or the other way round.
            for first in [0, 1] {
                let lengths = [2, 3];
                Pages.dealloc(parts[first], layout(lengths[first]));
                Pages.dealloc(parts[1 - first], layout(lengths[1 - first]));
                if ours(&layout(1)) {
                    assert_eq!(large::take(6 * HUGE), (long, true), "one piece again");
                    large::give(long, 6 * HUGE);
                }
                if first == 0 {
                    let parts = [filled(layout(2), 2), filled(layout(3), 3)];
                    assert!(!ours(&layout(1)) || parts == [long, long.add(2 * HUGE)]);
                }
            }
        }
    }

    #[test]
    fn growing_and_shrinking_keep_what_is_there() {
        let _alone = alone();
        let (small, large) = (1 << 10, HUGE + 1);
        let layout = |size| Layout::from_size_align(size, 8).unwrap();
        let at = filled(layout(small), 9);
        // SAFETY: each call names the layout that the block has.
        unsafe {
            let at = Pages.realloc(at, layout(small), large);
            at.add(small).write_bytes(3, large - small);
            let at = Pages.realloc(at, layout(large), 2 * large);
            let at = Pages.realloc(at, layout(2 * large), small + 1);
            let all = std::slice::from_raw_parts(at, small + 1);
            assert!(all[..small].iter().all(|v| *v == 9) && all[small] == 3);
            Pages.dealloc(at, layout(small + 1));
        }
    }

    #[test]
    fn many_threads_get_blocks_of_their_own() {
        let _alone = alone();
        let work = |seed: usize| {
            for i in 0..20 {
                let layout = Layout::from_size_align(HUGE + 4096 * ((seed + i) % 3), 8).unwrap();
                let value = (16 * seed + i) as u8;
                let at = filled(layout, value);
                std::thread::yield_now();
                // SAFETY: as long as it is read, then given back with its layout.
                unsafe {
                    let all = std::slice::from_raw_parts(at, layout.size());
                    assert!(all.iter().all(|v| *v == value));
                    Pages.dealloc(at, layout);
                }
            }
        };
        std::thread::scope(|s| (0..4).for_each(|seed| drop(s.spawn(move || work(seed)))));
    }
}
