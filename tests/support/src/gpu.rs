//! The GPU that tests run on: any adapter, a software one too.

use std::sync::{Arc, OnceLock};
use subsplat_kernels::gpu::{DeviceChoice, Gpu, GpuError, features_of, find_for, instance, wgpu};

/// The adapter, opened once, or `None`, loudly, where there is none.
/// `SUBSPLAT_GPU=require` (CI) turns absence into failure.
pub fn gpu() -> Option<Arc<Gpu>> {
    static GPU: OnceLock<Option<Arc<Gpu>>> = OnceLock::new();
    GPU.get_or_init(|| {
        let required = std::env::var("SUBSPLAT_GPU").is_ok_and(|v| v == "require");
        let line = match Gpu::open(&DeviceChoice::Gpu) {
            Ok(Some(gpu)) => {
                tell(&format!("GPU: {}\n", gpu.adapter()));
                return Some(gpu);
            }
            Ok(None) => "no GPU".to_owned(),
            Err(e) => e.to_string(),
        };
        assert!(!required, "a GPU adapter is required: {line}");
        tell(&format!("SKIP: {line}; this test checked nothing\n"));
        None
    })
    .clone()
}

/// The same adapter with a device of whose buffers at most `binding` bytes are bound.
pub fn limited(binding: u64) -> Option<Arc<Gpu>> {
    let limits =
        wgpu::Limits { max_storage_buffer_binding_size: binding, ..wgpu::Limits::default() };
    opened(limits, features_of)
}

/// The same adapter with a device without subgroup operations.
pub fn without_subgroups() -> Option<Arc<Gpu>> {
    opened(wgpu::Limits::default(), |adapter| {
        Ok(features_of(adapter)?.difference(wgpu::Features::SUBGROUP))
    })
}

fn opened(
    required_limits: wgpu::Limits,
    features: impl FnOnce(&wgpu::Adapter) -> Result<wgpu::Features, GpuError>,
) -> Option<Arc<Gpu>> {
    gpu()?;
    let adapter = find_for(&instance(), &DeviceChoice::Gpu, None).unwrap().unwrap();
    let required_features = features(&adapter).unwrap();
    let descriptor = wgpu::DeviceDescriptor {
        required_features,
        required_limits,
        ..wgpu::DeviceDescriptor::default()
    };
    let (device, queue) = pollster::block_on(adapter.request_device(&descriptor)).unwrap();
    Some(Gpu::from_device(device, queue))
}

/// Not `eprintln!`, which cargo hides for tests that pass.
fn tell(line: &str) {
    std::io::Write::write_all(&mut std::io::stderr(), line.as_bytes()).ok();
}
