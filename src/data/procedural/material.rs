//! What surfaces look like: a texture, the colours that its two fields stand for, and
//! how light leaves.

use super::rng::Rng;
use super::texture::{BANK, Kind, TextureBank};
use glam::{Vec2, Vec3};

/// Where a material is used: decides how often it is near flat, and what it shows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    Wall,
    Ceiling,
    Floor,
    Furniture,
    Picture,
    Thing,
    Leaf,
}

/// A surface's look. Colours are linear reflectances, RGB.
#[derive(Clone, Debug)]
pub(super) struct Material {
    texture: usize,
    /// Colour where both fields are 0, and what each adds at 1.
    base: Vec3,
    by_a: Vec3,
    by_b: Vec3,
    /// Periods of the texture per metre.
    frequency: f32,
    /// Rotation of the texture, (cos, sin).
    turn: Vec2,
    offset: Vec2,
    /// Weight of the highlight, and its exponent (Blinn-Phong).
    pub(super) specular: f32,
    pub(super) gloss: f32,
    /// Part of the light that is reflected as by a mirror.
    pub(super) mirror: f32,
    /// Radiance that it sends out by itself, in units of its colour.
    pub(super) glow: f32,
}

/// A linear colour of the given hue (turns), saturation and value.
pub(super) fn colour(hue: f32, saturation: f32, value: f32) -> Vec3 {
    let channel = |shift: f32| {
        let t = ((hue + shift).rem_euclid(1.0) * 6.0 - 3.0).abs() - 1.0;
        1.0 - saturation + saturation * t.clamp(0.0, 1.0)
    };
    value * Vec3::new(channel(0.0), channel(2.0 / 3.0), channel(1.0 / 3.0))
}

/// The hues of one room: most things take one of three, as furnished rooms do.
#[derive(Clone, Debug)]
pub(super) struct Palette {
    hues: [f32; 3],
    vivid: f32,
}

impl Palette {
    pub(super) fn new(rng: &mut Rng) -> Self {
        // Indoor colours gather around orange (0.08 turns).
        let warm = 0.08 + 0.05 * rng.normal();
        Self { hues: [warm, warm + 0.08 * rng.normal(), rng.unit()], vivid: rng.range(0.5, 1.0) }
    }

    fn pick(&self, rng: &mut Rng, saturation: f32, value: [f32; 2]) -> Vec3 {
        let hue = if rng.chance(0.8) { self.hues[rng.count(0, 2)] } else { rng.unit() };
        let hue = hue + 0.02 * rng.normal();
        colour(hue, saturation * rng.unit().sqrt() * self.vivid, rng.log_range(value[0], value[1]))
    }
}

impl Role {
    /// Chance of a near flat material: two thirds of walls, a third overall.
    fn flat(self) -> f32 {
        match self {
            Self::Wall => 0.67,
            Self::Ceiling => 0.85,
            Self::Floor => 0.15,
            Self::Furniture => 0.35,
            Self::Picture | Self::Leaf => 0.0,
            Self::Thing => 0.3,
        }
    }

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
            Self::Thing if dice < 0.2 => from(Kind::Text, rng),
            Self::Leaf => from(if dice < 0.7 { Kind::Leaves } else { Kind::Blobs }, rng),
            _ => rng.count(0, BANK - 1),
        }
    }

    /// Lightest and darkest reflectance, and the largest saturation.
    fn tones(self) -> ([f32; 2], f32) {
        match self {
            Self::Wall => ([0.25, 0.8], 0.45),
            Self::Ceiling => ([0.55, 0.85], 0.12),
            Self::Floor => ([0.06, 0.45], 0.75),
            Self::Furniture => ([0.03, 0.65], 0.9),
            Self::Picture | Self::Thing => ([0.03, 0.85], 1.0),
            Self::Leaf => ([0.05, 0.35], 1.0),
        }
    }

    /// Metres per period of the texture.
    fn period(self, rng: &mut Rng) -> f32 {
        match self {
            Self::Wall | Self::Ceiling | Self::Floor => rng.log_range(0.6, 2.5),
            Self::Furniture | Self::Picture => rng.log_range(0.4, 1.4),
            Self::Thing | Self::Leaf => rng.log_range(0.15, 0.6),
        }
    }
}

impl Material {
    /// A random material for `role`.
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
        // Wood, tiles and writing follow the edges of what they cover.
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
            by_a: contrast * (one - base),
            by_b: contrast * rng.unit() * (two - base),
            frequency: 1.0 / role.period(rng),
            turn: Vec2::from_angle(angle),
            offset: Vec2::new(rng.unit(), rng.unit()),
            specular,
            gloss,
            mirror: 0.0,
            glow: 0.0,
        }
    }

    /// The texture stretched to about one period over `extent` metres.
    pub(super) fn spread_over(mut self, extent: f32) -> Self {
        self.frequency = 1.0 / extent.max(0.05);
        self
    }

    /// A mirror with a faint tint.
    pub(super) fn into_mirror(mut self) -> Self {
        (self.mirror, self.by_a, self.by_b) = (0.85, Vec3::ZERO, Vec3::ZERO);
        self
    }

    /// The same look, but sending out light.
    pub(super) fn into_glowing(mut self, radiance: f32) -> Self {
        (self.specular, self.glow) = (0.0, radiance);
        self
    }

    /// Range of the first field's colour relative to the base.
    #[cfg(test)]
    pub(super) fn contrast(&self) -> f32 {
        self.by_a.length() / self.base.length()
    }

    /// Reflectance at `uv` metres on a surface, averaged over `footprint` metres.
    pub(super) fn colour(&self, bank: &TextureBank, uv: Vec2, footprint: f32) -> Vec3 {
        let p = self.turn.rotate(uv) * self.frequency + self.offset;
        let [a, b] = bank.get(self.texture).sample(p.x, p.y, footprint * self.frequency);
        (self.base + self.by_a * a + self.by_b * b).clamp(Vec3::splat(0.01), Vec3::splat(0.95))
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
