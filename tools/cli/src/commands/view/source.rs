//! Where the splats in the window come from: a finished scene, or photographs, which can
//! be taken again with another number of children.

use crate::commands::args::DetailArg;
use crate::commands::args_view::ViewArgs;
use crate::commands::{frames, info, model, pair, range, render, run};
use crate::report::{Progress, say, warn};
use anyhow::{Context, Result, bail, ensure};
use std::path::Path;
use subsplat::abi::RasterOptions;
use subsplat::data::depth::depth_range;
use subsplat::io::{SplatFormat, load_with_comments};
use subsplat::navigation::{Start, up_of};
use subsplat::pipeline::{self, Photo, Reconstruction, Reconstructor, Request};
use subsplat::splats::Splats;

/// Highest SH degree of a finished scene.
const SH_DEGREE: usize = 4;

/// Splats, and how they are drawn.
pub struct Made {
    pub splats: Splats,
    pub options: RasterOptions,
    /// r, the children's grid being r×r; a finished scene has none.
    pub upscale: Option<usize>,
}

/// All that a window begins with.
pub struct Source {
    /// For the title and for pictures' names.
    pub name: String,
    pub start: Start,
    pub made: Made,
    /// Where the splats can be made again.
    pub photographs: Option<Photographs>,
}

/// Photographs that are ready for the network.
pub struct Photographs {
    args: ViewArgs,
    photos: Vec<Photo>,
    request: Request,
}

/// What the arguments name.
pub fn open(args: &ViewArgs, progress: &mut Progress) -> Result<Source> {
    match args.input.as_slice() {
        [one] if is_splats(one)? => finished(args, one, progress),
        _ => photographs(args, progress),
    }
}

/// Refuses what photographs alone have a use for where a finished scene is named.
pub fn check(args: &ViewArgs) -> Result<()> {
    if let ([one], Some(flag)) = (args.input.as_slice(), args.for_photographs())
        && is_splats(one)?
    {
        bail!("{flag}: only with photographs; {} is a finished scene", one.display());
    }
    Ok(())
}

fn is_splats(path: &Path) -> Result<bool> {
    if !path.is_file() {
        return Ok(false);
    }
    let named = SplatFormat::from_name(path).is_some();
    Ok(named || SplatFormat::from_magic(&info::head(path)?).is_some())
}

fn finished(args: &ViewArgs, path: &Path, progress: &mut Progress) -> Result<Source> {
    let (splats, comments) = progress.stage("scene", |_| load_with_comments(path))?;
    let options = render::options(&args.look(), args.source.near, SH_DEGREE, &comments)?;
    let beside = path.parent().unwrap_or(Path::new("")).join("cameras.json");
    let cameras = match &args.cameras {
        Some(source) => render::read_cameras(source)?,
        None if beside.is_file() => render::read_cameras(&beside)?,
        None => vec![(String::new(), render::whole(&splats)?)],
    };
    let Some((_, home)) = cameras.first() else {
        let source = args.cameras.as_ref().unwrap_or(&beside);
        bail!("{}: expected a camera, got none", source.display())
    };
    let start = Start {
        home: *home,
        up: up_of(cameras.iter().map(|(_, c)| c)),
        distance: render::median_depth(&splats, home),
        radius: render::bounds(&splats)?.radius(),
    };
    let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let made = Made { splats, options, upscale: None };
    Ok(Source { name, start, made, photographs: None })
}

fn photographs(args: &ViewArgs, progress: &mut Progress) -> Result<Source> {
    ensure!(args.cameras.is_none(), "--cameras: only with a finished scene");
    let input_size = frames::size(&args.source.input_size)?;
    let scene = progress.stage("scene", |_| pair::load(&args.input, &args.source.pair))?;
    scene.warnings.iter().for_each(warn);
    let first = args.input.first().context("no input")?;
    let (context, why) = run::context(&args.source.context, first, &scene)?;
    say(format!("{}: {} frames; context {why}", scene.name, scene.frames.len()));
    let given = (args.source.near, args.source.far);
    let guess = depth_range(&scene, &context, given)?;
    let model = progress.stage("model", |_| load_model(args, args.source.upscale))?;
    run::check_size(&model, context.len(), input_size)?;
    let photos = run::photographs(&scene, &context, progress)?;
    let reports = match args.source.no_check {
        true => Vec::new(),
        false => progress.stage("check", |_| pipeline::check_photos(&photos))?,
    };
    let range = range::refine(guess, given, &reports);
    let request = Request {
        input_size,
        near_far: (range.near, range.far),
        detail: args.source.detail == DetailArg::Photo,
        look: given == (None, None),
    };
    let photographs = Photographs { args: args.clone(), photos, request };
    let result = progress.stage("network", |bar| {
        photographs.reconstruct(&model, &mut |name| bar.set_message(name))
    })?;
    result.warnings.iter().for_each(warn);
    let cameras: Vec<_> = scene.frames.iter().map(|f| f.camera).collect();
    let (Some(input), Some(depth)) = (result.inputs.first(), result.depths.first()) else {
        bail!("{}: expected photographs, got none", scene.name)
    };
    let start = Start {
        home: input.target_camera,
        up: up_of(cameras.iter()),
        distance: run::median(&depth.data),
        radius: render::bounds(&result.splats)?.radius(),
    };
    let made = photographs.made(&model, result);
    Ok(Source { name: scene.name, start, made, photographs: Some(photographs) })
}

fn load_model(args: &ViewArgs, upscale: Option<usize>) -> Result<Reconstructor> {
    model::load(&model::Asked { upscale, ..model::Asked::of(&args.source) })
}

impl Photographs {
    /// The same scene with r×r children to a pixel; `stage` hears what is being done.
    pub fn make(&self, upscale: usize, stage: &mut dyn FnMut(&'static str)) -> Result<Made> {
        stage("model");
        let model = load_model(&self.args, Some(upscale))?;
        run::check_size(&model, self.photos.len(), self.request.input_size)?;
        let result = self.reconstruct(&model, stage)?;
        Ok(self.made(&model, result))
    }

    fn reconstruct(
        &self,
        model: &Reconstructor,
        stage: &mut dyn FnMut(&'static str),
    ) -> Result<Reconstruction> {
        Ok(model.reconstruct_with(&self.photos, &self.request, stage)?)
    }

    fn made(&self, model: &Reconstructor, result: Reconstruction) -> Made {
        let (near, _) = result.near_far;
        let config = model.config();
        let options = run::raster_options(&self.args.look(), config, (near, &result.inputs));
        Made { splats: result.splats, options, upscale: Some(config.upscale) }
    }
}
