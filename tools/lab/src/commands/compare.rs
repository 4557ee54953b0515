//! `subsplat-lab compare`: the encoder, or the rasterizer, against a reference file.

use super::args::{CompareArgs, SimdArg};
use super::compare_raster::{self, Comparison};
use super::raster_case::Case;
use crate::compare;
use crate::compare::Row;
use anyhow::{Context, Result, bail, ensure};
use serde_json::{Value, json};
use std::path::Path;
use subsplat::network::model::Backend;
use subsplat::network::model::weights::Weights;
use subsplat::scene::render::Renderer;
use subsplat_cli::report::{Answer, Progress, peak_memory_bytes, print_warning};
use subsplat_kernels::cpu::SimdLevel;

/// Runs the command; `false` where a tensor is out of tolerance.
pub fn compare(args: &CompareArgs, answer: Answer) -> Result<bool> {
    match &args.weights {
        Some(weights) => encoder(weights, &args.reference, &args.device, answer),
        None if args.device.eq_ignore_ascii_case("cpu") => {
            let level = level(args.simd)?;
            let compare = |case: &Case| compare_raster::compare(case, level);
            rasterizer(
                &args.reference,
                &format!("instruction set: {}", level.name()),
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

fn encoder(weights: &Path, reference: &Path, device: &str, answer: Answer) -> Result<bool> {
    let backend = Backend::open(device)?;
    let mut progress = Progress::new();
    let report = progress.stage("encoder", |_| -> Result<_> {
        let weights = Weights::load(weights)?;
        compare::compare(&weights, reference, &backend)
            .with_context(|| reference.display().to_string())
    })?;
    table(&report.rows, answer);
    for name in &report.not_produced {
        print_warning(format!("the reference holds `{name}`, which the encoder does not produce"));
    }
    let ok = report.ok();
    let extra = json!({ "not_produced": report.not_produced });
    finish(&report.rows, ok, extra, &progress, answer)
}

/// Gives the requested instruction set, or the best one.
fn level(asked: Option<SimdArg>) -> Result<SimdLevel> {
    let level = asked.map_or_else(SimdLevel::best, SimdLevel::from);
    let here: Vec<&str> = SimdLevel::available().iter().map(|t| t.name()).collect();
    ensure!(
        level.is_available(),
        "--simd: expected one that this processor runs ({}), got {}",
        here.join(", "),
        level.name()
    );
    Ok(level)
}

fn rasterizer(
    reference: &Path,
    with: &str,
    compare: impl FnOnce(&Case) -> Result<Comparison>,
    answer: Answer,
) -> Result<bool> {
    let mut progress = Progress::new();
    let Comparison { rows, absent } = progress.stage("rasterizer", |_| -> Result<_> {
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
    if !absent.is_empty() {
        answer.line(format!("not in the file, not compared: {}", absent.join(", ")));
    }
    let ok = rows.iter().all(|r| r.ok);
    finish(&rows, ok, json!({ "absent": absent, "not_produced": [] }), &progress, answer)
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

/// Answers with the rows and the fields of `extra`, an object.
fn finish(
    rows: &[Row],
    ok: bool,
    extra: Value,
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
    let mut report = json!({
        "ok": ok,
        "tensors": tensors,
        "seconds": progress.seconds(),
        "peak_memory_bytes": peak_memory_bytes(),
    });
    if let (Some(report), Value::Object(extra)) = (report.as_object_mut(), extra) {
        report.extend(extra);
    }
    answer.finish(&report)?;
    Ok(ok)
}
