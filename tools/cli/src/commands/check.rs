//! `subsplat check`: checks poses by points matched between the photographs.

use super::args::CheckArgs;
use super::info::{left_out, print_left_out};
use super::{frames, pair};
use crate::report::{Answer, Progress, peak_memory_bytes, print_line, print_warning};
use anyhow::{Context, Result, ensure};
use serde_json::json;
use subsplat::cameras::check::{
    CheckOptions, GrayImage, PairReport, RgbPicture, Verdict, check_pair, epipolar_picture,
};
use subsplat::files::photos::image::{LoadOptions, save_png};
use subsplat::files::poses::scene::{LoadedFrame, Scene};
use subsplat::reconstruct::inputs::pair::choose_pair;
use subsplat::scene::pictures::Rgb;

/// Runs the command; returns `false` where the poses are judged bad.
pub fn check(args: &CheckArgs, answer: Answer) -> Result<bool> {
    let mut progress = Progress::new();
    let wanted = [("--context", args.context.as_slice())];
    let pair::Loaded { scene, .. } =
        progress.stage("scene", |bar| pair::load(&args.input, &args.pair, &wanted, bar))?;
    scene.warnings.iter().for_each(print_warning);
    let pairs = pairs(args, &scene)?;
    print_line(format!(
        "{}: {} photographs ({}), {} pair(s) to check",
        scene.name,
        scene.frames.len(),
        scene.source.name(),
        pairs.len()
    ));
    std::fs::create_dir_all(&args.out)
        .with_context(|| format!("output folder {}", args.out.display()))?;
    let mut reports = Vec::new();
    let mut good = true;
    progress.steps("matching", pairs.len(), |bar| {
        for &[i, j] in &pairs {
            let (report, picture) = judge(&scene, i, j)?;
            good &= report.verdict != Verdict::Bad;
            let [a, b] = [i, j].map(|i| scene.frames[i].entry);
            let file = args.out.join(format!("epipolar_{a}_{b}.png"));
            if let Some(picture) = &picture {
                save_png(&file, picture)?;
            }
            bar.suspend(|| print_report(answer, &scene, [i, j], &report));
            // The report leaves out the matched points; the picture shows them.
            let mut value = serde_json::to_value(&report)?;
            value["frames"] = json!([scene.frames[i].name, scene.frames[j].name]);
            value["epipolar_picture"] = json!(picture.map(|_| file.display().to_string()));
            reports.push(value);
            bar.inc(1);
        }
        anyhow::Ok(())
    })?;
    print_line(format!(
        "pictures of the shared points and their lines are in {}",
        args.out.display()
    ));
    answer.finish(&json!({
        "scene": scene.name,
        "ok": good,
        "pairs": reports,
        "left_out": left_out(&scene),
        "seconds": progress.seconds(),
        "peak_memory_bytes": peak_memory_bytes(),
    }))?;
    print_left_out(&scene);
    Ok(good)
}

fn pairs(args: &CheckArgs, scene: &Scene) -> Result<Vec<[usize; 2]>> {
    let n = scene.frames.len();
    ensure!(n >= 2, "{}: expected at least 2 photographs, got {n}", args.input[0].display());
    if !args.context.is_empty() {
        let chosen = frames::indices(scene, &args.context, "--context")?;
        ensure!(
            chosen.len() >= 2,
            "--context: expected at least 2 photographs, got {}",
            chosen.len()
        );
        return Ok(chosen.windows(2).map(|w| [w[0], w[1]]).collect());
    }
    if n == 2 {
        return Ok(vec![[0, 1]]);
    }
    let tests = frames::protocol(&args.input[0], scene)?;
    let pairs: Vec<[usize; 2]> = tests
        .iter()
        .filter(|t| t.context.len() >= 2)
        .map(|t| [t.context[0], t.context[1]])
        .collect();
    if !pairs.is_empty() {
        return Ok(pairs);
    }
    Ok(choose_pair(scene).map_or(vec![[0, n - 1]], |pair| vec![pair.frames]))
}

fn judge(scene: &Scene, i: usize, j: usize) -> Result<(PairReport, Option<Rgb>)> {
    let [a, b] = [i, j].map(|i| scene.frames[i].load_with(&LoadOptions::default()));
    let (a, b) = (a?, b?);
    let (camera_a, camera_b) = (a.camera, b.camera);
    let options = CheckOptions::default();
    let report = check_pair(&grey(&a)?, &camera_a, &grey(&b)?, &camera_b, &options);
    fn picture(p: &Rgb) -> RgbPicture<'_> {
        RgbPicture { width: p.width, height: p.height, pixels: &p.data }
    }
    let drawn = epipolar_picture(
        [picture(&a.picture), picture(&b.picture)],
        [&camera_a, &camera_b],
        &report.points,
    )
    .map(|(width, height, data)| Rgb { width, height, data });
    Ok((report, drawn))
}

/// Grey copy of a photograph.
fn grey(photo: &LoadedFrame) -> Result<GrayImage> {
    let Rgb { width, height, .. } = photo.picture;
    GrayImage::from_picture(&photo.picture, photo.mask.as_ref())
        .with_context(|| format!("picture of {width}x{height} pixels"))
}

fn verdict_name(verdict: Verdict) -> &'static str {
    match verdict {
        Verdict::Ok => "ok",
        Verdict::Warning => "warning",
        Verdict::Bad => "bad",
    }
}

fn print_report(answer: Answer, scene: &Scene, [i, j]: [usize; 2], report: &PairReport) {
    let names = [&scene.frames[i].name, &scene.frames[j].name];
    answer.line(format!(
        "photographs {} ({}) and {} ({}): {}",
        scene.frames[i].entry,
        names[0],
        scene.frames[j].entry,
        names[1],
        verdict_name(report.verdict)
    ));
    let median = report.epipolar.as_ref().and_then(|e| e.median_px);
    answer.line(format!(
        "  {} points appear in both photographs; their distance from the lines that the cameras predict: \
         {}; cameras {:.4} apart, turned by {:.1}°, angle of view {:.1}°×{:.1}°{}",
        report.matches,
        median.map_or("an unknown number of pixels".to_owned(), |m| {
            format!("{m:.2} px (median, of 640 px)")
        }),
        report.baseline,
        report.rotation_deg,
        report.fov_deg[0][0],
        report.fov_deg[0][1],
        report
            .overlap
            .map_or(String::new(), |o| format!(", overlap {:.0} %", 100.0 * o[0].min(o[1])))
    ));
    for finding in &report.findings {
        answer.line(format!("  {}: {}", verdict_name(finding.severity), finding.sentence));
    }
}
