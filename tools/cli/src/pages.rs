//! An allocator for programs that run the network. It places large blocks on huge pages and
//! reuses them.
//!
//! The network allocates and frees hundreds of tensors of megabytes. The system's allocator
//! maps each of them anew. The kernel then clears it in pages of 4 KiB with one fault each, which
//! takes a seventh of the time from two photographs to a picture. Here freed blocks go to a free
//! list, where adjacent blocks are merged. A request takes the front of the shortest free block
//! that is long enough. After the first call of the network, few requests reach the kernel.
//!
//! The free list never makes the process larger than its largest set of live blocks and what
//! [`keep_free`] allows: a request without a fitting free block first returns as many bytes to the kernel as
//! it needs.
//!
//! A program declares the allocator; a library must not:
//! ```ignore
//! #[global_allocator]
//! static PAGES: subsplat_cli::pages::Pages = subsplat_cli::pages::Pages;
//! ```
//! On other systems than Linux on x86-64 and AArch64 it is the system's allocator.
//!
//! A request that finds no memory ends the program with one line and the exit code 1, on Unix. Rust's own answer is
//! an abort, which writes a backtrace and a core dump, and the standard library has no stable way to replace it.

use std::alloc::{GlobalAlloc, Layout, System};

/// The allocator (module doc).
#[derive(Clone, Copy, Debug, Default)]
pub struct Pages;

/// Returns free memory to the kernel, between stages that allocate blocks of other sizes.
///
/// The matching of points frees hundreds of buffers of one to two megabytes, which glibc keeps:
/// 26 MiB after two photographs of 1080x1920. The refinement frees large blocks beside which the
/// pictures of a finished scene need new ones below 2 MiB.
pub fn trim() {
    large::clear();
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        unsafe extern "C" {
            fn malloc_trim(pad: usize) -> std::ffi::c_int;
        }
        // SAFETY: the function of glibc has no precondition, and is safe on any thread.
        unsafe { malloc_trim(0) };
    }
}

/// Lets `bytes` bytes of free blocks stay while a request that fits none of them gets new memory. Default: 0.
///
/// A loop that frees some of its blocks late takes a short block from the front of a long free one, and finds
/// no place for the next long one: it would return and map the same memory in each round.
pub fn keep_free(bytes: usize) {
    large::keep_free(bytes);
}

/// Size of a huge page on x86-64 and on most AArch64 kernels, bytes. Smaller blocks go to the
/// system's allocator.
const HUGE: usize = 2 << 20;

/// True if this allocator manages blocks of this layout.
fn is_large(layout: &Layout) -> bool {
    cfg!(all(target_os = "linux", any(target_arch = "x86_64", target_arch = "aarch64")))
        && layout.size() >= HUGE
        && layout.align() <= 4096
}

// SAFETY: small blocks are the system's. A large block has the length of its layout in whole
// pages, so its length is known when it is freed. It is reused, whole or in parts, only after
// that.
unsafe impl GlobalAlloc for Pages {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let at = if is_large(&layout) {
            large::allocate(layout.size()).0
        } else {
            // SAFETY: the caller's.
            unsafe { System.alloc(layout) }
        };
        exhausted::unless_null(at, layout.size())
    }

    unsafe fn dealloc(&self, at: *mut u8, layout: Layout) {
        if is_large(&layout) {
            return large::free(at, layout.size());
        }
        // SAFETY: the caller's; small blocks came from there.
        unsafe { System.dealloc(at, layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        if !is_large(&layout) {
            // SAFETY: the caller's.
            let at = unsafe { System.alloc_zeroed(layout) };
            return exhausted::unless_null(at, layout.size());
        }
        let (at, used) = large::allocate(layout.size());
        let at = exhausted::unless_null(at, layout.size());
        if used && !at.is_null() {
            // SAFETY: a block of this size.
            unsafe { at.write_bytes(0, layout.size()) };
        }
        at
    }

    unsafe fn realloc(&self, at: *mut u8, layout: Layout, size: usize) -> *mut u8 {
        // SAFETY: the caller's: `size` fits a layout of this alignment.
        let wanted = unsafe { Layout::from_size_align_unchecked(size, layout.align()) };
        if !is_large(&layout) && !is_large(&wanted) {
            // SAFETY: the caller's; both are small.
            let to = unsafe { System.realloc(at, layout, size) };
            return exhausted::unless_null(to, size);
        }
        // SAFETY: the new block holds the lesser of both sizes, and the old one came from here.
        unsafe {
            let to = self.alloc(wanted);
            if !to.is_null() {
                to.copy_from_nonoverlapping(at, layout.size().min(size));
                self.dealloc(at, layout);
            }
            to
        }
    }
}

/// The end of a program without memory.
mod exhausted {
    /// Returns `at`, a block of `size` bytes; where it is null on Unix, ends the program.
    #[inline]
    pub(super) fn unless_null(at: *mut u8, size: usize) -> *mut u8 {
        #[cfg(unix)]
        if at.is_null() {
            end(size);
        }
        let _ = size;
        at
    }

    /// The line that the program ends with, in `buffer`; nothing here allocates.
    #[cfg(any(unix, test))]
    pub(super) fn line(size: usize, buffer: &mut [u8; 256]) -> &[u8] {
        use std::io::Write;
        let mut rest = &mut buffer[..];
        // A line that is too long is cut.
        let _ = writeln!(
            rest,
            "error: not enough memory: {} KiB more were needed; --quality fast, fewer photographs and smaller \
             pictures (--size) need less",
            size.div_ceil(1024)
        );
        let left = rest.len();
        &buffer[..buffer.len() - left]
    }

    #[cfg(unix)]
    #[cold]
    fn end(size: usize) -> ! {
        use std::ffi::{c_int, c_void};
        use std::sync::atomic::{AtomicBool, Ordering};
        unsafe extern "C" {
            fn write(file: c_int, from: *const c_void, length: usize) -> isize;
            fn _exit(code: c_int) -> !;
        }
        /// Set by the first thread without memory; the others wait for the end.
        static ENDS: AtomicBool = AtomicBool::new(false);
        while ENDS.swap(true, Ordering::Relaxed) {
            std::thread::yield_now();
        }
        let mut buffer = [0; 256];
        let line = line(size, &mut buffer);
        // SAFETY: the buffer is as long as it is read; neither function allocates, and the process ends.
        unsafe {
            write(2, line.as_ptr().cast(), line.len());
            _exit(1)
        }
    }
}

#[cfg(not(all(target_os = "linux", any(target_arch = "x86_64", target_arch = "aarch64"))))]
mod large {
    /// Never called: no block is large here.
    pub(super) fn allocate(_: usize) -> (*mut u8, bool) {
        (std::ptr::null_mut(), false)
    }

    pub(super) fn free(_: *mut u8, _: usize) {}

    pub(super) fn clear() {}

    pub(super) fn keep_free(_: usize) {}
}

#[cfg(all(target_os = "linux", any(target_arch = "x86_64", target_arch = "aarch64")))]
mod large {
    use super::HUGE;
    use std::ffi::{c_int, c_void};
    use std::sync::atomic::{AtomicUsize, Ordering};
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

    /// Largest number of free blocks.
    const SLOTS: usize = 128;
    /// Lengths are multiples of the largest page size that these kernels have.
    const PAGE: usize = 1 << 16;

    /// A free block of memory, mostly resident.
    #[derive(Clone, Copy)]
    struct Block {
        at: usize,
        length: usize,
        /// Number of the call that freed it; the lowest is unmapped first.
        stamp: u64,
    }

    /// Free blocks by address. Adjacent blocks are merged, also those of different mappings.
    struct FreeList {
        blocks: [Block; SLOTS],
        n: usize,
        stamp: u64,
    }

    static FREE: Mutex<FreeList> = Mutex::new(FreeList {
        blocks: [Block { at: 0, length: 0, stamp: 0 }; SLOTS],
        n: 0,
        stamp: 0,
    });

    /// Bytes of free blocks that a request may leave ([`super::keep_free`]).
    static KEPT: AtomicUsize = AtomicUsize::new(0);

    pub(super) fn keep_free(bytes: usize) {
        KEPT.store(bytes, Ordering::Relaxed);
    }

    impl FreeList {
        fn bytes(&self) -> usize {
            self.blocks[..self.n].iter().map(|block| block.length).sum()
        }

        fn remove(&mut self, i: usize) -> Block {
            let block = self.blocks[i];
            self.blocks.copy_within(i + 1..self.n, i);
            self.n -= 1;
            block
        }

        fn oldest(&self) -> Option<usize> {
            (0..self.n).min_by_key(|&i| self.blocks[i].stamp)
        }

        /// Removes the front of the shortest block that is long enough.
        fn take(&mut self, length: usize) -> Option<usize> {
            let fits = |&i: &usize| self.blocks[i].length >= length;
            let i = (0..self.n).filter(fits).min_by_key(|&i| self.blocks[i].length)?;
            let block = &mut self.blocks[i];
            let at = block.at;
            block.at += length;
            block.length -= length;
            if block.length == 0 {
                self.remove(i);
            }
            Some(at)
        }

        /// Inserts a block. Returns the oldest block where the list is full; the caller unmaps it.
        fn insert(&mut self, at: usize, length: usize) -> Option<Block> {
            self.stamp += 1;
            let mut new = Block { at, length, stamp: self.stamp };
            let mut i = self.blocks[..self.n].partition_point(|p| p.at < at);
            if i < self.n && self.blocks[i].at == at + length {
                new.length += self.remove(i).length;
            }
            if i > 0 && self.blocks[i - 1].at + self.blocks[i - 1].length == at {
                i -= 1;
                let before = self.remove(i);
                new = Block { at: before.at, length: before.length + new.length, ..new };
            }
            let out = if self.n == SLOTS {
                self.oldest().map(|oldest| {
                    i -= usize::from(oldest < i);
                    self.remove(oldest)
                })
            } else {
                None
            };
            self.blocks.copy_within(i..self.n, i + 1);
            self.blocks[i] = new;
            self.n += 1;
            out
        }

        /// Removes up to `length` bytes of the oldest block.
        fn take_oldest(&mut self, length: usize) -> Option<Block> {
            let i = self.oldest()?;
            let block = &mut self.blocks[i];
            if block.length <= length {
                return Some(self.remove(i));
            }
            block.length -= length;
            Some(Block { at: block.at + block.length, length, ..*block })
        }
    }

    fn free_list() -> MutexGuard<'static, FreeList> {
        FREE.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Allocates a block of `size` bytes. Returns also whether it was used before; otherwise it is
    /// zero. The pointer is null without memory.
    pub(super) fn allocate(size: usize) -> (*mut u8, bool) {
        let Some(length) = size.checked_next_multiple_of(PAGE) else {
            return (std::ptr::null_mut(), false);
        };
        if let Some(at) = free_list().take(length) {
            return (at as *mut u8, true);
        }
        let mut left = length.min(free_list().bytes().saturating_sub(KEPT.load(Ordering::Relaxed)));
        while left > 0 {
            let Some(block) = free_list().take_oldest(left) else { break };
            left -= block.length;
            unmap(block.at, block.length);
        }
        (map(length), false)
    }

    /// Frees a block.
    pub(super) fn free(at: *mut u8, size: usize) {
        let out = free_list().insert(at as usize, size.next_multiple_of(PAGE));
        if let Some(block) = out {
            unmap(block.at, block.length);
        }
    }

    /// Unmaps all free blocks.
    pub(super) fn clear() {
        while let Some(block) = free_list().take_oldest(usize::MAX) {
            unmap(block.at, block.length);
        }
    }

    /// Maps new pages at a multiple of [`HUGE`]; returns null without memory.
    fn map(length: usize) -> *mut u8 {
        let Some(reserved) = length.checked_add(HUGE) else { return std::ptr::null_mut() };
        // SAFETY: a new mapping at an address of the kernel's choice.
        let all =
            unsafe { mmap(std::ptr::null_mut(), reserved, READ_WRITE, PRIVATE_ANONYMOUS, -1, 0) };
        // MAP_FAILED.
        if all as isize == -1 {
            return std::ptr::null_mut();
        }
        let first = all as usize;
        let at = first.next_multiple_of(HUGE);
        // The parts before and after the block.
        unmap(first, at - first);
        unmap(at + length, first + reserved - at - length);
        // SAFETY: advice on whole huge pages of the new mapping. The end keeps small pages, so
        // that it holds no more than necessary. A failure has no effect.
        unsafe { madvise(at as *mut c_void, length / HUGE * HUGE, HUGE_PAGES) };
        at as *mut u8
    }

    fn unmap(at: usize, length: usize) {
        if length > 0 {
            // SAFETY: pages of a mapping of this module that no block uses.
            unsafe { munmap(at as *mut c_void, length) };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The free list belongs to the process, so tests run one after another.
    static ALONE: std::sync::Mutex<()> = std::sync::Mutex::new(());

    fn alone() -> std::sync::MutexGuard<'static, ()> {
        let guard = ALONE.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        large::clear();
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
    fn blocks_are_reused_and_zeroed_on_request() {
        let _alone = alone();
        let layout = Layout::from_size_align(3 * HUGE + 12_345, 64).unwrap();
        let first = filled(layout, 7);
        // SAFETY: allocated above with this layout; then blocks as long as they are read.
        unsafe {
            Pages.dealloc(first, layout);
            let again = Pages.alloc_zeroed(layout);
            if is_large(&layout) {
                assert_eq!(again, first, "the free block is reused");
            }
            let all = std::slice::from_raw_parts(again, layout.size());
            assert!(all.iter().all(|v| *v == 0));
            Pages.dealloc(again, layout);
        }
    }

    #[test]
    fn blocks_are_split_and_merged() {
        let _alone = alone();
        let layout = |huge: usize| Layout::from_size_align(huge * HUGE, 8).unwrap();
        let long = filled(layout(6), 1);
        // SAFETY: each block is freed with the layout of its allocation.
        unsafe {
            Pages.dealloc(long, layout(6));
            let parts = [filled(layout(2), 2), filled(layout(3), 3)];
            if is_large(&layout(1)) {
                assert_eq!(parts[0], long, "the front of the free block");
                assert_eq!(parts[1], long.add(2 * HUGE), "then the rest of it");
            }
            let all = std::slice::from_raw_parts(parts[0], 2 * HUGE);
            assert!(all.iter().all(|v| *v == 2));
            // The lower block is freed first, then the upper one.
            for first in [0, 1] {
                let lengths = [2, 3];
                Pages.dealloc(parts[first], layout(lengths[first]));
                Pages.dealloc(parts[1 - first], layout(lengths[1 - first]));
                if is_large(&layout(1)) {
                    assert_eq!(large::allocate(6 * HUGE), (long, true), "one block again");
                    large::free(long, 6 * HUGE);
                }
                if first == 0 {
                    let parts = [filled(layout(2), 2), filled(layout(3), 3)];
                    assert!(!is_large(&layout(1)) || parts == [long, long.add(2 * HUGE)]);
                }
            }
        }
    }

    #[test]
    fn a_loop_that_frees_late_gets_no_new_memory() {
        let _alone = alone();
        let layout = |huge: usize| Layout::from_size_align(huge * HUGE, 8).unwrap();
        // The short block of a round is freed after that of the next one is allocated.
        let new_blocks = || {
            let (mut short, mut new) = (filled(layout(1), 1), 0);
            for round in 0..10 {
                // SAFETY: each block is freed with the layout of its allocation.
                unsafe {
                    let next = filled(layout(1), 1);
                    Pages.dealloc(short, layout(1));
                    short = next;
                    let (long, used) = large::allocate(8 * HUGE);
                    new += usize::from(!used && round > 3);
                    large::free(long, 8 * HUGE);
                }
            }
            // SAFETY: as above.
            unsafe { Pages.dealloc(short, layout(1)) };
            new
        };
        if is_large(&layout(1)) {
            keep_free(16 * HUGE);
            assert_eq!(new_blocks(), 0);
            keep_free(0);
            large::clear();
            assert_eq!(new_blocks(), 6, "without free memory that may stay");
        }
    }

    #[test]
    fn growing_and_shrinking_keep_the_contents() {
        let _alone = alone();
        let (small, large) = (1 << 10, HUGE + 1);
        let layout = |size| Layout::from_size_align(size, 8).unwrap();
        let at = filled(layout(small), 9);
        // SAFETY: each call passes the block's layout.
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
    fn the_last_line_names_the_size() {
        let mut buffer = [0; 256];
        let line = String::from_utf8(exhausted::line(5_000_000, &mut buffer).to_vec()).unwrap();
        assert!(
            line.starts_with("error: not enough memory: 4883 KiB more were needed; "),
            "{line}"
        );
        assert!(line.ends_with("need less\n"), "{line}");
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
                // SAFETY: the block is as long as it is read, and is freed with its layout.
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
