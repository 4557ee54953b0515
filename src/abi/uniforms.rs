//! Uniforms of the WGSL kernels: what a kernel is told beside its arrays.
//!
//! Fields have the order, the types and the offsets of the WGSL struct of the same name
//! (`tests/shaders.rs` compares). No hidden padding: bytemuck refuses it.

/// A uniform struct and the table of its fields' offsets.
macro_rules! uniform {
    ($(#[$doc:meta])* $name:ident { $($(#[$field_doc:meta])* $field:ident: $ty:ty,)* }) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, Default, PartialEq, bytemuck::Pod, bytemuck::Zeroable)]
        #[repr(C)]
        pub struct $name {
            $($(#[$field_doc])* pub $field: $ty,)*
        }

        impl $name {
            /// Name and byte offset of every field.
            pub const FIELDS: &'static [(&'static str, usize)] =
                &[$((stringify!($field), std::mem::offset_of!($name, $field)),)*];
        }
    };
}

uniform! {
    /// Of kernels/redistribute.wgsl.
    RedistributeUniform {
        /// P.
        parents: u32,
        /// K.
        children: u32,
        /// [`super::Rule`] as a number.
        rule: u32,
        /// Unused.
        pad: u32,
    }
}
