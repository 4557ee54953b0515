//! Photographs in memory become a picture, with progress, for at most ten minutes.

use std::{error::Error, ops::ControlFlow, time::Duration, time::Instant};
use subsplat::image::{RgbImage, open};
use subsplat::{Options, Photograph, Reconstructor};

fn picture(photographs: Vec<RgbImage>, cancelled: &dyn Fn() -> bool) -> subsplat::Result<RgbImage> {
    let photographs: Vec<_> = photographs.into_iter().map(Photograph::from_pixels).collect();
    let model = Reconstructor::shipped(2)?;
    let scene = model.run_with(photographs, &Options::default(), &mut |progress| {
        eprintln!("{:3.0} % {}", 100.0 * progress.fraction, progress.stage);
        if cancelled() { ControlFlow::Break(()) } else { ControlFlow::Continue(()) }
    })?;
    let camera = scene.inputs()[0].target_camera;
    Ok(RgbImage::from(&scene.render(&camera)))
}

fn main() -> Result<(), Box<dyn Error>> {
    let paths = std::env::args().skip(1);
    let photographs =
        paths.map(|path| Ok(open(path)?.to_rgb8())).collect::<Result<_, Box<dyn Error>>>()?;
    let start = Instant::now();
    let late = || start.elapsed() > Duration::from_secs(600);
    Ok(picture(photographs, &late)?.save("view.png")?)
}
