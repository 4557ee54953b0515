//! Listing and choice of wgpu adapters ([`DeviceChoice`]).
//!

use crate::device::DeviceChoice;
use crate::gpu::error::GpuError;
use crate::gpu::wait;
use std::fmt;
use wgpu::DeviceType;

/// Properties of an adapter that is not opened yet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AdapterSummary {
    /// Name that the driver reports.
    pub name: String,
    /// Graphics API: Vulkan, Metal, Dx12 or BrowserWebGpu.
    pub backend: String,
    /// Driver name and version.
    pub driver: String,
    /// True if the adapter emulates a GPU on the CPU (lavapipe, WARP).
    pub software: bool,
}

impl AdapterSummary {
    pub(crate) fn of(info: &wgpu::AdapterInfo) -> Self {
        Self {
            // Browsers may conceal the name.
            name: if info.name.is_empty() { "adapter".to_owned() } else { info.name.clone() },
            backend: format!("{:?}", info.backend),
            driver: format!("{} {}", info.driver, info.driver_info).trim().to_owned(),
            software: info.device_type == DeviceType::Cpu,
        }
    }
}

impl fmt::Display for AdapterSummary {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        write!(f, "{} ({}", self.name, self.backend)?;
        if !self.driver.is_empty() {
            write!(f, ", {}", self.driver)?;
        }
        f.write_str(if self.software { "), software" } else { ")" })
    }
}

/// Lists all adapters, best first: discrete, integrated, virtual, unknown, software. Adapters of
/// one kind keep the order of the platform.
pub fn adapters() -> Vec<AdapterSummary> {
    let all = enumerate(&instance());
    all.iter().map(|a| AdapterSummary::of(&a.get_info())).collect()
}

/// Creates the wgpu instance that lists adapters, for the platform's primary graphics APIs. A
/// surface of this instance supplies its own display handle.
pub fn instance() -> wgpu::Instance {
    let mut descriptor = wgpu::InstanceDescriptor::new_without_display_handle();
    descriptor.backends = wgpu::Backends::PRIMARY;
    // wgpu's validation of indirect counts is off: the kernels keep their counts within the
    // limits.
    descriptor.flags = wgpu::InstanceFlags::empty();
    wgpu::Instance::new(descriptor)
}

fn enumerate(instance: &wgpu::Instance) -> Vec<wgpu::Adapter> {
    let found = wait::block_on(instance.enumerate_adapters(wgpu::Backends::PRIMARY));
    let mut all = found.unwrap_or_default();
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

/// Returns the index in `found` of the adapter that `choice` selects; `None` for the CPU kernels.
///
/// # Errors
/// [`GpuError::NoAdapter`] where `choice` requires a GPU and no adapter matches.
pub fn choose(choice: &DeviceChoice, found: &[AdapterSummary]) -> Result<Option<usize>, GpuError> {
    let index = match choice {
        DeviceChoice::Cpu => return Ok(None),
        DeviceChoice::Auto => return Ok(found.iter().position(|a| !a.software)),
        DeviceChoice::Gpu => (!found.is_empty()).then_some(0),
        DeviceChoice::Named(name) => {
            let name = name.to_lowercase();
            found.iter().position(|a| a.name.to_lowercase().contains(&name))
        }
    };
    let listed = || match found {
        [] => "no adapter (expected a driver for Vulkan, Metal or DX12, or WebGPU)".to_owned(),
        _ => found.iter().map(AdapterSummary::to_string).collect::<Vec<_>>().join("; "),
    };
    match index {
        Some(index) => Ok(Some(index)),
        None => Err(GpuError::NoAdapter { requested: choice.to_string(), found: listed() }),
    }
}

/// Returns the adapter that `choice` selects; `None` for the CPU kernels.
pub(crate) fn find(choice: &DeviceChoice) -> Result<Option<wgpu::Adapter>, GpuError> {
    find_for(&instance(), choice, None)
}

/// Returns the adapter of `instance` that `choice` selects; `None` for the CPU kernels. With a
/// `surface`, only adapters that can present to it are considered.
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
