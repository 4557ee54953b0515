//! Refusing early, and with a number, what the machine's memory cannot hold.

use anyhow::{Result, ensure};
use subsplat::config::Config;

/// Least bytes that a run takes per input pixel and view, both backbones: 2.9 KB
/// measured between 256² and 512² (two views, K = 4), less a margin.
const PER_PIXEL: u64 = 2000;
/// The same for each child: 11 lanes, gain and what the trunk keeps; 78 B measured
/// between K = 4 and K = 16.
const PER_CHILD: u64 = 70;
/// Bytes per pixel of a rendered picture: colour, alpha, depth, 8 and 16 bit copies.
const PER_RENDERED: u64 = 30;

/// Refuses a reconstruction that cannot fit.
pub fn check_run(config: &Config, views: usize, (w, h): (usize, usize)) -> Result<()> {
    let pixels = (w as u64).saturating_mul(h as u64);
    let each = PER_PIXEL + PER_CHILD * config.children() as u64;
    let r = config.upscale as u64;
    let network = pixels.saturating_mul(views as u64).saturating_mul(each);
    let rendered = pixels.saturating_mul(r * r * PER_RENDERED);
    let what = format!("--input-size {w}x{h} with {views} views at --upscale {r}");
    fits(&what, network.saturating_add(rendered), available())
}

/// Refuses a picture that cannot fit; `what` asks for it.
pub fn check_picture(what: &str, (w, h): (usize, usize)) -> Result<()> {
    let bytes = (w as u64).saturating_mul(h as u64).saturating_mul(PER_RENDERED);
    fits(&format!("{what} {w}x{h}"), bytes, available())
}

fn fits(what: &str, needed: u64, available: Option<u64>) -> Result<()> {
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    let enough = available.is_none_or(|a| needed <= a);
    ensure!(
        enough,
        "{what}: needs at least {:.1} GiB of memory, {:.1} GiB are available",
        gib(needed),
        gib(available.unwrap_or(0))
    );
    Ok(())
}

/// Memory and swap that the system could still give, bytes; `None` where it does not
/// say (anything but Linux).
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
    fn what_cannot_fit_is_refused_with_numbers() {
        assert!(fits("a", 5, Some(5)).is_ok() && fits("a", 5, None).is_ok());
        let error = fits("--size 9x9", 3 << 30, Some(1 << 30)).unwrap_err().to_string();
        assert_eq!(error, "--size 9x9: needs at least 3.0 GiB of memory, 1.0 GiB are available");
        let config = Config::x4();
        // Far beyond any machine, and no overflow on the way.
        assert!(available().is_none() || check_run(&config, 2, (1 << 20, 1 << 20)).is_err());
        assert!(available().is_none() || check_picture("", (usize::MAX, usize::MAX)).is_err());
    }
}
