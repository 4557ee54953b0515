//! Periodic textures with mipmaps, and the bank of 144 textures that all rooms share.
//!
//! A texture is two fields in [0, 1] without colour. A material maps the fields to colour linearly.
//! A linear map commutes with the box filter of the mip levels, so that one texture serves any
//! palette without aliasing. `synthesis.rs` computes the fields.

use super::rng::Rng;
use super::synthesis::{self, Fields};
use std::sync::{Arc, LazyLock, OnceLock};

/// Number of textures in a bank, in the proportions of [`SHARES`].
pub(super) const BANK: usize = 144;

/// Kind of a texture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// Isotropic noise with amplitude spectrum 1/f^0.8 to 1/f^1.7.
    Noise,
    /// Opaque shapes that occlude one another, radii by an inverse cube law.
    Leaves,
    /// Parallel bands.
    Stripes,
    /// Lines of glyph-like strokes.
    Text,
    /// Tiles and bricks with grout.
    Tiles,
    /// Wood and cloth: noise with a much larger scale along than across.
    Grain,
    /// Level sets of noise.
    Blobs,
}

/// Number of textures of each kind: 22, 26, 8, 8, 10, 14, 12 %.
const SHARES: [(Kind, usize); 7] = [
    (Kind::Noise, 32),
    (Kind::Leaves, 37),
    (Kind::Stripes, 12),
    (Kind::Text, 12),
    (Kind::Tiles, 14),
    (Kind::Grain, 20),
    (Kind::Blobs, 17),
];

impl Kind {
    /// Returns the kind of the bank's texture `index`.
    pub(super) fn of(index: usize) -> Self {
        let mut first = 0;
        for (kind, count) in SHARES {
            if index < first + count {
                return kind;
            }
            first += count;
        }
        Self::Noise
    }

    /// Returns the bank's indices of this kind.
    pub(super) fn indices(self) -> std::ops::Range<usize> {
        let mut first = 0;
        for (kind, count) in SHARES {
            if kind == self {
                return first..first + count;
            }
            first += count;
        }
        0..0
    }
}

/// A square periodic texture of two fields and its mip levels, down to 1×1.
pub(super) struct Texture {
    /// Level l: `[size >> l]²` texels, both fields; 65535 is 1.
    levels: Vec<Vec<[u16; 2]>>,
    size: usize,
}

impl Texture {
    /// Builds the mip levels. The side of `fields` is a power of two; values are clipped to [0, 1].
    pub(super) fn new(fields: &Fields) -> Self {
        let size = fields.size;
        let quantised = |v: f32| (v.clamp(0.0, 1.0) * 65_535.0 + 0.5) as u16;
        let first = fields.a.iter().zip(&fields.b).map(|(a, b)| [quantised(*a), quantised(*b)]);
        let mut levels = vec![first.collect::<Vec<_>>()];
        let mut side = size;
        while side > 1 {
            let fine = &levels[levels.len() - 1];
            let half = side / 2;
            let mut coarse = Vec::with_capacity(half * half);
            for y in 0..half {
                for x in 0..half {
                    let i = 2 * y * side + 2 * x;
                    let four = [fine[i], fine[i + 1], fine[i + side], fine[i + side + 1]];
                    let mean = |k: usize| {
                        ((four.iter().map(|t| u32::from(t[k])).sum::<u32>() + 2) / 4) as u16
                    };
                    coarse.push([mean(0), mean(1)]);
                }
            }
            levels.push(coarse);
            side = half;
        }
        Self { levels, size }
    }

    /// Returns the bilinear value at (u, v), in periods, on one level.
    fn bilinear(&self, level: usize, u: f32, v: f32) -> [f32; 2] {
        let side = self.size >> level;
        let mask = side - 1;
        let (x, y) = (u * side as f32 - 0.5, v * side as f32 - 0.5);
        let (x0, y0) = (x.floor(), y.floor());
        let (fx, fy) = (x - x0, y - y0);
        // The mask wraps negative positions correctly in two's complement, because the side is a
        // power of two.
        let (x0, y0) = (x0 as i64 as usize, y0 as i64 as usize);
        let left = x0 & mask;
        let right = x0.wrapping_add(1) & mask;
        let top = (y0 & mask) * side;
        let bottom = (y0.wrapping_add(1) & mask) * side;
        let t = &self.levels[level];
        let [a, b, c, d] = [t[top + left], t[top + right], t[bottom + left], t[bottom + right]];
        let blend = |k: usize| {
            let up = f32::from(a[k]) + fx * (f32::from(b[k]) - f32::from(a[k]));
            let down = f32::from(c[k]) + fx * (f32::from(d[k]) - f32::from(c[k]));
            (up + fy * (down - up)) * (1.0 / 65_535.0)
        };
        [blend(0), blend(1)]
    }

    /// Returns both fields at (u, v), in periods, averaged over about `footprint` periods. The
    /// value is linear between the two mip levels whose texels are closest to the footprint in
    /// size.
    pub(super) fn sample(&self, u: f32, v: f32, footprint: f32) -> [f32; 2] {
        let last = self.levels.len() - 1;
        let lod = (footprint * self.size as f32).max(1.0).log2().min(last as f32);
        let level = (lod as usize).min(last);
        let near = self.bilinear(level, u, v);
        let t = lod - level as f32;
        if t < 1e-3 || level == last {
            return near;
        }
        let far = self.bilinear(level + 1, u, v);
        [near[0] + t * (far[0] - near[0]), near[1] + t * (far[1] - near[1])]
    }
}

/// The textures of one seed and size. Each is synthesised on its first use.
pub struct TextureBank {
    seed: u64,
    size: usize,
    slots: Vec<OnceLock<Texture>>,
}

impl std::fmt::Debug for TextureBank {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let made = self.slots.iter().filter(|s| s.get().is_some()).count();
        write!(f, "TextureBank(seed {}, {}², {made} of {BANK} made)", self.seed, self.size)
    }
}

/// Side of the shared bank's textures, px.
const SHARED_SIZE: usize = 256;
/// Largest side of a texture, px.
const SIZE_MAX: usize = 2048;
/// Seed of the shared bank: rooms of the same seed are equal in every process.
const SHARED_SEED: u64 = 0;

static SHARED: LazyLock<Arc<TextureBank>> =
    LazyLock::new(|| Arc::new(TextureBank::new(SHARED_SEED, SHARED_SIZE)));
static FINE: LazyLock<Arc<TextureBank>> =
    LazyLock::new(|| Arc::new(TextureBank::new(SHARED_SEED, SIZE_MAX)));

impl TextureBank {
    /// Creates a bank of 144 textures without synthesising them. `size` (px) is rounded up to a
    /// power of two from 64 to 2048. A synthesised texture takes 4 bytes × 4/3 × size².
    pub fn new(seed: u64, size: usize) -> Self {
        let size = size.clamp(64, SIZE_MAX).next_power_of_two();
        Self { seed, size, slots: (0..BANK).map(|_| OnceLock::new()).collect() }
    }

    /// Returns the bank of 256² textures that [`super::Room::new`] uses: 50 MB when all are
    /// synthesised.
    pub fn shared() -> Arc<Self> {
        Arc::clone(&SHARED)
    }

    /// Returns a bank of 2048² textures, for pictures of 512 pixels and more: 22 MB for each texture
    /// that a scene shows.
    pub fn fine() -> Arc<Self> {
        Arc::clone(&FINE)
    }

    /// Returns texture `index`, modulo the bank's size.
    pub(super) fn get(&self, index: usize) -> &Texture {
        let index = index % BANK;
        self.slots[index].get_or_init(|| {
            let mut rng = Rng::new(self.seed).fork(index as u64);
            Texture::new(&synthesis::fields(Kind::of(index), self.size, &mut rng))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ramp() -> Texture {
        let mut f = Fields::filled(8, 0.0, 0.25);
        for (i, a) in f.a.iter_mut().enumerate() {
            *a = (i % 8) as f32 / 7.0;
        }
        Texture::new(&f)
    }

    #[test]
    fn texels_interpolate_and_wrap() {
        let t = ramp();
        let at = |x: f32| t.sample(x / 8.0, 0.3, 0.0)[0];
        assert!((at(3.5) - 3.0 / 7.0).abs() < 1e-4);
        assert!((at(4.0) - 3.5 / 7.0).abs() < 1e-4);
        assert!((at(0.0) - 0.5).abs() < 1e-4, "between the last column and the first");
        assert!((at(-4.5) - at(3.5)).abs() < 1e-4);
        assert!((at(163.5) - at(3.5)).abs() < 1e-4);
    }

    #[test]
    fn a_large_footprint_gives_the_mean() {
        let t = ramp();
        let [a, b] = t.sample(0.1, 0.9, 1.0);
        assert!((a - 0.5).abs() < 1e-4 && (b - 0.25).abs() < 1e-4, "{a} {b}");
        assert_eq!(t.sample(0.1, 0.9, 1e9), [a, b]);
    }

    #[test]
    fn shares_fill_the_bank() {
        assert_eq!(SHARES.iter().map(|s| s.1).sum::<usize>(), BANK);
        for (kind, count) in SHARES {
            assert_eq!(kind.indices().len(), count);
            assert!(kind.indices().all(|i| Kind::of(i) == kind));
        }
    }
}
