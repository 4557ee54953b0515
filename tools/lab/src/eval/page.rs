//! One HTML page that contains all pictures: tables of scores, and one window of each method's
//! picture side by side.

use super::{CaseResult, InputReport, Score, Scores};
use std::fmt::Write;
use std::path::Path;
use subsplat::files::Result;
use subsplat::files::photos::image::png_bytes;
use subsplat::scene::metrics::mean_gradient;
use subsplat::scene::pictures::Rgb;
use subsplat_cli::report::escaped;

/// Side of the windows, target px.
const WINDOW: usize = 128;
/// Candidate windows along each side of a target.
const CANDIDATES: usize = 7;

/// A row of pictures on the page: one window of one target of a case.
#[derive(Clone, Debug)]
pub struct Sheet {
    title: String,
    /// Caption and PNG: inputs whole, then the photograph's and each method's window.
    cells: Vec<(String, Vec<u8>)>,
}

impl Sheet {
    /// Chooses the middle target of a case, and the window with the largest mean gradient.
    ///
    /// # Errors
    /// A picture that cannot be encoded.
    pub fn new(result: &CaseResult, methods: &[String]) -> Result<Self> {
        let scores = &result.scores;
        let place = result.pictures.len() / 2;
        let (Some(target), Some(pictures)) =
            (scores.targets.get(place), result.pictures.get(place))
        else {
            return Ok(Self { title: scores.scene.clone(), cells: Vec::new() });
        };
        let png = |picture: &Rgb| png_bytes(picture, Path::new("page"));
        let mut cells = Vec::new();
        for (frame, input) in scores.context.iter().zip(&result.inputs) {
            cells.push((format!("input {frame}, whole"), png(input)?));
        }
        let window = busiest(&pictures.truth, WINDOW);
        let cut =
            |p: &Rgb| p.window(window.0, window.1, window.2, window.3).unwrap_or_else(|| p.clone());
        cells.push(("photograph".to_owned(), png(&cut(&pictures.truth))?));
        for ((method, picture), score) in methods.iter().zip(&pictures.methods).zip(&target.scores)
        {
            cells.push((format!("{method} {:.2} dB", score.psnr), png(&cut(picture))?));
        }
        let context: Vec<String> = scores.context.iter().map(usize::to_string).collect();
        let title = format!(
            "{}: inputs {}, target {} ({}x{} at {},{})",
            scores.scene,
            context.join(" "),
            target.frame,
            window.2,
            window.3,
            window.0,
            window.1
        );
        Ok(Self { title, cells })
    }
}

/// Finds the window (left, top, width, height) of at most `side` px a side with the largest mean
/// gradient.
pub fn busiest(truth: &Rgb, side: usize) -> (usize, usize, usize, usize) {
    let (w, h) = (side.min(truth.width), side.min(truth.height));
    let mut best = (-1.0, (0, 0, w, h));
    for i in 0..CANDIDATES * CANDIDATES {
        let at = |space: usize, k: usize| space * k / (CANDIDATES - 1);
        let left = at(truth.width - w, i % CANDIDATES);
        let top = at(truth.height - h, i / CANDIDATES);
        let Some(window) = truth.window(left, top, w, h) else { continue };
        let detail = mean_gradient(&window.to_unit(), w, h).unwrap_or(0.0);
        if detail > best.0 {
            best = (detail, (left, top, w, h));
        }
    }
    best.1
}

const STYLE: &str = "body{font:14px/1.4 system-ui,sans-serif;margin:2em;color:#222}\
table{border-collapse:collapse;margin:1em 0}td,th{padding:.2em .7em;text-align:right;\
border-bottom:1px solid #ddd}td:first-child,th:first-child{text-align:left}\
.row{display:flex;flex-wrap:wrap;gap:8px}figure{margin:0}figcaption{font-size:12px}\
img{width:256px;image-rendering:pixelated;background:#eee;display:block}\
h2{font-size:15px;margin:1.6em 0 .4em}p{max-width:60em}";

/// Formats the page. Each of `notes` becomes a paragraph.
pub fn page(title: &str, notes: &[String], scores: &Scores, sheets: &[Sheet]) -> String {
    let mut html = format!(
        "<!DOCTYPE html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><title>{0}</title>\
         <style>{STYLE}</style></head><body><h1>{0}</h1>\n",
        escaped(title)
    );
    // Writing to a String does not fail.
    for note in notes {
        let _ = writeln!(html, "<p>{}</p>", escaped(note));
    }
    let _ = writeln!(html, "<table><tr><th>method</th>{HEADER}</tr>");
    for method in &scores.methods {
        let _ = writeln!(html, "<tr><td>{}</td>{}</tr>", escaped(method), row(scores.mean(method)));
    }
    let _ =
        writeln!(html, "</table>\n<table><tr><th>at the inputs' cameras</th>{INPUT_HEADER}</tr>");
    for method in &scores.methods {
        let report = scores.input_mean(None, method);
        if report.inputs.is_some() {
            let _ = writeln!(html, "<tr><td>{}</td>{}</tr>", escaped(method), input_row(&report));
        }
    }
    let _ = writeln!(html, "</table>\n<table><tr><th>scene</th><th>method</th>{HEADER}</tr>");
    for scene in scores.scenes() {
        for method in &scores.methods {
            let cells = row(scores.scene_mean(scene, method));
            let (scene, method) = (escaped(scene), escaped(method));
            let _ = writeln!(html, "<tr><td>{scene}</td><td>{method}</td>{cells}</tr>");
        }
    }
    html.push_str("</table>\n");
    for sheet in sheets {
        let _ = writeln!(html, "<h2>{}</h2><div class=\"row\">", escaped(&sheet.title));
        for (caption, png) in &sheet.cells {
            let caption = escaped(caption);
            let _ = writeln!(
                html,
                "<figure><img alt=\"{caption}\" src=\"data:image/png;base64,{}\"><figcaption>\
                 {caption}</figcaption></figure>",
                base64::encode(png)
            );
        }
        html.push_str("</div>\n");
    }
    html.push_str("</body></html>\n");
    html
}

const HEADER: &str = "<th>PSNR, dB</th><th>SSIM</th><th>LPIPS</th><th>sharpness</th><th>GMSD</th>";
const INPUT_HEADER: &str = "<th>PSNR, dB</th><th>SSIM</th><th>sharpness</th><th>Gaussians</th>\
    <th>σ, target px</th><th>opacity</th><th>coverage</th>";

/// Formats the figures of the inputs' own cameras.
fn input_row(report: &InputReport) -> String {
    let number = |v: Option<f64>, digits: usize| {
        v.map_or_else(|| "–".to_owned(), |v| format!("{v:.digits$}"))
    };
    let three = |v: Option<[f64; 3]>| {
        v.map_or_else(|| "–".to_owned(), |v| v.map(|v| format!("{v:.2}")).join(" / "))
    };
    let (score, gaussians) = (report.inputs, report.gaussians);
    [
        number(score.map(|s| s.psnr), 2),
        number(score.map(|s| s.ssim), 4),
        number(score.and_then(|s| s.sharpness), 3),
        number(gaussians.map(|g| g.count), 0),
        three(gaussians.map(|g| g.sigma_px)),
        three(gaussians.map(|g| g.opacity)),
        number(gaussians.map(|g| g.coverage), 3),
    ]
    .map(|cell| format!("<td>{cell}</td>"))
    .concat()
}

fn row(mean: Option<Score>) -> String {
    let cell = |v: Option<f64>, digits: usize| {
        v.map_or_else(|| "<td>–</td>".to_owned(), |v| format!("<td>{v:.digits$}</td>"))
    };
    [
        cell(mean.map(|s| s.psnr), 2),
        cell(mean.map(|s| s.ssim), 4),
        cell(mean.and_then(|s| s.lpips), 4),
        cell(mean.and_then(|s| s.sharpness), 3),
        cell(mean.map(|s| s.gmsd), 4),
    ]
    .concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_window_finds_the_detail() {
        let mut picture = Rgb::black(300, 200);
        for y in 60..190 {
            for x in 150..290 {
                picture.data[3 * (300 * y + x)] = if (x + y) % 2 == 0 { 255 } else { 0 };
            }
        }
        let (left, top, w, h) = busiest(&picture, WINDOW);
        assert_eq!((w, h), (128, 128));
        assert!((left, top) == (143, 60) || (left, top) == (172, 60), "{left} {top}");
        assert_eq!(busiest(&Rgb::black(20, 10), WINDOW), (0, 0, 20, 10));
    }
}
