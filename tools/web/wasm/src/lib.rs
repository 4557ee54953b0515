//! The library for the page in `tools/web`: photographs in, Gaussians out.
//!
//! A WebAssembly module with plain functions and numbers. JavaScript asks for memory with [`input`],
//! writes bytes there and calls one of the functions below. Each returns 1 on success. The answer, or
//! the message of an error, then lies at [`output`], [`output_length`] bytes long, until the next
//! call. The imports `env.progress`, `env.suspend` and `env.resume` are those of `host.rs`. The other
//! imports belong to wgpu, and wasm-bindgen generates them (`tools/web/bindgen`).
//!
//! With a GPU, [`reconstruct`] suspends while the device works: JavaScript calls it through
//! `WebAssembly.promising`, and calls no other function until it returns.
//!
//! The module has one thread and belongs into a Web Worker: a reconstruction blocks for seconds.

mod host;
mod session;

use session::Session;
use std::cell::RefCell;

thread_local! {
    static SESSION: RefCell<Session> = RefCell::new(Session::default());
    static INPUT: RefCell<Vec<u8>> = const { RefCell::new(Vec::new()) };
    static OUTPUT: RefCell<Vec<u8>> = const { RefCell::new(Vec::new()) };
}

/// Runs `work` with the session and the input, stores its answer, and returns 1 for success.
fn answer(work: impl FnOnce(&mut Session, Vec<u8>) -> Result<Vec<u8>, String>) -> u32 {
    let input = INPUT.take();
    let result = SESSION.with_borrow_mut(|session| work(session, input));
    let success = u32::from(result.is_ok());
    OUTPUT.set(result.unwrap_or_else(String::into_bytes));
    success
}

/// Makes room for the next call's input and returns its address.
#[unsafe(no_mangle)]
pub extern "C" fn input(length: usize) -> *mut u8 {
    INPUT.with_borrow_mut(|bytes| {
        *bytes = vec![0; length];
        bytes.as_mut_ptr()
    })
}

/// Returns the address of the last answer.
#[unsafe(no_mangle)]
pub extern "C" fn output() -> *const u8 {
    OUTPUT.with_borrow(|bytes| bytes.as_ptr())
}

/// Returns the length of the last answer, bytes.
#[unsafe(no_mangle)]
pub extern "C" fn output_length() -> usize {
    OUTPUT.with_borrow(Vec::len)
}

/// Forgets photographs and scene.
#[unsafe(no_mangle)]
pub extern "C" fn reset() {
    SESSION.set(Session::default());
}

/// Adds a photograph. Input: its name, `name_length` bytes, then the file. Answer: JSON with
/// `width`, `height` and `warnings`.
#[unsafe(no_mangle)]
pub extern "C" fn add_photograph(name_length: usize) -> u32 {
    answer(|session, input| session.add_photograph(&input, name_length))
}

/// Finds the cameras of the photographs and reconstructs their scene. Input: JSON with the texts
/// `upscale` (1 to 8), `effort` (0: the network alone; 1: fitted to the photographs; 2: refined too),
/// `size` (side of a square with as many pixels as the network's input), `network` (the device:
/// `auto`, `cpu` or `gpu`) and `focal` (focal length as of 35 mm film, mm; may be empty). Where the device cannot be
/// opened, the CPU does the work. Answer: JSON with `gaussians`, `background`, `cameras` (of the photographs, with a
/// `name`), `verdict` (`trust`, `reason`), `warnings` and `network`.
#[unsafe(no_mangle)]
pub extern "C" fn reconstruct() -> u32 {
    answer(|session, request| session.reconstruct(&request))
}

/// Writes the scene. Input: the format's extension (`ply`, `spz`, `sog`, `glb` or `splat`). Answer: the
/// file.
#[unsafe(no_mangle)]
pub extern "C" fn save() -> u32 {
    answer(|session, input| session.save(&input))
}
