//! `subsplat compare`: the encoder against a reference file.

use super::args::CompareArgs;
use super::report::{Answer, Progress, peak_memory_bytes, warn};
use anyhow::{Context, Result};
use serde_json::{Value, json};
use subsplat::model::compare;
use subsplat::model::weights::Weights;

/// Runs the command; `false` where a tensor is out of tolerance.
pub fn compare(args: &CompareArgs, answer: Answer) -> Result<bool> {
    let mut progress = Progress::new();
    let report = progress.stage("encoder", |_| -> Result<_> {
        let weights = Weights::load(&args.weights)?;
        compare::compare(&weights, &args.reference)
            .with_context(|| args.reference.display().to_string())
    })?;
    answer.line(format!("{:<44} {:>10} {:>10} {:>10}", "tensor", "max abs", "relative", "allowed"));
    for row in &report.rows {
        answer.line(format!(
            "{:<44} {:>10.2e} {:>10.2e} {:>10.2e}{}",
            row.tensor,
            row.max_abs,
            row.relative,
            row.allowed,
            if row.ok { "" } else { "  OUT" }
        ));
    }
    for name in &report.not_produced {
        warn(format!("the reference holds `{name}`, which the encoder does not produce"));
    }
    let out = report.rows.iter().filter(|r| !r.ok).count();
    answer.line(format!("{} tensors compared, {out} out of tolerance", report.rows.len()));
    let rows: Vec<Value> = report
        .rows
        .iter()
        .map(|r| {
            json!({
                "tensor": r.tensor,
                "max_abs": r.max_abs,
                "relative": r.relative,
                "allowed": r.allowed,
                "ok": r.ok,
            })
        })
        .collect();
    let ok = report.ok();
    answer.finish(&json!({
        "ok": ok,
        "tensors": rows,
        "not_produced": report.not_produced,
        "seconds": progress.seconds(),
        "peak_memory_bytes": peak_memory_bytes(),
    }))?;
    Ok(ok)
}
