//! Drawing of a frame to a texture of the application, without a copy through host memory.

use crate::camera::Camera;
use crate::gpu::buffers::{Binding, Buffer};
use crate::gpu::commands::Commands;
use crate::gpu::device::Gpu;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::pipelines::layout;
use crate::gpu::raster::constants::{PLAN_WORDS, TILE_GPU};
use crate::gpu::raster::frame::{Channels, pixels, uniform};
use crate::gpu::raster::rasterize::Rasterizer;
use crate::gpu::raster::scene::Scene;
use crate::gpu::uniforms::{RasterUniform, ShowUniform};
use crate::layout::RasterOptions;
use std::sync::PoisonError;

pub(crate) static SHOW: Kernel =
    Kernel { name: "show", entry: "fragment", source: wgsl!(ShowUniform; "raster/show") };

impl Rasterizer {
    /// Renders splats to `target`, a renderable texture view of this rasterizer's device: RGB
    /// over the background, and accumulated alpha.
    ///
    /// One submit, without waiting for it; only the pair count of the previous frame is waited
    /// for. The first frame is always complete. A later frame with more (splat, tile) pairs than
    /// the capacity lacks its farthest splats; the capacity of the next frame is sufficient. A
    /// frame that exceeds a binding takes several submits and waits for them.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for a target of another size than the camera's picture; otherwise
    /// as [`Rasterizer::render`].
    pub fn draw(
        &mut self,
        scene: &Scene,
        camera: &Camera,
        options: &RasterOptions,
        target: &wgpu::TextureView,
    ) -> Result<(), GpuError> {
        let size = target.texture().size();
        let k = camera.intrinsics;
        if (size.width as usize, size.height as usize) != (k.width, k.height) {
            return Err(GpuError::Argument {
                kernel: SHOW.name,
                argument: "the texture, px",
                expected: format!("{}x{}", k.width, k.height),
                got: format!("{}x{}", size.width, size.height),
            });
        }
        let gpu = self.gpu().clone();
        if let Some(plan) = self.pending.take() {
            self.update_capacity(&plan.take(&gpu)?);
        }
        let call = uniform(scene, camera, options, Channels::Interleaved)?;
        loop {
            if self.needs_layers(scene, &call) {
                let show = |commands: &mut Commands, call: &RasterUniform, picture: &Buffer| {
                    gpu.show(commands, call, picture, target)
                };
                return self.layered(scene, &call, show).map(drop);
            }
            let mut commands = gpu.commands("frame", false);
            let frame = self.record(&mut commands, scene, &call)?;
            let plan = commands.read::<u32>(&frame.plan, PLAN_WORDS)?;
            gpu.show(&mut commands, &call, &frame.picture, target)?;
            commands.submit()?;
            if self.pairs_known {
                self.pending = Some(plan);
                return Ok(());
            }
            // The number of pairs is unknown before the first frame.
            self.pairs_known = self.update_capacity(&plan.take(&gpu)?);
            if self.pairs_known {
                return Ok(());
            }
        }
    }
}

fn draw_band(
    device: &wgpu::Device,
    encoder: &mut wgpu::CommandEncoder,
    pipeline: &wgpu::RenderPipeline,
    bindings: &[Binding],
    target: &wgpu::TextureView,
    band: &ShowUniform,
) {
    let entries: Vec<_> = (0..)
        .zip(bindings)
        .map(|(binding, b)| wgpu::BindGroupEntry { binding, resource: b.resource() })
        .collect();
    let group = device.create_bind_group(&wgpu::BindGroupDescriptor {
        label: Some(SHOW.name),
        layout: &pipeline.get_bind_group_layout(0),
        entries: &entries,
    });
    let first = band.top == 0;
    let load = if first { wgpu::LoadOp::Clear(wgpu::Color::BLACK) } else { wgpu::LoadOp::Load };
    let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
        label: Some(SHOW.name),
        color_attachments: &[Some(wgpu::RenderPassColorAttachment {
            view: target,
            depth_slice: None,
            resolve_target: None,
            ops: wgpu::Operations { load, store: wgpu::StoreOp::Store },
        })],
        ..wgpu::RenderPassDescriptor::default()
    });
    pass.set_pipeline(pipeline);
    pass.set_bind_group(0, &group, &[]);
    pass.set_scissor_rect(0, band.top, band.width, band.height);
    pass.draw(0..3, 0..1);
}

impl Gpu {
    /// Appends the drawing of the call's band of `picture` to `target`.
    fn show(
        &self,
        commands: &mut Commands,
        call: &RasterUniform,
        picture: &Buffer,
        target: &wgpu::TextureView,
    ) -> Result<(), GpuError> {
        let format = target.texture().format();
        let band = ShowUniform {
            width: call.width,
            height: pixels(call) as u32 / call.width.max(1),
            srgb: u32::from(format.is_srgb()),
            top: call.top * TILE_GPU as u32,
        };
        let bindings = vec![Binding::from(&self.uniform(&band)?), Binding::from(picture)];
        let pipeline = self.show_pipeline(format)?;
        let (device, target) = (self.device.clone(), target.clone());
        commands.draw(bindings, move |encoder, bindings| {
            draw_band(&device, encoder, &pipeline, bindings, &target, &band);
        });
        Ok(())
    }

    /// Returns the render pipeline of [`SHOW`] for a texture format, built at its first use.
    fn show_pipeline(&self, format: wgpu::TextureFormat) -> Result<wgpu::RenderPipeline, GpuError> {
        let mut built =
            self.pipelines.show_pipelines.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(found) = built.get(&format) {
            return Ok(found.clone());
        }
        let new = self.checked(SHOW.name, || Ok(self.build_show(format)))?;
        built.insert(format, new.clone());
        Ok(new)
    }

    fn build_show(&self, format: wgpu::TextureFormat) -> wgpu::RenderPipeline {
        let module = self.module(&SHOW);
        let bindings = SHOW.source.bindings(self.has_subgroups());
        let group = layout(&self.device, SHOW.name, &bindings, wgpu::ShaderStages::FRAGMENT);
        let whole = self.device.create_pipeline_layout(&wgpu::PipelineLayoutDescriptor {
            label: Some(SHOW.name),
            bind_group_layouts: &[Some(&group)],
            immediate_size: 0,
        });
        self.device.create_render_pipeline(&wgpu::RenderPipelineDescriptor {
            label: Some(SHOW.name),
            layout: Some(&whole),
            vertex: wgpu::VertexState {
                module: &module,
                entry_point: Some("vertex"),
                compilation_options: wgpu::PipelineCompilationOptions::default(),
                buffers: &[],
            },
            primitive: wgpu::PrimitiveState::default(),
            depth_stencil: None,
            multisample: wgpu::MultisampleState::default(),
            fragment: Some(wgpu::FragmentState {
                module: &module,
                entry_point: Some("fragment"),
                compilation_options: wgpu::PipelineCompilationOptions::default(),
                targets: &[Some(format.into())],
            }),
            multiview_mask: None,
            cache: None,
        })
    }
}
