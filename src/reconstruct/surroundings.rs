//! Gaussians beyond the edges of the photographs, where a new view soon looks. Without them, a view from beside
//! the photographs has strips of the background's colour at its edges.
//!
//! Rings lie around each photograph, each twice as wide as the one inside it, with the colour of the pixels at the
//! edge, a little farther than these. A Gaussian stays out where any photograph shows a part of it. The refinement,
//! which comes before, knows nothing of them, and the pictures at the photographs' own cameras stay as they are
//! (29.78 dB / .952 with them and without, sixteen pairs of `../shared/photos`, 128 → 256). New views of these pairs
//! have 20.01 dB / .7276 with them and 19.99 / .7275 without; an orbit has no blurred strip at its lower edge.
//!
//! Tried and left out, on eight of the pairs (18.79 dB / .684 without, at their own cameras 28.59 / .944): the same
//! rings at the depth of the edge and with twice the width, 18.71 / .683 and 27.10 / .938, because they cover what the
//! scene's own Gaussians show beyond the edges; strips of the same widths behind the edges of near objects, where
//! the farther surface goes on, 18.77 / .681 and 27.68 / .925: they shine through surfaces that are not quite opaque.

use super::assessment::surface_depth;
use crate::reconstruct::inputs::crop::Cropped;
use crate::scene::render::Renderer;
use crate::scene::splats::Splats;
use glam::{Mat3, Quat, UVec2, Vec2, Vec3};
use rayon::prelude::*;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{RasterOptions, SCALE_OFFSET, SPLAT_STRIDE, gain_with_offsets};

/// Gaussians beyond the edges of the photographs, so that new views from beside them have no strips of the
/// background's colour.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum Surroundings {
    /// In the colours and depths of the pixels at the edges, about 1 % more Gaussians. None where the caller gives
    /// their number ([`Options::density`]), or where neither [`Options::fit`] nor [`Options::refine`] changes them.
    ///
    /// [`Options::density`]: super::Options::density
    /// [`Options::fit`]: super::Options::fit
    /// [`Options::refine`]: super::Options::refine
    #[default]
    Photographs,
    /// None.
    Off,
}

/// A photograph's shorter side over the width of the innermost ring.
const FINEST: f32 = 128.0;
/// Rings of a photograph.
const RINGS: usize = 5;
/// Distance of a ring's middle from its inner side, over its width: the photograph's own pixels keep their colours.
const MIDDLE: f32 = 0.8;
/// σ over the width of a ring: across it, along it, and along the ray.
const SIGMAS: [f32; 3] = [0.35, 0.5, 0.1];
/// Distance from the middle of a Gaussian at which it is no longer seen, σ.
const REACH: f32 = 2.0;
/// Camera z over that of the edge. The scene's own Gaussians at the edges reach beyond them, and have more detail.
const FARTHER: f32 = 1.05;
/// Opacity.
const OPACITY: f32 = 0.95;

/// A photograph with the depth of the scene at its pixels.
struct Surface<'a> {
    camera: Camera,
    photograph: &'a Cropped,
    /// Camera z of each pixel, row by row; 0 where there is none.
    depth: Vec<f32>,
}

/// One Gaussian before it is placed.
#[derive(Clone, Copy, Debug)]
struct Patch {
    /// Centre, px of the photograph.
    centre: Vec2,
    /// Direction away from the photograph's edge.
    outwards: Vec2,
    /// Beyond two edges.
    is_corner: bool,
    /// Camera z.
    depth: f32,
    /// Width, px.
    width: f32,
    /// RGB, display values.
    colour: Vec3,
}

impl<'a> Surface<'a> {
    fn new(
        splats: &Splats,
        photograph: &'a Cropped,
        raster: &RasterOptions,
        renderer: &mut Renderer,
    ) -> Self {
        let camera = photograph.input_camera;
        let picture = renderer.render(splats, &camera, raster);
        let mask = photograph.input_mask.as_ref();
        let depth = (0..picture.depth.len()).map(|i| surface_depth(&picture, i, mask));
        Self { depth: depth.collect(), camera, photograph }
    }

    fn size(&self) -> UVec2 {
        let picture = &self.photograph.input;
        UVec2::new(picture.width as u32, picture.height as u32)
    }

    /// Width of the innermost ring, px.
    fn finest(&self) -> f32 {
        (self.size().min_element() as f32 / FINEST).max(1.0)
    }

    /// Mean colour and middle depth of the square of `width` px around `centre`, of pixels that have a depth.
    /// `None` where these are fewer than a quarter.
    fn square(&self, centre: Vec2, width: f32) -> Option<(Vec3, f32)> {
        let size = self.size().as_vec2();
        let low = (centre - 0.5 * width).clamp(Vec2::ZERO, size - 1.0).as_uvec2();
        let high = (centre + 0.5 * width).clamp(Vec2::ONE, size).as_uvec2().max(low + 1);
        let picture = &self.photograph.input;
        let (mut depths, mut sum) = (Vec::new(), Vec3::ZERO);
        for y in low.y..high.y {
            for x in low.x..high.x {
                let i = y as usize * picture.width + x as usize;
                if self.depth[i] > 0.0 {
                    depths.push(self.depth[i]);
                    let rgb = [0, 1, 2].map(|c| f32::from(picture.data[3 * i + c]));
                    sum += Vec3::from_array(rgb) / 255.0;
                }
            }
        }
        let area = (high - low).element_product() as usize;
        if depths.is_empty() || 4 * depths.len() < area {
            return None;
        }
        let (count, middle) = (depths.len() as f32, depths.len() / 2);
        let (_, depth, _) = depths.select_nth_unstable_by(middle, f32::total_cmp);
        Some((sum / count, *depth))
    }

    /// Patches around the photograph.
    fn beyond(&self) -> Vec<Patch> {
        let size = self.size().as_vec2();
        let (mut patches, mut inner) = (Vec::new(), 0.0);
        for ring in 0..RINGS {
            let width = self.finest() * (1 << ring) as f32;
            if width > size.min_element() {
                break;
            }
            let distance = inner + MIDDLE * width;
            inner += width;
            for centre in around(size, distance, width) {
                let outwards = centre - centre.clamp(Vec2::ZERO, size);
                let is_corner = outwards.x != 0.0 && outwards.y != 0.0;
                let edge = centre.clamp(Vec2::splat(0.5 * width), size - 0.5 * width);
                if let Some((colour, depth)) = self.square(edge, width) {
                    let depth = FARTHER * depth;
                    patches.push(Patch { centre, outwards, is_corner, depth, width, colour });
                }
            }
        }
        patches
    }

    /// Returns whether this photograph shows a part of the Gaussian around `mean` with the largest σ `sigma` (world
    /// units), or what hides it.
    fn shows(&self, mean: Vec3, sigma: f32) -> bool {
        let (size, k) = (self.size().as_vec2(), self.camera.intrinsics());
        let Some(px) = self.camera.project(mean) else { return false };
        let reach = REACH * sigma * k.fx.max(k.fy) / self.camera.to_camera(mean).z;
        px.cmpge(Vec2::splat(-reach)).all() && px.cmplt(size + reach).all()
    }

    /// Packed row of a patch.
    fn row(&self, patch: &Patch) -> [f32; SPLAT_STRIDE] {
        let k = self.camera.intrinsics();
        let ray = k.unproject(patch.centre).normalize();
        let outwards = patch.outwards.extend(0.0);
        let along = ray.cross(outwards).normalize();
        let in_camera = Mat3::from_cols(along.cross(ray), along, ray);
        let q = Quat::from_mat3(&(self.camera.rotation() * in_camera)).normalize();
        let width = patch.width * patch.depth / k.fx.max(k.fy);
        let [mut across, along, ray] = SIGMAS.map(|sigma| sigma * width);
        if patch.is_corner {
            across = along;
        }
        let m = self.camera.unproject(patch.centre, patch.depth);
        // Equal cameras give equal bytes: a zero of either sign becomes +0.
        [m.x, m.y, m.z, q.w, q.x, q.y, q.z, across, along, ray, OPACITY].map(|v| v + 0.0)
    }
}

/// Centres `spacing` apart on the rectangle around a picture of `size` px, at this distance from it.
fn around(size: Vec2, distance: f32, spacing: f32) -> Vec<Vec2> {
    let outer = size + 2.0 * distance;
    let [across, down] = (outer / spacing).round().max(Vec2::ONE).to_array().map(|n| n as usize);
    let mut centres = Vec::with_capacity(2 * (across + down));
    let mut side = |from: Vec2, to: Vec2, n: usize| {
        centres.extend((0..n).map(|i| from.lerp(to, i as f32 / n as f32)));
    };
    let (low, high) = (Vec2::splat(-distance), size + distance);
    let corners = [low, Vec2::new(high.x, low.y), high, Vec2::new(low.x, high.y)];
    side(corners[0], corners[1], across);
    side(corners[1], corners[2], down);
    side(corners[2], corners[3], across);
    side(corners[3], corners[0], down);
    centres
}

/// Adds Gaussians to `splats` where no photograph of `inputs` shows the scene, after the others. `raster` renders
/// pictures of the inputs' size. Returns their number.
pub fn add_surroundings(
    splats: &mut Splats,
    inputs: &[Cropped],
    raster: &RasterOptions,
    renderer: &mut Renderer,
) -> usize {
    let surfaces: Vec<Surface<'_>> =
        inputs.iter().map(|input| Surface::new(splats, input, raster, renderer)).collect();
    let of = |(i, surface): (usize, &Surface<'_>)| {
        let others = surfaces.iter().enumerate().filter(|(j, _)| *j != i).map(|(_, other)| other);
        let mut found = Vec::new();
        for patch in surface.beyond() {
            let row = surface.row(&patch);
            let (mean, sigma) = (Vec3::from_slice(&row), row[SCALE_OFFSET + 1]);
            if others.clone().all(|other| !other.shows(mean, sigma)) {
                found.push((row, patch.colour));
            }
        }
        found
    };
    let found: Vec<Vec<([f32; SPLAT_STRIDE], Vec3)>> =
        surfaces.par_iter().enumerate().map(of).collect();
    let mut found: Vec<([f32; SPLAT_STRIDE], Vec3)> = found.into_iter().flatten().collect();
    // Every parent has the same number of children.
    let children = splats.children_per_parent().max(1);
    found.truncate(found.len() / children * children);
    let set = 3 * splats.sh_coefficients();
    splats.gain = gain_with_offsets(&splats.gain, splats.len());
    for (row, colour) in &found {
        splats.rows.extend_from_slice(row);
        // Without SH coefficients the colour is ½ + δ.
        splats.gain.push(1.0);
        splats.gain.extend((*colour - 0.5).to_array());
    }
    splats.sh.resize(splats.sh.len() + found.len() / children * set, 0.0);
    found.len()
}

/// Removes the last `number` Gaussians, which [`add_surroundings`] added, and returns them.
pub fn take_surroundings(splats: &mut Splats, number: usize) -> Splats {
    let (children, channels) = (splats.children_per_parent().max(1), splats.gain_channels());
    let left = splats.len().saturating_sub(number);
    Splats {
        rows: splats.rows.split_off(left * SPLAT_STRIDE),
        sh: splats.sh.split_off(left / children * 3 * splats.sh_coefficients()),
        gain: splats.gain.split_off(left * channels),
        ..*splats
    }
}

/// Adds Gaussians that [`take_surroundings`] removed.
pub fn restore_surroundings(splats: &mut Splats, taken: Splats) {
    splats.rows.extend(taken.rows);
    splats.sh.extend(taken.sh);
    splats.gain.extend(taken.gain);
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::pictures::Rgb;
    use glam::Mat4;
    use subsplat_kernels::camera::{Camera, Intrinsics};
    use subsplat_kernels::layout::ShBasis;

    const SIDE: usize = 48;
    /// Distance of the wall, world units.
    const WALL: f32 = 4.0;

    fn camera(x: f32, fov: f32) -> Camera {
        let k = Intrinsics::from_fov_x(fov, SIDE, SIDE);
        Camera::new(k, Mat4::from_translation(Vec3::X * x)).unwrap()
    }

    /// A red photograph.
    fn photograph(x: f32) -> Cropped {
        let red = Rgb { width: SIDE, height: SIDE, data: [200, 40, 20].repeat(SIDE * SIDE) };
        Cropped::of_whole(red, camera(x, 1.0))
    }

    /// A wall that the photographs show, of families of `children` Gaussians.
    fn wall(photographs: &[Cropped], children: usize) -> Splats {
        let mut rows = Vec::new();
        for photograph in photographs {
            let k = photograph.input_camera.intrinsics();
            let sigma = 0.6 * WALL / k.fx;
            for i in 0..SIDE * SIDE {
                let px = Vec2::new((i % SIDE) as f32 + 0.5, (i / SIDE) as f32 + 0.5);
                let m = photograph.input_camera.position() + k.unproject(px) * WALL;
                rows.extend([m.x, m.y, m.z, 1.0, 0.0, 0.0, 0.0, sigma, sigma, 0.01, 0.9]);
            }
        }
        let n = rows.len() / SPLAT_STRIDE;
        let red = [1.0, -1.2, -1.5];
        Splats::new(rows, red.repeat(n / children), Vec::new(), 0, ShBasis::default()).unwrap()
    }

    #[test]
    fn a_view_from_beside_the_photographs_has_no_strip() {
        let photographs = [photograph(0.0), photograph(0.3)];
        let raster = RasterOptions::default();
        for children in [1, 4] {
            let bare = wall(&photographs, children);
            let mut splats = bare.clone();
            let renderer = &mut Renderer::default();
            let number = add_surroundings(&mut splats, &photographs, &raster, renderer);
            assert!(number > 100 && number.is_multiple_of(children), "{number}");
            assert_eq!(splats.len(), bare.len() + number);
            assert_eq!(splats.children_per_parent(), children);
            assert!(Splats::try_from(splats.clone().into_parts()).is_ok());
            let wide = camera(0.15, 1.2);
            let [before, after] = [&bare, &splats].map(|s| renderer.render(s, &wide, &raster));
            let corner = SIDE + 1;
            assert!(
                before.alpha[corner] < 0.1 && after.alpha[corner] > 0.8,
                "{}",
                after.alpha[corner]
            );
            let red = [200.0, 40.0, 20.0].map(|c: f32| c / 255.0);
            for (got, expected) in after.rgb[3 * corner..3 * corner + 3].iter().zip(red) {
                assert!((got / after.alpha[corner] - expected).abs() < 0.1, "{got} {expected}");
            }
            // The photographs' own pictures stay.
            for photograph in &photographs {
                let camera = &photograph.input_camera;
                let [a, b] = [&bare, &splats].map(|s| renderer.render(s, camera, &raster));
                let inner = (0..SIDE * SIDE).filter(|i| {
                    let border = |at: usize| at.min(SIDE - 1 - at);
                    border(i % SIDE).min(border(i / SIDE)) > 1
                });
                for i in inner {
                    assert!((a.rgb[3 * i] - b.rgb[3 * i]).abs() < 0.02, "{i}");
                }
            }
            let whole = splats.clone();
            let taken = take_surroundings(&mut splats, number);
            assert_eq!(taken.len(), number);
            assert_eq!((&splats.rows, &splats.sh), (&bare.rows, &bare.sh));
            assert_eq!(splats.gain, gain_with_offsets(&bare.gain, bare.len()));
            restore_surroundings(&mut splats, taken);
            assert_eq!(splats, whole);
        }
    }

    #[test]
    fn places_that_a_photograph_shows_stay_empty() {
        let photographs = [photograph(0.0), photograph(0.3)];
        let mut splats = wall(&photographs, 1);
        let number = splats.len();
        add_surroundings(
            &mut splats,
            &photographs,
            &RasterOptions::default(),
            &mut Renderer::default(),
        );
        for mean in splats.means().skip(number).map(Vec3::from_array) {
            for photograph in &photographs {
                let px = photograph.input_camera.project(mean).unwrap();
                let is_inside =
                    px.cmpgt(Vec2::ZERO).all() && px.cmplt(Vec2::splat(SIDE as f32)).all();
                assert!(!is_inside, "{px}");
            }
        }
    }

    #[test]
    fn masked_edges_and_small_pictures_are_no_error() {
        let renderer = &mut Renderer::default();
        let raster = RasterOptions::default();
        let mut photographs = [photograph(0.0), photograph(0.3)];
        let mut splats = wall(&photographs, 1);
        let none = crate::scene::mask::Mask::new(SIDE, SIDE, vec![false; SIDE * SIDE]);
        photographs.iter_mut().for_each(|p| p.input_mask = none.clone());
        assert_eq!(add_surroundings(&mut splats, &photographs, &raster, renderer), 0);
        let mut tiny = photograph(0.0);
        tiny.input = Rgb { width: 3, height: 2, data: vec![9; 18] };
        tiny.input_camera = tiny.input_camera.resized(3, 2).unwrap();
        assert!(add_surroundings(&mut splats, &[tiny], &raster, renderer) > 0);
    }
}
