//! Makes photographs of a walk through a room, with their cameras, for reconstructions of many photographs:
//!
//! ```text
//! cargo run --release --example make_walk -- out/walk 25      # folder, photographs
//! subsplat-lab eval out/walk --contexts 9 --holdout 8 --upscale 2 --input-size 256
//! ```
//!
//! It is the room of `examples/room` with finer textures. The camera moves 0.8 m sideways, rises and falls, and looks
//! at the middle of the furniture.

use anyhow::{Context, Result, ensure};
use glam::{Mat3, Mat4, Vec3};
use image::{ImageFormat, RgbImage};
use serde_json::json;
use std::path::PathBuf;
use std::sync::Arc;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_lab::data::procedural::{Grade, Quality, Room, TextureBank};

const SEED: u64 = 7663;
const TEXTURE: usize = 2048;
/// Size of the photographs, px.
const SIZE: [usize; 2] = [768, 576];
/// Angle of view across, radians.
const FOV: f32 = 1.15;
/// Positions at both ends of the walk, and what the camera looks at there, m.
const EYES: [Vec3; 2] = [Vec3::new(-0.95, -1.6, 0.55), Vec3::new(-0.3, -1.64, 1.0)];
const AIM: [Vec3; 2] = [Vec3::new(0.95, -0.62, -1.15), Vec3::new(0.83, -0.58, -1.21)];

fn main() -> Result<()> {
    let mut arguments = std::env::args().skip(1);
    let folder = PathBuf::from(arguments.next().unwrap_or_else(|| "out/walk".to_owned()));
    let count: usize = arguments.next().map_or(Ok(25), |text| text.parse()).context("a number")?;
    ensure!(count > 1, "expected two photographs or more, got {count}");
    std::fs::create_dir_all(folder.join("images"))?;
    let room = Room::with_bank(SEED, Arc::new(TextureBank::new(0, TEXTURE)));
    let grade = Grade { gain: [1.2; 3], ..Grade::default() };
    let quality = Quality { grade, ..Quality::training(grade) };
    let mut frames = Vec::new();
    for i in 0..count {
        let camera = camera(i as f32 / (count - 1) as f32)?;
        let view = room.render(&camera, &quality);
        let bytes = view.rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect();
        let picture =
            RgbImage::from_raw(SIZE[0] as u32, SIZE[1] as u32, bytes).context("a size")?;
        let file = format!("images/{i:02}.png");
        picture.save_with_format(folder.join(&file), ImageFormat::Png)?;
        let k = camera.intrinsics();
        let rows = camera.world_from_camera().transpose().to_cols_array_2d();
        frames.push(json!({
            "file": file, "width": k.width, "height": k.height,
            "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "c2w": rows,
        }));
    }
    let cameras = serde_json::to_string_pretty(&json!({ "frames": frames }))?;
    std::fs::write(folder.join("cameras.json"), cameras)?;
    println!("{count} photographs in {}", folder.display());
    Ok(())
}

/// The camera after the share `part` of the walk.
fn camera(part: f32) -> Result<Camera> {
    let bob = 0.12 * (5.0 * std::f32::consts::PI * part).sin();
    let eye = EYES[0].lerp(EYES[1], part) + Vec3::Y * bob;
    let z = (AIM[0].lerp(AIM[1], part) - eye).normalize();
    let x = Vec3::Y.cross(z).normalize();
    let axes = Mat3::from_cols(x, z.cross(x), z);
    let k = Intrinsics::from_fov_x(FOV, SIZE[0], SIZE[1]);
    Ok(Camera::new(k, Mat4::from_translation(eye) * Mat4::from_mat3(axes))?)
}
