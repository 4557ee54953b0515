//! Makes a test set of procedural rooms for `subsplat-lab eval`, one scene folder each:
//!
//! ```text
//! cargo run --release --example make_rooms -- out/rooms 24 77   # folder, rooms, seed (and
//!     # the share of rooms with things close before the cameras: 0; the share of scenes of
//!     # shapes at random places, with cameras of a wide range: 0; the side of the pictures: 256)
//! subsplat-lab eval out/rooms --upscale 2
//! ```
//!
//! Two context pictures and two targets of 256², drawn as training draws its examples
//! but from another seed; `eval` halves the context pictures to get its ×2 input. Pictures of a larger
//! side have textures of 2048², so that they are sharp:
//!
//! ```text
//! cargo run --release --example make_rooms -- out/sharp_rooms 12 78 0 0 1024
//! subsplat-lab eval out/sharp_rooms --input-size 256 --upscale 4
//! ```

use anyhow::{Context, Result};
use std::path::PathBuf;
use subsplat_lab::train::TrainConfig;
use subsplat_lab::train::folders::write_scene;
use subsplat_lab::train::source::Source;
use subsplat_lab::train::validate::{Split, rooms};

/// Side of every picture by default, px.
const SIDE: usize = 256;
const TARGETS: usize = 2;

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let folder = PathBuf::from(arguments.next().unwrap_or_else(|| "out/rooms".to_owned()));
    let mut number = |default: u64| -> Result<u64> {
        arguments.next().map_or(Ok(default), |text| text.parse().context("a number"))
    };
    let (count, seed) = (number(24)?, number(77)?);
    let mut share = || arguments.next().map_or(Ok(0.0), |text| text.parse().context("a share"));
    let (foreground, scattered) = (share()?, share()?);
    let side = arguments.next().map_or(Ok(SIDE), |text| text.parse().context("a side"))?;
    let mut config = TrainConfig::default();
    config.model.upscale = 1;
    config.data.input = [side, side];
    config.data.targets = TARGETS;
    config.data.target_samples = 2;
    config.data.seed = seed;
    config.data.foreground = foreground;
    (config.data.scattered, config.data.wide) = (scattered, scattered);
    let mut source = rooms(&config, Split::HeldOut)?;
    source.spec.fine_textures = side > SIDE;
    for i in 0..count {
        write_scene(&*source.example(i)?, &folder.join(format!("room_{i:03}")))?;
    }
    println!("{count} rooms in {}", folder.display());
    Ok(())
}
