//! The programs `subsplat` and `subsplat-convert`: command lines over the library's API.
//!
//! The two binaries contain an allocator and one call each; this crate holds what they run,
//! so that they share error reporting, progress bars and the JSON answer.

pub mod commands;
pub mod convert;
pub mod failure;
pub mod interrupt;
pub mod lettering;
pub mod pages;
pub mod report;
