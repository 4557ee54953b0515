//! Tables of stages: the time, and the arithmetic rate and the bandwidth of convolutions and matrix
//! products as shares of the machine's at this SIMD level. Winograd's algorithm needs a quarter of
//! the products that are counted, so its share may exceed 100 %.

use crate::common::Machine;
use std::collections::BTreeMap;
use std::time::Instant;
use subsplat_kernels::cpu::work::{Counts, counts};

/// Time and work of one stage.
#[derive(Clone, Copy, Default)]
struct Spent {
    seconds: f64,
    flops: f64,
    bytes: f64,
}

/// Times and work of the stages of one run.
pub struct Stages {
    rows: BTreeMap<String, Spent>,
    /// End of the last stage, and the counts then.
    last: (Instant, Counts),
}

impl Stages {
    /// Starts the first stage.
    pub fn start() -> Self {
        Self { rows: BTreeMap::new(), last: (Instant::now(), counts()) }
    }

    /// Ends a stage, which may have several parts, and starts the next one.
    pub fn end(&mut self, name: &str) {
        let (then, before) = self.last;
        self.last = (Instant::now(), counts());
        let (now, after) = self.last;
        let own = self.rows.entry(name.to_owned()).or_default();
        own.seconds += (now - then).as_secs_f64();
        own.flops += (after.flops - before.flops) as f64;
        own.bytes += (after.bytes - before.bytes) as f64;
    }

    /// Prints the table; `machine` has the rates of all threads.
    pub fn print(&self, title: &str, machine: &Machine) {
        let total: f64 = self.rows.values().map(|own| own.seconds).sum();
        println!("\n{title}");
        println!(
            "  {:<32} {:>9} {:>6} {:>9} {:>6} {:>8} {:>6}",
            "stage", "ms", "", "GFLOP/s", "of", "GB/s", "of"
        );
        for (name, own) in &self.rows {
            let share = 100.0 * own.seconds / total;
            print!("  {name:<32} {:>9.1} {share:>5.1}%", 1e3 * own.seconds);
            if own.flops > 0.0 {
                let [flops, bytes] = [own.flops, own.bytes].map(|n| 1e-9 * n / own.seconds);
                let (peak, copy) =
                    (100.0 * flops / machine.fma[1], 100.0 * bytes / machine.copy[1]);
                print!(" {flops:>9.1} {peak:>5.0}% {bytes:>8.1} {copy:>5.0}%");
            }
            println!();
        }
        println!("  {:<32} {:>9.1}", "all", 1e3 * total);
    }
}
