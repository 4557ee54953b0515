//! `subsplat-lab eval`: scores methods on photographs.

use super::args_eval::{CropArg, EvalArgs, LrFromArg};
use crate::eval::{
    Benchmark, CaseResult, Evaluator, Method, Options, Preparation, Score, Scores, Sheet,
    means_csv, page, report, targets_csv,
};
use anyhow::{Context, Result, ensure};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::Write;
use std::path::Path;
use subsplat::files::photos::image::save_png;
use subsplat::files::write_atomic;
use subsplat::reconstruct::inputs::crop::{CropRule, LrFrom};
use subsplat::reconstruct::{DepthRange, Poses, Reconstructor, is_mvsplat};
use subsplat_cli::commands::args::DetailArg;
use subsplat_cli::commands::memory::{self, Planned};
use subsplat_cli::commands::model;
use subsplat_cli::report::{
    Answer, Progress, mebibytes, peak_memory_bytes, print_line, print_warning,
};

/// r without arguments or weights that state one.
const UPSCALE: f32 = 2.0;
/// Largest number of cases on the page; each takes some hundred kilobytes.
const SHEETS: usize = 60;
/// Reason for an empty LPIPS column.
const NO_LPIPS: &str = "not measured: VGG16's weights were not given (--lpips FILE)";

/// Runs the command.
pub fn eval(args: &EvalArgs, answer: Answer) -> Result<()> {
    let mut progress = Progress::new();
    let ratio = args.upscale;
    let mut data = progress.stage("data", |_| -> Result<_> {
        let mut data = Benchmark::open(&args.data, args.index.as_deref())?;
        data.set_depth_range(DepthRange::from_ends(args.near, args.far));
        if let Some(count) = args.contexts {
            data.spread_contexts(count, args.holdout)?;
        }
        Ok(data)
    })?;
    data.notes().iter().for_each(|n| print_line(format!("note: {n}")));
    if let Some(limit) = args.limit {
        data.limit(limit);
    }
    if let Some((part, parts)) = args.shard {
        data.keep_part(part, parts).context("--shard")?;
    }
    let needed = methods(args, ratio.unwrap_or(UPSCALE))?.iter().any(Method::needs_model);
    let model = if needed { Some(progress.stage("model", |_| load(args, ratio))?) } else { None };
    let own = model.as_ref().map(|m| m.config().upscale as f32);
    let upscale = ratio.or(own).unwrap_or(UPSCALE);
    let options = Options {
        input_size: args.input_size,
        methods: methods(args, upscale)?,
        rule: rule(args, &data, model.as_ref()),
        lr_from: match args.lr_from {
            LrFromArg::HrCrop => LrFrom::HrCrop,
            LrFromArg::Independent => LrFrom::Independent,
        },
        disturbances: args.disturb.clone(),
        preparation: Preparation {
            poses: args.adjust_poses.into(),
            equal_exposure: args.equal_exposure,
        },
        density: args.gaussians,
        refine: args.refine,
        ..Options::new(upscale)
    };
    if let Some(model) = &model {
        check_memory(model, &data, &options)?;
    }
    let mut evaluator = Evaluator::new(options);
    if let Some(path) = &args.lpips {
        evaluator = progress.stage("LPIPS", |_| evaluator.with_lpips(path))?;
    }
    let out = args.out.as_deref();
    if let Some(out) = out {
        std::fs::create_dir_all(out).with_context(|| format!("output folder {}", out.display()))?;
    }
    let (scores, sheets) = run(&mut progress, &evaluator, model.as_ref(), &data, out)?;
    print_scores(&scores, evaluator.options().upscale, answer);
    if args.lpips.is_none() {
        answer.line(format!("LPIPS {NO_LPIPS}"));
    }
    let mut all = report(&scores);
    all["protocol"] = protocol(args, evaluator.options(), model.as_ref());
    all["notes"] = json!(data.notes());
    if let Some(out) = out {
        progress.stage("writing", |_| write(out, args, &scores, &sheets, &all))?;
        answer.line(format!("tables, pictures and index.html in {}", out.display()));
    }
    all["seconds"] = Value::Object(progress.seconds());
    let peak = peak_memory_bytes();
    all["peak_memory_bytes"] = json!(peak);
    let seconds = all["seconds"]["total"].as_f64().unwrap_or(0.0);
    let memory = peak.map_or(String::new(), |p| format!(", peak memory {}", mebibytes(p)));
    answer.line(format!("{seconds:.1} s{memory}"));
    answer.finish(&all)
}

fn load(args: &EvalArgs, ratio: Option<f32>) -> Result<Reconstructor> {
    model::load(&model::ModelRequest {
        weights: args.weights.as_deref(),
        seed: args.seed,
        upscale: None,
        ratio: ratio.map(|r| r.ceil() as usize),
        model: &args.model,
    })
}

/// The methods of the arguments at `upscale`, checked: no name twice.
fn methods(args: &EvalArgs, upscale: f32) -> Result<Vec<Method>> {
    let mut all =
        if args.methods.is_empty() { Options::new(upscale).methods } else { args.methods.clone() };
    if args.detail == DetailArg::Photo && !all.contains(&Method::Detail) {
        let place = all.iter().position(|m| *m == Method::Subsplat).map_or(0, |i| i + 1);
        all.insert(place, Method::Detail);
    }
    for pred in &args.pred {
        ensure!(
            matches!(pred, Method::Other { .. }),
            "--pred: expected NAME=DIR, got `{}`",
            pred.name()
        );
        all.push(pred.clone());
    }
    for (i, method) in all.iter().enumerate() {
        let name = method.name();
        ensure!(
            !all[..i].iter().any(|m| m.name() == name),
            "--methods: expected different names, got `{name}` twice"
        );
        if let Method::Other { folder, .. } = method {
            ensure!(folder.is_dir(), "{name}={0}: expected a folder of pictures", folder.display());
        }
    }
    Ok(all)
}

fn rule(args: &EvalArgs, data: &Benchmark, model: Option<&Reconstructor>) -> CropRule {
    let published = data.is_chunks() && model.is_some_and(|m| is_mvsplat(m.config()));
    match args.crop {
        Some(CropArg::Mvsplat) => CropRule::Mvsplat,
        None if published => CropRule::Mvsplat,
        _ => CropRule::Exact,
    }
}

/// Rejects sizes that exceed the memory, before any work.
fn check_memory(model: &Reconstructor, data: &Benchmark, options: &Options) -> Result<()> {
    let mut config = model.config().clone();
    config.upscale = config.upscale.max(options.upscale.ceil() as usize);
    for case in data.cases() {
        let nominal = case.resolution.map(|[w, h]| (w, h)).unwrap_or((256, 256));
        memory::check_run(&Planned {
            config: &config,
            views: case.views.context.len(),
            input: options.input_size.unwrap_or(nominal),
            density: options.density,
        })?;
    }
    Ok(())
}

/// Evaluates all cases in order, and writes their pictures.
fn run(
    progress: &mut Progress,
    evaluator: &Evaluator,
    model: Option<&Reconstructor>,
    data: &Benchmark,
    out: Option<&Path>,
) -> Result<(Scores, Vec<Sheet>)> {
    let mut scores = Scores { methods: evaluator.methods(), cases: Vec::new() };
    let mut sheets = Vec::new();
    progress.steps("cases", data.cases().len(), |bar| -> Result<()> {
        for case in data.cases() {
            let result = data
                .load(case)
                .and_then(|loaded| evaluator.case(model, case, loaded))
                .with_context(|| format!("scene {} ({})", case.scene, case.pair()))?;
            if result.scores.enlarged {
                let scene = &case.scene;
                bar.suspend(|| {
                    print_warning(format!("{scene}: photographs smaller than the target"))
                });
            }
            if let Some(out) = out {
                pictures(out, &case.pair(), &scores.methods, &result)?;
                if sheets.len() < SHEETS {
                    sheets.push(Sheet::new(&result, &scores.methods)?);
                }
            }
            scores.cases.push(result.scores);
            bar.inc(1);
        }
        Ok(())
    })?;
    Ok((scores, sheets))
}

/// Writes `pictures/METHOD/SCENE/INPUTS/FRAME.png`, as `--pred` reads them; `truth` too.
fn pictures(out: &Path, pair: &str, methods: &[String], result: &CaseResult) -> Result<()> {
    let scene = result.scores.scene.replace(['/', '\\', ':'], "_");
    let folder = |method: &str| out.join("pictures").join(method).join(&scene).join(pair);
    let make = |method: &str| {
        let folder = folder(method);
        std::fs::create_dir_all(&folder).with_context(|| folder.display().to_string())
    };
    make("truth")?;
    methods.iter().try_for_each(|m| make(m))?;
    for (target, pictures) in result.scores.targets.iter().zip(&result.pictures) {
        let file = format!("{:06}.png", target.frame);
        save_png(folder("truth").join(&file), &pictures.truth)?;
        for (method, picture) in methods.iter().zip(&pictures.methods) {
            save_png(folder(method).join(&file), picture)?;
        }
    }
    Ok(())
}

fn print_scores(scores: &Scores, upscale: f32, answer: Answer) {
    let line = |name: &str, mean: Option<Score>| {
        let cell = |v: Option<f64>, digits: usize| {
            v.map_or_else(|| format!("{:>7}", "-"), |v| format!("{v:7.digits$}"))
        };
        format!(
            "  {name:<12} {} {} {} {} {}",
            cell(mean.map(|s| s.psnr), 2),
            cell(mean.map(|s| s.ssim), 4),
            cell(mean.and_then(|s| s.lpips), 4),
            cell(mean.and_then(|s| s.sharpness), 3),
            cell(mean.map(|s| s.gmsd), 4),
        )
    };
    let head = format!(
        "  {:<12} {:>7} {:>7} {:>7} {:>7} {:>7}",
        "", "PSNR", "SSIM", "LPIPS", "sharp", "GMSD"
    );
    let scenes = scores.scenes();
    if scenes.len() > 1 && scenes.len() <= 20 {
        for scene in &scenes {
            answer.line(scene);
            answer.line(&head);
            for method in &scores.methods {
                answer.line(line(method, scores.scene_mean(scene, method)));
            }
        }
    }
    let targets: usize = scores.cases.iter().map(|c| c.targets.len()).sum();
    answer.line(format!(
        "{targets} targets, {} cases, {} scenes, x{upscale}: mean over each case's targets, then \
         over cases",
        scores.cases.len(),
        scenes.len()
    ));
    answer.line(sizes(scores));
    answer.line(&head);
    for method in &scores.methods {
        answer.line(line(method, scores.mean(method)));
    }
    print_inputs(scores, answer);
}

/// Prints the scores at the inputs' own cameras and the distribution of the Gaussians.
fn print_inputs(scores: &Scores, answer: Answer) {
    let three = |v: [f64; 3]| v.map(|v| format!("{v:.2}")).join(" / ");
    let mut head = Some(format!(
        "at the inputs' own cameras\n  {:<12} {:>7} {:>7} {:>7} {:>10} {:>20} {:>20} {:>8}",
        "", "PSNR", "SSIM", "sharp", "Gaussians", "sigma, target px", "opacity", "coverage"
    ));
    for method in &scores.methods {
        let report = scores.input_mean(None, method);
        let (Some(score), Some(g)) = (report.inputs, report.gaussians) else { continue };
        if let Some(head) = head.take() {
            answer.line(head);
        }
        let sharpness = score.sharpness.map_or_else(|| "-".to_owned(), |s| format!("{s:.3}"));
        answer.line(format!(
            "  {method:<12} {:7.2} {:7.4} {sharpness:>7} {:10.0} {:>20} {:>20} {:8.3}",
            score.psnr,
            score.ssim,
            g.count,
            three(g.sigma_px),
            three(g.opacity),
            g.coverage
        ));
    }
}

/// Formats the sizes of inputs and targets: `128x128 to 256x256 (14 cases), …`.
fn sizes(scores: &Scores) -> String {
    let mut counts: BTreeMap<[(usize, usize); 2], usize> = BTreeMap::new();
    scores.cases.iter().for_each(|c| *counts.entry(c.sizes).or_default() += 1);
    let one = |(&[(w, h), (to_w, to_h)], count): (&[(usize, usize); 2], &usize)| {
        let plural = if *count == 1 { "" } else { "s" };
        format!("{w}x{h} to {to_w}x{to_h} ({count} case{plural})")
    };
    counts.iter().map(one).collect::<Vec<_>>().join(", ")
}

/// A ratio as JSON: a whole number where it is one.
fn json_ratio(ratio: f32) -> Value {
    if ratio.fract() == 0.0 {
        return json!(ratio as usize);
    }
    // The shortest digits of the f32, not those of its value as f64.
    ratio.to_string().parse::<f64>().map_or(Value::Null, |r| json!(r))
}

fn protocol(args: &EvalArgs, options: &Options, model: Option<&Reconstructor>) -> Value {
    let config = model.map(Reconstructor::config);
    json!({
        "data": args.data.display().to_string(),
        "contexts": args.contexts,
        "holdout": args.holdout,
        "refine": args.refine.to_string(),
        "index": args.index.as_ref().map(|p| p.display().to_string()),
        "upscale": json_ratio(options.upscale),
        "crop": if options.rule == CropRule::Mvsplat { "mvsplat" } else { "exact" },
        "lr_from": if options.lr_from == LrFrom::HrCrop { "hr_crop" } else { "independent" },
        "disturbances": args.disturb.iter().map(|d| d.name()).collect::<Vec<_>>(),
        "poses": match options.preparation.poses {
            Poses::Adjusted => "adjusted",
            Poses::Given => "given",
            _ => "auto",
        },
        "equal_exposure": args.equal_exposure,
        "weights": args.weights.as_ref().map(|p| p.display().to_string()),
        "seed": args.seed,
        "shard": args.shard.map(|(part, parts)| format!("{part}/{parts}")),
        "untrained_tensors": model.map(|m| m.untrained_tensors().len()),
        "backbone": config.map(|c| if is_mvsplat(c) { "re10k" } else { "small" }),
        "children": config.map(|c| if c.spgr.enabled { c.children() } else { 1 }),
        "lpips": match &args.lpips {
            Some(path) => format!("VGG16, {}", path.display()),
            None => NO_LPIPS.to_owned(),
        },
    })
}

/// Writes tables and page, each atomically.
fn write(
    out: &Path,
    args: &EvalArgs,
    scores: &Scores,
    sheets: &[Sheet],
    all: &Value,
) -> Result<()> {
    let targets: usize = scores.cases.iter().map(|c| c.targets.len()).sum();
    let text = |key: &str| match &all["protocol"][key] {
        Value::String(s) => s.clone(),
        other => other.to_string(),
    };
    let weights = match &args.weights {
        Some(path) => format!("weights {}", path.display()),
        None => match args.seed {
            Some(seed) => format!("untrained weights, seed {seed}"),
            None => "the weights that ship".to_owned(),
        },
    };
    let mut notes = vec![
        format!(
            "{targets} targets of {} cases; target over input x{}, {}; {weights}; LPIPS: {}.",
            scores.cases.len(),
            text("upscale"),
            sizes(scores),
            text("lpips")
        ),
        "Means are over a case's targets first, then over cases. Sharpness is the mean absolute \
         gradient over the photograph's; GMSD is the gradient magnitude similarity deviation, 0 for \
         equal pictures. Sigma and opacity: quantiles of 10, 50 and 90 %. Windows show the photograph's busiest part of the \
         case's middle target."
            .to_owned(),
    ];
    if scores.cases.len() > sheets.len() {
        notes.push(format!("Pictures of the first {} cases.", sheets.len()));
    }
    let title = format!("subsplat eval: {}", args.data.display());
    let files = [
        ("eval.json", serde_json::to_string_pretty(all)?),
        ("targets.csv", targets_csv(scores)),
        ("means.csv", means_csv(scores)),
        ("index.html", page(&title, &notes, scores, sheets)),
    ];
    for (name, content) in files {
        write_atomic(out.join(name), |f| f.write_all(content.as_bytes()))?;
    }
    Ok(())
}
