//! `subsplat export`: writes a finished scene in another format.

use super::args::{ExportArgs, UpArg};
use super::html::Page;
use super::render;
use crate::report::{Answer, Progress, print_warning};
use anyhow::{Result, bail};
use serde_json::json;
use subsplat::files::poses::reading::SceneOptions;
use subsplat::files::splats::ply::is_own_comment;
use subsplat::files::{SaveOptions, SplatFormat, save_splats};
use subsplat::finish::reduce;
use subsplat::scene::render::{
    Renderer, camera_of_comments, comments_without_camera, options_of_comments, origin_of_comments,
    photographs_of_comments,
};
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{Convention, RasterOptions};

/// Runs the command.
pub fn export(args: &ExportArgs, answer: Answer) -> Result<()> {
    let mut progress = Progress::new();
    let file = render::scene_file(&args.scene)?;
    let html = args.out.extension().is_some_and(|e| e.eq_ignore_ascii_case("html"));
    if args.cameras.is_some() && !html && args.gaussians.is_none() {
        bail!(
            "--cameras: only .html files hold cameras, got {}; --gaussians uses them too",
            args.out.display()
        );
    }
    let format = SplatFormat::from_name(&args.out);
    if !html && format.is_none_or(|format| format == SplatFormat::Ksplat) {
        bail!(
            "{}: expected a name that ends in .ply, .glb, .spz, .sog, .splat or .html",
            args.out.display()
        );
    }
    let spz = format == Some(SplatFormat::Spz);
    if args.spz_version.is_some() && !spz {
        bail!("--spz-version: only with a .spz, got {}", args.out.display());
    }
    let (mut splats, mut comments) = progress.stage("scene", |_| render::load(&file, false))?;
    comments.retain(|comment| !is_own_comment(comment));
    let stored = options_of_comments(&comments);
    let all = splats.len();
    // The comments of `run` hold the photographs, of older files the first one; cameras.json the views.
    let photographs = photographs_of_comments(&comments);
    let own = camera_of_comments(&comments);
    let beside = if html || args.gaussians.is_some() {
        render::cameras_beside(
            args.cameras.as_deref(),
            &file,
            origin_of_comments(&comments),
            &SceneOptions::default(),
        )?
    } else {
        None
    };
    if let Some(density) = args.gaussians {
        let options = stored.unwrap_or_else(|| RasterOptions::new(Convention::Standard));
        let count = density.limit(all, 1, 1).max(1);
        let places = beside.iter().flatten().map(|(_, camera)| *camera);
        let cameras: Vec<Camera> = places.chain(own).collect();
        splats = progress.stage("merging", |_| {
            let renderer = &mut Renderer::default();
            Ok::<_, anyhow::Error>(reduce(&splats, &cameras, &options, count, renderer))
        })?;
    }
    // The camera of a comment holds in the axes that the file had.
    let kept = match args.up {
        None | Some(UpArg::Keep) => comments,
        Some(UpArg::Y | UpArg::Z) => comments_without_camera(&comments),
    };
    let save = SaveOptions {
        sh_degree: args.content.sh,
        min_opacity: args.content.min_opacity,
        up: args.up.map(Into::into).unwrap_or_default(),
        comments: kept,
        spz_version: args.spz_version.unwrap_or_default(),
    };
    let report = progress.stage("writing", |_| {
        if !html {
            return Ok(save_splats(&args.out, &splats, &save)?);
        }
        if args.up.is_some() {
            bail!("--up: a .html file shows the scene upright as it is; leave the flag out");
        }
        let options = stored.unwrap_or_else(|| RasterOptions::new(Convention::Standard));
        if options.convention == Convention::Mvsplat {
            print_warning(
                "the scene was made for --convention mvsplat; the page draws by the standard rules, which \
                 look a little different",
            );
        }
        let title = file.file_stem().unwrap_or_default().to_string_lossy();
        let given = args.cameras.is_some() && beside.is_some();
        let from_comments = !given && !photographs.is_empty();
        let first = || own.into_iter().map(|camera| (String::new(), camera)).collect();
        let cameras = if from_comments { photographs } else { beside.unwrap_or_else(first) };
        let page = Page {
            splats: &splats,
            cameras: &cameras,
            photographs: from_comments,
            options: &options,
            title: &title,
        };
        page.write(&args.out, &save)
    })?;
    report.notes().iter().for_each(print_warning);
    let kind =
        if html { "html".to_owned() } else { serde_json::to_value(report.format)?.to_string() };
    let kind = kind.trim_matches('"').to_owned();
    let of = if args.gaussians.is_some() { format!(" of {all}") } else { String::new() };
    answer.line(format!(
        "{}: {}{of} splats, colours of degree {} (0: the same from all sides), {:.1} MB",
        args.out.display(),
        report.count,
        report.sh_degree,
        report.bytes as f64 / 1e6
    ));
    let mut value = serde_json::to_value(&report)?;
    value["format"] = json!(kind);
    value["all"] = json!(all);
    value["file"] = json!(args.out.display().to_string());
    value["seconds"] = serde_json::Value::Object(progress.seconds());
    answer.finish(&value)
}
