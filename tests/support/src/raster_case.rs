//! Reader of the rasterizer's conformance cases (`shared/fixtures/raster`).

use glam::Mat4;
use safetensors::SafeTensors;
use std::collections::HashMap;
use std::path::Path;
use subsplat_kernels::camera::{Camera, Intrinsics};
use subsplat_kernels::layout::{
    Convention, Geometry, RasterOptions, SH_DEGREE_MAX, ShBasis, SplatSlices, sh_coefficients,
};

/// A fixture file, decoded.
pub struct File {
    pub tensors: HashMap<String, (Vec<usize>, Vec<f32>)>,
    pub metadata: HashMap<String, String>,
}

impl File {
    pub fn read(path: &Path) -> Self {
        let bytes = std::fs::read(path).unwrap();
        let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
        let metadata = header.metadata().clone().unwrap_or_default();
        let tensors = SafeTensors::deserialize(&bytes).unwrap();
        let tensors = tensors.tensors().into_iter().map(|(name, t)| {
            let data = match t.dtype() {
                safetensors::Dtype::F32 => t
                    .data()
                    .chunks_exact(4)
                    .map(|b| f32::from_le_bytes(b.try_into().unwrap()))
                    .collect(),
                safetensors::Dtype::U8 => t.data().iter().map(|&b| f32::from(b)).collect(),
                other => panic!("{name}: {other:?}"),
            };
            (name, (t.shape().to_vec(), data))
        });
        Self { tensors: tensors.collect(), metadata }
    }

    pub fn get(&self, name: &str) -> &[f32] {
        &self.tensors.get(name).unwrap_or_else(|| panic!("no tensor {name}")).1
    }

    pub fn meta<T: std::str::FromStr<Err: std::fmt::Debug>>(&self, key: &str) -> T {
        self.metadata[key].parse().unwrap()
    }

    pub fn camera(&self) -> Camera {
        let k = self.get("intrinsics");
        let k = Intrinsics {
            fx: k[0],
            fy: k[1],
            cx: k[2],
            cy: k[3],
            width: self.meta("width"),
            height: self.meta("height"),
        };
        let pose: [f32; 16] = self.get("world_from_camera").try_into().unwrap();
        Camera::new(k, Mat4::from_cols_array(&pose).transpose()).unwrap()
    }

    pub fn options(&self) -> RasterOptions {
        let near: f32 = self.meta("near");
        let (convention, sh_basis, near) = match self.metadata["convention"].as_str() {
            "standard" => (Convention::Standard, ShBasis::Standard, near),
            "mvsplat" => (Convention::Mvsplat, ShBasis::Mvsplat, near / 0.2),
            other => panic!("{other}"),
        };
        RasterOptions {
            sh_basis,
            sh_degree: self.meta("sh_degree"),
            lowpass: self.meta("lowpass"),
            antialiased: self.meta("antialiased"),
            near,
            background: self.get("background").try_into().unwrap(),
            ..RasterOptions::new(convention)
        }
    }

    /// Runs `f` on the kernels' view of the case's splats.
    pub fn with_splats<R>(&self, f: impl FnOnce(&SplatSlices) -> R) -> R {
        let t = |name| self.get(name);
        let packed;
        let geometry = if self.options().convention == Convention::Mvsplat {
            Geometry::Cov6 { means: t("means"), cov6: t("cov6"), opacities: t("opacities") }
        } else {
            packed = rows(t("means"), t("quats"), t("scales"), t("opacities"));
            Geometry::Packed(&packed)
        };
        let gain = self.tensors.get("gain").map_or(&[][..], |t| &t.1);
        let sh_degree = degree_of(self.tensors["sh"].0[1]);
        f(&SplatSlices { geometry, sh: t("sh"), gain, sh_degree })
    }
}

/// `[N, 11]` rows.
pub fn rows(means: &[f32], quats: &[f32], scales: &[f32], opacities: &[f32]) -> Vec<f32> {
    let mut rows = Vec::new();
    for (i, o) in opacities.iter().enumerate() {
        rows.extend_from_slice(&means[3 * i..3 * i + 3]);
        rows.extend_from_slice(&quats[4 * i..4 * i + 4]);
        rows.extend_from_slice(&scales[3 * i..3 * i + 3]);
        rows.push(*o);
    }
    rows
}

pub fn degree_of(coefficients: usize) -> usize {
    (0..=SH_DEGREE_MAX).find(|&l| sh_coefficients(l) == coefficients).unwrap()
}
