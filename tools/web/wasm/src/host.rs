//! Functions that the page supplies; natively they do nothing.

#[cfg(all(target_family = "wasm", target_os = "unknown"))]
#[link(wasm_import_module = "env")]
unsafe extern "C" {
    /// Receives the name of a stage (UTF-8) and the share of the work that is done.
    pub(crate) safe fn progress(stage: *const u8, length: usize, fraction: f32);

    /// Returns once [`resume`] was called. The browser delivers events meanwhile.
    safe fn suspend();

    /// Ends [`suspend`], or the next call of it.
    safe fn resume();
}

/// Lets the library wait for a GPU.
#[cfg(all(target_family = "wasm", target_os = "unknown"))]
pub(crate) fn allow_waiting() {
    subsplat::kernels::gpu::set_gpu_wait(|| suspend(), || resume());
}

#[cfg(not(all(target_family = "wasm", target_os = "unknown")))]
pub(crate) fn progress(_: *const u8, _: usize, _: f32) {}

#[cfg(not(all(target_family = "wasm", target_os = "unknown")))]
pub(crate) fn allow_waiting() {}
