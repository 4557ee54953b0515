//! Headings under which `--help` lists the flags.

/// Views to draw.
pub const PICTURES: &str = "Pictures";
/// Photographs of the scene, and where they were taken.
pub const CAMERAS: &str = "Cameras";
/// Pixels of the pictures.
pub const SIZE: &str = "Size";
/// Time and memory against sharpness.
pub const QUALITY: &str = "Quality";
/// The network and its weights: for experts, in `--help` alone.
pub const NETWORK: &str = "Network";
