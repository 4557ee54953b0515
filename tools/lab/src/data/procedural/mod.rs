//! Procedural scenes for training and for the shipped example, ray traced: furnished rooms, and
//! shapes at random places indoors and outdoors, or in the air of a room (`scatter.rs`).
//!
//! Input: a 64-bit seed, pinhole cameras, a resolution. Output: pictures `[H, W, 3]` as display
//! values in [0, 1], and depth `[H, W]` as camera z of the ray through the pixel's centre, metres.
//! World: metres, y down, floor at y = 0.
//!
//! The statistics (sizes, counts, texture shares, camera motion) are those of a prototype
//! generator. A small two-view network trained on its rooms alone estimated depth on real
//! photographs.
//!
//! A seed gives the same scene and pictures for any number of threads. Integers and random numbers
//! are equal on every platform. Colours may differ in the last bit where the platform's `sin` or
//! `pow` differs.

mod cameras;
mod example;
mod foreground;
mod furniture;
mod layout;
mod light;
mod material;
mod render;
pub(in crate::data) mod rng;
mod scatter;
mod shape;
mod synthesis;
mod texture;

pub use cameras::{CameraRange, CameraSpec, Motion, Rig, sample_cameras};
pub use example::{Example, ExampleSpec, TargetSpec};
pub use render::{Grade, Quality, View};
pub use texture::TextureBank;

use glam::Vec3;
use layout::Layout;
use light::{Lighting, Shading};
use material::Material;
use rng::Rng;
use shape::{Form, Primitive, Ray, Surface};
use std::sync::Arc;

/// A furnished room. Construction takes microseconds, because textures are synthesised once per
/// [`TextureBank`], on their first use.
#[derive(Clone, Debug)]
pub struct Room {
    size: Vec3,
    /// All solids; the first is the shell.
    primitives: Vec<Primitive>,
    materials: Vec<Material>,
    lighting: Lighting,
    /// Gain that maps the mean radiance to a middle grey.
    exposure: f32,
    bank: Arc<TextureBank>,
}

/// Linear value of a room's mean radiance after exposure. With the tone curve and a gamma of 2.2
/// its display value is slightly below ½.
const MIDDLE_GREY: f32 = 0.2;

impl Room {
    /// Builds the room of `seed` with the shared bank of 256² textures.
    pub fn new(seed: u64) -> Self {
        Self::with_bank(seed, TextureBank::shared())
    }

    /// Builds the room of `seed` with the textures of `bank`, for instance larger ones.
    pub fn with_bank(seed: u64, bank: Arc<TextureBank>) -> Self {
        let mut layout = Layout::furnished(seed);
        let lighting = Lighting::new(layout.size, &mut layout.rng.fork(1));
        layout.add_lamp(lighting.main_lamp());
        Self::lit(layout, lighting, bank)
    }

    /// Builds a room from a layout, with an exposure that gives a middle grey.
    fn lit(layout: Layout, lighting: Lighting, bank: Arc<TextureBank>) -> Self {
        let mut room = Self {
            size: layout.size,
            primitives: layout.primitives,
            materials: layout.materials,
            lighting,
            exposure: 1.0,
            bank,
        };
        room.exposure =
            MIDDLE_GREY / room.geometric_mean_luminance(&mut layout.rng.fork(2)).max(1e-3);
        room
    }

    /// Returns width (x), height (y) and length (z) of the room, metres. The floor lies at y = 0,
    /// the ceiling at −height.
    pub fn size(&self) -> Vec3 {
        self.size
    }

    /// Returns the number of solids, the shell included.
    pub fn solids(&self) -> usize {
        self.primitives.len()
    }

    /// Returns the distance from a world point to the nearest surface, metres. It is negative
    /// inside a solid or outside the room.
    pub fn clearance(&self, in_world: Vec3) -> f32 {
        self.primitives.iter().map(|p| p.distance(in_world)).fold(f32::INFINITY, f32::min)
    }

    /// Returns the geometric mean luminance over rays from the middle of the room.
    fn geometric_mean_luminance(&self, rng: &mut Rng) -> f32 {
        const RAYS: usize = 96;
        let shading = Shading { spread: 0.1, view_dependent: false, lamp_shift: None };
        let mut sum = 0.0;
        for _ in 0..RAYS {
            let origin = Vec3::new(
                0.3 * self.size.x * rng.range(-1.0, 1.0),
                -0.5 * self.size.y,
                0.3 * self.size.z * rng.range(-1.0, 1.0),
            );
            let direction = Vec3::new(rng.normal(), 0.5 * rng.normal(), rng.normal());
            let ray = Ray { origin, direction };
            if let Some((solid, t)) = self.nearest(&ray) {
                let c = self.radiance(solid, &ray, t, &shading);
                sum += c.dot(Vec3::new(0.2126, 0.7152, 0.0722)).max(1e-3).ln();
            }
        }
        (sum / RAYS as f32).exp()
    }

    /// Returns the first solid along a ray, and the parameter of the hit.
    fn nearest(&self, ray: &Ray) -> Option<(&Primitive, f32)> {
        let mut best: Option<(&Primitive, f32)> = None;
        for p in &self.primitives {
            if let Some(t) = p.intersect(ray, best.map_or(f32::INFINITY, |b| b.1)) {
                best = Some((p, t));
            }
        }
        best
    }
}
