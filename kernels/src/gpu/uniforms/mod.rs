//! Uniforms of the WGSL kernels: the parameters of a call beside its arrays.
//!
//! One list of fields gives the struct in Rust and in WGSL. Offsets are the same in both: the struct
//! of Rust has no padding (bytemuck refuses it), and the compiler checks that each offset and the
//! size are multiples of WGSL's alignments.

/// The struct of a uniform in WGSL.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UniformStruct {
    /// Name.
    pub name: &'static str,
    /// Declaration.
    pub wgsl: &'static str,
    /// Size, bytes.
    pub bytes: usize,
}

/// The type of a field in WGSL.
macro_rules! wgsl_type {
    (u32) => {
        "u32"
    };
    (f32) => {
        "f32"
    };
    ([[$scalar:ident; 4]; $count:literal]) => {
        concat!("array<vec4<", stringify!($scalar), ">, ", $count, ">")
    };
    ([$scalar:ident; 2]) => {
        concat!("vec2<", stringify!($scalar), ">")
    };
    ([$scalar:ident; 4]) => {
        concat!("vec4<", stringify!($scalar), ">")
    };
}

/// The alignment of a field in WGSL, bytes.
macro_rules! wgsl_alignment {
    ([[$scalar:ident; 4]; $count:literal]) => {
        16
    };
    ([$scalar:ident; 2]) => {
        8
    };
    ([$scalar:ident; 4]) => {
        16
    };
    ($scalar:ident) => {
        4
    };
}

/// A uniform struct, and the same struct in WGSL.
macro_rules! uniform {
    ($(#[$doc:meta])* $name:ident { $($(#[$field_doc:meta])* $field:ident: $ty:tt,)* }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
        #[repr(C)]
        pub struct $name {
            $($(#[$field_doc])* pub $field: $ty,)*
        }

        impl $name {
            /// The same struct in WGSL.
            pub const LAYOUT: UniformStruct = UniformStruct {
                name: stringify!($name),
                wgsl: concat!(
                    "struct ", stringify!($name), " {\n",
                    $("    ", stringify!($field), ": ", wgsl_type!($ty), ",\n",)*
                    "}\n",
                ),
                bytes: size_of::<$name>(),
            };
        }

        $(const _: () = assert!(
            std::mem::offset_of!($name, $field).is_multiple_of(wgsl_alignment!($ty))
                && size_of::<$name>().is_multiple_of(wgsl_alignment!($ty)),
            concat!(stringify!($name), ".", stringify!($field), " has another offset in WGSL")
        );)*
    };
}

mod finish;
mod network;
mod raster;
mod spgr;

pub use finish::{LossUniform, OptimiseUniform};
pub use network::{
    AdamUniform, AdapterUniform, AttentionGatherUniform, AttentionUniform, AttributesUniform,
    ConvexUniform, ConvolutionUniform, CrossCheckUniform, DepthConsensusUniform,
    ElementwiseUniform, ExpectationUniform, HeadOutputUniform, InvertUniform, LinearUniform,
    LinearWeightBwdUniform, NormUniform, OcclusionUniform, PlaneSweepUniform, RawMatchingUniform,
    ReduceUniform, ResizeUniform, RowsUniform, SelectUniform, SumPartsUniform,
};
pub use raster::{RasterUniform, ShowUniform, SortUniform};
pub use spgr::{RedistributeUniform, SpgrGainsBwdUniform, SpgrUniform};
