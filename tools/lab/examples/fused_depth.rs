//! Depth of the Gaussians of nine views of a room, beside that of every pair of them, on rooms of the
//! generator, whose depth is known:
//!
//! ```text
//! cargo run --release --example fused_depth -- 12 91              # rooms, seed of the rooms
//! cargo run --release --example fused_depth -- 0 91 sheet.png     # a sheet of the first room instead
//! ```
//!
//! The error is the mean of |z − ẑ|/z over the pixels of all nine cameras that the pair covers (opacity
//! above one half). The scene of nine is measured at the same pixels.
//!
//! The sheet shows a view between the fifth and the seventh of the nine: from the first and the last photograph,
//! from five photographs as the network predicts them, from the same five refined on them, and the truth.

use anyhow::{Context, Result};
use std::path::Path;
use subsplat::reconstruct::DepthSource;
use subsplat::{
    Camera, DepthBounds, FitOptions, Options, Photo, Picture, Reconstruction, Reconstructor,
    Refine, Rgb, save_png,
};
use subsplat_lab::data::procedural::{CameraSpec, Example, ExampleSpec, View};

/// Views of a room: the two ends of a path, and cameras between them.
const VIEWS: usize = 9;
/// Side of the network's input, px; the Gaussians are made for twice the side.
const INPUT: usize = 128;
/// Opacity from which on a pixel is covered.
const COVERED: f32 = 0.5;

/// A room's views with their depth.
struct Room {
    photos: Vec<Photo>,
    cameras: Vec<Camera>,
    depths: Vec<Vec<f32>>,
    range: [f32; 2],
}

fn room(seed: u64) -> Result<Room> {
    let spec = ExampleSpec::new(2 * INPUT, 2 * INPUT, VIEWS - 2);
    let spec = ExampleSpec { cameras: CameraSpec { crop: 0.0, ..spec.cameras }, ..spec };
    let made = Example::new(seed, &spec);
    let photo = |(view, camera): (&View, &Camera)| {
        let data = view.rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect();
        Ok(Photo::new(Rgb { width: view.width, height: view.height, data }, *camera)?)
    };
    Ok(Room {
        photos: made.views.iter().zip(&made.cameras).map(photo).collect::<Result<_>>()?,
        depths: made.views.into_iter().map(|view| view.depth).collect(),
        cameras: made.cameras,
        range: [made.near, made.far],
    })
}

/// Reconstructs the scene of some photographs, refined on them or as the network predicts it.
fn scene(
    model: &Reconstructor,
    room: &Room,
    views: &[usize],
    refined: bool,
) -> Result<Reconstruction> {
    let photos: Vec<Photo> = views.iter().map(|i| room.photos[*i].clone()).collect();
    let [near, far] = room.range;
    let options = Options::default().with_input_size(INPUT, INPUT);
    let options = options.with_depth_prior(DepthBounds::new(near, far, DepthSource::PoseFile));
    let options = if refined {
        options
    } else {
        options.with_fit(FitOptions::off()).with_refine(Refine::Off)
    };
    Ok(model.run(&photos, &options)?)
}

/// Mean relative error of depth at the pixels that `mask` marks, and their share.
fn error(pictures: &[Picture], room: &Room, mask: &[Vec<bool>]) -> (f64, f64) {
    let (mut sum, mut count, mut pixels) = (0.0, 0usize, 0usize);
    for ((picture, truth), mask) in pictures.iter().zip(&room.depths).zip(mask) {
        pixels += truth.len();
        for ((z, truth), _) in picture.depth.iter().zip(truth).zip(mask).filter(|(_, m)| **m) {
            sum += f64::from((z - truth).abs() / truth);
            count += 1;
        }
    }
    (sum / count.max(1) as f64, count as f64 / pixels.max(1) as f64)
}

fn pictures(scene: &Reconstruction, room: &Room) -> Vec<Picture> {
    room.cameras.iter().map(|camera| scene.render(camera)).collect()
}

/// Covered pixels with a surface.
fn covered(pictures: &[Picture], room: &Room) -> Vec<Vec<bool>> {
    let of = |(p, truth): (&Picture, &Vec<f32>)| {
        p.alpha.iter().zip(truth).map(|(a, z)| *a > COVERED && *z > 0.0).collect()
    };
    pictures.iter().zip(&room.depths).map(of).collect()
}

/// Writes the sheet of a room.
fn write_sheet(model: &Reconstructor, room: &Room, path: &Path) -> Result<()> {
    let eye = |i: usize| room.cameras[i].position();
    let mut order: Vec<usize> = (0..VIEWS).collect();
    order.sort_by(|a, b| eye(*a).distance(eye(0)).total_cmp(&eye(*b).distance(eye(0))));
    let two = [0, 8].map(|i| order[i]);
    let five = [0, 2, 4, 6, 8].map(|i| order[i]);
    let view = &room.cameras[order[5]];
    let truth = room.photos[order[5]].image();
    let drawn = [(&two[..], true), (&five[..], false), (&five[..], true)];
    let mut panels = Vec::new();
    for (views, refined) in drawn {
        let rgb = Rgb::from(&scene(model, room, views, refined)?.render(view));
        let mse = rgb.data.iter().zip(&truth.data).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2));
        let mse = mse.sum::<f64>() / truth.data.len() as f64;
        println!(
            "{} photographs, refined {refined}: {:.2} dB",
            views.len(),
            10.0 * (255.0f64.powi(2) / mse).log10()
        );
        panels.push(rgb);
    }
    panels.push(truth.clone());
    let (width, height) = (truth.width, truth.height);
    let row =
        |y: usize| panels.iter().flat_map(move |p| &p.data[3 * width * y..3 * width * (y + 1)]);
    let data = (0..height).flat_map(row).copied().collect();
    Ok(save_png(path, &Rgb { width: width * panels.len(), height, data })?)
}

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let mut number = |default: u64| -> Result<u64> {
        arguments.next().map_or(Ok(default), |text| text.parse().context("a number"))
    };
    let (rooms, seed) = (number(12)?, number(91)?);
    let model = Reconstructor::shipped(2)?;
    if let Some(path) = arguments.next() {
        return write_sheet(&model, &room(1000 * seed)?, Path::new(&path));
    }
    let all: Vec<usize> = (0..VIEWS).collect();
    println!(
        "mean relative error of depth, %: nine views refined, nine views; best pair, nine views at \
         its pixels (their share); mean of the pairs; pairs below nine views at their pixels"
    );
    let mut means = [0.0; 5];
    for i in 0..rooms {
        let room = room(1000 * seed + i)?;
        let refined = pictures(&scene(&model, &room, &all, true)?, &room);
        let fused = pictures(&scene(&model, &room, &all, false)?, &room);
        let [own, plain] = [&refined, &fused].map(|p| error(p, &room, &covered(p, &room)).0);
        let mut best = [f64::INFINITY; 3];
        let mut sum = 0.0;
        let mut better = 0;
        let mut pairs = 0;
        for a in 0..VIEWS {
            for b in a + 1..VIEWS {
                let pair = pictures(&scene(&model, &room, &[a, b], false)?, &room);
                let mask = covered(&pair, &room);
                let ((one, share), (nine, _)) =
                    (error(&pair, &room, &mask), error(&fused, &room, &mask));
                if one < best[0] {
                    best = [one, nine, share];
                }
                sum += one;
                better += usize::from(one < nine);
                pairs += 1;
            }
        }
        let mean = sum / f64::from(pairs);
        let row = [own, plain, best[0], best[1], mean];
        means.iter_mut().zip(row).for_each(|(m, v)| *m += v / rooms as f64);
        let [own, plain, one, nine, mean] = row.map(|v| 100.0 * v);
        let share = 100.0 * best[2];
        println!(
            "room {i:2}: {own:5.2} {plain:5.2}; {one:5.2} {nine:5.2} ({share:.0}); {mean:5.2}; {better} of {pairs}"
        );
    }
    let [own, plain, one, nine, mean] = means.map(|v| 100.0 * v);
    println!("mean:    {own:5.2} {plain:5.2}; {one:5.2} {nine:5.2}; {mean:5.2}");
    Ok(())
}
