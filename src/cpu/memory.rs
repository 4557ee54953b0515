//! How the process keeps memory that it has freed.

/// Asks the C library to keep freed memory for the next allocation rather than give it
/// back to the system: each step of a training frees and takes the same hundreds of MiB,
/// and fresh pages cost more than many a kernel that fills them. The process then stays
/// at its peak. Without effect where the C library is not glibc, and for blocks of
/// more than some 20 MiB on threads other than the main one.
pub fn keep_freed() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        use std::ffi::c_int;
        // SAFETY: glibc's signature.
        unsafe extern "C" {
            fn mallopt(parameter: c_int, value: c_int) -> c_int;
        }
        const M_TRIM_THRESHOLD: c_int = -1;
        const M_MMAP_THRESHOLD: c_int = -3;
        for parameter in [M_MMAP_THRESHOLD, M_TRIM_THRESHOLD] {
            // SAFETY: a call that takes two numbers and refuses what it does not know.
            unsafe {
                mallopt(parameter, c_int::MAX);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    /// Page faults of this process so far.
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    fn faults() -> u64 {
        let stat = std::fs::read_to_string("/proc/thread-self/stat").unwrap();
        stat.rsplit_once(')').unwrap().1.split_whitespace().nth(7).unwrap().parse().unwrap()
    }

    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    #[test]
    fn memory_is_taken_once() {
        super::keep_freed();
        let mut counts = [0; 2];
        for count in &mut counts {
            let before = faults();
            let block = std::hint::black_box(vec![1u8; 16 << 20]);
            assert_eq!(block[12_345], 1);
            *count = faults() - before;
        }
        // 16 MiB are 4,096 pages. A thread other than the main one holds at most 64 MiB.
        assert!(4 * counts[1] < counts[0], "{counts:?}");
    }
}
