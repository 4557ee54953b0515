//! Finds out where photographs were taken from, and prints the cameras:
//!
//! ```text
//! cargo run --release --example cameras -- a.jpg b.jpg c.jpg
//! ```

use std::error::Error;
use subsplat::{EstimateOptions, LoadOptions, estimate_cameras, load_photograph};

fn main() -> Result<(), Box<dyn Error>> {
    let load = |path| load_photograph(path, &LoadOptions::default());
    let photographs = std::env::args().skip(1).map(load).collect::<Result<Vec<_>, _>>()?;
    let estimated = estimate_cameras(photographs, &EstimateOptions::default())?;
    for photo in &estimated.photos {
        let camera = photo.camera();
        println!("position {}, focal length {} px", camera.position(), camera.intrinsics().fx);
    }
    println!("{} points", estimated.estimate.points.len());
    Ok(())
}
