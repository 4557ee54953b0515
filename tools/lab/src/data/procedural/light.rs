//! Illumination: two lamps, an ambient gradient, darkened corners, highlights (Blinn-Phong) and
//! mirrors.
//!
//! Input: surfaces and rays, metres. Output: linear RGB radiance.

use super::rng::Rng;
use super::shape::{Primitive, Ray};
use super::{Room, Surface};
use glam::Vec3;

/// A point lamp; a small sphere where shadows are soft.
#[derive(Clone, Debug)]
pub(super) struct Lamp {
    /// Position, world.
    pub(super) position: Vec3,
    /// Irradiance at a distance of one metre.
    power: Vec3,
    casts_shadow: bool,
}

/// The light sources of a room.
#[derive(Clone, Debug)]
pub(super) struct Lighting {
    lamps: [Lamp; 2],
    /// Ambient radiance from above.
    above: Vec3,
    /// Ambient radiance from below.
    below: Vec3,
}

/// Radius of a lamp with soft shadows, m.
const LAMP_RADIUS: f32 = 0.08;
/// Extent of the darkening in corners, m.
const CORNER_REACH: f32 = 0.22;
/// Strength of the darkening in corners.
const CORNER_DEPTH: f32 = 0.38;

impl Lighting {
    /// Samples two lamps in the upper half of a room of `size`. The first casts shadows in half of
    /// the rooms.
    pub(super) fn new(size: Vec3, rng: &mut Rng) -> Self {
        let mut lamp = |casts_shadow: bool, share: f32| {
            let warm = 0.12 * rng.normal();
            let tint = Vec3::new(1.0 + warm, 1.0, 1.0 - warm);
            let position = Vec3::new(
                rng.range(-0.4, 0.4) * size.x,
                -rng.range(0.6, 0.93) * size.y,
                rng.range(-0.4, 0.4) * size.z,
            );
            Lamp { position, power: tint * share * rng.range(1.0, 3.0), casts_shadow }
        };
        let (first, second) = (lamp(true, 1.0), lamp(false, 0.6));
        let casts_shadow = rng.chance(0.5);
        let sky = 0.06 * rng.normal();
        let above = Vec3::new(1.0 - sky, 1.0, 1.0 + sky) * rng.range(0.2, 0.5);
        let below = above * rng.range(0.35, 0.9);
        Self { lamps: [Lamp { casts_shadow, ..first }, second], above, below }
    }

    /// Returns the position of the lamp that may cast shadows.
    pub(super) fn main_lamp(&self) -> Vec3 {
        self.lamps[0].position
    }
}

/// Options of a shaded ray.
#[derive(Clone, Copy)]
pub(super) struct Shading {
    /// Width of the ray at parameter 1, world units.
    pub(super) spread: f32,
    /// Enables highlights and mirrors.
    pub(super) view_dependent: bool,
    /// Position inside each lamp's sphere, in radii, for soft shadows of all lamps. `None` gives
    /// the room's hard shadows.
    pub(super) lamp_shift: Option<Vec3>,
}

impl Room {
    /// Returns the linear radiance of the surface of `solid` at parameter `t` of `ray`.
    pub(super) fn radiance(&self, solid: &Primitive, ray: &Ray, t: f32, shading: &Shading) -> Vec3 {
        let (colour, mirrored) = self.shaded(solid, ray, t, shading);
        let Some((share, reflected)) = mirrored else { return colour };
        // One reflection: a mirror seen in a mirror shows its own, dark, colour.
        let Some((next, u)) = self.nearest(&reflected) else { return colour };
        let wider = Shading { spread: shading.spread * (1.0 + t / u.max(1e-3)), ..*shading };
        colour * (1.0 - share) + share * self.shaded(next, &reflected, u, &wider).0
    }

    /// Returns the radiance without the reflection, and the weight and the ray of the reflection.
    fn shaded(
        &self,
        solid: &Primitive,
        ray: &Ray,
        t: f32,
        shading: &Shading,
    ) -> (Vec3, Option<(f32, Ray)>) {
        let point = ray.at(t);
        let surface = solid.surface(point);
        let toward_eye = -ray.direction.normalize_or(Vec3::Z);
        let facing = surface.normal.dot(toward_eye).max(0.05);
        let material =
            &self.materials[solid.material + if solid.is_shell() { surface.face } else { 0 }];
        // An oblique surface stretches the footprint in one direction: the geometric mean of both.
        let footprint = t * shading.spread / facing.sqrt();
        let colour = material.colour(&self.bank, surface.uv, footprint);
        if material.emission > 0.0 {
            return (colour * material.emission, None);
        }
        let mut light = self.ambient(point, &surface);
        let mut highlight = Vec3::ZERO;
        for lamp in &self.lighting.lamps {
            let path = lamp.position - point;
            let distance2 = path.length_squared();
            let direction = path / distance2.sqrt().max(1e-6);
            let slope = surface.normal.dot(direction);
            // The extent of a lamp affects its shadow only, which limits the noise to shadows.
            let position = lamp.position + shading.lamp_shift.unwrap_or(Vec3::ZERO) * LAMP_RADIUS;
            let casts_shadow = lamp.casts_shadow || shading.lamp_shift.is_some();
            let from = point + surface.normal * 1e-3;
            if slope <= 0.0 || (casts_shadow && self.shadowed(from, position)) {
                continue;
            }
            // 0.3 m² limit the irradiance of a wall beside a lamp.
            let arriving = lamp.power / (distance2 + 0.3);
            light += arriving * slope;
            if shading.view_dependent && material.specular > 0.0 {
                let half = (direction + toward_eye).normalize_or(surface.normal);
                let lobe = surface.normal.dot(half).max(0.0).powf(material.gloss);
                highlight += arriving * lobe * material.specular;
            }
        }
        let radiance = colour * light + highlight;
        if material.mirror == 0.0 || !shading.view_dependent {
            return (radiance, None);
        }
        let direction = ray.direction - 2.0 * ray.direction.dot(surface.normal) * surface.normal;
        let reflected = Ray { origin: point + surface.normal * 1e-3, direction };
        (radiance, Some((material.mirror, reflected)))
    }

    /// Returns the ambient light: brighter from above, and darker towards the edges of the room, as
    /// light between walls is.
    fn ambient(&self, point: Vec3, surface: &Surface) -> Vec3 {
        let up = 0.5 - 0.5 * surface.normal.y;
        let shell = &self.primitives[0];
        let gaps = shell.half - (point - shell.centre).abs();
        let mut open = 1.0;
        for axis in 0..3 {
            let d = gaps[axis].max(0.0) / CORNER_REACH;
            let across = 1.0 - surface.normal[axis].abs();
            open *= 1.0 - across * CORNER_DEPTH / (1.0 + d * d);
        }
        (self.lighting.below + up * (self.lighting.above - self.lighting.below)) * open
    }

    /// Returns true if a solid lies between `point` and `lamp`.
    fn shadowed(&self, point: Vec3, lamp: Vec3) -> bool {
        let ray = Ray { origin: point, direction: lamp - point };
        self.primitives[1..].iter().any(|p| p.casts_shadow && p.intersect(&ray, 1.0).is_some())
    }
}
