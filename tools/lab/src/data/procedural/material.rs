//! Materials: a texture, the colours of its two fields, and the reflection model.
//!
//! Colours are linear RGB reflectances; lengths are metres.

use super::rng::Rng;
use super::texture::{BANK, Kind, TextureBank};
use glam::{Vec2, Vec3};

/// Use of a material. It determines the textures, the colours and the share of nearly flat
/// materials.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    Wall,
    Ceiling,
    Floor,
    Furniture,
    Picture,
    Object,
    Leaf,
}

/// A material. Colours are linear reflectances, RGB.
#[derive(Clone, Debug)]
pub(super) struct Material {
    /// Index in the texture bank.
    texture: usize,
    /// Colour where both fields are 0.
    base: Vec3,
    /// Change of colour where the first field is 1.
    delta_a: Vec3,
    /// Change of colour where the second field is 1.
    delta_b: Vec3,
    /// Periods of the texture per metre.
    frequency: f32,
    /// Rotation of the texture, (cos, sin).
    rotation: Vec2,
    /// Offset of the texture, periods.
    offset: Vec2,
    /// Weight of the highlight.
    pub(super) specular: f32,
    /// Exponent of the highlight (Blinn-Phong).
    pub(super) gloss: f32,
    /// Share of the light that is reflected as by a mirror.
    pub(super) mirror: f32,
    /// Emitted radiance, in units of the colour.
    pub(super) emission: f32,
}

/// Returns a linear colour of the given hue (full turns), saturation and value.
pub(super) fn colour(hue: f32, saturation: f32, value: f32) -> Vec3 {
    let channel = |shift: f32| {
        let t = ((hue + shift).rem_euclid(1.0) * 6.0 - 3.0).abs() - 1.0;
        1.0 - saturation + saturation * t.clamp(0.0, 1.0)
    };
    value * Vec3::new(channel(0.0), channel(2.0 / 3.0), channel(1.0 / 3.0))
}

/// The hues of one room. Most objects have one of three, as in furnished rooms.
#[derive(Clone, Debug)]
pub(super) struct Palette {
    /// The three hues, full turns.
    hues: [f32; 3],
    /// Factor on all saturations.
    vivid: f32,
}

impl Palette {
    /// Samples a palette.
    pub(super) fn new(rng: &mut Rng) -> Self {
        // Indoor colours cluster around orange (0.08 turns).
        let warm = 0.08 + 0.05 * rng.normal();
        Self { hues: [warm, warm + 0.08 * rng.normal(), rng.unit()], vivid: rng.range(0.5, 1.0) }
    }

    /// Samples a colour of the palette.
    fn pick(&self, rng: &mut Rng, saturation: f32, value: [f32; 2]) -> Vec3 {
        let hue = if rng.chance(0.8) { self.hues[rng.count(0, 2)] } else { rng.unit() };
        let hue = hue + 0.02 * rng.normal();
        colour(hue, saturation * rng.unit().sqrt() * self.vivid, rng.log_range(value[0], value[1]))
    }
}

impl Role {
    /// Returns the probability of a nearly flat material: two thirds of walls, a third overall.
    fn flat(self) -> f32 {
        match self {
            Self::Wall => 0.67,
            Self::Ceiling => 0.85,
            Self::Floor => 0.15,
            Self::Furniture => 0.35,
            Self::Picture | Self::Leaf => 0.0,
            Self::Object => 0.3,
        }
    }

    /// Samples the index of a texture.
    fn texture(self, rng: &mut Rng) -> usize {
        let from = |kind: Kind, rng: &mut Rng| {
            let range = kind.indices();
            range.start + rng.count(0, range.len().saturating_sub(1))
        };
        let dice = rng.unit();
        match self {
            Self::Floor if dice < 0.3 => from(Kind::Tiles, rng),
            Self::Floor if dice < 0.75 => from(Kind::Grain, rng),
            Self::Furniture if dice < 0.35 => from(Kind::Grain, rng),
            Self::Picture if dice < 0.5 => from(Kind::Leaves, rng),
            Self::Picture if dice < 0.65 => from(Kind::Text, rng),
            Self::Object if dice < 0.2 => from(Kind::Text, rng),
            Self::Leaf => from(if dice < 0.7 { Kind::Leaves } else { Kind::Blobs }, rng),
            _ => rng.count(0, BANK - 1),
        }
    }

    /// Returns the range of reflectance, and the largest saturation.
    fn tones(self) -> ([f32; 2], f32) {
        match self {
            Self::Wall => ([0.25, 0.8], 0.45),
            Self::Ceiling => ([0.55, 0.85], 0.12),
            Self::Floor => ([0.06, 0.45], 0.75),
            Self::Furniture => ([0.03, 0.65], 0.9),
            Self::Picture | Self::Object => ([0.03, 0.85], 1.0),
            Self::Leaf => ([0.05, 0.35], 1.0),
        }
    }

    /// Samples the period of the texture, metres.
    fn period(self, rng: &mut Rng) -> f32 {
        match self {
            Self::Wall | Self::Ceiling | Self::Floor => rng.log_range(0.6, 2.5),
            Self::Furniture | Self::Picture => rng.log_range(0.4, 1.4),
            Self::Object | Self::Leaf => rng.log_range(0.15, 0.6),
        }
    }
}

impl Material {
    /// Samples a material for `role`.
    pub(super) fn new(role: Role, palette: &Palette, rng: &mut Rng) -> Self {
        let (values, saturation) = role.tones();
        let pick = |rng: &mut Rng| palette.pick(rng, saturation, values);
        let (mut base, mut one, mut two) = (pick(rng), pick(rng), pick(rng));
        if role == Role::Leaf {
            let green = |rng: &mut Rng| {
                colour(rng.range(0.2, 0.38), rng.range(0.5, 0.9), rng.log_range(0.04, 0.4))
            };
            (base, one, two) = (green(rng), green(rng), green(rng));
        }
        let flat = rng.chance(role.flat());
        let contrast = if flat { rng.log_range(0.02, 0.1) } else { rng.range(0.5, 1.0) };
        let texture = if flat && rng.chance(0.7) {
            rng.count(0, Kind::Noise.indices().len() - 1)
        } else {
            role.texture(rng)
        };
        // Wood, tiles and text are parallel to the edges of their surfaces.
        let straight = matches!(Kind::of(texture), Kind::Text | Kind::Tiles | Kind::Grain);
        let quarter = std::f32::consts::FRAC_PI_2;
        let angle = match Kind::of(texture) {
            Kind::Text => 0.0,
            _ if straight || rng.chance(0.5) => quarter * rng.count(0, 1) as f32,
            _ => rng.range(0.0, 4.0 * quarter),
        };
        let (specular, gloss) = if rng.chance(0.2) {
            (rng.range(0.05, 0.5), rng.log_range(8.0, 150.0))
        } else {
            (0.0, 1.0)
        };
        Self {
            texture,
            base,
            delta_a: contrast * (one - base),
            delta_b: contrast * rng.unit() * (two - base),
            frequency: 1.0 / role.period(rng),
            rotation: Vec2::from_angle(angle),
            offset: Vec2::new(rng.unit(), rng.unit()),
            specular,
            gloss,
            mirror: 0.0,
            emission: 0.0,
        }
    }

    /// Stretches the texture to about one period over `extent` metres.
    pub(super) fn spread_over(mut self, extent: f32) -> Self {
        self.frequency = 1.0 / extent.max(0.05);
        self
    }

    /// Turns the material into a mirror with a faint tint.
    pub(super) fn into_mirror(mut self) -> Self {
        (self.mirror, self.delta_a, self.delta_b) = (0.85, Vec3::ZERO, Vec3::ZERO);
        self
    }

    /// Makes the material emit light of its own colour.
    pub(super) fn into_emissive(mut self, radiance: f32) -> Self {
        (self.specular, self.emission) = (0.0, radiance);
        self
    }

    /// Returns the range of the first field's colour relative to the base.
    #[cfg(test)]
    pub(super) fn contrast(&self) -> f32 {
        self.delta_a.length() / self.base.length()
    }

    /// Returns the reflectance at `uv` metres on a surface, averaged over `footprint` metres.
    pub(super) fn colour(&self, bank: &TextureBank, uv: Vec2, footprint: f32) -> Vec3 {
        let p = self.rotation.rotate(uv) * self.frequency + self.offset;
        let [a, b] = bank.get(self.texture).sample(p.x, p.y, footprint * self.frequency);
        (self.base + self.delta_a * a + self.delta_b * b)
            .clamp(Vec3::splat(0.01), Vec3::splat(0.95))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hues() {
        assert_eq!(colour(0.0, 1.0, 0.5), Vec3::new(0.5, 0.0, 0.0));
        assert!((colour(1.0 / 3.0, 1.0, 1.0) - Vec3::Y).length() < 1e-5);
        assert!((colour(2.0 / 3.0, 0.5, 1.0) - Vec3::new(0.5, 0.5, 1.0)).length() < 1e-5);
    }

    #[test]
    fn two_thirds_of_walls_are_near_flat() {
        let mut rng = Rng::new(3);
        let palette = Palette::new(&mut rng);
        let n = 1000;
        let walls = (0..n).map(|_| Material::new(Role::Wall, &palette, &mut rng));
        let near_flat = walls.filter(|m| m.contrast() < 0.12).count();
        assert!((600..740).contains(&near_flat), "{near_flat}");
    }
}
