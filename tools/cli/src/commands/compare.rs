//! `subsplat compare`: the encoder, or the rasterizer, against a reference file.

use super::args::{CompareArgs, SimdArg};
use super::compare_raster;
use super::raster_case::Case;
use crate::report::{Answer, Progress, peak_memory_bytes, print_warning};
use anyhow::{Context, Result, bail, ensure};
use serde_json::{Value, json};
use std::path::Path;
use subsplat::cpu::Tier;
use subsplat::model::compare::{self, Row};
use subsplat::model::weights::Weights;
use subsplat::render::Renderer;

/// Runs the command; `false` where a tensor is out of tolerance.
pub fn compare(args: &CompareArgs, answer: Answer) -> Result<bool> {
    match &args.weights {
        Some(weights) => encoder(weights, &args.reference, answer),
        None if args.device.eq_ignore_ascii_case("cpu") => {
            let tier = tier(args.simd)?;
            let compare = |case: &Case| compare_raster::compare(case, tier);
            rasterizer(
                &args.reference,
                &format!("instruction set: {}", tier.name()),
                compare,
                answer,
            )
        }
        None => {
            let mut renderer = Renderer::open(&args.device)?;
            let device = format!("device: {}", renderer.device());
            let compare = |case: &Case| compare_raster::compare_on(case, &mut renderer);
            rasterizer(&args.reference, &device, compare, answer)
        }
    }
}

fn encoder(weights: &Path, reference: &Path, answer: Answer) -> Result<bool> {
    let mut progress = Progress::new();
    let report = progress.stage("encoder", |_| -> Result<_> {
        let weights = Weights::load(weights)?;
        compare::compare(&weights, reference).with_context(|| reference.display().to_string())
    })?;
    table(&report.rows, answer);
    for name in &report.not_produced {
        print_warning(format!("the reference holds `{name}`, which the encoder does not produce"));
    }
    let ok = report.ok();
    finish(&report.rows, ok, &report.not_produced, &progress, answer)
}

/// The instruction set that is asked for, or the best one.
fn tier(asked: Option<SimdArg>) -> Result<Tier> {
    let tier = asked.map_or_else(Tier::best, Tier::from);
    let here: Vec<&str> = Tier::available().iter().map(|t| t.name()).collect();
    ensure!(
        tier.is_available(),
        "--simd: expected one that this processor runs ({}), got {}",
        here.join(", "),
        tier.name()
    );
    Ok(tier)
}

fn rasterizer(
    reference: &Path,
    with: &str,
    compare: impl FnOnce(&Case) -> Result<Vec<Row>>,
    answer: Answer,
) -> Result<bool> {
    let mut progress = Progress::new();
    let rows = progress.stage("rasterizer", |_| -> Result<_> {
        let Some(case) = Case::read(reference)? else {
            bail!(
                "{}: expected a rasterizer case (metadata `convention`), or --weights beside a \
                 reference of the encoder",
                reference.display()
            )
        };
        compare(&case).with_context(|| format!("{} {}", reference.display(), case.name))
    })?;
    answer.line(with);
    table(&rows, answer);
    let ok = rows.iter().all(|r| r.ok);
    finish(&rows, ok, &[], &progress, answer)
}

fn table(rows: &[Row], answer: Answer) {
    answer.line(format!("{:<44} {:>10} {:>10} {:>10}", "tensor", "max abs", "relative", "allowed"));
    for row in rows {
        answer.line(format!(
            "{:<44} {:>10.2e} {:>10.2e} {:>10.2e}{}",
            row.tensor,
            row.max_abs,
            row.relative,
            row.allowed,
            if row.ok { "" } else { "  OUT" }
        ));
    }
    let out = rows.iter().filter(|r| !r.ok).count();
    answer.line(format!("{} tensors compared, {out} out of tolerance", rows.len()));
}

fn finish(
    rows: &[Row],
    ok: bool,
    not_produced: &[String],
    progress: &Progress,
    answer: Answer,
) -> Result<bool> {
    let tensors: Vec<Value> = rows
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
    answer.finish(&json!({
        "ok": ok,
        "tensors": tensors,
        "not_produced": not_produced,
        "seconds": progress.seconds(),
        "peak_memory_bytes": peak_memory_bytes(),
    }))?;
    Ok(ok)
}
