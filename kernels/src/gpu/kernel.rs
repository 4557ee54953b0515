//! Kernels: WGSL source, entry point, and the access to each argument.
//!
//! The source of a kernel is a concatenation: the constants (`constants`), the struct of its
//! uniform ([`crate::gpu::uniforms`]), then files of `wgsl`, those that kernels share first. There
//! is no preprocessor. Binding i of group 0 is argument i.
//!
//! A kernel that reduces over a workgroup has two sources, which differ in one shared file: with
//! subgroup operations for devices that have them, and without for all others ([`Source`]).

use crate::gpu::constants;
use crate::gpu::uniforms::UniformStruct;

/// Makes a [`Source`] of files under `wgsl`, after the name of the uniform if the kernel has one:
/// `wgsl!(RasterUniform; "shared/grid", "raster/plan")`. `[a | b]` is file a without subgroups, b
/// with them.
macro_rules! wgsl {
    (@uniform) => { None };
    (@uniform $uniform:ident) => { Some($crate::gpu::uniforms::$uniform::LAYOUT) };
    (@file $file:literal) => {
        include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/wgsl/", $file, ".wgsl"))
    };
    ($($uniform:ident;)? $($file:literal),+ $(,)?) => {
        $crate::gpu::kernel::Source {
            uniform: wgsl!(@uniform $($uniform)?),
            plain: &[$(wgsl!(@file $file)),+],
            subgroups: None,
        }
    };
    ($($uniform:ident;)? $($file:literal),+, [$plain:literal | $subgroups:literal], $($last:literal),+ $(,)?) => {
        $crate::gpu::kernel::Source {
            uniform: wgsl!(@uniform $($uniform)?),
            plain: &[$(wgsl!(@file $file),)+ wgsl!(@file $plain), $(wgsl!(@file $last)),+],
            subgroups: Some(
                &[$(wgsl!(@file $file),)+ wgsl!(@file $subgroups), $(wgsl!(@file $last)),+],
            ),
        }
    };
}
pub(crate) use wgsl;

/// Parts of the WGSL source of a kernel.
#[derive(Clone, Copy, Debug)]
pub struct Source {
    /// Struct of the kernel's uniform.
    pub uniform: Option<UniformStruct>,
    /// Texts of the files without subgroup operations, in order.
    pub plain: &'static [&'static str],
    /// Texts of the files with subgroup operations, for kernels that use them.
    pub subgroups: Option<&'static [&'static str]>,
}

impl Source {
    /// Returns the texts of the files for devices with or without subgroup operations.
    pub fn files(&self, subgroups: bool) -> &'static [&'static str] {
        self.subgroups.filter(|_| subgroups).unwrap_or(self.plain)
    }

    /// Returns the whole source for devices with or without subgroup operations.
    pub fn text(&self, subgroups: bool) -> String {
        let uniform = self.uniform.map_or("", |uniform| uniform.wgsl);
        constants::wgsl() + uniform + &self.files(subgroups).concat()
    }

    /// Returns binding and access of each argument, in the order of their declarations in the
    /// source. At most 8 arguments are storage buffers (WebGPU's default limit).
    pub fn bindings(&self, subgroups: bool) -> Vec<(u32, Access)> {
        self.files(subgroups).iter().flat_map(|file| file.lines()).filter_map(argument).collect()
    }
}

/// Access of a kernel to an argument.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Access {
    /// `var<uniform>`.
    Uniform,
    /// `var<storage, read>`.
    Read,
    /// `var<storage, read_write>`.
    Write,
}

/// Returns binding and access of the argument that a line of WGSL declares.
fn argument(line: &str) -> Option<(u32, Access)> {
    let (binding, declared) = line.strip_prefix("@group(0) @binding(")?.split_once(") var<")?;
    let (space, _) = declared.split_once('>')?;
    let access = match space {
        "uniform" => Access::Uniform,
        "storage, read" => Access::Read,
        "storage, read_write" => Access::Write,
        _ => return None,
    };
    Some((binding.parse().ok()?, access))
}

/// One entry point of one file of `wgsl`.
#[derive(Debug)]
pub struct Kernel {
    /// Stem of the kernel's file.
    pub name: &'static str,
    /// Entry point.
    pub entry: &'static str,
    /// WGSL source.
    pub source: Source,
}

impl Kernel {
    /// Returns name and entry point.
    pub(crate) fn label(&self) -> String {
        format!("{}::{}", self.name, self.entry)
    }
}
