//! Draws a .ply from the front, with all of it in view.

use std::error::Error;
use subsplat::{Bounds, Rgb, Splats, save_png};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scene, out] = arguments.as_slice() else {
        return Err("expected SCENE.PLY OUT.PNG".into());
    };
    let splats = Splats::load(scene)?;
    let bounds = Bounds::of(splats.means()).ok_or("the scene holds no Gaussian")?;
    let camera = bounds.camera(60f32.to_radians(), 1024)?;
    save_png(out, &Rgb::from(&splats.render(&camera)))?;
    Ok(())
}
