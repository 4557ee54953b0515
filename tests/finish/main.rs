//! The optimiser of a scene on its photographs, its losses, and the merging of Gaussians.

mod fit;
mod loss;
mod properties;
mod reduce;
mod refine;
