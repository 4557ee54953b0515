//! Random Gaussians, and what two sets of them must have in common.

use glam::{DMat3, DQuat, DVec3};
use subsplat::scene::splats::Splats;
use subsplat_kernels::layout::{SPLAT_STRIDE, ShBasis, random};
use subsplat_kernels::sh;

/// SplitMix64: the same numbers everywhere.
pub struct Random(pub u64);

impl Random {
    pub fn word(&mut self) -> u64 {
        random::next(&mut self.0)
    }

    /// Uniform in [a, b).
    pub fn within(&mut self, a: f64, b: f64) -> f64 {
        a + (b - a) * (self.word() >> 11) as f64 / (1u64 << 53) as f64
    }

    pub fn below(&mut self, n: usize) -> usize {
        (self.word() % n as u64) as usize
    }

    pub fn direction(&mut self) -> DVec3 {
        loop {
            let v = DVec3::from_array([(); 3].map(|()| self.within(-1.0, 1.0)));
            if (0.01..1.0).contains(&v.length_squared()) {
                return v.normalize();
            }
        }
    }
}

/// Sizes and colour format of a random scene.
#[derive(Clone, Copy, Debug)]
pub struct Kind {
    pub parents: usize,
    pub children: usize,
    pub degree: usize,
    pub gain_channels: usize,
    pub basis: ShBasis,
}

/// Small numbers of everything, for formats that quantise: SH within ±0.4.
pub fn scene(seed: u64, kind: Kind) -> Splats {
    let mut r = Random(seed);
    let n = kind.parents * kind.children;
    let d = (kind.degree + 1) * (kind.degree + 1);
    let mut rows = Vec::with_capacity(n * SPLAT_STRIDE);
    for _ in 0..n {
        rows.extend([(); 3].map(|()| r.within(-4.0, 4.0) as f32));
        // Not unit, of either sign: writers must normalise.
        let length = r.within(0.5, 2.0);
        rows.extend([(); 4].map(|()| (length * r.within(-1.0, 1.0)) as f32));
        rows.extend([(); 3].map(|()| r.within(-6.0, 0.0).exp() as f32));
        rows.push(r.within(0.0, 1.0) as f32);
    }
    let sh = (0..kind.parents * d * 3).map(|_| r.within(-0.4, 0.4) as f32).collect();
    let gain = (0..n * kind.gain_channels)
        .map(|i| {
            if kind.gain_channels == 1 || i % 4 == 0 {
                r.within(0.5, 1.5) as f32
            } else {
                r.within(-0.1, 0.1) as f32
            }
        })
        .collect();
    Splats::new(rows, sh, gain, kind.degree, kind.basis).unwrap()
}

/// R·diag(σ²)·Rᵀ of splat `i`.
pub fn covariance(s: &Splats, i: usize) -> DMat3 {
    let [w, x, y, z] = s.quat_wxyz(i).map(f64::from);
    let r = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let scale = DVec3::from_array(s.scale(i).map(f64::from));
    r * DMat3::from_diagonal(scale * scale) * r.transpose()
}

/// ½ + γΣ + δ of splat `i` in direction `d`, degrees above `degree` left out.
pub fn colour(s: &Splats, i: usize, d: DVec3, degree: usize) -> [f64; 3] {
    let basis: Vec<f64> = match s.sh_basis() {
        ShBasis::Standard => sh::standard(d).to_vec(),
        ShBasis::Mvsplat => sh::mvsplat(d).to_vec(),
    };
    let used = if s.sh_basis() == ShBasis::Standard { (degree + 1) * (degree + 1) } else { 16 };
    let (gamma, delta) = s.gain_of(i);
    std::array::from_fn(|c| {
        let sum: f64 = s
            .sh_of(i)
            .chunks_exact(3)
            .zip(&basis)
            .take(used)
            .map(|(h, y)| f64::from(h[c]) * y)
            .sum();
        0.5 + f64::from(gamma) * sum + f64::from(delta[c])
    })
}

/// How far two sets may lie apart.
#[derive(Clone, Copy, Debug)]
pub struct Tolerance {
    pub mean: f64,
    /// Of the covariance, relative to its trace.
    pub covariance: f64,
    pub opacity: f64,
    pub colour: f64,
}

/// Float files: rounding of f32 only.
pub const EXACT: Tolerance =
    Tolerance { mean: 1e-6, covariance: 2e-6, opacity: 1e-6, colour: 2e-6 };

/// Asserts that `after[i]` is `before[order[i]]` turned by `turn`, up to `degree`.
pub fn assert_same(
    before: &Splats,
    after: &Splats,
    order: &[usize],
    turn: DMat3,
    degree: usize,
    allowed: Tolerance,
) {
    assert_eq!(after.len(), order.len(), "number of Gaussians");
    assert_eq!((after.sh_basis(), after.gain_channels()), (ShBasis::Standard, 0));
    let mut random = Random(99);
    for (j, &i) in order.iter().enumerate() {
        let m = turn * DVec3::from_array(before.mean(i).map(f64::from));
        let off = (m - DVec3::from_array(after.mean(j).map(f64::from))).abs().max_element();
        assert!(off <= allowed.mean, "mean of {i}: off by {off}");
        let (a, b) = (turn * covariance(before, i) * turn.transpose(), covariance(after, j));
        let trace = a.x_axis.x + a.y_axis.y + a.z_axis.z;
        let off = (a - b).to_cols_array().iter().fold(0.0f64, |m, v| m.max(v.abs())) / trace;
        assert!(off <= allowed.covariance, "covariance of {i}: off by {off}");
        let length: f64 = after.quat_wxyz(j).iter().map(|v| f64::from(*v).powi(2)).sum();
        assert!((length - 1.0).abs() < 1e-6, "quaternion of {i}: squared length {length}");
        let off = f64::from((before.opacity(i) - after.opacity(j)).abs());
        assert!(off <= allowed.opacity, "opacity of {i}: off by {off}");
        for _ in 0..4 {
            let d = random.direction();
            let (a, b) = (colour(before, i, d, degree), colour(after, j, turn * d, degree));
            for c in 0..3 {
                let off = (a[c] - b[c]).abs();
                assert!(off <= allowed.colour, "colour {c} of {i}: {} became {}", a[c], b[c]);
            }
        }
    }
}

/// 0, 1, 2, …
pub fn in_order(s: &Splats) -> Vec<usize> {
    (0..s.len()).collect()
}
