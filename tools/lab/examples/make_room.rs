//! Makes `examples/room/`, the scene that ships with the crate, byte for byte:
//!
//! ```text
//! cargo run --example make_room            # into examples/room
//! cargo run --example make_room -- DIR     # elsewhere
//! ```
//!
//! One procedural room (`subsplat_lab::data::procedural`), two context pictures of 256²,
//! and the same three held-out views at 512² and 1024². `cameras.json` and
//! `protocol.json` have the layout that `subsplat run` reads and writes; README.md in
//! the folder describes them.

use anyhow::{Context, Result};
use glam::{Mat3, Mat4, Vec3};
use image::codecs::jpeg::JpegEncoder;
use serde_json::{Value, json};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_lab::data::procedural::{Grade, Quality, Room, TextureBank, View};

/// Seed of the room: looked at, and chosen for its written notice, thin rail, patterned
/// doors and rug, and soft shadows.
const SEED: u64 = 7663;
/// Side of its textures, px: about one texel per pixel of the largest pictures.
const TEXTURE: usize = 512;
/// Samples on every side of the whole picture, whatever its size: all sizes then show
/// box means of the same samples.
const LATTICE: usize = 3072;
/// A little brighter than the room's own exposure.
pub const GAIN: f32 = 1.2;
/// Side of the context pictures, px.
const INPUT: usize = 256;
/// Where the camera between the two context views stands, and what it looks at, m.
const EYE: Vec3 = Vec3::new(-0.48, -1.66, 0.84);
const AIM: Vec3 = Vec3::new(0.95, -0.6, -1.15);
/// Horizontal field of view, degrees.
const FOV: f32 = 68.0;
/// Eyes of the context views: right, down and forward of [`EYE`], m.
const CONTEXT: [Vec3; 2] = [Vec3::new(-0.15, 0.0, 0.0), Vec3::new(0.15, 0.0, 0.02)];
/// Eyes of the held-out views: two between the context views, one above and behind.
const TARGET: [Vec3; 3] =
    [Vec3::new(-0.06, 0.02, 0.03), Vec3::new(0.07, -0.03, 0.0), Vec3::new(0.01, -0.08, -0.08)];
/// Sides of the held-out pictures, px.
const TARGET_SIDES: [usize; 2] = [512, 1024];
const JPEG_QUALITY: u8 = 95;

/// One picture of the scene.
pub struct Frame {
    /// Path within the scene's folder.
    pub file: String,
    /// Its camera.
    pub camera: Camera,
}

/// The camera `offset` from the middle one, looking at the same point.
fn camera(offset: Vec3, side: usize) -> Camera {
    let axes = |forward: Vec3| {
        let z = forward.normalize();
        let x = Vec3::Y.cross(z).normalize();
        Mat3::from_cols(x, z.cross(x), z)
    };
    let eye = EYE + axes(AIM - EYE) * offset;
    let pose = Mat4::from_translation(eye) * Mat4::from_mat3(axes(AIM - eye));
    Camera::new(Intrinsics::from_fov_x(FOV.to_radians(), side, side), pose).expect("a valid camera")
}

/// All frames in the order of `cameras.json`.
pub fn frames() -> Vec<Frame> {
    let mut frames = Vec::new();
    for (i, offset) in CONTEXT.into_iter().enumerate() {
        frames.push(Frame { file: format!("images/input_{i}.png"), camera: camera(offset, INPUT) });
    }
    for side in TARGET_SIDES {
        for (i, offset) in TARGET.into_iter().enumerate() {
            let file = format!("images/heldout_{i}_{side}.jpg");
            frames.push(Frame { file, camera: camera(offset, side) });
        }
    }
    frames
}

/// The room.
pub fn room() -> Room {
    Room::with_bank(SEED, Arc::new(TextureBank::new(0, TEXTURE)))
}

/// The view of one frame.
pub fn render(room: &Room, camera: &Camera) -> View {
    let grade = Grade { gain: [GAIN; 3], ..Grade::default() };
    room.render(camera, &Quality { grade, ..Quality::clean(LATTICE / camera.intrinsics().width) })
}

/// Display values to bytes, rounded.
pub fn bytes(view: &View) -> Vec<u8> {
    view.rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect()
}

fn save(view: &View, path: &Path) -> Result<()> {
    let (w, h) = (view.width as u32, view.height as u32);
    let picture = image::RgbImage::from_raw(w, h, bytes(view)).context("picture size")?;
    let mut file = std::fs::File::create(path)?;
    if path.extension().is_some_and(|e| e == "jpg") {
        JpegEncoder::new_with_quality(&mut file, JPEG_QUALITY).encode_image(&picture)?;
    } else {
        picture.write_to(&mut std::io::BufWriter::new(&mut file), image::ImageFormat::Png)?;
    }
    Ok(file.flush()?)
}

/// Nearest and farthest depth of the context views with a tenth to spare, two digits.
pub fn near_far(views: &[View]) -> (f64, f64) {
    let depths = || views.iter().flat_map(|v| &v.depth);
    let near = 0.9 * depths().fold(f32::INFINITY, |a, b| a.min(*b));
    let far = 1.1 * depths().fold(0.0f32, |a, b| a.max(*b));
    ((f64::from(near) * 100.0).floor() / 100.0, (f64::from(far) * 100.0).ceil() / 100.0)
}

fn frame_json(frame: &Frame) -> Value {
    let k = &frame.camera.intrinsics();
    let rows = frame.camera.world_from_camera().transpose().to_cols_array_2d();
    json!({
        "file": frame.file, "width": k.width, "height": k.height,
        "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy, "c2w": rows,
    })
}

fn cameras_json(frames: &[Frame], near: f64, far: f64) -> Value {
    json!({
        "convention": "OpenCV camera-to-world (x right, y down, z forward); pixel intrinsics at \
                       the stored resolution; pinhole; metres; world y down",
        "source": format!("examples/make_room.rs, seed {SEED}"),
        "near": near,
        "far": far,
        "frames": frames.iter().map(frame_json).collect::<Vec<_>>(),
    })
}

fn protocol_json(frames: &[Frame]) -> Value {
    let k = &frames[0].camera.intrinsics();
    let tests = TARGET_SIDES.iter().enumerate().map(|(i, side)| {
        let first = CONTEXT.len() + i * TARGET.len();
        json!({
            "context": [0, 1],
            "target": (first..first + TARGET.len()).collect::<Vec<_>>(),
            "target_size": [side, side],
            "upscale": side / INPUT,
        })
    });
    json!({
        "resolution": [INPUT, INPUT],
        "intrinsics_256": { "fx": k.fx, "fy": k.fy, "cx": k.cx, "cy": k.cy },
        "note": "indices refer to the frames of cameras.json; target_size is [height, width]",
        "tests": tests.collect::<Vec<_>>(),
    })
}

fn main() -> Result<()> {
    let default = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/room");
    let folder = std::env::args_os().nth(1).map_or(default, PathBuf::from);
    std::fs::create_dir_all(folder.join("images"))?;
    let (room, frames) = (room(), frames());
    let mut views = Vec::new();
    for (i, frame) in frames.iter().enumerate() {
        let clear = room.clearance(frame.camera.position());
        anyhow::ensure!(clear > 0.1, "frame {i}: the eye is {clear} m from a surface");
        let view = render(&room, &frame.camera);
        let path = folder.join(&frame.file);
        save(&view, &path).with_context(|| path.display().to_string())?;
        println!("{} {} bytes", path.display(), std::fs::metadata(&path)?.len());
        if i < CONTEXT.len() {
            views.push(view);
        }
    }
    let (near, far) = near_far(&views);
    let write = |name: &str, value: &Value| -> Result<()> {
        Ok(std::fs::write(folder.join(name), format!("{value:#}\n"))?)
    };
    write("cameras.json", &cameras_json(&frames, near, far))?;
    write("protocol.json", &protocol_json(&frames))
}
