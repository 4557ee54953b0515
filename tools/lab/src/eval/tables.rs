//! Scores as JSON and CSV.

use super::{InputReport, Score, Scores};
use serde_json::{Map, Value, json};
use std::fmt::Write;

/// Formats scores as JSON: `{"methods": {NAME: {psnr, ssim, lpips, sharpness, gmsd}}, "scenes":
/// {SCENE: {"methods": …, "cases": [{"context": …, "targets": [{"frame": …, "methods": …}]}]}}}`.
/// Beside each `methods` but those of targets, `inputs` holds `{NAME: {inputs: {psnr, …},
/// gaussians: {count, sigma_px, opacity, coverage}}}` ([`InputReport`]). Missing figures and
/// infinite PSNR are null.
pub fn report(scores: &Scores) -> Value {
    let methods = |of: &dyn Fn(&str) -> Option<Score>| -> Map<String, Value> {
        scores.methods.iter().map(|m| (m.clone(), json!(of(m)))).collect()
    };
    let inputs = |of: &dyn Fn(&str) -> InputReport| -> Map<String, Value> {
        scores.methods.iter().map(|m| (m.clone(), json!(of(m)))).collect()
    };
    let scene = |name: &&str| {
        let cases = scores.cases.iter().filter(|c| c.scene == *name).map(|case| {
            let place = |m: &str| scores.methods.iter().position(|x| x == m);
            let targets = case.targets.iter().map(|t| {
                let of = |m: &str| t.scores.get(place(m)?).copied();
                json!({ "frame": t.name, "index": t.frame, "methods": methods(&of) })
            });
            let targets: Vec<Value> = targets.collect();
            let [(iw, ih), (tw, th)] = case.sizes;
            json!({
                "context": case.context,
                "input": [iw, ih],
                "target": [tw, th],
                "near": case.near_far.near,
                "far": case.near_far.far,
                "photograph_enlarged": case.enlarged,
                "methods": methods(&|m| case.mean(place(m)?)),
                "inputs": inputs(&|m| {
                    place(m).and_then(|i| case.inputs.get(i).copied()).unwrap_or_default()
                }),
                "targets": targets,
            })
        });
        let cases: Vec<Value> = cases.collect();
        let mean = methods(&|m| scores.scene_mean(name, m));
        let of_inputs = inputs(&|m| scores.input_mean(Some(name), m));
        ((*name).to_owned(), json!({ "methods": mean, "inputs": of_inputs, "cases": cases }))
    };
    let scenes: Map<String, Value> = scores.scenes().iter().map(scene).collect();
    json!({
        "methods": methods(&|m| scores.mean(m)),
        "inputs": inputs(&|m| scores.input_mean(None, m)),
        "scenes": scenes,
        "cases": scores.cases.len(),
        "targets": scores.cases.iter().map(|c| c.targets.len()).sum::<usize>(),
    })
}

/// Names of the figures' columns.
const COLUMNS: &str = "psnr,ssim,lpips,sharpness,gmsd";
/// Names of the columns of [`InputReport`].
const INPUT_COLUMNS: &str = "inputs_psnr,inputs_ssim,inputs_sharpness,gaussians,\
    sigma_10,sigma_50,sigma_90,opacity_10,opacity_50,opacity_90,coverage";

fn figures(score: &Score) -> String {
    let cell = |v: Option<f64>| v.map_or_else(String::new, |v| format!("{v:.6}"));
    let Score { psnr, ssim, lpips, sharpness, gmsd } = score;
    format!("{psnr:.6},{ssim:.6},{},{},{gmsd:.6}", cell(*lpips), cell(*sharpness))
}

/// Formats the cells of [`INPUT_COLUMNS`].
fn input_figures(report: &InputReport) -> String {
    let score = report.inputs;
    let mut cells =
        vec![score.map(|s| s.psnr), score.map(|s| s.ssim), score.and_then(|s| s.sharpness)];
    let g = report.gaussians;
    cells.push(g.map(|g| g.count));
    cells.extend([0, 1, 2].map(|i| g.map(|g| g.sigma_px[i])));
    cells.extend([0, 1, 2].map(|i| g.map(|g| g.opacity[i])));
    cells.push(g.map(|g| g.coverage));
    let cell = |v: Option<f64>| v.map_or_else(String::new, |v| format!("{v:.6}"));
    cells.into_iter().map(cell).collect::<Vec<_>>().join(",")
}

/// Quotes a cell of a CSV file where necessary (RFC 4180).
fn quoted(text: &str) -> String {
    if text.contains([',', '"', '\n', '\r']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

/// Formats scores as CSV: one line for each target and method.
pub fn targets_csv(scores: &Scores) -> String {
    let mut text = format!("scene,context,target,frame,method,{COLUMNS}\n");
    for case in &scores.cases {
        let context: Vec<String> = case.context.iter().map(usize::to_string).collect();
        let scene = quoted(&case.scene);
        let context = context.join(" ");
        for t in &case.targets {
            for (method, score) in scores.methods.iter().zip(&t.scores) {
                let name = quoted(&t.name);
                let figures = figures(score);
                // Writing to a String does not fail.
                let _ = writeln!(text, "{scene},{context},{},{name},{method},{figures}", t.frame);
            }
        }
    }
    text
}

/// Formats means as CSV: one line for each method and scene, and one for each method over all
/// scenes (scene `*`).
pub fn means_csv(scores: &Scores) -> String {
    let mut text = format!("scene,method,{COLUMNS},{INPUT_COLUMNS}\n");
    let mut line = |scene: &str, method: &str, mean: Option<Score>, inputs: InputReport| {
        let figures = mean.map_or_else(|| ",,,,".to_owned(), |s| figures(&s));
        let _ = writeln!(text, "{scene},{method},{figures},{}", input_figures(&inputs));
    };
    for method in &scores.methods {
        line("*", method, scores.mean(method), scores.input_mean(None, method));
    }
    for scene in scores.scenes() {
        for method in &scores.methods {
            let inputs = scores.input_mean(Some(scene), method);
            line(&quoted(scene), method, scores.scene_mean(scene, method), inputs);
        }
    }
    text
}
