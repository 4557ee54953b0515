//! Cameras: gsplat's arrays to the library's, and the class `Camera`.

use crate::arrays::{Array, array, borrow};
use crate::error;
use crate::numbers::whole;
use crate::raster::SIDES;
use numpy::PyArrayDyn;
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use subsplat::glam::{DMat3, DVec3, Mat4};
use subsplat::{Camera as Pinhole, Intrinsics};

/// A pinhole camera: OpenCV axes, world to camera, px with pixel centres at +0.5.
#[pyclass(frozen, module = "subsplat")]
#[derive(Clone)]
pub(crate) struct Camera(pub(crate) Pinhole);

#[pymethods]
impl Camera {
    #[new]
    fn new(
        viewmat: &Bound<'_, PyAny>,
        #[allow(non_snake_case, reason = "gsplat's name")] K: &Bound<'_, PyAny>,
        width: &Bound<'_, PyAny>,
        height: &Bound<'_, PyAny>,
    ) -> PyResult<Self> {
        let (width, height) = (whole("width", width, SIDES)?, whole("height", height, SIDES)?);
        let viewmat = borrow::<f32>("viewmat", "[4, 4]", viewmat)?;
        viewmat.expect("[4, 4]", &[Some(4), Some(4)])?;
        let k = borrow::<f32>("K", "[3, 3]", K)?;
        k.expect("[3, 3]", &[Some(3), Some(3)])?;
        Ok(Self(pinhole("camera", viewmat.slice()?, k.slice()?, width, height)?))
    }

    /// `[4, 4]` float32, world to camera.
    #[getter]
    fn viewmat<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let rows = self.0.camera_from_world().transpose().to_cols_array().to_vec();
        array(py, rows, &[4, 4])
    }

    /// `[3, 3]` float32, px.
    #[getter]
    #[allow(non_snake_case, reason = "gsplat's name")]
    fn K<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyArrayDyn<f32>>> {
        let rows = self.0.intrinsics().matrix().transpose().to_cols_array().to_vec();
        array(py, rows, &[3, 3])
    }

    /// Width, px.
    #[getter]
    fn width(&self) -> usize {
        self.0.intrinsics().width
    }

    /// Height, px.
    #[getter]
    fn height(&self) -> usize {
        self.0.intrinsics().height
    }

    /// The same camera for a picture of another size.
    fn resized(&self, width: &Bound<'_, PyAny>, height: &Bound<'_, PyAny>) -> PyResult<Self> {
        let (width, height) = (whole("width", width, SIDES)?, whole("height", height, SIDES)?);
        let resized = self.0.resized(width, height);
        resized.map(Self).map_err(|e| PyValueError::new_err(e.to_string()))
    }

    fn __repr__(&self) -> String {
        let (k, at) = (self.0.intrinsics(), self.0.position());
        format!("Camera({}x{} px, fx {:.1} px, position {at})", k.width, k.height, k.fx)
    }
}

/// Makes the cameras of `viewmats` `[C, 4, 4]` and `ks` `[C, 3, 3]`.
///
/// # Errors
/// Other shapes; matrices of no pinhole camera.
pub(crate) fn cameras(
    viewmats: &Array<'_>,
    ks: &Array<'_>,
    (width, height): (usize, usize),
) -> PyResult<Vec<Pinhole>> {
    viewmats.expect("[C, 4, 4]", &[None, Some(4), Some(4)])?;
    let count = viewmats.shape()[0];
    if count == 0 {
        return Err(viewmats.misfit("[C, 4, 4] with at least one camera"));
    }
    ks.expect(&format!("[{count}, 3, 3]"), &[Some(count), Some(3), Some(3)])?;
    let pairs = viewmats.slice()?.chunks_exact(16).zip(ks.slice()?.chunks_exact(9));
    pairs
        .enumerate()
        .map(|(i, (viewmat, k))| pinhole(&format!("camera {i}"), viewmat, k, width, height))
        .collect()
}

fn pinhole(
    what: &str,
    viewmat: &[f32],
    k: &[f32],
    width: usize,
    height: usize,
) -> PyResult<Pinhole> {
    let &[fx, skew, cx, below, fy, cy, g, h, one] = k else {
        return Err(error::value(what, "a matrix K [3, 3]", format!("{} numbers", k.len())));
    };
    if [skew, below, g, h, one] != [0.0, 0.0, 0.0, 0.0, 1.0] {
        let expected = "K = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]";
        return Err(error::value(what, expected, format!("{k:?}")));
    }
    let m: [f32; 16] = viewmat
        .try_into()
        .map_err(|_| error::value(what, "a matrix [4, 4]", format!("{} numbers", viewmat.len())))?;
    if m[12..] != [0.0, 0.0, 0.0, 1.0] {
        return Err(error::value(what, "a last row 0 0 0 1 of viewmat", format!("{:?}", &m[12..])));
    }
    let d = m.map(f64::from);
    // Rows of R are columns of Rᵀ, the rotation from camera to world.
    let back = DMat3::from_cols(
        DVec3::new(d[0], d[1], d[2]),
        DVec3::new(d[4], d[5], d[6]),
        DVec3::new(d[8], d[9], d[10]),
    );
    let eye = -(back * DVec3::new(d[3], d[7], d[11]));
    let pose = Mat4::from_cols(
        back.x_axis.as_vec3().extend(0.0),
        back.y_axis.as_vec3().extend(0.0),
        back.z_axis.as_vec3().extend(0.0),
        eye.as_vec3().extend(1.0),
    );
    Pinhole::new(Intrinsics { fx, fy, cx, cy, width, height }, pose)
        .map_err(|e| PyValueError::new_err(format!("{what}: {e}")))
}
