//! The `subsplat-convert` program: it converts PyTorch checkpoints to safetensors weights,
//! one tensor in memory at a time.

mod args;
mod numbers;
mod plan;
mod source;

use crate::failure;
use crate::report::{Answer, mebibytes, peak_memory_bytes, print_warning};
use anyhow::{Context, Result, ensure};
use args::Args;
use clap::{CommandFactory, Parser};
use numbers::Float;
use plan::Plan;
use serde_json::{Value, json};
use source::{Content, Source};
use std::collections::BTreeMap;
use std::path::Path;
use std::process::ExitCode;
use subsplat::files as io;
use subsplat::files::weights::tensors::{TensorSpec, write_tensors};
use subsplat::network::config::Config;

/// Names that are printed of each list; `--json` has all of them.
const NAMES_PRINTED: usize = 3;

/// The program's command line, from which its man page is made.
pub fn command() -> clap::Command {
    Args::command()
}

/// Runs the program with the process's arguments and returns its exit code.
pub fn main() -> ExitCode {
    let args = match Args::try_parse() {
        Ok(args) => args,
        Err(error) => return failure::report_usage(&error),
    };
    let answer = Answer::new(args.json);
    match run(&args, answer) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => failure::report_error(&error, answer),
    }
}

fn run(args: &Args, answer: Answer) -> Result<()> {
    let inputs: Vec<&Path> =
        std::iter::once(&args.input).chain(&args.lpips_linear).map(|p| p.as_path()).collect();
    check_output(&args.output, &inputs, args.force)?;
    let sources = inputs.iter().map(|path| Source::open(path)).collect::<Result<Vec<_>>>()?;
    let plan = plan::plan(args, &sources)?;
    let to = Float::from(args.dtype);
    let done = write(&args.output, &plan, &sources, to)?;
    print_summary(answer, args, &plan, &sources, &done);
    answer.finish(&report(args, &plan, &sources, &done))
}

/// Rejects, before any work, an output that would replace a file.
fn check_output(output: &Path, inputs: &[&Path], force: bool) -> Result<()> {
    let shown = output.display();
    let named = output.extension().is_some_and(|e| e.eq_ignore_ascii_case("safetensors"));
    ensure!(named, "{shown}: expected OUT to end in .safetensors");
    let Ok(existing) = output.canonicalize() else { return Ok(()) };
    let same = inputs.iter().any(|i| i.canonicalize().is_ok_and(|i| i == existing));
    ensure!(!same, "{shown}: expected another file than the input");
    ensure!(force, "{shown}: exists already; --force replaces it");
    Ok(())
}

/// Statistics of the file that was written.
struct Done {
    parameters: usize,
    /// Tensors of each type in the inputs.
    dtypes_in: BTreeMap<Float, usize>,
    bytes: u64,
}

fn write(output: &Path, plan: &Plan, sources: &[Source], to: Float) -> Result<Done> {
    let mut specs = Vec::with_capacity(plan.taken.len());
    let mut items = Vec::with_capacity(plan.taken.len());
    let mut dtypes_in = BTreeMap::new();
    for (name, &(s, e)) in &plan.taken {
        let Some((source, entry)) = sources.get(s).and_then(|s| Some((s, s.entries.get(e)?)))
        else {
            continue;
        };
        let Content::Floats { dtype, shape, .. } = &entry.content else { continue };
        specs.push(TensorSpec { name: name.clone(), dtype: to.dtype(), shape: shape.clone() });
        items.push((source, entry, *dtype));
        *dtypes_in.entry(*dtype).or_insert(0) += 1;
    }
    write_tensors(output, &specs, &metadata(plan, sources)?, |i| {
        let Some((source, entry, from)) = items.get(i) else { return Ok(Vec::new()) };
        numbers::convert(source.read(entry)?, *from, to).map_err(|rejected| {
            io::Error::format(&source.path, rejected.expected, rejected.got)
                .at(format!(" tensor `{}`", entry.name))
        })
    })?;
    let bytes = std::fs::metadata(output).with_context(|| output.display().to_string())?.len();
    let parameters = specs.iter().filter_map(TensorSpec::elements).sum();
    Ok(Done { parameters, dtypes_in, bytes })
}

/// Metadata of the file: kind, source and configuration of the weights.
fn metadata(plan: &Plan, sources: &[Source]) -> Result<BTreeMap<String, String>> {
    let join = |of: &dyn Fn(&Source) -> String| -> String {
        sources.iter().map(of).collect::<Vec<_>>().join(", ")
    };
    let mut metadata = BTreeMap::from([
        ("subsplat.kind".to_owned(), plan.kind.name().to_owned()),
        ("subsplat.source".to_owned(), join(&|s| s.file_name())),
        ("subsplat.source_sha256".to_owned(), join(&|s| s.sha256.clone())),
        (
            "subsplat.converter".to_owned(),
            concat!("subsplat-convert ", env!("CARGO_PKG_VERSION")).to_owned(),
        ),
    ]);
    if let Some(config) = &plan.config {
        metadata.insert(Config::METADATA_KEY.to_owned(), config.to_json()?);
    }
    Ok(metadata)
}

/// The lists of names in both reports, with their descriptions.
fn lists(plan: &Plan) -> [(&'static str, &[String], &'static str); 4] {
    [
        ("missing", &plan.missing, "of the architecture are missing"),
        ("unexpected", &plan.unexpected, "are not of the architecture and were left out"),
        ("not_needed", &plan.not_needed, "are not needed and were left out"),
        ("integers", &plan.integers, "hold integers and were left out"),
    ]
}

fn print_summary(answer: Answer, args: &Args, plan: &Plan, sources: &[Source], done: &Done) {
    for source in sources {
        let inside = source.inside.map_or_else(String::new, |key| format!(", weights at `{key}`"));
        answer.line(format!(
            "{}: {}{inside}, {}, sha256 {}",
            source.path.display(),
            source.format,
            size(source.bytes),
            source.sha256
        ));
        if source.beside.0 > 0 {
            let (n, bytes) = source.beside;
            answer.line(format!(
                "  {n} tensors beside the weights ({}; optimizer state) were left out",
                size(bytes)
            ));
        }
        if !source.opaque.is_empty() {
            let names: Vec<&str> = source.opaque.iter().map(String::as_str).collect();
            answer.line(format!("  names {}, which was not called", names.join(", ")));
        }
    }
    for (key, names, what) in lists(plan).into_iter().filter(|(_, names, _)| !names.is_empty()) {
        let first: Vec<String> =
            names.iter().take(NAMES_PRINTED).map(|n| format!("`{n}`")).collect();
        let dots = if names.len() > NAMES_PRINTED { ", …" } else { "" };
        let line = format!("{} tensors {what}: {}{dots}", names.len(), first.join(", "));
        match key {
            "missing" | "unexpected" => print_warning(line),
            _ => answer.line(format!("  {line}")),
        }
    }
    let from: Vec<String> =
        done.dtypes_in.iter().map(|(d, n)| format!("{n} {}", d.name())).collect();
    answer.line(format!(
        "{}: kind {}{}, {} tensors, {} parameters, {} to {}, {}",
        args.output.display(),
        plan.kind.name(),
        if plan.recognised { " (by its names)" } else { "" },
        plan.taken.len(),
        done.parameters,
        from.join(" and "),
        Float::from(args.dtype).name(),
        size(done.bytes)
    ));
}

fn size(bytes: u64) -> String {
    if bytes < 1 << 20 { format!("{bytes} bytes") } else { mebibytes(bytes) }
}

fn report(args: &Args, plan: &Plan, sources: &[Source], done: &Done) -> Value {
    let source = |s: &Source| {
        json!({
            "file": s.path.display().to_string(),
            "format": s.format,
            "weights_at": s.inside,
            "bytes": s.bytes,
            "sha256": s.sha256,
            "beside": { "tensors": s.beside.0, "bytes": s.beside.1 },
            "opaque_globals": s.opaque,
        })
    };
    let dtypes: BTreeMap<&str, usize> =
        done.dtypes_in.iter().map(|(d, n)| (d.name(), *n)).collect();
    let mut report = json!({
        "kind": plan.kind.name(),
        "recognised": plan.recognised,
        "inputs": sources.iter().map(source).collect::<Vec<_>>(),
        "output": args.output.display().to_string(),
        "bytes": done.bytes,
        "tensors": plan.taken.len(),
        "parameters": done.parameters,
        "dtypes_in": dtypes,
        "dtype": Float::from(args.dtype).name(),
        "config": plan.config,
        "peak_memory_bytes": peak_memory_bytes(),
    });
    for (key, names, _) in lists(plan) {
        report[key] = json!(names);
    }
    report
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_arguments_are_consistent() {
        Args::command().debug_assert();
    }
}
