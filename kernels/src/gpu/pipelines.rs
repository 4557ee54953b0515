//! Compiled pipelines of the kernels, built once per device.

use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Access, Kernel};
use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

/// Values of the kernel's `override` constants.
pub(crate) type Constants<'a> = &'a [(&'static str, f64)];

#[derive(Debug)]
pub(crate) struct Pipeline {
    pub(crate) raw: wgpu::ComputePipeline,
    pub(crate) layout: wgpu::BindGroupLayout,
    pub(crate) label: String,
    /// Number of arguments.
    pub(crate) arguments: usize,
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
        let name = kernel.name;
        let mut modules = self.pipelines.modules.lock().unwrap_or_else(PoisonError::into_inner);
        let compile = || {
            let source = kernel.source.text(self.has_subgroups());
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
        let bindings = kernel.source.bindings(self.has_subgroups());
        let layout = layout(&self.device, &label, &bindings, wgpu::ShaderStages::COMPUTE);
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
        Pipeline { raw, layout, label, arguments: bindings.len() }
    }
}

/// Returns the bind group layout of a kernel's arguments ([`crate::gpu::Source::bindings`]).
pub(crate) fn layout(
    device: &wgpu::Device,
    label: &str,
    bindings: &[(u32, Access)],
    visibility: wgpu::ShaderStages,
) -> wgpu::BindGroupLayout {
    let entries: Vec<_> =
        bindings.iter().map(|&(binding, access)| entry(binding, access, visibility)).collect();
    device.create_bind_group_layout(&wgpu::BindGroupLayoutDescriptor {
        label: Some(label),
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
