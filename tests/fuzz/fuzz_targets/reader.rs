//! One target of `subsplat_fuzz::targets`, the one that the environment variable `SUBSPLAT_FUZZ_TARGET` names. A
//! program for each would be linked 43 times.
#![no_main]

use std::sync::LazyLock;
use subsplat_fuzz::targets::{Target, target};

static TARGET: LazyLock<Target> = LazyLock::new(|| {
    let name = std::env::var("SUBSPLAT_FUZZ_TARGET").unwrap_or_default();
    target(&name).unwrap_or_else(|| panic!("SUBSPLAT_FUZZ_TARGET={name}: expected a name of subsplat_fuzz::targets"))
});

libfuzzer_sys::fuzz_target!(
    init: {
        // Work for a second thread takes longer to hand over than inputs of a few bytes take to read.
        rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build_global().unwrap();
        LazyLock::force(&TARGET);
    },
    |bytes: &[u8]| TARGET(bytes)
);
