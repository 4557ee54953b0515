//! Which adapter does the work.
//!
//! `auto` takes a GPU and never a software adapter: the CPU kernels are faster than an
//! emulated GPU. `gpu` takes the best adapter there is, a software one too, and a name
//! takes the first whose name holds it.

use crate::device::DeviceChoice;
use crate::gpu::error::GpuError;
use std::fmt;
use wgpu::DeviceType;

/// What is known of an adapter before it is opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdapterSummary {
    /// The driver's name for it.
    pub name: String,
    /// Vulkan, Metal, Dx12.
    pub backend: String,
    /// Driver and its version.
    pub driver: String,
    /// Whether it is a CPU that plays a GPU (lavapipe, WARP).
    pub software: bool,
}

impl AdapterSummary {
    pub(crate) fn of(info: &wgpu::AdapterInfo) -> Self {
        Self {
            name: info.name.clone(),
            backend: format!("{:?}", info.backend),
            driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
            software: info.device_type == DeviceType::Cpu,
        }
    }
}

impl fmt::Display for AdapterSummary {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{} ({}, {})", self.name, self.backend, self.driver)?;
        if self.software { f.write_str(", software") } else { Ok(()) }
    }
}

/// All adapters, best first: discrete, integrated, virtual, unknown, software; in the
/// platform's own order within a kind.
pub fn adapters() -> Vec<AdapterSummary> {
    let all = enumerate(&instance());
    all.iter().map(|a| AdapterSummary::of(&a.get_info())).collect()
}

/// Where adapters are looked for: the platform's own back-ends. A surface made from it
/// brings its display with it.
pub fn instance() -> wgpu::Instance {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = wgpu::Backends::PRIMARY;
    // Our indirect counts are written by our own kernels within limits.
    descriptor.flags = wgpu::InstanceFlags::empty();
    wgpu::Instance::new(descriptor)
}

fn enumerate(instance: &wgpu::Instance) -> Vec<wgpu::Adapter> {
    let mut all = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
    all.sort_by_key(|a| rank(a.get_info().device_type));
    all
}

fn rank(kind: DeviceType) -> u8 {
    match kind {
        DeviceType::DiscreteGpu => 0,
        DeviceType::IntegratedGpu => 1,
        DeviceType::VirtualGpu => 2,
        DeviceType::Other => 3,
        DeviceType::Cpu => 4,
    }
}

/// Place in `found` of the adapter that `choice` means; `None` for the CPU kernels.
///
/// # Errors
/// [`GpuError::NoAdapter`] where a GPU was asked for and none answers.
pub fn choose(choice: &DeviceChoice, found: &[AdapterSummary]) -> Result<Option<usize>, GpuError> {
    let place = match choice {
        DeviceChoice::Cpu => return Ok(None),
        DeviceChoice::Auto => return Ok(found.iter().position(|a| !a.software)),
        DeviceChoice::Gpu => (!found.is_empty()).then_some(0),
        DeviceChoice::Named(name) => {
            let name = name.to_lowercase();
            found.iter().position(|a| a.name.to_lowercase().contains(&name))
        }
    };
    let names = || match found {
        [] => "no adapter (is a Vulkan, Metal or DX12 driver installed?)".to_owned(),
        _ => found.iter().map(AdapterSummary::to_string).collect::<Vec<_>>().join("; "),
    };
    match place {
        Some(place) => Ok(Some(place)),
        None => Err(GpuError::NoAdapter { asked: choice.to_string(), found: names() }),
    }
}

/// The adapter that `choice` means; `None` for the CPU kernels.
pub(crate) fn find(choice: &DeviceChoice) -> Result<Option<wgpu::Adapter>, GpuError> {
    find_for(&instance(), choice, None)
}

/// The adapter of `instance` that `choice` means, among those that can show pictures on
/// `surface` where there is one; `None` for the CPU kernels.
///
/// # Errors
/// As [`choose`].
pub fn find_for(
    instance: &wgpu::Instance,
    choice: &DeviceChoice,
    surface: Option<&wgpu::Surface>,
) -> Result<Option<wgpu::Adapter>, GpuError> {
    if *choice == DeviceChoice::Cpu {
        return Ok(None);
    }
    let mut all = enumerate(instance);
    all.retain(|a| surface.is_none_or(|s| a.is_surface_supported(s)));
    let summaries: Vec<_> = all.iter().map(|a| AdapterSummary::of(&a.get_info())).collect();
    Ok(choose(choice, &summaries)?.map(|i| all.swap_remove(i)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn adapter(name: &str, software: bool) -> AdapterSummary {
        let (backend, driver) = ("Vulkan".to_owned(), "driver 1".to_owned());
        AdapterSummary { name: name.to_owned(), backend, driver, software }
    }

    #[test]
    fn auto_takes_no_software_adapter() {
        let (emulated, real) = (adapter("llvmpipe", true), adapter("Vendor X100", false));
        let auto = DeviceChoice::Auto;
        assert_eq!(choose(&auto, std::slice::from_ref(&emulated)), Ok(None));
        assert_eq!(choose(&auto, &[]), Ok(None));
        assert_eq!(choose(&auto, &[emulated.clone(), real.clone()]), Ok(Some(1)));
        let any = DeviceChoice::Gpu;
        assert_eq!(choose(&any, &[emulated, real]), Ok(Some(0)));
        assert!(matches!(choose(&any, &[]), Err(GpuError::NoAdapter { .. })));
    }

    #[test]
    fn a_name_finds_its_adapter_or_names_what_there_is() {
        let all = [adapter("Vendor X100", false), adapter("llvmpipe (LLVM)", true)];
        let named = |name: &str| choose(&name.parse().unwrap_or_default(), &all);
        assert_eq!(named("LLVMpipe"), Ok(Some(1)));
        assert_eq!(named("x100"), Ok(Some(0)));
        assert_eq!(named("CPU"), Ok(None));
        let error = named("gizmo").unwrap_err().to_string();
        assert!(error.contains("gizmo") && error.contains("llvmpipe (LLVM)"), "{error}");
    }
}
