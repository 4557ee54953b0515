//! Optimises the opacities of a scene towards a picture, by gradients through the rasterizer:
//!
//! ```text
//! cargo run --release --example optimise_splats -- scene.ply
//! ```

use std::error::Error;
use subsplat::network::candle_core::{Device, Var};
use subsplat::{Bounds, RasterOptions, SplatTensors, Splats, rasterize};

fn main() -> Result<(), Box<dyn Error>> {
    let path = std::env::args().nth(1).ok_or("expected SCENE")?;
    let splats = Splats::load(path)?;
    let bounds = Bounds::of(splats.means()).ok_or("the scene holds no Gaussian")?;
    let camera = bounds.camera(60f32.to_radians(), 256)?;
    let options = RasterOptions::default();
    let mut tensors = SplatTensors::new(&splats, &Device::Cpu)?;
    let truth = rasterize(&tensors, &camera, &options)?.detach();
    let rows = Var::from_tensor(&tensors.rows.affine(0.98, 0.0)?)?;
    for step in 0..10 {
        tensors.rows = rows.as_tensor().clone();
        let loss = (rasterize(&tensors, &camera, &options)? - &truth)?.sqr()?.mean_all()?;
        println!("step {step}: {}", loss.to_scalar::<f32>()?);
        let gradients = loss.backward()?;
        let gradient = gradients.get(&rows).ok_or("the loss does not depend on the scene")?;
        rows.set(&(rows.as_tensor() - (gradient * 1.0)?)?)?;
    }
    Ok(())
}
