//! Winograd convolution: 3×3 kernels of stride 1 and 2, forward and both gradients
//! (Winograd 1980; Lavin and Gray 2016, section 4).
//!
//! Y = Aᵀ·[(G·g·Gᵀ) ⊙ (Bᵀ·d·B)]·A
//!
//! d is a tile of the source with its border, g the kernel, Y a tile of the destination.
//! Summed over source channels, the elementwise products ⊙ become 36 matrix products. A tile
//! of 4×4 outputs needs 36 products per pair of channels instead of 144 (stride 1), or 81
//! instead of 144 (stride 2).
//!
//! * `transforms` holds Bᵀ, G and Aᵀ along one axis, for each [`Kind`].
//! * `product_layout` defines the places of the transformed tiles in memory.
//! * `load_tiles` reads the tiles of one channel and transforms them: Bᵀ·d·B.
//! * `weights` transforms the kernels: G·g·Gᵀ.
//! * `products` multiplies, transforms back and writes: Aᵀ·[…]·A.
//! * `forward`, `small_images` and `weight_grad` combine them into jobs.
//!
//! For inputs in ±1 and n products per sum, results are within 3e-6·√n of the exact ones
//! (conv/tests.rs).
//!
//! Rows and channels are prefetched explicitly, because hardware prefetchers do not follow steps
//! of this size.

mod forward;
mod kind;
mod load_tiles;
mod product_layout;
mod products;
mod small_images;
mod transforms;
mod weight_grad;
mod weights;

pub(super) use forward::Winograd;
pub(super) use kind::{Kind, tiles_per_image};
pub(super) use small_images::SmallImages;
pub(super) use weight_grad::WinogradWeightGrad;
