//! Early rejection of runs that exceed the machine's memory.

use anyhow::{Result, ensure};
use subsplat::Density;
use subsplat::network::config::Config;

/// Lower bound of a run's memory per input pixel of the first two views, bytes. Measured with both
/// backbones between 256² and 512² (K = 4): 2.9 KB.
const PER_PIXEL: u64 = 2000;
/// The same of further views, which the network encodes one at a time. Twenty views of 256² take
/// 1337 MiB, refined, with 675,838 children.
const PER_FURTHER_PIXEL: u64 = 600;
/// Lower bound of the memory per child: row, gain and the trunk's buffers, bytes. Measured
/// between K = 4 and K = 16: 78 B.
const PER_CHILD: u64 = 70;
/// Bytes per pixel of a rendered picture: colour, alpha, depth, 8 and 16 bit copies.
const PER_RENDERED: u64 = 30;

/// A reconstruction whose memory is estimated.
#[derive(Clone, Copy, Debug)]
pub struct Planned<'a> {
    /// The model's configuration.
    pub config: &'a Config,
    /// Number of photographs.
    pub views: usize,
    /// Width and height of the network's input, px.
    pub input: (usize, usize),
    /// Number of Gaussians.
    pub density: Density,
}

impl Planned<'_> {
    /// Lower bound of the memory, bytes.
    fn bytes(&self) -> u64 {
        let (w, h) = self.input;
        let pixels = (w as u64).saturating_mul(h as u64);
        let first = self.views.min(2) as u64;
        let each = PER_PIXEL * first + PER_FURTHER_PIXEL * (self.views as u64 - first);
        let r = self.config.upscale;
        let parents = w.saturating_mul(h).saturating_mul(self.views);
        let children = self.density.limit(parents, self.views, r) as u64;
        let network = pixels.saturating_mul(each);
        let rendered = pixels.saturating_mul((r * r) as u64 * PER_RENDERED);
        network.saturating_add(children.saturating_mul(PER_CHILD)).saturating_add(rendered)
    }
}

/// Rejects a reconstruction that exceeds the memory.
pub fn check_run(planned: &Planned<'_>) -> Result<()> {
    let Planned { config, views, input: (w, h), .. } = planned;
    let r = config.upscale;
    let source = format!("{views} photographs read at {w}x{h} pixels, with {r}x{r} splats a pixel");
    fits(&source, planned.bytes(), available(), RUN_HINT)
}

/// Advice where a reconstruction exceeds the memory.
const RUN_HINT: &str =
    "choose a smaller --input-size, --upscale or --gaussians, or fewer photographs";

/// Advice where a picture exceeds the memory.
const PICTURE_HINT: &str = "choose a smaller picture";

/// Returns whether the memory is ample for a reconstruction: half as much again as the lower bound, which
/// leaves room for the fit to the photographs (measured: 1.3 times the bound).
pub fn is_ample(planned: &Planned<'_>) -> bool {
    let needed = planned.bytes().saturating_mul(3) / 2;
    available().is_none_or(|a| needed <= a)
}

/// Rejects a picture that exceeds the memory; `source` names its flag or frame.
pub fn check_picture(source: &str, (w, h): (usize, usize)) -> Result<()> {
    let bytes = (w as u64).saturating_mul(h as u64).saturating_mul(PER_RENDERED);
    fits(&format!("{source} {w}x{h}"), bytes, available(), PICTURE_HINT)
}

fn fits(source: &str, needed: u64, available: Option<u64>, hint: &str) -> Result<()> {
    let gib = |bytes: u64| bytes as f64 / f64::from(1 << 30);
    let enough = available.is_none_or(|a| needed <= a);
    ensure!(
        enough,
        "{source}: needs at least {:.1} GiB of memory, {:.1} GiB are available; {hint}",
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
        assert!(fits("a", 5, Some(5), "").is_ok() && fits("a", 5, None, "").is_ok());
        let error = fits("--size 9x9", 3 << 30, Some(1 << 30), "less").unwrap_err().to_string();
        let told = "--size 9x9: needs at least 3.0 GiB of memory, 1.0 GiB are available; less";
        assert_eq!(error, told);
        let config = Config::x4();
        // Far beyond any machine; the products do not overflow.
        let of = |views, side| Planned {
            config: &config,
            views,
            input: (side, side),
            density: Density::Auto,
        };
        let huge = of(2, 1 << 20);
        assert!(available().is_none() || check_run(&huge).is_err());
        assert!(available().is_none() || !is_ample(&huge));
        assert!(is_ample(&of(2, 64)));
        assert!(of(2, usize::MAX).bytes() == u64::MAX);
        assert!(available().is_none() || check_picture("", (usize::MAX, usize::MAX)).is_err());
    }

    /// The bound is below what a run of twenty photographs took, and not far below.
    #[test]
    fn many_photographs_are_not_refused() {
        let config = Config { upscale: 2, ..Config::x4() };
        let planned =
            Planned { config: &config, views: 20, input: (256, 256), density: Density::Auto };
        let mebibytes = planned.bytes() >> 20;
        assert!((900..1337).contains(&mebibytes), "{mebibytes}");
        let all = Planned { density: Density::Full, ..planned };
        assert!(all.bytes() > planned.bytes());
    }
}
