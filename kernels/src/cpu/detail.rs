//! Detail from the photograph (ours, not the paper's): the colour of the full-resolution
//! photograph of a child's source view at the child's place, minus the colour of its parent's
//! input pixel.
//!
//! δ_k = I_r(π(μ_k)) − mean of I_r over the parent's pixel, per colour channel; the
//! renderer adds it: colour = max(0, ½ + γ·S_p + δ). I_r is the photograph at the
//! children's scale, r times the input's: a larger one is averaged down by area
//! first, so that no frequency above the children's pitch aliases into them; a
//! smaller one (but larger than the input) is used as it is.
//!
//! In: photographs `[H', W', 3]` cropped to the network's field of view, cameras in
//! px of the input (W × H), child means `[N·K, 3]` world, parents in the order
//! ((view·H + row)·W + column)·G + g. Out: δ `[N·K, 3]`.
//! Holds: children on the sub-pixel grid of their parent's pixel (offset 0) have
//! δ = I_r − mean exactly, so that mean + δ is the photograph and δ sums to 0 over
//! the parent. δ = 0 where the photograph is not larger than the input, for
//! children behind their source camera and for means that are not finite.

use crate::camera::Camera;
use crate::layout::gain_with_offsets;
use glam::Vec3;
use rayon::prelude::*;

/// A photograph `[height, width, 3]`, RGB in [0, 1], showing exactly the network's
/// field of view.
#[derive(Clone, Debug)]
pub struct Photograph<'a> {
    pixels: std::borrow::Cow<'a, [f32]>,
    width: usize,
    height: usize,
}

impl<'a> Photograph<'a> {
    /// `None` where the slice does not hold 3·width·height values or the picture is
    /// empty.
    pub fn new(pixels: &'a [f32], width: usize, height: usize) -> Option<Self> {
        let length = width.checked_mul(height)?.checked_mul(3)?;
        (length > 0 && pixels.len() == length).then_some(Self {
            pixels: pixels.into(),
            width,
            height,
        })
    }

    fn pixel(&self, x: usize, y: usize) -> Vec3 {
        let i = 3 * (y * self.width + x);
        Vec3::new(self.pixels[i], self.pixels[i + 1], self.pixels[i + 2])
    }

    /// Bilinear value at a position in px, clamped to the border's pixel centres.
    fn sample(&self, x: f32, y: f32) -> Vec3 {
        let split = |v: f32, size: usize| {
            let v = (v - 0.5).clamp(0.0, (size - 1) as f32);
            let low = (v as usize).min(size - 1);
            (low, (low + 1).min(size - 1), v - low as f32)
        };
        let ((x0, x1, fx), (y0, y1, fy)) = (split(x, self.width), split(y, self.height));
        let top = self.pixel(x0, y0).lerp(self.pixel(x1, y0), fx);
        let bottom = self.pixel(x0, y1).lerp(self.pixel(x1, y1), fx);
        top.lerp(bottom, fy)
    }

    /// Area average down to at most `width × height`; a side that is not larger
    /// stays.
    fn reduced(&self, width: usize, height: usize) -> Photograph<'static> {
        let (width, height) = (width.clamp(1, self.width), height.clamp(1, self.height));
        let columns = area_weights(self.width, width);
        let rows = area_weights(self.height, height);
        let mut pixels = vec![0.0f32; 3 * width * height];
        pixels.par_chunks_mut(3 * width).zip(&rows).for_each(|(out, (top, weights))| {
            let mut sum = vec![0.0f32; 3 * self.width];
            for (k, &weight) in weights.iter().enumerate() {
                let start = 3 * (top + k) * self.width;
                let row = &self.pixels[start..start + sum.len()];
                sum.iter_mut().zip(row).for_each(|(s, v)| *s += weight * v);
            }
            for (o, (left, weights)) in out.chunks_exact_mut(3).zip(&columns) {
                for (&weight, p) in weights.iter().zip(sum[3 * left..].chunks_exact(3)) {
                    o.iter_mut().zip(p).for_each(|(o, v)| *o += weight * v);
                }
            }
        });
        Photograph { pixels: pixels.into(), width, height }
    }
}

/// For every output pixel: the first input pixel that it covers and the share of
/// each, summing to 1.
fn area_weights(from: usize, to: usize) -> Vec<(usize, Vec<f32>)> {
    let edge = |i: usize| (i * from) as f64 / to as f64;
    (0..to)
        .map(|i| {
            let (start, end) = (edge(i), edge(i + 1));
            let first = start.floor() as usize;
            let last = (end.ceil() as usize).min(from);
            let cover = |p: usize| end.min((p + 1) as f64) - start.max(p as f64);
            let size = end - start;
            (first, (first..last).map(|p| (cover(p) / size) as f32).collect())
        })
        .collect()
}

/// One source view.
#[derive(Clone, Debug)]
pub struct SourceView<'a> {
    /// The camera with intrinsics in px of the network's input.
    pub camera: Camera,
    /// The photograph; `None` gives no detail.
    pub photograph: Option<Photograph<'a>>,
}

/// A view prepared once for all its children.
struct Prepared<'a> {
    camera: &'a Camera,
    /// The photograph at the children's scale and its mean over every input pixel.
    pictures: Option<(Photograph<'a>, Photograph<'static>)>,
}

impl<'a> Prepared<'a> {
    fn new(view: &'a SourceView<'_>, ratio: usize) -> Self {
        let k = &view.camera.intrinsics;
        let larger = |p: &&Photograph<'_>| p.width > k.width || p.height > k.height;
        // A side below the input's would leave pixels without a mean.
        let whole = |p: &&Photograph<'_>| p.width >= k.width && p.height >= k.height;
        let pictures = view.photograph.as_ref().filter(larger).filter(whole).map(|p| {
            let fine = p.reduced(k.width * ratio, k.height * ratio);
            let coarse = fine.reduced(k.width, k.height);
            (fine, coarse)
        });
        Self { camera: &view.camera, pictures }
    }

    /// δ of a child at `mean` whose parent is input pixel `pixel` (row-major).
    fn residual(&self, mean: Vec3, pixel: usize) -> Vec3 {
        let Some((fine, coarse)) = &self.pictures else { return Vec3::ZERO };
        let k = &self.camera.intrinsics;
        let Some(px) = self.camera.project(mean).filter(|p| p.is_finite()) else {
            return Vec3::ZERO;
        };
        let x = px.x * (fine.width as f32 / k.width as f32);
        let y = px.y * (fine.height as f32 / k.height as f32);
        fine.sample(x, y) - coarse.pixel(pixel % k.width, pixel / k.width)
    }
}

/// δ `[N·K, 3]` of `means` `[N·K, 3]`: `children` K per parent, `per_view` parents
/// per view (a multiple G of the input's pixels), children `ratio` times as dense as
/// input pixels along either side.
///
/// Lengths must fit: `means` holds 3·K·`per_view` floats for each of `views`.
/// Children beyond that have δ = 0.
pub fn residuals(
    views: &[SourceView<'_>],
    means: &[f32],
    per_view: usize,
    children: usize,
    ratio: usize,
) -> Vec<f32> {
    debug_assert_eq!(means.len(), 3 * children * per_view * views.len());
    let mut out = vec![0.0f32; means.len()];
    let per_parent = 3 * children;
    if per_parent * per_view == 0 {
        return out;
    }
    for (v, view) in views.iter().enumerate() {
        let k = &view.camera.intrinsics;
        let per_pixel = per_view / (k.width * k.height).max(1);
        debug_assert_eq!(per_pixel * k.width * k.height, per_view);
        let prepared = Prepared::new(view, ratio.max(1));
        if prepared.pictures.is_none() || per_pixel == 0 {
            continue;
        }
        let start = (v * per_view * per_parent).min(means.len());
        let end = (start + per_view * per_parent).min(means.len());
        let parents = out[start..end].par_chunks_mut(per_parent);
        parents.zip(means[start..end].par_chunks(per_parent)).enumerate().for_each(
            |(i, (out, means))| {
                let pixel = (i / per_pixel).min(k.width * k.height - 1);
                for (o, m) in out.chunks_exact_mut(3).zip(means.chunks_exact(3)) {
                    let delta = prepared.residual(Vec3::from_slice(m), pixel);
                    o.copy_from_slice(&delta.to_array());
                }
            },
        );
    }
    out
}

/// δ `[N, 3]` of `means` `[N, 3]` whose parents have different numbers of children. `parents` `[N]`,
/// in ascending order, are indices in the order of [`residuals`], `counts` their numbers of children;
/// `per_view` parents per view.
pub fn mixed_residuals(
    views: &[SourceView<'_>],
    means: &[f32],
    per_view: usize,
    parents: &[u32],
    counts: &[u8],
) -> Vec<f32> {
    debug_assert_eq!((means.len(), counts.len()), (3 * parents.len(), per_view * views.len()));
    let mut out = vec![0.0f32; means.len()];
    for (v, view) in views.iter().enumerate() {
        let k = &view.camera.intrinsics;
        let pixels = k.width * k.height;
        let per_pixel = per_view / pixels.max(1);
        if per_pixel == 0 {
            continue;
        }
        let first = v * per_view;
        // The photograph has the children's pixels, or smaller ones if K is not a square.
        let side = |children: &u8| f64::from(*children).sqrt().ceil() as usize;
        let sides: Vec<usize> = counts[first..first + per_view].iter().map(side).collect();
        // The only child of a parent lies in its pixel's middle: no detail.
        let most = sides.iter().copied().max().unwrap_or(0);
        let prepared: Vec<Option<Prepared<'_>>> = (0..=most)
            .map(|side| (side > 1 && sides.contains(&side)).then(|| Prepared::new(view, side)))
            .collect();
        let end = |limit: usize| parents.partition_point(|p| (*p as usize) < limit);
        let begin = end(first);
        let end = end(first + per_view);
        let children = parents[begin..end].par_iter().zip(means[3 * begin..3 * end].par_chunks(3));
        out[3 * begin..3 * end].par_chunks_mut(3).zip(children).with_min_len(1024).for_each(
            |(out, (parent, mean))| {
                let parent = *parent as usize;
                let Some(prepared) = &prepared[sides[parent - first]] else { return };
                let pixel = ((parent - first) / per_pixel).min(pixels - 1);
                let delta = prepared.residual(Vec3::from_slice(mean), pixel);
                out.copy_from_slice(&delta.to_array());
            },
        );
    }
    out
}

/// `[N, 4]` of γ and δ as the renderer takes it: `gain` of 0 (γ = 1), N or 4·N floats
/// with `delta` `[N, 3]` added to whatever residual is there.
pub fn with_residuals(gain: &[f32], delta: &[f32]) -> Vec<f32> {
    let mut out = gain_with_offsets(gain, delta.len() / 3);
    for (row, d) in out.chunks_exact_mut(4).zip(delta.chunks_exact(3)) {
        row[1..].iter_mut().zip(d).for_each(|(o, d)| *o += d);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Intrinsics;
    use glam::{Mat4, Quat, Vec2};

    const W: usize = 12;
    const H: usize = 8;

    fn camera(turn: f32) -> Camera {
        let k = Intrinsics { fx: 14.0, fy: 15.0, cx: 6.2, cy: 3.9, width: W, height: H };
        let pose = Mat4::from_rotation_translation(
            Quat::from_euler(glam::EulerRot::XYZ, 0.2, turn, -0.1),
            Vec3::new(turn, -0.5, 2.0),
        );
        Camera::new(k, pose).unwrap()
    }

    fn noise(n: usize, seed: u32) -> Vec<f32> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1u32 << 24) as f32
        };
        (0..n).map(|_| next()).collect()
    }

    /// Children exactly on the r × r grid of every input pixel, at varied depths.
    fn children(camera: &Camera, r: usize) -> Vec<f32> {
        let mut means = Vec::new();
        for i in 0..W * H {
            for k in 0..r * r {
                let g = Vec2::new((k % r) as f32 + 0.5, (k / r) as f32 + 0.5) / r as f32;
                let px = Vec2::new((i % W) as f32, (i / W) as f32) + g;
                let z = 1.0 + 0.3 * ((i + k) % 7) as f32;
                let p = camera.intrinsics.unproject(px) * z;
                means.extend(camera.world_from_camera.transform_point3(p).to_array());
            }
        }
        means
    }

    fn view<'a>(turn: f32, pixels: &'a [f32], w: usize, h: usize) -> SourceView<'a> {
        SourceView { camera: camera(turn), photograph: Photograph::new(pixels, w, h) }
    }

    #[test]
    fn mixed_children_have_the_residuals_of_their_grid() {
        let photos = [noise(3 * W * H * 16, 1), noise(3 * W * H * 16, 2)];
        let views = [view(0.0, &photos[0], W * 4, H * 4), view(0.7, &photos[1], W * 4, H * 4)];
        let sides: Vec<u8> = (0..2 * W * H).map(|i| [4, 1, 2, 0][i % 4]).collect();
        let of_side = |side: usize| -> (Vec<f32>, Vec<f32>) {
            let mut means = children(&views[0].camera, side);
            means.extend(children(&views[1].camera, side));
            let delta = residuals(&views, &means, W * H, side * side, side);
            (means, delta)
        };
        let all = [1, 2, 4].map(of_side);
        let (mut means, mut want, mut parents) = (Vec::new(), Vec::new(), Vec::new());
        for (i, side) in sides.iter().enumerate().filter(|(_, side)| **side > 0) {
            let k = 3 * usize::from(*side).pow(2);
            let (own, delta) = &all[usize::from(*side) / 2];
            means.extend_from_slice(&own[i * k..(i + 1) * k]);
            want.extend_from_slice(&delta[i * k..(i + 1) * k]);
            parents.extend(std::iter::repeat_n(i as u32, k / 3));
        }
        let counts: Vec<u8> = sides.iter().map(|side| side * side).collect();
        let got = mixed_residuals(&views, &means, W * H, &parents, &counts);
        assert!(want.iter().any(|d| d.abs() > 0.1));
        for (g, w) in got.iter().zip(&want) {
            assert!((g - w).abs() < 1e-5, "{g} {w}");
        }
    }

    #[test]
    fn mean_and_residual_are_the_photograph_at_zero_offset() {
        for r in [2, 4] {
            let photos = [noise(3 * W * H * r * r, 1), noise(3 * W * H * r * r, 2)];
            let views = [view(0.0, &photos[0], W * r, H * r), view(0.7, &photos[1], W * r, H * r)];
            let mut means = children(&views[0].camera, r);
            means.extend(children(&views[1].camera, r));
            let delta = residuals(&views, &means, W * H, r * r, r);
            for v in 0..2 {
                for i in 0..W * H {
                    let at = |k: usize, c: usize| {
                        let x = i % W * r + k % r;
                        let y = i / W * r + k / r;
                        photos[v][3 * (y * W * r + x) + c]
                    };
                    for c in 0..3 {
                        let mean = (0..r * r).map(|k| at(k, c)).sum::<f32>() / (r * r) as f32;
                        let mut sum = 0.0;
                        for k in 0..r * r {
                            let d = delta[3 * ((v * W * H + i) * r * r + k) + c];
                            assert!((mean + d - at(k, c)).abs() < 2e-4, "{v} {i} {k} {c}");
                            sum += d;
                        }
                        assert!(sum.abs() < 1e-3, "{sum}");
                    }
                }
            }
        }
    }

    #[test]
    fn an_enlarged_input_holds_no_detail() {
        let r = 2;
        let small = noise(3 * W * H, 3);
        let large: Vec<f32> = (0..W * r * H * r)
            .flat_map(|i| {
                let from = (i / (W * r) / r) * W + i % (W * r) / r;
                small[3 * from..3 * from + 3].to_vec()
            })
            .collect();
        let views = [view(0.3, &large, W * r, H * r)];
        let delta = residuals(&views, &children(&views[0].camera, r), W * H, r * r, r);
        assert!(delta.iter().all(|d| d.abs() < 2e-4));
    }

    #[test]
    fn a_photograph_no_larger_than_the_input_gives_nothing_wherever_children_are() {
        let small = noise(3 * W * H, 4);
        let views = [view(0.3, &small, W, H)];
        let means: Vec<f32> = children(&views[0].camera, 2).iter().map(|m| m + 0.03).collect();
        let delta = residuals(&views, &means, W * H, 4, 2);
        assert!(delta.iter().all(|d| *d == 0.0));
        let none = [SourceView { camera: camera(0.3), photograph: None }];
        assert!(residuals(&none, &means, W * H, 4, 2).iter().all(|d| *d == 0.0));
    }

    #[test]
    fn a_larger_photograph_is_averaged_to_the_childrens_scale() {
        // Six times the input under children of ratio 2: stripes of three columns
        // average to grey, and the column under a child's centre must not stand out.
        let stripes: Vec<f32> = (0..3 * 36 * W * H).map(|i| [1.0, 0.0, 0.5][i / 3 % 3]).collect();
        let views = [view(0.0, &stripes, 6 * W, 6 * H)];
        let means = children(&views[0].camera, 2);
        let delta = residuals(&views, &means, W * H, 4, 2);
        assert!(delta.iter().all(|d| d.abs() < 1e-5));
        // And a size that no integer divides keeps constants.
        let flat = vec![0.3; 3 * 31 * 21];
        let views = [view(0.0, &flat, 31, 21)];
        let delta = residuals(&views, &means, W * H, 4, 2);
        assert!(delta.iter().all(|d| d.abs() < 1e-5));
    }

    #[test]
    fn children_anywhere_get_finite_residuals() {
        let photo = noise(3 * W * H * 4, 5);
        let views = [view(0.0, &photo, 2 * W, 2 * H)];
        let mut means = children(&views[0].camera, 2);
        let odd = [f32::NAN, f32::INFINITY, -1e30, 1e30, 0.0, 7.0, -40.0];
        means.iter_mut().enumerate().step_by(5).for_each(|(i, m)| *m = odd[i % odd.len()]);
        let delta = residuals(&views, &means, W * H, 4, 2);
        assert!(delta.iter().all(|d| d.is_finite() && d.abs() <= 1.0));
        let eye = views[0].camera.position();
        let behind: Vec<f32> = means
            .chunks_exact(3)
            .flat_map(|m| {
                let m = Vec3::from_slice(m);
                (if m.is_finite() { 2.0 * eye - m } else { eye }).to_array()
            })
            .collect();
        let delta = residuals(&views, &behind, W * H, 4, 2);
        assert!(delta.iter().all(|d| d.is_finite()));
    }

    #[test]
    fn gaussians_of_one_pixel_share_its_mean() {
        let photo = noise(3 * W * H * 4, 6);
        let views = [view(0.0, &photo, 2 * W, 2 * H)];
        let one = children(&views[0].camera, 2);
        let twice: Vec<f32> = one.chunks_exact(12).flat_map(|p| [p, p].concat()).collect();
        let single = residuals(&views, &one, W * H, 4, 2);
        let double = residuals(&views, &twice, 2 * W * H, 4, 2);
        for (i, pair) in double.chunks_exact(24).enumerate() {
            assert_eq!(&pair[..12], &single[12 * i..12 * i + 12]);
            assert_eq!(pair[..12], pair[12..]);
        }
    }

    #[test]
    fn residuals_join_any_gain() {
        let delta = [0.1, 0.2, 0.3, -0.1, 0.0, 0.5];
        let expected = |g: [f32; 2]| vec![g[0], 0.1, 0.2, 0.3, g[1], -0.1, 0.0, 0.5];
        assert_eq!(with_residuals(&[], &delta), expected([1.0, 1.0]));
        assert_eq!(with_residuals(&[0.9, 1.1], &delta), expected([0.9, 1.1]));
        let four = [0.9, 0.0, 0.0, 0.0, 1.1, 0.0, 0.0, 0.0];
        assert_eq!(with_residuals(&four, &delta), expected([0.9, 1.1]));
        assert!(with_residuals(&[], &[]).is_empty());
    }
}
