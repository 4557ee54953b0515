//! Kernels: WGSL source, arguments, and compiled pipelines, built once per device.
//!
//! The source of a kernel is the concatenation of files under `kernels/`: shared files
//! (`kernels/shared`) first, then its own file. There is no preprocessor. Binding i of group 0 is
//! argument i.
//!
//! A kernel that reduces over a workgroup has two sources, which differ in one shared file: with subgroup
//! operations for devices that have them, and without for all others ([`Source`]).

use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Concatenates files under `kernels/` to a [`Source`]. `[a | b]` is file a without subgroups, b with them.
macro_rules! wgsl {
    ($($file:literal),+ $(,)?) => {
        $crate::gpu::pipelines::Source { plain: wgsl!(@joined $($file),+), subgroups: None }
    };
    ($($file:literal),+ , [$plain:literal | $subgroups:literal], $($last:literal),+ $(,)?) => {
        $crate::gpu::pipelines::Source {
            plain: wgsl!(@joined $($file,)+ $plain, $($last),+),
            subgroups: Some(wgsl!(@joined $($file,)+ $subgroups, $($last),+)),
        }
    };
    (@joined $($file:literal),+) => {
        concat!($(include_str!(concat!(env!("CARGO_MANIFEST_DIR"), "/", $file, ".wgsl"))),+)
    };
}
pub(crate) use wgsl;

/// WGSL source of a kernel, shared files included.
#[derive(Clone, Copy, Debug)]
pub struct Source {
    /// Source without subgroup operations.
    pub plain: &'static str,
    /// Source with subgroup operations, for kernels that use them.
    pub subgroups: Option<&'static str>,
}

impl Source {
    /// Returns the source for devices with or without subgroup operations.
    pub fn of(&self, subgroups: bool) -> &'static str {
        self.subgroups.filter(|_| subgroups).unwrap_or(self.plain)
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

/// One entry point of one file under `kernels/`.
#[derive(Debug)]
pub struct Kernel {
    /// Stem of the kernel's file.
    pub name: &'static str,
    /// Entry point.
    pub entry: &'static str,
    /// WGSL source.
    pub source: Source,
    /// Arguments in the order of their bindings. At most 8 are storage buffers (WebGPU's default
    /// limit).
    pub bindings: &'static [Access],
}

impl Kernel {
    /// Returns name and entry point.
    pub(crate) fn label(&self) -> String {
        format!("{}::{}", self.name, self.entry)
    }
}

/// Values of the kernel's `override` constants.
pub(crate) type Constants<'a> = &'a [(&'static str, f64)];

#[derive(Debug)]
pub(crate) struct Pipeline {
    pub(crate) raw: wgpu::ComputePipeline,
    pub(crate) layout: wgpu::BindGroupLayout,
    pub(crate) label: String,
}

/// Kernel, entry point, and the bits of its constants.
type Key = (&'static str, &'static str, Vec<(&'static str, u64)>);

/// Modules and pipelines that are compiled for one device.
#[derive(Debug, Default)]
pub(crate) struct Pipelines {
    modules: Mutex<HashMap<&'static str, wgpu::ShaderModule>>,
    built: Mutex<HashMap<Key, Arc<Pipeline>>>,
    pub(crate) show_pipelines: Mutex<HashMap<wgpu::TextureFormat, wgpu::RenderPipeline>>,
}

impl Gpu {
    /// Returns the pipeline of `kernel` with `constants`, compiled at its first use.
    ///
    /// # Errors
    /// [`GpuError::Refused`] with the message of the compiler.
    pub(crate) fn pipeline(
        &self,
        kernel: &'static Kernel,
        constants: Constants,
    ) -> Result<Arc<Pipeline>, GpuError> {
        let bits = constants.iter().map(|(name, v)| (*name, v.to_bits())).collect();
        let key = (kernel.name, kernel.entry, bits);
        let mut built = self.pipelines.built.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(found) = built.get(&key) {
            return Ok(found.clone());
        }
        let label = kernel.label();
        let new = self.checked(&label, || Ok(self.build(kernel, constants)))?;
        let new = Arc::new(new);
        built.insert(key, new.clone());
        Ok(new)
    }

    /// Returns the compiled module of a kernel's file. Errors go to the open error scope.
    pub(crate) fn module(&self, kernel: &'static Kernel) -> wgpu::ShaderModule {
        let (name, source) = (kernel.name, kernel.source.of(self.has_subgroups()));
        let mut modules = self.pipelines.modules.lock().unwrap_or_else(PoisonError::into_inner);
        let compile = || {
            self.device.create_shader_module(wgpu::ShaderModuleDescriptor {
                label: Some(name),
                source: wgpu::ShaderSource::Wgsl(source.into()),
            })
        };
        modules.entry(name).or_insert_with(compile).clone()
    }

    fn build(&self, kernel: &'static Kernel, constants: Constants) -> Pipeline {
        let label = kernel.label();
        let module = self.module(kernel);
        let layout = layout(&self.device, kernel, wgpu::ShaderStages::COMPUTE);
        let whole = self.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some(&label),
            bind_group_layouts: &[Some(&layout)],
            immediate_size: 0,
        });
        let raw = self.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(&label),
            layout: Some(&whole),
            module: &module,
            entry_point: Some(kernel.entry),
            compilation_options: wgpu::PipelineCompilationOptions {
                constants,
                // Kernels write their workgroup memory before they read it.
                zero_initialize_workgroup_memory: false,
            },
            cache: None,
        });
        Pipeline { raw, layout, label }
    }
}

/// Returns the bind group layout of a kernel's arguments.
pub(crate) fn layout(
    device: &wgpu::Device,
    kernel: &Kernel,
    visibility: wgpu::ShaderStages,
) -> wgpu::BindGroupLayout {
    let entry = |(i, &access)| entry(i, access, visibility);
    let entries: Vec<_> = (0..).zip(kernel.bindings).map(entry).collect();
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some(&kernel.label()),
        entries: &entries,
    })
}

fn entry(
    binding: u32,
    access: Access,
    visibility: wgpu::ShaderStages,
) -> wgpu::BindGroupLayoutEntry {
    let ty = match access {
        Access::Uniform => wgpu::BufferBindingType::Uniform,
        Access::Read => wgpu::BufferBindingType::Storage { read_only: true },
        Access::Write => wgpu::BufferBindingType::Storage { read_only: false },
    };
    wgpu::BindGroupLayoutEntry {
        binding,
        visibility,
        ty: wgpu::BindingType::Buffer { ty, has_dynamic_offset: false, min_binding_size: None },
        count: None,
    }
}
