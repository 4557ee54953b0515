//! The rasterizer for numpy arrays, with gsplat's conventions.
//!
//! [`rasterize`] reads the arrays in place and returns three pictures, which its outputs own; a [`Frame`]
//! keeps what the gradients need. Rasterizers with their buffers are reused from call to call.

use crate::arrays::{Array, array, borrow, check_gaussians, finite};
use crate::camera::cameras;
use crate::camera_gradients::viewmat_gradient;
use crate::error;
use crate::numbers::{optional_whole, real, whole};
use numpy::PyArrayDyn;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use rayon::prelude::*;
use std::ops::RangeInclusive;
use std::sync::{Mutex, PoisonError};
use subsplat::kernels::cpu::{Geometry, Gradients, Rasterizer, Rendered, SplatSlices};
use subsplat::kernels::layout::{SH_DEGREE_MAX, ShDirection, sh_coefficients};
use subsplat::{Camera, RasterOptions};

/// Sides of a picture, px.
pub(crate) const SIDES: RangeInclusive<usize> = 1..=32_768;
/// Most pixels of all pictures of a call: 2 GB of outputs.
const PIXELS_MAX: usize = 100_000_000;
/// Idle drawers that are kept, about 200 bytes a Gaussian and 20 a pixel each.
const IDLE_MAX: usize = 2;
/// Pixels that one thread converts in turn.
const PART: usize = 4096;

/// A rasterizer and the upstream planes `[5, H, W]` of its backward pass.
#[derive(Default)]
struct Drawer {
    rasterizer: Rasterizer,
    planes: Vec<f32>,
}

static IDLE: Mutex<Vec<Drawer>> = Mutex::new(Vec::new());

/// A drawer, with the buffers of an earlier call where one is idle.
fn take() -> Drawer {
    IDLE.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default()
}

fn give_back(drawers: impl IntoIterator<Item = Drawer>) {
    let mut idle = IDLE.lock().unwrap_or_else(PoisonError::into_inner);
    for drawer in drawers {
        if idle.len() < IDLE_MAX {
            idle.push(drawer);
        }
    }
}

/// Shape of the colours.
#[derive(Clone, Copy)]
struct Colours {
    /// Coefficients D of each channel; 1 for colours without a direction.
    coefficients: usize,
    /// SH degree of D.
    degree: usize,
    /// Each camera has colours of its own.
    per_camera: bool,
}

/// The arrays of a scene.
struct Arrays<'py> {
    means: Array<'py>,
    quats: Array<'py>,
    scales: Array<'py>,
    opacities: Array<'py>,
    colors: Array<'py>,
}

/// The numbers of a scene.
#[derive(Clone, Copy)]
struct Slices<'a> {
    means: &'a [f32],
    quats: &'a [f32],
    scales: &'a [f32],
    opacities: &'a [f32],
    colors: &'a [f32],
    colours: Colours,
}

impl<'py> Arrays<'py> {
    fn borrow(
        [means, quats, scales, opacities, colors]: [&Bound<'py, PyAny>; 5],
    ) -> PyResult<Self> {
        Ok(Self {
            means: borrow("means", "[N, 3]", means)?,
            quats: borrow("quats", "[N, 4]", quats)?,
            scales: borrow("scales", "[N, 3]", scales)?,
            opacities: borrow("opacities", "[N]", opacities)?,
            colors: borrow("colors", "[N, 3]", colors)?,
        })
    }

    /// Checks all shapes for `cameras` cameras.
    fn check(&self, cameras: usize, sh_degree: Option<usize>) -> PyResult<Colours> {
        self.means.expect("[N, 3]", &[None, Some(3)])?;
        let n = self.means.shape()[0];
        self.quats.expect(&format!("[{n}, 4]"), &[Some(n), Some(4)])?;
        self.scales.expect(&format!("[{n}, 3]"), &[Some(n), Some(3)])?;
        self.opacities.expect(&format!("[{n}]"), &[Some(n)])?;
        let shape = self.colors.shape();
        let Some(wanted) = sh_degree else {
            let per_camera = shape.len() == 3;
            let fits = shape == [n, 3] || shape == [cameras, n, 3];
            let expected = format!("[{n}, 3] or [{cameras}, {n}, 3] (without sh_degree)");
            let colours = Colours { coefficients: 1, degree: 0, per_camera };
            return if fits { Ok(colours) } else { Err(self.colors.misfit(&expected)) };
        };
        let degree = match shape {
            [count, d, 3] if *count == n => Some((*d, false)),
            [c, count, d, 3] if (*c, *count) == (cameras, n) => Some((*d, true)),
            _ => None,
        };
        let of = |d: usize| (wanted..=SH_DEGREE_MAX).find(|l| sh_coefficients(*l) == d);
        match degree.and_then(|(d, per_camera)| Some((d, of(d)?, per_camera))) {
            Some((coefficients, degree, per_camera)) => {
                Ok(Colours { coefficients, degree, per_camera })
            }
            None => {
                let least = sh_coefficients(wanted);
                Err(self.colors.misfit(&format!(
                    "[{n}, D, 3] or [{cameras}, {n}, D, 3] with D = 1, 4, 9, 16 or 25, at least {least}"
                )))
            }
        }
    }

    fn slices(&self, colours: Colours) -> PyResult<Slices<'_>> {
        Ok(Slices {
            means: self.means.slice()?,
            quats: self.quats.slice()?,
            scales: self.scales.slice()?,
            opacities: self.opacities.slice()?,
            colors: self.colors.slice()?,
            colours,
        })
    }
}

impl<'a> Slices<'a> {
    fn len(&self) -> usize {
        self.opacities.len()
    }

    /// Numbers of the colours of one camera.
    fn colour_numbers(&self) -> usize {
        3 * self.len() * self.colours.coefficients
    }

    /// The kernels' view for camera `c`.
    fn of_camera(&self, c: usize) -> SplatSlices<'a> {
        let Self { means, quats, scales, opacities, colors, colours } = *self;
        let numbers = self.colour_numbers();
        let first = if colours.per_camera { c * numbers } else { 0 };
        SplatSlices {
            geometry: Geometry::Separate { means, quats, scales, opacities },
            sh: colors.get(first..first + numbers).unwrap_or_default(),
            gain: &[],
            sh_degree: colours.degree,
        }
    }

    /// Refuses numbers of no Gaussian.
    fn check_numbers(&self) -> Result<(), String> {
        finite("means", self.means, 3)?;
        finite("quats", self.quats, 4)?;
        finite("scales", self.scales, 3)?;
        finite("opacities", self.opacities, 1)?;
        finite("colors", self.colors, 3 * self.colours.coefficients)?;
        check_gaussians(self.quats, self.opacities)
    }

    /// Reports whether the lengths fit one another: an array may have been given another shape since.
    fn is_consistent(&self, cameras: usize) -> bool {
        (0..cameras).all(|c| self.of_camera(c).is_consistent())
    }
}

/// Options of each camera, which differ in their backgrounds.
fn options(
    colours: Colours,
    sh_degree: Option<usize>,
    (near_plane, eps2d, antialiased): (f32, f32, bool),
    backgrounds: Option<&Array<'_>>,
    cameras: usize,
) -> PyResult<Vec<RasterOptions>> {
    if !(near_plane > 0.0 && near_plane.is_finite()) {
        return Err(error::value("near_plane", "a number above 0", near_plane));
    }
    if !(eps2d >= 0.0 && eps2d.is_finite()) {
        return Err(error::value("eps2d", "a number of at least 0", eps2d));
    }
    let direction = if sh_degree.is_some() { ShDirection::Child } else { ShDirection::Colour };
    let base = RasterOptions {
        sh_degree: sh_degree.unwrap_or(colours.degree),
        sh_direction: direction,
        lowpass: eps2d,
        antialiased,
        near: near_plane,
        ..RasterOptions::default()
    };
    let Some(backgrounds) = backgrounds else { return Ok(vec![base; cameras]) };
    backgrounds.expect(&format!("[{cameras}, 3]"), &[Some(cameras), Some(3)])?;
    let values = backgrounds.slice()?;
    finite("backgrounds", values, 3).map_err(PyValueError::new_err)?;
    let (rows, _) = values.as_chunks::<3>();
    Ok(rows.iter().map(|row| RasterOptions { background: *row, ..base }).collect())
}

/// Pictures `[C, H, W, …]`, one after the other.
#[derive(Default)]
struct Pictures {
    colours: Vec<f32>,
    alphas: Vec<f32>,
    depth_sums: Vec<f32>,
}

impl Pictures {
    fn push(&mut self, picture: Rendered) {
        // The pictures of one camera move.
        if self.alphas.is_empty() {
            (self.colours, self.alphas) = (picture.rgb, picture.alpha);
            self.depth_sums = picture.depth_sum;
        } else {
            self.colours.extend_from_slice(&picture.rgb);
            self.alphas.extend_from_slice(&picture.alpha);
            self.depth_sums.extend_from_slice(&picture.depth_sum);
        }
    }
}

/// Results of [`rasterize`]: colours, alphas, depth sums and the frame.
type Rasterized<'py> = (
    Bound<'py, PyArrayDyn<f32>>,
    Bound<'py, PyArrayDyn<f32>>,
    Bound<'py, PyArrayDyn<f32>>,
    Option<Frame>,
);

/// Renders `[C, H, W, 3]`, `[C, H, W, 1]` and `[C, H, W, 1]` (Σ w·z), and with `keep` a [`Frame`].
#[pyfunction]
#[pyo3(signature = (means, quats, scales, opacities, colors, viewmats, Ks, width, height, near_plane,
    eps2d, sh_degree, antialiased, backgrounds, keep))]
#[allow(clippy::too_many_arguments, non_snake_case, reason = "gsplat's names")]
pub(crate) fn rasterize<'py>(
    py: Python<'py>,
    means: &Bound<'py, PyAny>,
    quats: &Bound<'py, PyAny>,
    scales: &Bound<'py, PyAny>,
    opacities: &Bound<'py, PyAny>,
    colors: &Bound<'py, PyAny>,
    viewmats: &Bound<'py, PyAny>,
    Ks: &Bound<'py, PyAny>,
    width: &Bound<'py, PyAny>,
    height: &Bound<'py, PyAny>,
    near_plane: &Bound<'py, PyAny>,
    eps2d: &Bound<'py, PyAny>,
    sh_degree: Option<&Bound<'py, PyAny>>,
    antialiased: bool,
    backgrounds: Option<&Bound<'py, PyAny>>,
    keep: bool,
) -> PyResult<Rasterized<'py>> {
    let arrays = Arrays::borrow([means, quats, scales, opacities, colors])?;
    let (width, height) = (whole("width", width, SIDES)?, whole("height", height, SIDES)?);
    let sh_degree = optional_whole("sh_degree", sh_degree, 0..=SH_DEGREE_MAX)?;
    let viewmats = borrow("viewmats", "[C, 4, 4]", viewmats)?;
    let ks = borrow("Ks", "[C, 3, 3]", Ks)?;
    let cameras = cameras(&viewmats, &ks, (width, height))?;
    let count = cameras.len();
    let pixels = width.saturating_mul(height).saturating_mul(count);
    if pixels > PIXELS_MAX {
        let got = format!("{count} of {width}x{height}");
        return Err(error::value("pictures", format!("at most {PIXELS_MAX} pixels"), got));
    }
    let colours = arrays.check(count, sh_degree)?;
    let backgrounds =
        backgrounds.map(|values| borrow("backgrounds", "[C, 3]", values)).transpose()?;
    let kind = (real("near_plane", near_plane)?, real("eps2d", eps2d)?, antialiased);
    let options = options(colours, sh_degree, kind, backgrounds.as_ref(), count)?;
    let slices = arrays.slices(colours)?;
    let drawn = py.detach(|| draw(&slices, &cameras, &options, keep));
    let (pictures, drawers) = drawn.map_err(PyValueError::new_err)?;
    let Pictures { colours: rgb, alphas, depth_sums } = pictures;
    let frame = keep.then(|| Frame {
        arrays: [
            arrays.means.keep(),
            arrays.quats.keep(),
            arrays.scales.keep(),
            arrays.opacities.keep(),
            arrays.colors.keep(),
        ],
        colours,
        cameras,
        options,
        drawers: Mutex::new(drawers),
    });
    Ok((
        array(py, rgb, &[count, height, width, 3])?,
        array(py, alphas, &[count, height, width, 1])?,
        array(py, depth_sums, &[count, height, width, 1])?,
        frame,
    ))
}

/// Draws all cameras; keeps their drawers where `keep` says so.
fn draw(
    slices: &Slices<'_>,
    cameras: &[Camera],
    options: &[RasterOptions],
    keep: bool,
) -> Result<(Pictures, Vec<Drawer>), String> {
    slices.check_numbers()?;
    let (mut pictures, mut kept) = (Pictures::default(), Vec::new());
    let mut current = None;
    for (c, (camera, options)) in cameras.iter().zip(options).enumerate() {
        let drawer = current.get_or_insert_with(take);
        pictures.push(drawer.rasterizer.render(&slices.of_camera(c), camera, options));
        if keep {
            kept.extend(current.take());
        }
    }
    give_back(current);
    Ok((pictures, kept))
}

/// A drawn frame, for its gradients. It holds the arrays that were passed.
#[pyclass(frozen, module = "subsplat._native")]
pub(crate) struct Frame {
    arrays: [Py<PyAny>; 5],
    colours: Colours,
    cameras: Vec<Camera>,
    options: Vec<RasterOptions>,
    /// One for each camera.
    drawers: Mutex<Vec<Drawer>>,
}

impl Drop for Frame {
    fn drop(&mut self) {
        let drawers = self.drawers.get_mut().unwrap_or_else(PoisonError::into_inner);
        give_back(drawers.drain(..));
    }
}

/// Gradients with respect to the pictures; `None` for zeros.
#[derive(Clone, Copy)]
struct Upstream<'a> {
    colours: Option<&'a [f32]>,
    alphas: Option<&'a [f32]>,
    depth_sums: Option<&'a [f32]>,
}

/// Gradients of all cameras together.
#[derive(Default)]
struct Sums {
    splats: Gradients,
    backgrounds: Vec<f32>,
    viewmats: Vec<f32>,
}

#[pymethods]
impl Frame {
    /// Gradients of a scalar with respect to all inputs, from those with respect to the pictures.
    #[pyo3(signature = (v_colors, v_alphas, v_depth_sums, viewmats))]
    fn backward<'py>(
        &self,
        py: Python<'py>,
        v_colors: Option<&Bound<'py, PyAny>>,
        v_alphas: Option<&Bound<'py, PyAny>>,
        v_depth_sums: Option<&Bound<'py, PyAny>>,
        viewmats: bool,
    ) -> PyResult<Bound<'py, PyDict>> {
        let [means, quats, scales, opacities, colors] =
            self.arrays.each_ref().map(|array| array.bind(py));
        let arrays = Arrays::borrow([means, quats, scales, opacities, colors])?;
        let slices = arrays.slices(self.colours)?;
        let count = self.cameras.len();
        if !slices.is_consistent(count) {
            let got = "arrays whose shapes have changed";
            return Err(error::value("backward", "the arrays of the forward pass", got));
        }
        let upstream =
            [("v_colors", v_colors, 3), ("v_alphas", v_alphas, 1), ("v_depths", v_depth_sums, 1)];
        let mut held = Vec::new();
        for (name, value, channels) in upstream {
            held.push(value.map(|value| self.upstream(name, value, channels)).transpose()?);
        }
        let [colours, alphas, depth_sums] = &held[..] else {
            return Err(error::value("backward", "three gradients", held.len()));
        };
        let upstream = Upstream {
            colours: colours.as_ref().map(Array::slice).transpose()?,
            alphas: alphas.as_ref().map(Array::slice).transpose()?,
            depth_sums: depth_sums.as_ref().map(Array::slice).transpose()?,
        };
        let sums = py.detach(|| self.gradients(&slices, upstream, viewmats));
        let Sums { splats, backgrounds, viewmats } = sums.map_err(PyValueError::new_err)?;
        let out = PyDict::new(py);
        let n = slices.len();
        out.set_item("means", array(py, splats.means, &[n, 3])?)?;
        out.set_item("quats", array(py, splats.quats, &[n, 4])?)?;
        out.set_item("scales", array(py, splats.scales, &[n, 3])?)?;
        out.set_item("opacities", array(py, splats.opacities, &[n])?)?;
        out.set_item("colors", array(py, splats.sh, arrays.colors.shape())?)?;
        out.set_item("backgrounds", array(py, backgrounds, &[count, 3])?)?;
        if !viewmats.is_empty() {
            out.set_item("viewmats", array(py, viewmats, &[count, 4, 4])?)?;
        }
        Ok(out)
    }
}

impl Frame {
    fn size(&self) -> [usize; 2] {
        let k = self.cameras.first().map(|camera| camera.intrinsics());
        k.map_or([0, 0], |k| [k.height, k.width])
    }

    /// Borrows a gradient with respect to pictures of `channels` channels.
    fn upstream<'py>(
        &self,
        name: &'static str,
        value: &Bound<'py, PyAny>,
        channels: usize,
    ) -> PyResult<Array<'py>> {
        let (count, [h, w]) = (self.cameras.len(), self.size());
        let shape = format!("[{count}, {h}, {w}, {channels}]");
        let array = borrow(name, &shape, value)?;
        array.expect(&shape, &[count, h, w, channels].map(Some))?;
        Ok(array)
    }

    fn gradients(
        &self,
        slices: &Slices<'_>,
        upstream: Upstream<'_>,
        viewmats: bool,
    ) -> Result<Sums, String> {
        let [h, w] = self.size();
        let pixels = h * w;
        for (name, values, row) in [
            ("v_colors", upstream.colours, 3),
            ("v_alphas", upstream.alphas, 1),
            ("v_depths", upstream.depth_sums, 1),
        ] {
            finite(name, values.unwrap_or_default(), row)?;
        }
        let mut drawers = self.drawers.lock().unwrap_or_else(PoisonError::into_inner);
        let mut sums = Sums::default();
        let views = self.cameras.iter().zip(&self.options).zip(drawers.iter_mut());
        for (c, ((camera, options), Drawer { rasterizer, planes })) in views.enumerate() {
            planes.resize(5 * pixels, 0.0);
            fill_planes(planes, upstream, c, pixels);
            let splats = slices.of_camera(c);
            let mut own = Gradients::default();
            rasterizer.backward_of_last(&splats, camera, options, planes, &mut own);
            sums.backgrounds.extend(own.background);
            if viewmats {
                sums.viewmats.extend(viewmat_gradient(&splats, camera, options, &own));
            }
            if c == 0 {
                sums.splats = own;
            } else {
                add(&mut sums.splats, own, self.colours.per_camera);
            }
        }
        Ok(sums)
    }
}

/// Adds the gradients of another camera; those of colours of its own follow the ones before.
fn add(sum: &mut Gradients, mut own: Gradients, per_camera: bool) {
    if per_camera {
        sum.sh.append(&mut own.sh);
    }
    let pairs = [
        (&mut sum.means, &own.means),
        (&mut sum.quats, &own.quats),
        (&mut sum.scales, &own.scales),
        (&mut sum.opacities, &own.opacities),
        (&mut sum.sh, &own.sh),
    ];
    for (sum, own) in pairs {
        sum.iter_mut().zip(own).for_each(|(sum, v)| *sum += v);
    }
}

/// Writes the planes `[5, H, W]` of camera `c` from pictures `[C, H, W, …]`.
fn fill_planes(planes: &mut [f32], upstream: Upstream<'_>, c: usize, pixels: usize) {
    let (rgb, rest) = planes.split_at_mut(3 * pixels);
    if let Some(colours) = upstream.colours {
        let colours = &colours[3 * c * pixels..3 * (c + 1) * pixels];
        for (channel, plane) in rgb.chunks_exact_mut(pixels).enumerate() {
            let parts = plane.par_chunks_mut(PART).zip(colours.par_chunks(3 * PART));
            parts.for_each(|(plane, colours)| {
                for (v, pixel) in plane.iter_mut().zip(colours.chunks_exact(3)) {
                    *v = pixel[channel];
                }
            });
        }
    } else {
        rgb.fill(0.0);
    }
    let single = [upstream.alphas, upstream.depth_sums];
    for (plane, values) in rest.chunks_exact_mut(pixels).zip(single) {
        match values {
            Some(values) => plane.copy_from_slice(&values[c * pixels..(c + 1) * pixels]),
            None => plane.fill(0.0),
        }
    }
}
