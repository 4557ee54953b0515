//! The class `Scene`: Gaussians with the rules to render them.

use crate::arrays::{array, borrow, check_gaussians, finite};
use crate::camera::Camera;
use crate::error;
use crate::numbers::{misfit, optional_whole, real, whole};
use crate::raster::SIDES;
use numpy::PyArrayDyn;
use pyo3::exceptions::{PyRuntimeError, PyValueError};
use pyo3::prelude::*;
use pyo3::types::PyDict;
use std::path::{Path, PathBuf};
use subsplat::files::{SplatFile, load_splat_file};
use subsplat::kernels::layout::{
    OPACITY_OFFSET, QUAT_OFFSET, SCALE_OFFSET, SH_DEGREE_MAX, SPLAT_STRIDE, sh_coefficients,
};
use subsplat::reconstruct::{SceneVerdict, Trust};
use subsplat::scene::render::{
    camera_of_comments, comment_of_camera, comment_of_options, options_of_comments, render,
};
use subsplat::{
    Backend, Bounds, Convention, FileError, RasterOptions, Reconstruction, Renderer, SaveOptions,
    ShBasis, SplatFormat, Splats, Warning, encode_splats, parse_splats, save_splats,
};
use subsplat_cli::commands::html::Page;

/// Least size of a page: the viewer alone has a quarter of it.
const PAGE_BYTES_MIN: usize = 200_000;
/// Field of view of the camera that sees a whole scene, radians.
const FOV: f32 = 1.0;

/// Gaussians, the rules to render them, and cameras to see them from.
#[pyclass(frozen, module = "subsplat._native")]
pub(crate) struct Scene {
    splats: Splats,
    options: RasterOptions,
    cameras: Vec<subsplat::Camera>,
    verdict: Option<SceneVerdict>,
    warnings: Vec<String>,
}

/// Trust in a scene, the reason, and both as a sentence.
type Verdict = (&'static str, String, String);

/// Colours, alpha and depth of a picture.
type Drawn<'py> =
    (Bound<'py, PyArrayDyn<f32>>, Bound<'py, PyArrayDyn<f32>>, Bound<'py, PyArrayDyn<f32>>);

#[pymethods]
impl Scene {
    /// A scene of arrays, which are copied.
    #[new]
    fn new(
        means: &Bound<'_, PyAny>,
        quats: &Bound<'_, PyAny>,
        scales: &Bound<'_, PyAny>,
        opacities: &Bound<'_, PyAny>,
        sh: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let means = borrow("means", "[N, 3]", means)?;
        means.expect("[N, 3]", &[None, Some(3)])?;
        let n = means.shape()[0];
        let quats = borrow("quats", "[N, 4]", quats)?;
        quats.expect(&format!("[{n}, 4]"), &[Some(n), Some(4)])?;
        let scales = borrow("scales", "[N, 3]", scales)?;
        scales.expect(&format!("[{n}, 3]"), &[Some(n), Some(3)])?;
        let opacities = borrow("opacities", "[N]", opacities)?;
        opacities.expect(&format!("[{n}]"), &[Some(n)])?;
        let sh = borrow("sh", "[N, D, 3]", sh)?;
        sh.expect(&format!("[{n}, D, 3]"), &[Some(n), None, Some(3)])?;
        let d = sh.shape()[1];
        let Some(degree) = (0..=SH_DEGREE_MAX).find(|l| sh_coefficients(*l) == d) else {
            return Err(sh.misfit(&format!("[{n}, D, 3] with D = 1, 4, 9, 16 or 25")));
        };
        let (m, q, s) = (means.slice()?, quats.slice()?, scales.slice()?);
        let (o, h) = (opacities.slice()?, sh.slice()?);
        for (name, values, row) in [
            ("means", m, 3),
            ("quats", q, 4),
            ("scales", s, 3),
            ("opacities", o, 1),
            ("sh", h, 3 * d),
        ] {
            finite(name, values, row).map_err(PyValueError::new_err)?;
        }
        check_gaussians(q, o).map_err(PyValueError::new_err)?;
        let mut rows = Vec::with_capacity(SPLAT_STRIDE * n);
        for (i, opacity) in o.iter().enumerate() {
            rows.extend_from_slice(&m[3 * i..3 * i + 3]);
            rows.extend_from_slice(&q[4 * i..4 * i + 4]);
            rows.extend_from_slice(&s[3 * i..3 * i + 3]);
            rows.push(*opacity);
        }
        let splats = Splats::new(rows, h.to_vec(), Vec::new(), degree, ShBasis::Standard);
        let splats = splats.map_err(|e| PyValueError::new_err(e.to_string()))?;
        let options = RasterOptions::default();
        Ok(Self { splats, options, cameras: Vec::new(), verdict: None, warnings: Vec::new() })
    }

    fn __len__(&self) -> usize {
        self.splats.len()
    }

    /// The cameras of the photographs, at the size of the pictures.
    #[getter]
    fn cameras(&self) -> Vec<Camera> {
        self.cameras.iter().copied().map(Camera).collect()
    }

    /// The verdict on a scene of photographs.
    #[getter]
    fn verdict(&self) -> Option<Verdict> {
        let verdict = self.verdict.as_ref()?;
        let trust = match verdict.trust {
            Trust::Good => "good",
            Trust::NearPhotographs => "near_photographs",
            Trust::Wrong => "wrong",
        };
        Some((trust, verdict.reason.clone(), verdict.to_string()))
    }

    /// Remarks about the photographs or the file.
    #[getter]
    fn warnings(&self) -> Vec<String> {
        self.warnings.clone()
    }

    /// A camera that sees the whole scene, along +z of the world.
    fn overview(&self, side: &Bound<'_, PyAny>) -> PyResult<Camera> {
        let side = whole("side", side, SIDES)?;
        let Some(bounds) = Bounds::of(self.splats.means()) else {
            return Err(PyValueError::new_err(
                "overview: expected a scene with Gaussians, got none",
            ));
        };
        let camera = bounds.camera(FOV, side);
        camera.map(Camera).map_err(|e| PyValueError::new_err(e.to_string()))
    }

    /// Arrays of all attributes, in a dictionary.
    fn splats<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyDict>> {
        let plain = py.detach(|| self.plain()).map_err(PyRuntimeError::new_err)?;
        let (n, rows) = (plain.len(), plain.rows());
        let column = |from: usize, lanes: usize| -> Vec<f32> {
            let rows = rows.chunks_exact(SPLAT_STRIDE);
            rows.flat_map(|row| &row[from..from + lanes]).copied().collect()
        };
        let out = PyDict::new(py);
        out.set_item("means", array(py, column(0, 3), &[n, 3])?)?;
        out.set_item("quats", array(py, column(QUAT_OFFSET, 4), &[n, 4])?)?;
        out.set_item("scales", array(py, column(SCALE_OFFSET, 3), &[n, 3])?)?;
        out.set_item("opacities", array(py, column(OPACITY_OFFSET, 1), &[n])?)?;
        let d = plain.sh_coefficients();
        out.set_item("sh", array(py, plain.sh().to_vec(), &[n, d, 3])?)?;
        Ok(out)
    }

    /// Renders a picture: colours `[H, W, 3]`, alpha `[H, W]`, depth `[H, W]`.
    fn render<'py>(
        &self,
        py: Python<'py>,
        camera: &Bound<'py, PyAny>,
        background: Option<&Bound<'py, PyAny>>,
    ) -> PyResult<Drawn<'py>> {
        let Ok(camera) = camera.cast::<Camera>() else {
            return Err(misfit("camera", "a subsplat.Camera", camera.repr()?));
        };
        let camera = camera.get();
        let background = match background {
            None => self.options.background,
            Some(rgb) => rgb
                .extract::<[f32; 3]>()
                .or_else(|_| Err(misfit("background", "three numbers", rgb.repr()?)))?,
        };
        finite("background", &background, 3).map_err(PyValueError::new_err)?;
        let options = RasterOptions { background, ..self.options };
        let k = camera.0.intrinsics();
        let (w, h) = (k.width, k.height);
        let drawn = py.detach(|| render(&self.splats, &camera.0, &options));
        Ok((
            array(py, drawn.rgb, &[h, w, 3])?,
            array(py, drawn.alpha, &[h, w])?,
            array(py, drawn.depth, &[h, w])?,
        ))
    }

    /// Writes a file; its name decides the format. A page has at most `page_bytes` bytes.
    fn save(
        &self,
        py: Python<'_>,
        path: PathBuf,
        sh_degree: Option<&Bound<'_, PyAny>>,
        min_opacity: &Bound<'_, PyAny>,
        up: &str,
        page_bytes: Option<&Bound<'_, PyAny>>,
    ) -> PyResult<()> {
        let sh_degree = optional_whole("sh_degree", sh_degree, 0..=SH_DEGREE_MAX)?;
        let min_opacity = real("min_opacity", min_opacity)?;
        let page_bytes = optional_whole("page_bytes", page_bytes, PAGE_BYTES_MIN..=usize::MAX)?;
        let up = up.parse().map_err(PyValueError::new_err)?;
        if !(0.0..=1.0).contains(&min_opacity) {
            return Err(error::value("min_opacity", "0 to 1", min_opacity));
        }
        let camera = self.cameras.first().map(comment_of_camera);
        let comments = std::iter::once(comment_of_options(&self.options)).chain(camera).collect();
        let options =
            SaveOptions { sh_degree, min_opacity, up, comments, ..SaveOptions::default() };
        let html = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("html"));
        py.detach(|| {
            if html {
                self.save_page(&path, &options, page_bytes)
            } else {
                save_splats(&path, &self.splats, &options).map(drop).map_err(|e| error::of_file(&e))
            }
        })
    }
}

impl Scene {
    /// The scene of a reconstruction, with more `warnings`.
    pub(crate) fn of(
        result: Reconstruction,
        verdict: SceneVerdict,
        mut warnings: Vec<String>,
    ) -> Self {
        warnings.extend(Warning::sentences(result.warnings()));
        let cameras = result.inputs().iter().map(|input| input.target_camera).collect();
        let options = *result.raster_options();
        let splats = result.into_splats();
        Self { splats, options, cameras, verdict: Some(verdict), warnings }
    }

    /// The Gaussians with SH sets of their own in the standard basis, as a .ply file has them.
    fn plain(&self) -> Result<Splats, String> {
        let options = SaveOptions { sh_degree: Some(SH_DEGREE_MAX), ..SaveOptions::default() };
        let s = &self.splats;
        if s.sh_basis() == ShBasis::Standard && s.gain().is_empty() && s.parents() == s.len() {
            return Ok(s.clone());
        }
        let file = encode_splats(SplatFormat::Ply, s, &options).map_err(|e| e.to_string())?;
        parse_splats(&file, "scene.ply").map(|(splats, _)| splats).map_err(|e| e.to_string())
    }

    fn save_page(&self, path: &Path, options: &SaveOptions, most: Option<usize>) -> PyResult<()> {
        let title = path.file_stem().unwrap_or_default().to_string_lossy();
        let named =
            |(i, camera): (usize, &subsplat::Camera)| (format!("photograph {}", i + 1), *camera);
        let cameras: Vec<_> = self.cameras.iter().enumerate().map(named).collect();
        let page = Page {
            splats: &self.splats,
            cameras: &cameras,
            // A scene with a verdict was made here, from photographs at these cameras.
            photographs: self.verdict.is_some(),
            options: &self.options,
            title: &title,
        };
        let written = match most {
            Some(most) => page.write_within(path, options, most, &mut Renderer::new(&Backend::Cpu)),
            None => page.write(path, options),
        };
        written.map(drop).map_err(|e| match e.downcast_ref::<FileError>() {
            Some(e) => error::of_file(e),
            None => PyRuntimeError::new_err(e.to_string()),
        })
    }
}

/// Reads a .ply, .glb, .spz, .sog, .splat or .ksplat file.
#[pyfunction]
pub(crate) fn load(py: Python<'_>, path: PathBuf) -> PyResult<Scene> {
    let read = py.detach(|| load_splat_file(&path));
    let SplatFile { splats, comments, notes } = read.map_err(|e| error::of_file(&e))?;
    let options =
        options_of_comments(&comments).unwrap_or_else(|| RasterOptions::new(Convention::Standard));
    let cameras = camera_of_comments(&comments).into_iter().collect();
    Ok(Scene { splats, options, cameras, verdict: None, warnings: notes })
}
