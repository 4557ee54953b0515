//! Light: two lamps, an ambient gradient, corners that darken, highlights and mirrors.

use super::rng::Rng;
use super::shape::{Primitive, Ray};
use super::{Room, Surface};
use glam::Vec3;

/// A lamp without extent, or a small ball of it where shadows are soft.
#[derive(Clone, Debug)]
pub(super) struct Lamp {
    pub(super) place: Vec3,
    /// Irradiance at one metre.
    power: Vec3,
    casts_shadow: bool,
}

/// What lights a room.
#[derive(Clone, Debug)]
pub(super) struct Lighting {
    lamps: [Lamp; 2],
    /// Ambient radiance from above and from below.
    above: Vec3,
    below: Vec3,
}

/// Radius of a lamp where shadows are soft, m.
const LAMP_RADIUS: f32 = 0.08;
/// Reach of the darkening in corners, m, and its strength.
const CORNER_REACH: f32 = 0.22;
const CORNER_DEPTH: f32 = 0.38;

impl Lighting {
    /// Two lamps in the upper half of a room of `size`; the first casts shadows in
    /// half of the rooms.
    pub(super) fn new(size: Vec3, rng: &mut Rng) -> Self {
        let mut lamp = |casts_shadow: bool, share: f32| {
            let warm = 0.12 * rng.normal();
            let tint = Vec3::new(1.0 + warm, 1.0, 1.0 - warm);
            let place = Vec3::new(
                rng.range(-0.4, 0.4) * size.x,
                -rng.range(0.6, 0.93) * size.y,
                rng.range(-0.4, 0.4) * size.z,
            );
            Lamp { place, power: tint * share * rng.range(1.0, 3.0), casts_shadow }
        };
        let (first, second) = (lamp(true, 1.0), lamp(false, 0.6));
        let casts_shadow = rng.chance(0.5);
        let sky = 0.06 * rng.normal();
        let above = Vec3::new(1.0 - sky, 1.0, 1.0 + sky) * rng.range(0.2, 0.5);
        let below = above * rng.range(0.35, 0.9);
        Self { lamps: [Lamp { casts_shadow, ..first }, second], above, below }
    }

    /// Where the lamp that may cast shadows hangs.
    pub(super) fn main_lamp(&self) -> Vec3 {
        self.lamps[0].place
    }
}

/// What a ray brings besides its path: how wide it is, and what it may see.
#[derive(Clone, Copy)]
pub(super) struct Look {
    /// Width of the ray at parameter 1, world units.
    pub(super) spread: f32,
    /// Highlights and mirrors.
    pub(super) view_dependent: bool,
    /// Where in its ball each lamp stands, radii, when all lamps cast soft shadows;
    /// `None` for the room's own choice of hard ones.
    pub(super) lamp_shift: Option<Vec3>,
}

impl Room {
    /// Linear radiance from the surface of `solid` that `ray` meets at `t`.
    pub(super) fn radiance(&self, solid: &Primitive, ray: &Ray, t: f32, look: &Look) -> Vec3 {
        let (colour, mirrored) = self.shaded(solid, ray, t, look);
        let Some((share, reflected)) = mirrored else { return colour };
        // One bounce: a mirror in a mirror shows its own, dark, colour.
        let Some((next, u)) = self.nearest(&reflected) else { return colour };
        let wider = Look { spread: look.spread * (1.0 + t / u.max(1e-3)), ..*look };
        colour * (1.0 - share) + share * self.shaded(next, &reflected, u, &wider).0
    }

    /// Radiance without the mirror's part; that part's weight and ray beside it.
    fn shaded(
        &self,
        solid: &Primitive,
        ray: &Ray,
        t: f32,
        look: &Look,
    ) -> (Vec3, Option<(f32, Ray)>) {
        let point = ray.at(t);
        let surface = solid.surface(point);
        let toward_eye = -ray.direction.normalize_or(Vec3::Z);
        let facing = surface.normal.dot(toward_eye).max(0.05);
        let material =
            &self.materials[solid.material + if solid.is_shell() { surface.face } else { 0 }];
        // A slanted surface stretches the footprint one way only: the geometric mean.
        let footprint = t * look.spread / facing.sqrt();
        let colour = material.colour(&self.bank, surface.uv, footprint);
        if material.glow > 0.0 {
            return (colour * material.glow, None);
        }
        let (mut light, mut highlight) = (self.ambient(point, &surface), Vec3::ZERO);
        for lamp in &self.lighting.lamps {
            let path = lamp.place - point;
            let distance2 = path.length_squared();
            let direction = path / distance2.sqrt().max(1e-6);
            let slope = surface.normal.dot(direction);
            // Only the shadow knows that a lamp has extent: no grain elsewhere.
            let place = lamp.place + look.lamp_shift.unwrap_or(Vec3::ZERO) * LAMP_RADIUS;
            let casts_shadow = lamp.casts_shadow || look.lamp_shift.is_some();
            let from = point + surface.normal * 1e-3;
            if slope <= 0.0 || (casts_shadow && self.shadowed(from, place)) {
                continue;
            }
            // 0.3 m² keep a wall beside a lamp from burning out.
            let arriving = lamp.power / (distance2 + 0.3);
            light += arriving * slope;
            if look.view_dependent && material.specular > 0.0 {
                let half = (direction + toward_eye).normalize_or(surface.normal);
                let lobe = surface.normal.dot(half).max(0.0).powf(material.gloss);
                highlight += arriving * lobe * material.specular;
            }
        }
        let radiance = colour * light + highlight;
        if material.mirror == 0.0 || !look.view_dependent {
            return (radiance, None);
        }
        let direction = ray.direction - 2.0 * ray.direction.dot(surface.normal) * surface.normal;
        let reflected = Ray { origin: point + surface.normal * 1e-3, direction };
        (radiance, Some((material.mirror, reflected)))
    }

    /// Ambient light: brighter from above, darker towards the edges of the room, as
    /// light that bounces between the walls is.
    fn ambient(&self, point: Vec3, surface: &Surface) -> Vec3 {
        let up = 0.5 - 0.5 * surface.normal.y;
        let shell = &self.primitives[0];
        let gaps = shell.half - (point - shell.centre).abs();
        let mut open = 1.0;
        for axis in 0..3 {
            let d = gaps[axis].max(0.0) / CORNER_REACH;
            let turned = 1.0 - surface.normal[axis].abs();
            open *= 1.0 - turned * CORNER_DEPTH / (1.0 + d * d);
        }
        (self.lighting.below + up * (self.lighting.above - self.lighting.below)) * open
    }

    /// True where something stands between `point` and `lamp`.
    fn shadowed(&self, point: Vec3, lamp: Vec3) -> bool {
        let ray = Ray { origin: point, direction: lamp - point };
        self.primitives[1..].iter().any(|p| p.casts_shadow && p.intersect(&ray, 1.0).is_some())
    }
}
