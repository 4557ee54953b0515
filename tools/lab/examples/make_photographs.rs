//! Makes two photographs as a phone writes them: 4000×3000 JPEG files of a room, taken a step
//! apart, with the distortion, the shade and the noise of a small lens and sensor, and with EXIF.
//! They have no camera file; `subsplat run` estimates the cameras:
//!
//! ```text
//! cargo run --release --example make_photographs -- out/photographs
//! subsplat run out/photographs/*.jpg -o out/from_photographs
//! ```
//!
//! `cameras.txt` beside them has the true pose of the second camera, for a person to compare.

use anyhow::{Context, Result};
use exif::experimental::Writer;
use exif::{Field, In, Rational, Tag, Value};
use glam::{Mat3, Mat4, Vec2, Vec3};
use image::ImageEncoder;
use image::codecs::jpeg::JpegEncoder;
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::layout::random::{GOLDEN, mix};
use subsplat_lab::data::procedural::{Grade, Quality, Room, TextureBank, View};

/// Room of `examples/room`, with finer textures.
const SEED: u64 = 7663;
const TEXTURE: usize = 2048;
const WIDTH: usize = 4000;
const HEIGHT: usize = 3000;
/// Focal length in terms of 35 mm film, mm, as EXIF states it.
const FILM_MM: u16 = 26;
/// Diagonal of 35 mm film, mm.
const FILM_DIAGONAL: f32 = 43.27;
/// Radial distortion left by the phone's own correction: x_d = x·(1 + k₁·|x|²).
const K1: f32 = -0.01;
/// Pixels that are rendered beyond each border: the distorted picture shows a little more.
const MARGIN: usize = 48;
/// Share of the light that a corner lacks.
const SHADE: f32 = 0.2;
/// Standard deviation of the noise, display values.
const NOISE: f32 = 0.012;
const JPEG_QUALITY: u8 = 92;
/// Positions of the two cameras, and what they look at, m.
const EYES: [Vec3; 2] = [Vec3::new(-0.62, -1.64, 0.76), Vec3::new(-0.36, -1.67, 0.94)];
const AIM: [Vec3; 2] = [Vec3::new(0.95, -0.6, -1.15), Vec3::new(0.9, -0.57, -1.2)];

fn main() -> Result<()> {
    let folder =
        PathBuf::from(std::env::args().nth(1).unwrap_or_else(|| "out/photographs".to_owned()));
    std::fs::create_dir_all(&folder)?;
    let focal = f32::from(FILM_MM) / FILM_DIAGONAL * (WIDTH as f32).hypot(HEIGHT as f32);
    let room = Room::with_bank(SEED, Arc::new(TextureBank::new(0, TEXTURE)));
    let mut cameras = Vec::new();
    for i in 0..2 {
        let camera = camera(i, focal)?;
        let grade = Grade { gain: [1.2; 3], softness: 0.6, ..Grade::default() };
        let view = room.render(&camera, &Quality { grade, ..Quality::training(grade) });
        let path = folder.join(format!("IMG_{:04}.jpg", i + 1));
        save(&path, &developed(&view, focal, i as u64), exif_block()?)?;
        cameras.push(camera);
    }
    let second = cameras[0].camera_from_world() * cameras[1].world_from_camera();
    let text = format!(
        "focal length {focal:.1} px\nsecond camera in the first one's axes (rows of the 4x4):\n{}\n{}\n{}\n",
        second.row(0),
        second.row(1),
        second.row(2)
    );
    std::fs::write(folder.join("cameras.txt"), text)?;
    println!("two photographs in {}", folder.display());
    Ok(())
}

/// Camera `i` of the picture with its margin.
fn camera(i: usize, focal: f32) -> Result<Camera> {
    let z = (AIM[i] - EYES[i]).normalize();
    let x = Vec3::Y.cross(z).normalize();
    let axes = Mat3::from_cols(x, z.cross(x), z);
    let (width, height) = (WIDTH + 2 * MARGIN, HEIGHT + 2 * MARGIN);
    let (cx, cy) = (width as f32 / 2.0, height as f32 / 2.0);
    let k = Intrinsics { fx: focal, fy: focal, cx, cy, width, height };
    Ok(Camera::new(k, Mat4::from_translation(EYES[i]) * Mat4::from_mat3(axes))?)
}

/// Bytes of the picture that the lens and the sensor make of a pinhole camera's.
fn developed(view: &View, focal: f32, seed: u64) -> Vec<u8> {
    let middle = Vec2::new(WIDTH as f32 / 2.0, HEIGHT as f32 / 2.0);
    let corner = middle.length() / focal;
    let pixel = |i: usize| {
        let at = Vec2::new((i % WIDTH) as f32 + 0.5, (i / WIDTH) as f32 + 0.5);
        let distorted = (at - middle) / focal;
        // The inverse of x_d = x·(1 + k₁|x|²) by three steps of a fixed-point iteration.
        let mut ideal = distorted;
        for _ in 0..3 {
            ideal = distorted / (1.0 + K1 * ideal.length_squared());
        }
        let light = 1.0 - SHADE * (distorted.length() / corner).powi(4);
        let colour = sample(view, ideal * focal + middle + Vec2::splat(MARGIN as f32)) * light;
        let noise =
            Vec3::from_array(std::array::from_fn(|c| normal(3 * i as u64 + c as u64, seed)));
        (colour + NOISE * noise).to_array().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8)
    };
    (0..WIDTH * HEIGHT).into_par_iter().flat_map_iter(pixel).collect()
}

/// Bilinear sample of display values at a position, px.
fn sample(view: &View, at: Vec2) -> Vec3 {
    let p = (at - 0.5).clamp(Vec2::ZERO, Vec2::new(view.width as f32, view.height as f32) - 1.001);
    let (x, y) = (p.x as usize, p.y as usize);
    let value = |x: usize, y: usize| Vec3::from_slice(&view.rgb[3 * (y * view.width + x)..]);
    let (right, down) = (p.x - x as f32, p.y - y as f32);
    value(x, y)
        .lerp(value(x + 1, y), right)
        .lerp(value(x, y + 1).lerp(value(x + 1, y + 1), right), down)
}

/// Normal number of a counter (Irwin-Hall with four uniform numbers of SplitMix64).
fn normal(counter: u64, seed: u64) -> f32 {
    let z = mix((counter ^ (seed << 48)).wrapping_mul(GOLDEN));
    let sum: f32 = (0..4).map(|k| ((z >> (16 * k)) & 0xFFFF) as f32 / 65536.0).sum();
    (sum - 2.0) * 3.0f32.sqrt()
}

/// The EXIF block of a phone.
fn exif_block() -> Result<Vec<u8>> {
    let text = |s: &str| Value::Ascii(vec![s.as_bytes().to_vec()]);
    let fields = [
        (Tag::Make, text("subsplat")),
        (Tag::Model, text("generator")),
        (Tag::Orientation, Value::Short(vec![1])),
        (Tag::FocalLength, Value::Rational(vec![Rational { num: 425, denom: 100 }])),
        (Tag::FocalLengthIn35mmFilm, Value::Short(vec![FILM_MM])),
    ];
    let fields = fields.map(|(tag, value)| Field { tag, ifd_num: In::PRIMARY, value });
    let mut writer = Writer::new();
    fields.iter().for_each(|f| writer.push_field(f));
    let mut bytes = std::io::Cursor::new(Vec::new());
    writer.write(&mut bytes, true)?;
    Ok(bytes.into_inner())
}

fn save(path: &Path, rgb: &[u8], exif: Vec<u8>) -> Result<()> {
    let mut bytes = Vec::new();
    let mut encoder = JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY);
    encoder.set_exif_metadata(exif)?;
    encoder.write_image(rgb, WIDTH as u32, HEIGHT as u32, image::ExtendedColorType::Rgb8)?;
    std::fs::write(path, bytes).with_context(|| path.display().to_string())
}
