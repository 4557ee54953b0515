//! Functions that the page supplies; natively they do nothing.

#[cfg(all(target_family = "wasm", target_os = "unknown"))]
#[link(wasm_import_module = "env")]
unsafe extern "C" {
    /// Receives the name of a stage (UTF-8) and the share of the work that is done.
    pub(crate) safe fn progress(stage: *const u8, length: usize, fraction: f32);

    /// Returns 1 where the page shows another scene so far.
    safe fn wants_scene() -> u32;

    /// Receives a scene so far: its description (JSON) and its .spz.
    safe fn scene(description: *const u8, length: usize, spz: *const u8, size: usize);

    /// Returns once [`resume`] was called. The browser delivers events meanwhile.
    safe fn suspend();

    /// Ends [`suspend`], or the next call of it.
    safe fn resume();
}

/// Gives the page the scene that `make` describes and encodes, where the page shows another one.
#[cfg(all(target_family = "wasm", target_os = "unknown"))]
pub(crate) fn show(make: impl FnOnce() -> Option<[Vec<u8>; 2]>) {
    if wants_scene() != 0
        && let Some([description, spz]) = make()
    {
        scene(description.as_ptr(), description.len(), spz.as_ptr(), spz.len());
    }
}

/// Lets the library wait for a GPU.
#[cfg(all(target_family = "wasm", target_os = "unknown"))]
pub(crate) fn allow_waiting() {
    subsplat::kernels::gpu::set_gpu_wait(|| suspend(), || resume());
}

#[cfg(not(all(target_family = "wasm", target_os = "unknown")))]
pub(crate) fn progress(_: *const u8, _: usize, _: f32) {}

#[cfg(not(all(target_family = "wasm", target_os = "unknown")))]
pub(crate) fn show(_: impl FnOnce() -> Option<[Vec<u8>; 2]>) {}

#[cfg(not(all(target_family = "wasm", target_os = "unknown")))]
pub(crate) fn allow_waiting() {}
