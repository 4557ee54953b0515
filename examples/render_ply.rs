//! Renders a splat file from one camera, without candle or the network:
//!
//! ```text
//! cargo run --release --example render_ply -- scene.ply cameras.json view.png
//! ```

use anyhow::{Context, Result, bail};
use std::path::Path;
use subsplat::abi::RasterOptions;
use subsplat::io::cameras_json::load_cameras_json;
use subsplat::io::image::{Rgb, save_png};
use subsplat::io::load_splats;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scene, cameras, out] = arguments.as_slice() else {
        bail!("expected SCENE CAMERAS.JSON OUT.PNG, got {arguments:?}")
    };
    let splats = load_splats(Path::new(scene))?;
    let cameras = load_cameras_json(Path::new(cameras))?;
    let camera = cameras.cameras.first().context("a camera")?.camera;
    let picture = subsplat::render(&splats, &camera, &RasterOptions::default());
    let data = picture.rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
    save_png(Path::new(out), &Rgb { width: picture.width, height: picture.height, data })?;
    Ok(())
}
