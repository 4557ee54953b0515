//! Early rejection of runs that exceed the machine's memory.

use anyhow::{Result, ensure};
use subsplat::config::Config;

/// Lower bound of a run's memory per input pixel and view, bytes. Measured with both backbones
/// between 256² and 512² (two views, K = 4): 2.9 KB.
const PER_PIXEL: u64 = 2000;
/// Lower bound of the memory per child: row, gain and the trunk's buffers, bytes. Measured
/// between K = 4 and K = 16: 78 B.
const PER_CHILD: u64 = 70;
/// Bytes per pixel of a rendered picture: colour, alpha, depth, 8 and 16 bit copies.
const PER_RENDERED: u64 = 30;

/// Lower bound of a reconstruction's memory, bytes.
fn run_bytes(config: &Config, views: usize, (w, h): (usize, usize)) -> u64 {
    let pixels = (w as u64).saturating_mul(h as u64);
    let each = PER_PIXEL + PER_CHILD * config.children() as u64;
    let r = config.upscale as u64;
    let network = pixels.saturating_mul(views as u64).saturating_mul(each);
    let rendered = pixels.saturating_mul(r * r * PER_RENDERED);
    network.saturating_add(rendered)
}

/// Rejects a reconstruction that exceeds the memory.
pub fn check_run(config: &Config, views: usize, (w, h): (usize, usize)) -> Result<()> {
    let r = config.upscale;
    let source = format!("--input-size {w}x{h} with {views} views at --upscale {r}");
    fits(&source, run_bytes(config, views, (w, h)), available())
}

/// Whether the memory is ample for a reconstruction: half as much again as the lower bound, which
/// leaves room for the fit to the photographs (measured: 1.3 times the bound).
pub fn is_ample(config: &Config, views: usize, size: (usize, usize)) -> bool {
    let needed = run_bytes(config, views, size).saturating_mul(3) / 2;
    available().is_none_or(|a| needed <= a)
}

/// Rejects a picture that exceeds the memory; `source` names its flag or frame.
pub fn check_picture(source: &str, (w, h): (usize, usize)) -> Result<()> {
    let bytes = (w as u64).saturating_mul(h as u64).saturating_mul(PER_RENDERED);
    fits(&format!("{source} {w}x{h}"), bytes, available())
}

fn fits(source: &str, needed: u64, available: Option<u64>) -> Result<()> {
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    let enough = available.is_none_or(|a| needed <= a);
    ensure!(
        enough,
        "{source}: needs at least {:.1} GiB of memory, {:.1} GiB are available",
        gib(needed),
        gib(available.unwrap_or(0))
    );
    Ok(())
}

/// Reads the available memory and swap, bytes; `None` elsewhere than on Linux.
fn available() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let kib = |key: &str| -> Option<u64> {
        let line = text.lines().find(|l| l.starts_with(key))?;
        line.split_whitespace().nth(1)?.parse().ok()
    };
    Some((kib("MemAvailable:")? + kib("SwapFree:").unwrap_or(0)) * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn too_large_runs_are_rejected_with_numbers() {
        assert!(fits("a", 5, Some(5)).is_ok() && fits("a", 5, None).is_ok());
        let error = fits("--size 9x9", 3 << 30, Some(1 << 30)).unwrap_err().to_string();
        assert_eq!(error, "--size 9x9: needs at least 3.0 GiB of memory, 1.0 GiB are available");
        let config = Config::x4();
        // Far beyond any machine; the products do not overflow.
        assert!(available().is_none() || check_run(&config, 2, (1 << 20, 1 << 20)).is_err());
        assert!(available().is_none() || !is_ample(&config, 2, (1 << 20, 1 << 20)));
        assert!(is_ample(&config, 2, (64, 64)));
        assert!(available().is_none() || check_picture("", (usize::MAX, usize::MAX)).is_err());
    }
}
