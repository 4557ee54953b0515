//! Removal of lens distortion ([`Distortion`]).
//!
//! The undistorted picture has the stored size and principal point. Both focal lengths are
//! multiplied by the smallest factor for which every pixel lies inside the photograph: the
//! picture has no black border and keeps its aspect. Sampling is bicubic (a = −½), clamped
//! at the photograph's edge.

use super::distortion::Distortion;
use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;
use glam::DVec2;
use rayon::prelude::*;
use subsplat_kernels::camera::Intrinsics;

/// Range of the focal factor. Below ½, the middle would have a quarter of its pixels; above
/// 4, a sixteenth of the picture would remain.
const FOCAL_FACTORS: [f64; 2] = [0.5, 4.0];

/// Computes the pinhole of the undistorted picture (see the module's documentation).
///
/// # Errors
/// The distortion, where four times the focal length still leaves a black border.
pub fn pinhole(k: &Intrinsics, distortion: &Distortion) -> Result<Intrinsics, String> {
    if *distortion == Distortion::None {
        return Ok(*k);
    }
    let [mut low, mut high] = FOCAL_FACTORS;
    let corner = border(k).map(|px| ray(k, px).length()).fold(0.0, f64::max);
    let fold = distortion.monotone_radius(corner / low);
    let covered = |factor: f64| {
        border(k).all(|px| {
            let r = ray(k, px) / factor;
            let seen = distortion.distort_f64(r);
            let u = f64::from(k.fx) * seen.x + f64::from(k.cx);
            let v = f64::from(k.fy) * seen.y + f64::from(k.cy);
            // A NaN fails every comparison.
            r.length() <= fold
                && (0.0..=k.width as f64).contains(&u)
                && (0.0..=k.height as f64).contains(&v)
        })
    };
    if !covered(high) {
        return Err(format!("{distortion:?}, which leaves no rectangle inside the picture"));
    }
    if covered(low) {
        high = low;
    }
    // 30 bisections: a millionth of a pixel.
    for _ in 0..30 {
        let middle = 0.5 * (low + high);
        if covered(middle) {
            high = middle;
        } else {
            low = middle;
        }
    }
    Ok(Intrinsics {
        fx: (f64::from(k.fx) * high) as f32,
        fy: (f64::from(k.fy) * high) as f32,
        ..*k
    })
}

/// Iterates over the centres of the pixels along the picture's edge.
pub(super) fn border(k: &Intrinsics) -> impl Iterator<Item = DVec2> {
    let (w, h) = (k.width, k.height);
    let rows = (0..w).flat_map(move |x| [(x, 0), (x, h - 1)]);
    let columns = (0..h).flat_map(move |y| [(0, y), (w - 1, y)]);
    rows.chain(columns).map(|(x, y)| DVec2::new(x as f64 + 0.5, y as f64 + 0.5))
}

/// The ray (x, y, 1) of a pixel position, without its z.
pub(crate) fn ray(k: &Intrinsics, px: DVec2) -> DVec2 {
    DVec2::new(
        (px.x - f64::from(k.cx)) / f64::from(k.fx),
        (px.y - f64::from(k.cy)) / f64::from(k.fy),
    )
}

/// Resamples the photograph of a lens with `distortion` and intrinsics `from` to the pinhole
/// `to`.
pub fn undistort(photo: &Rgb, from: &Intrinsics, distortion: &Distortion, to: &Intrinsics) -> Rgb {
    resample(photo, to, Edge::Clamped, |px| Some(source(px, from, distortion, to)))
}

/// [`undistort`] of a photograph with a mask of its pixels. A pixel has the mask of the photograph's pixel at
/// its place. What is masked does not mix into pixels that count: the interpolation reads the colours around
/// instead ([`Mask::filled`]).
pub fn undistort_masked(
    photo: &Rgb,
    mask: &Mask,
    from: &Intrinsics,
    distortion: &Distortion,
    to: &Intrinsics,
) -> (Rgb, Option<Mask>) {
    let source = |px| Some(source(px, from, distortion, to));
    resample_masked(photo, mask, to, Edge::Clamped, source)
}

/// Pixels beside the left and the right edge of a picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Edge {
    /// Those of the edge.
    Clamped,
    /// Those of the other edge: a panorama.
    Wrapped,
}

/// Samples `photo` at the places that `source` gives for the pixels of a picture of the size of `to`; black where
/// there is none.
pub(super) fn resample(
    photo: &Rgb,
    to: &Intrinsics,
    edge: Edge,
    source: impl Fn(DVec2) -> Option<[f64; 2]> + Sync,
) -> Rgb {
    let mut out = Rgb::black(to.width, to.height);
    if out.data.is_empty() || photo.data.is_empty() {
        return out;
    }
    out.data.par_chunks_mut(3 * to.width).enumerate().for_each(|(y, line)| {
        for (x, pixel) in line.chunks_exact_mut(3).enumerate() {
            let px = DVec2::new(x as f64 + 0.5, y as f64 + 0.5);
            if let Some([u, v]) = source(px) {
                pixel.copy_from_slice(&sample(photo, u as f32, v as f32, edge));
            }
        }
    });
    out
}

/// [`resample`] with a mask, as [`undistort_masked`].
pub(super) fn resample_masked(
    photo: &Rgb,
    mask: &Mask,
    to: &Intrinsics,
    edge: Edge,
    source: impl Fn(DVec2) -> Option<[f64; 2]> + Sync,
) -> (Rgb, Option<Mask>) {
    let mut out = resample(photo, to, edge, &source);
    if !mask.fits(photo) {
        return (out, None);
    }
    let at = |i: usize| {
        let px = DVec2::new((i % to.width) as f64 + 0.5, (i / to.width) as f64 + 0.5);
        let Some([u, v]) = source(px) else { return false };
        // `as` saturates: any position gives a valid index.
        let (x, y) = ((u as usize).min(mask.width() - 1), (v as usize).min(mask.height() - 1));
        mask.kept()[y * mask.width() + x]
    };
    let kept: Vec<bool> = (0..to.width * to.height).into_par_iter().map(at).collect();
    let clean = resample(&mask.filled(photo), to, edge, &source);
    let pixels = out.data.chunks_exact_mut(3).zip(clean.data.chunks_exact(3));
    for ((pixel, clean), _) in pixels.zip(&kept).filter(|(_, kept)| **kept) {
        pixel.copy_from_slice(clean);
    }
    (out, Mask::new(to.width, to.height, kept))
}

/// Position in the photograph that pixel position `px` of the pinhole `to` shows, px.
fn source(px: DVec2, from: &Intrinsics, distortion: &Distortion, to: &Intrinsics) -> [f64; 2] {
    let seen = distortion.distort_f64(ray(to, px));
    [
        f64::from(from.fx) * seen.x + f64::from(from.cx),
        f64::from(from.fy) * seen.y + f64::from(from.cy),
    ]
}

/// Computes the weights of the neighbours at −1, 0, 1, 2 of a position `t` in [0, 1) (cubic
/// convolution, a = −½).
fn cubic(t: f32) -> [f32; 4] {
    let (t2, t3) = (t * t, t * t * t);
    [
        -0.5 * t + t2 - 0.5 * t3,
        1.0 - 2.5 * t2 + 1.5 * t3,
        0.5 * t + 2.0 * t2 - 1.5 * t3,
        -0.5 * t2 + 0.5 * t3,
    ]
}

/// Samples bicubically at pixel position (u, v), clamped at the upper and the lower edge.
fn sample(photo: &Rgb, u: f32, v: f32, edge: Edge) -> [u8; 3] {
    let (u, v) = (u - 0.5, v - 0.5);
    let (x0, y0) = (u.floor(), v.floor());
    let (wx, wy) = (cubic(u - x0), cubic(v - y0));
    // `as` saturates: any position gives a valid index.
    let at = |i: f32, n: usize| (i.max(0.0) as usize).min(n - 1);
    let column = |i: f32| match edge {
        Edge::Clamped => at(i, photo.width),
        Edge::Wrapped => at(i.rem_euclid(photo.width as f32), photo.width),
    };
    let mut sum = [0.0f32; 3];
    for (j, wy) in wy.into_iter().enumerate() {
        let row = at(y0 + j as f32 - 1.0, photo.height) * photo.width;
        for (i, wx) in wx.into_iter().enumerate() {
            let p = 3 * (row + column(x0 + i as f32 - 1.0));
            for (s, v) in sum.iter_mut().zip(&photo.data[p..p + 3]) {
                *s += wx * wy * f32::from(*v);
            }
        }
    }
    sum.map(|s| (s + 0.5) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    const K: Intrinsics =
        Intrinsics { fx: 200.0, fy: 210.0, cx: 155.0, cy: 122.0, width: 320, height: 240 };

    fn lenses() -> Vec<Distortion> {
        vec![
            Distortion::brown([-0.2, 0.05, 0.0, 0.0, 0.0, 0.0], [0.001, -0.002]),
            Distortion::brown([0.15, 0.0, 0.01, 0.0, 0.0, 0.0], [0.0, 0.0]),
            Distortion::brown([0.3, 0.1, 0.0, 0.5, 0.05, 0.0], [0.0, 0.0]),
            Distortion::polynomial([-0.2, 0.05, 0.01, 0.02], [0.001, -0.002], 0.004),
            Distortion::fisheye([0.02, -0.01, 0.0, 0.0]),
            Distortion::Fov { omega: 0.9 },
            Distortion::Division { k: -0.15 },
            Distortion::ThinPrismFisheye {
                k: [0.02, -0.01, 0.005, -0.002],
                p: [0.003, -0.004],
                s: [0.001, -0.002],
            },
            Distortion::RadTanThinPrismFisheye {
                k: [0.02, -0.01, 0.005, -0.002, 0.001, -0.0005],
                p: [0.003, -0.004],
                s: [0.001, -0.002, 0.0015, 0.0005],
            },
        ]
    }

    #[test]
    fn the_new_pinhole_touches_the_border_and_stays_inside() {
        for lens in lenses() {
            let new = pinhole(&K, &lens).unwrap();
            let (mut inside, mut closest) = (true, f64::MAX);
            for px in border(&new) {
                let d = lens.distort_f64(ray(&new, px));
                let u = f64::from(K.fx) * d.x + f64::from(K.cx);
                let v = f64::from(K.fy) * d.y + f64::from(K.cy);
                let edge = u.min(v).min(320.0 - u).min(240.0 - v);
                inside &= edge > -1e-3;
                closest = closest.min(edge);
            }
            assert!(inside && closest < 1e-2, "{lens:?} {new:?} {closest}");
            assert!((new.fx / K.fx - new.fy / K.fy).abs() < 1e-6);
        }
    }

    #[test]
    fn barrel_is_widened_and_pincushion_zoomed() {
        assert!(
            pinhole(&K, &Distortion::brown([-0.2, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2])).unwrap().fx
                < K.fx
        );
        assert!(
            pinhole(&K, &Distortion::brown([0.2, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2])).unwrap().fx
                > K.fx
        );
    }

    #[test]
    fn a_grid_becomes_straight() {
        // The photograph shows u of the ray in red and v in green, bent by the lens.
        for lens in lenses() {
            let new = pinhole(&K, &lens).unwrap();
            // Inverse of `distort` by fixed-point iteration, for the test alone.
            let straight = |px: DVec2| {
                let seen = ray(&K, px);
                let mut r = seen;
                for _ in 0..200 {
                    r += 0.7 * (seen - lens.distort_f64(r));
                }
                r
            };
            let mut photo = Rgb::black(K.width, K.height);
            let shade = |v: f64| (128.0 + 100.0 * v).clamp(0.0, 255.0).round() as u8;
            for y in 0..K.height {
                for x in 0..K.width {
                    let r = straight(DVec2::new(x as f64 + 0.5, y as f64 + 0.5));
                    let p = 3 * (y * K.width + x);
                    photo.data[p] = shade(r.x);
                    photo.data[p + 1] = shade(r.y);
                }
            }
            let out = undistort(&photo, &K, &lens, &new);
            for (i, pixel) in out.data.chunks_exact(3).enumerate() {
                let at = DVec2::new((i % K.width) as f64 + 0.5, (i / K.width) as f64 + 0.5);
                let r = ray(&new, at);
                for (got, want) in [(pixel[0], shade(r.x)), (pixel[1], shade(r.y))] {
                    assert!(got.abs_diff(want) <= 2, "{lens:?} at {at}: {got} not {want}");
                }
            }
        }
    }

    #[test]
    fn masked_pixels_do_not_mix_into_the_others() {
        for lens in lenses() {
            let new = pinhole(&K, &lens).unwrap();
            let mut photo = Rgb { data: vec![90; 3 * 320 * 240], ..Rgb::black(320, 240) };
            let masked = |x: f64, y: f64| (x - 130.0).hypot(y - 100.0) < 50.0;
            let kept: Vec<bool> = (0..320 * 240)
                .map(|i| !masked((i % 320) as f64 + 0.5, (i / 320) as f64 + 0.5))
                .collect();
            for (pixel, kept) in photo.data.chunks_exact_mut(3).zip(&kept) {
                if !kept {
                    pixel.fill(255);
                }
            }
            let mask = Mask::new(320, 240, kept).unwrap();
            let (out, moved) = undistort_masked(&photo, &mask, &K, &lens, &new);
            let moved = moved.unwrap();
            let mut counts = [0, 0];
            for (i, (pixel, kept)) in out.data.chunks_exact(3).zip(moved.kept()).enumerate() {
                let r = ray(&new, DVec2::new((i % 320) as f64 + 0.5, (i / 320) as f64 + 0.5));
                let seen = lens.distort_f64(r);
                let distance = (200.0 * seen.x + 155.0 - 130.0).hypot(210.0 * seen.y + 22.0);
                assert!((distance - 50.0).abs() < 1.0 || *kept == (distance > 50.0));
                assert!(!kept || pixel == [90; 3], "{lens:?} {i}: {pixel:?}");
                counts[usize::from(*kept)] += 1;
            }
            assert!(counts[0] > 2000 && counts[1] > 20_000, "{counts:?}");
        }
    }

    #[test]
    fn a_lens_that_folds_is_refused_or_cut_before_the_fold() {
        // r' = r(1 − 2r²) turns back at r = 0.41; the picture's corner is at 0.97.
        let lens = Distortion::brown([-2.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2]);
        let new = pinhole(&K, &lens).unwrap();
        let corner = border(&new).map(|px| ray(&new, px).length()).fold(0.0, f64::max);
        assert!(corner <= 0.41, "{corner}");
        let lens = Distortion::brown([-200.0, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2]);
        assert!(pinhole(&K, &lens).is_err());
        let lens = Distortion::brown([f64::NAN, 0.0, 0.0, 0.0, 0.0, 0.0], [0.0; 2]);
        assert!(pinhole(&K, &lens).is_err());
    }
}
