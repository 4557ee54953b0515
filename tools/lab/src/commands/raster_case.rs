//! Reads a rasterizer case for `subsplat-lab compare`: one `.safetensors` file with splats, a
//! camera, and the pictures and gradients of a reference rasterizer.
//!
//! Pictures and gradients are optional, each by itself. Options are metadata strings
//! (`convention`, `width`, `height`, `near`, `lowpass`, `antialiased`, `children`,
//! `sh_degree`, and the constants `alpha_min`, `alpha_max`, `t_min`).

use anyhow::{Context, Result, bail, ensure};
use glam::Mat4;
use safetensors::{Dtype, SafeTensors};
use std::collections::{BTreeMap, HashMap};
use std::path::Path;
use std::str::FromStr;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::cpu::{Geometry, SplatSlices};
use subsplat_kernels::layout::{
    ALPHA_MAX_MVSPLAT, ALPHA_MAX_STANDARD, ALPHA_MIN, Convention, NEAR_MVSPLAT, RasterOptions,
    SH_DEGREE_MAX, SPLAT_STRIDE, ShBasis, TRANSMITTANCE_MIN, sh_coefficients,
};

/// Metadata key that tells a rasterizer case from a reference of the encoder.
const MARK: &str = "convention";
/// Largest relative difference between a constant of the file and ours: f32 rounding.
const CONSTANT_TOLERANCE: f64 = 1e-6;

/// Values of a tensor, row-major.
struct Array {
    shape: Vec<usize>,
    values: Vec<f32>,
}

type Tensors = BTreeMap<String, Array>;

/// Tensors `[H, W]` or `[H, W, 3]`, all of them optional: name and channels.
const PICTURES: [(&str, usize); 7] = [
    ("rgb", 3),
    ("alpha", 1),
    ("depth_sum", 1),
    ("depth", 1),
    ("boundary", 1),
    ("v_rgb", 3),
    ("v_alpha", 1),
];

/// A rasterizer case, checked: shapes fit one another, camera and options are valid.
pub struct Case {
    /// The file's own name of the case; empty where it has none.
    pub name: String,
    /// Camera.
    pub camera: Camera,
    /// Rules and background.
    pub options: RasterOptions,
    tensors: Tensors,
    /// `[N, 11]`; empty where the case gives covariances.
    rows: Vec<f32>,
    sh_degree: usize,
}

impl Case {
    /// Reads `path`; `None` where the file is no rasterizer case.
    ///
    /// # Errors
    /// No safetensors file; a tensor, option or camera that is missing or does not fit.
    pub fn read(path: &Path) -> Result<Option<Self>> {
        let bytes = subsplat::files::read(path)?;
        let named = || path.display().to_string();
        let (_, header) = SafeTensors::read_metadata(&bytes)
            .context("expected a safetensors file")
            .with_context(named)?;
        match header.metadata() {
            Some(metadata) if metadata.contains_key(MARK) => {
                Self::parse(&bytes, metadata).map(Some).with_context(named)
            }
            _ => Ok(None),
        }
    }

    fn parse(bytes: &[u8], metadata: &HashMap<String, String>) -> Result<Self> {
        let mut tensors = BTreeMap::new();
        for (name, view) in SafeTensors::deserialize(bytes)?.tensors() {
            let data = view.data();
            let values = match view.dtype() {
                Dtype::F32 => data
                    .chunks_exact(4)
                    .map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]]))
                    .collect(),
                Dtype::U8 => data.iter().map(|&b| f32::from(b)).collect(),
                other => bail!("tensor `{name}`: expected f32 or u8, got {other:?}"),
            };
            tensors.insert(name, Array { shape: view.shape().to_vec(), values });
        }
        let meta = Meta(metadata);
        let options = options(&meta, array(&tensors, "background", &[3])?)?;
        let camera = camera(&meta, &tensors)?;
        let n = tensors.get("opacities").map_or(0, |o| o.values.len());
        let ShShape { parents: p, degree: sh_degree } = sh_shape(&tensors)?;
        let children = meta.number::<usize>("children")?;
        ensure!(
            p.checked_mul(children) == Some(n) && n > 0,
            "rasterizer case: expected opacities [{p} x {children} children], got [{n}]"
        );
        let rows = match options.convention {
            Convention::Standard => pack(&tensors, n)?,
            Convention::Mvsplat => {
                array(&tensors, "means", &[n, 3])?;
                array(&tensors, "cov6", &[n, 6])?;
                array(&tensors, "opacities", &[n])?;
                Vec::new()
            }
        };
        if tensors.contains_key("gain") {
            array(&tensors, "gain", &[n])?;
        }
        let name = metadata.get("case").cloned().unwrap_or_default();
        Ok(Self { name, camera, options, tensors, rows, sh_degree })
    }

    /// The splats, as the kernels read them.
    pub fn splats(&self) -> SplatSlices<'_> {
        let geometry = match self.options.convention {
            Convention::Standard => Geometry::Packed(&self.rows),
            Convention::Mvsplat => Geometry::Cov6 {
                means: self.values("means"),
                cov6: self.values("cov6"),
                opacities: self.values("opacities"),
            },
        };
        let (sh, gain) = (self.values("sh"), self.values("gain"));
        SplatSlices { geometry, sh, gain, sh_degree: self.sh_degree }
    }

    /// Gives the values of an optional tensor; `None` where the file does not hold it.
    ///
    /// # Errors
    /// It has another shape.
    pub fn optional(&self, name: &str, shape: &[usize]) -> Result<Option<&[f32]>> {
        if self.tensors.contains_key(name) {
            array(&self.tensors, name, shape).map(Some)
        } else {
            Ok(None)
        }
    }

    fn values(&self, name: &str) -> &[f32] {
        self.tensors.get(name).map_or(&[], |array| &array.values)
    }
}

/// The file's metadata.
struct Meta<'a>(&'a HashMap<String, String>);

impl Meta<'_> {
    fn text(&self, key: &str) -> Result<&str> {
        let value = self.0.get(key);
        value.map(String::as_str).with_context(|| format!("metadata: expected `{key}`, got none"))
    }

    fn number<T: FromStr>(&self, key: &str) -> Result<T> {
        let text = self.text(key)?;
        let number = text.parse().ok();
        number.with_context(|| {
            format!("metadata `{key}`: expected {}, got {text:?}", std::any::type_name::<T>())
        })
    }

    /// Refuses a case that was made with another value of a constant of ours.
    fn constant(&self, key: &str, ours: f32) -> Result<()> {
        let theirs = self.number::<f64>(key)?;
        let ours = f64::from(ours);
        let same = (theirs - ours).abs() <= CONSTANT_TOLERANCE * ours;
        ensure!(same, "metadata `{key}`: expected {ours} under this convention, got {theirs}");
        Ok(())
    }
}

fn array<'a>(tensors: &'a Tensors, name: &str, expected: &[usize]) -> Result<&'a [f32]> {
    let Some(Array { shape, values }) = tensors.get(name) else {
        bail!("rasterizer case: expected a tensor `{name}` {expected:?}, got none")
    };
    ensure!(shape == expected, "tensor `{name}`: expected shape {expected:?}, got {shape:?}");
    Ok(values)
}

fn options(meta: &Meta, background: &[f32]) -> Result<RasterOptions> {
    let near: f32 = meta.number("near")?;
    let (convention, sh_basis, alpha_max, near) = match meta.text(MARK)? {
        "standard" => (Convention::Standard, ShBasis::Standard, ALPHA_MAX_STANDARD, near),
        "mvsplat" => {
            (Convention::Mvsplat, ShBasis::Mvsplat, ALPHA_MAX_MVSPLAT, near / NEAR_MVSPLAT)
        }
        other => bail!("metadata `{MARK}`: expected standard or mvsplat, got {other:?}"),
    };
    meta.constant("alpha_min", ALPHA_MIN)?;
    meta.constant("alpha_max", alpha_max)?;
    meta.constant("t_min", TRANSMITTANCE_MIN)?;
    let lowpass: f32 = meta.number("lowpass")?;
    let antialiased: bool = meta.number("antialiased")?;
    let sh_degree: usize = meta.number("sh_degree")?;
    ensure!(near > 0.0 && near.is_finite(), "metadata `near`: expected more than 0, got {near}");
    ensure!(
        lowpass >= 0.0 && lowpass.is_finite(),
        "metadata `lowpass`: expected at least 0 px², got {lowpass}"
    );
    ensure!(
        sh_degree <= SH_DEGREE_MAX,
        "metadata `sh_degree`: expected 0 to {SH_DEGREE_MAX}, got {sh_degree}"
    );
    ensure!(
        !antialiased || convention == Convention::Standard,
        "metadata `antialiased`: expected false under mvsplat, got true"
    );
    let &[r, g, b] = background else { bail!("tensor `background`: expected three numbers") };
    ensure!(
        background.iter().all(|v| v.is_finite()),
        "tensor `background`: expected finite numbers, got {background:?}"
    );
    let background = [r, g, b];
    let base = RasterOptions::new(convention);
    Ok(RasterOptions { sh_basis, sh_degree, lowpass, antialiased, near, background, ..base })
}

fn camera(meta: &Meta, tensors: &Tensors) -> Result<Camera> {
    let (width, height) = (meta.number("width")?, meta.number("height")?);
    let &[fx, fy, cx, cy] = array(tensors, "intrinsics", &[4])? else {
        bail!("tensor `intrinsics`: expected fx, fy, cx, cy")
    };
    let mut pose = [0f32; 16];
    pose.copy_from_slice(array(tensors, "world_from_camera", &[4, 4])?);
    let intrinsics = Intrinsics { fx, fy, cx, cy, width, height };
    let camera = Camera::new(intrinsics, Mat4::from_cols_array(&pose).transpose())?;
    // A picture of the file bounds the size that is rendered.
    let mut found = false;
    for (name, channels) in PICTURES.iter().filter(|(name, _)| tensors.contains_key(*name)) {
        let shape = [height, width, *channels];
        array(tensors, name, if *channels == 1 { &shape[..2] } else { &shape })?;
        found = true;
    }
    ensure!(
        found,
        "rasterizer case: expected a picture to compare (rgb, alpha, depth_sum, depth) or \
         gradients (v_rgb, v_alpha), got neither"
    );
    Ok(camera)
}

/// Sizes of `sh` `[P, D, 3]`.
struct ShShape {
    parents: usize,
    degree: usize,
}

fn sh_shape(tensors: &Tensors) -> Result<ShShape> {
    let shape = tensors.get("sh").map_or(&[][..], |array| &array.shape);
    let degree = |d: usize| (0..=SH_DEGREE_MAX).find(|&l| sh_coefficients(l) == d);
    match *shape {
        [parents, d, 3] if degree(d).is_some() => {
            Ok(ShShape { parents, degree: degree(d).unwrap_or_default() })
        }
        _ => bail!("tensor `sh`: expected [P, 1, 4, 9, 16 or 25, 3], got {shape:?}"),
    }
}

/// `[N, 11]` rows of the file's separate tensors.
fn pack(tensors: &Tensors, n: usize) -> Result<Vec<f32>> {
    let means = array(tensors, "means", &[n, 3])?.chunks_exact(3);
    let quats = array(tensors, "quats", &[n, 4])?.chunks_exact(4);
    let scales = array(tensors, "scales", &[n, 3])?.chunks_exact(3);
    let opacities = array(tensors, "opacities", &[n])?;
    let mut rows = Vec::with_capacity(n * SPLAT_STRIDE);
    for (((mean, quat), scale), opacity) in means.zip(quats).zip(scales).zip(opacities) {
        rows.extend(mean.iter().chain(quat).chain(scale).chain([opacity]));
    }
    Ok(rows)
}
