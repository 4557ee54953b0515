//! Photographs without cameras become a scene and a new view, with progress:
//!
//! ```text
//! cargo run --release --example reconstruct -- a.jpg b.jpg scene.ply view.png
//! ```

use std::error::Error;
use std::ops::ControlFlow;
use subsplat::{LoadOptions, Options, Reconstructor, Rgb, load_photograph, save_png};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [photographs @ .., scene, view] = arguments.as_slice() else {
        return Err("expected PHOTOGRAPH PHOTOGRAPH... SCENE.PLY VIEW.PNG".into());
    };
    let load = |path| load_photograph(path, &LoadOptions::default());
    let photographs = photographs.iter().map(load).collect::<Result<Vec<_>, _>>()?;
    let model = Reconstructor::shipped(2)?;
    let result = model.run_with(photographs, &Options::default(), &mut |progress| {
        eprintln!("{:3.0} % {}", 100.0 * progress.fraction, progress.stage);
        ControlFlow::Continue(()) // ControlFlow::Break(()) cancels
    })?;
    result.save(scene)?;
    let camera = result.inputs()[0].target_camera;
    save_png(view, &Rgb::from(&result.render(&camera)))?;
    Ok(())
}
