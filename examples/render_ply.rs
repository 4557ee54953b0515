//! Renders a splat file from one camera, without candle or the network:
//!
//! ```text
//! cargo run --release --example render_ply -- scene.ply cameras.json view.png
//! ```

use anyhow::{Context, Result, bail};
use subsplat::files::cameras_json::load_cameras_json;
use subsplat::scene::render;
use subsplat::{RasterOptions, Rgb, load_splats, save_png};

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scene, cameras, out] = arguments.as_slice() else {
        bail!("expected SCENE CAMERAS.JSON OUT.PNG, got {arguments:?}")
    };
    let splats = load_splats(scene)?;
    let cameras = load_cameras_json(cameras)?;
    let camera = cameras.cameras.first().context("a camera")?.camera;
    let picture = render(&splats, &camera, &RasterOptions::default());
    save_png(out, &Rgb::from(&picture))?;
    Ok(())
}
