//! A scene as one HTML file: the Gaussians as .spz in base64, and the viewer of `tools/web`.
//!
//! The file loads nothing else, so it opens from a disk, an attachment or any server.

use crate::report::escaped;
use anyhow::Result;
use serde_json::json;
use std::io::Write;
use std::path::Path;
use subsplat::files::{SaveOptions, SaveReport, SplatFormat, encode_splats_with, write_atomic};
use subsplat::finish::reduce;
use subsplat::scene::render::Renderer;
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{ALPHA_MIN, Convention, NEAR_MVSPLAT, RasterOptions};

const TEMPLATE: &str = include_str!("../../../web/scene.html");
const STYLE: &str = include_str!("../../../web/viewer.css");
/// The files of `tools/web/viewer` in the order of their names.
const VIEWER: &str = concat!(
    include_str!("../../../web/viewer/arithmetic.js"),
    include_str!("../../../web/viewer/cpu.js"),
    include_str!("../../../web/viewer/gl.js"),
    include_str!("../../../web/viewer/levels.js"),
    include_str!("../../../web/viewer/range.js"),
    include_str!("../../../web/viewer/scene.js"),
    include_str!("../../../web/viewer/swing.js"),
    include_str!("../../../web/viewer/viewer.js"),
);

/// Bytes of a Gaussian with one colour in a .spz: fewer than that have not been seen, and a mean.
const BYTES_LEAST: usize = 5;
const BYTES_MEAN: usize = 13;

/// A scene to be written.
pub struct Page<'a> {
    /// The Gaussians.
    pub splats: &'a Splats,
    /// Names and places that the viewer offers, its first one first; without any it shows the whole scene.
    pub cameras: &'a [(String, Camera)],
    /// True if the cameras are those of the photographs that the scene was made from.
    pub photographs: bool,
    /// Near plane, low-pass and background of the viewer.
    pub options: &'a RasterOptions,
    /// Title of the page.
    pub title: &'a str,
}

impl Page<'_> {
    /// Writes the page. Gaussians that no pixel shows are left out.
    ///
    /// # Errors
    /// Those of [`encode_splats_with`] for .spz; system errors.
    pub fn write(&self, path: &Path, save: &SaveOptions) -> Result<SaveReport> {
        let (scene, report) = encoded(self.splats, save, path)?;
        self.write_encoded(path, &scene, report)
    }

    /// Writes a page of at most `most` bytes: of a larger scene one colour for all views, then fewer Gaussians
    /// ([`reduce`]).
    ///
    /// # Errors
    /// Those of [`Page::write`].
    pub fn write_within(
        &self,
        path: &Path,
        save: &SaveOptions,
        most: usize,
        renderer: &mut Renderer,
    ) -> Result<SaveReport> {
        let rest = TEMPLATE.len() + STYLE.len() + VIEWER.len() + self.settings().len();
        let room = most.saturating_sub(rest) / 4 * 3;
        let plain = SaveOptions { sh_degree: Some(0), ..save.clone() };
        let mut count = room / BYTES_MEAN;
        let cameras: Vec<Camera> = self.cameras.iter().map(|(_, camera)| *camera).collect();
        // More would take the time of an encoding for nothing.
        if self.splats.len() <= room / BYTES_LEAST {
            for save in [save, &plain] {
                let (scene, report) = encoded(self.splats, save, path)?;
                if scene.len() <= room {
                    return self.write_encoded(path, &scene, report);
                }
                count = (room as f64 / scene.len() as f64 * report.count as f64) as usize;
            }
        }
        loop {
            let fewer = reduce(self.splats, &cameras, self.options, count, renderer);
            let (scene, report) = encoded(&fewer, &plain, path)?;
            if scene.len() <= room || count <= 1 {
                return self.write_encoded(path, &scene, report);
            }
            // The Gaussians of a merge compress a little worse.
            count = (0.97 * room as f64 / scene.len() as f64 * count as f64) as usize;
        }
    }

    fn write_encoded(&self, path: &Path, scene: &[u8], report: SaveReport) -> Result<SaveReport> {
        let parts = [
            ("{{title}}", escaped(self.title)),
            ("{{css}}", STYLE.to_owned()),
            ("{{settings}}", self.settings()),
            ("{{scene}}", base64::encode(scene)),
            ("{{js}}", VIEWER.to_owned()),
        ];
        let bytes = write_atomic(path, |file| {
            let mut rest = TEMPLATE;
            for (mark, text) in &parts {
                // A test compares the marks with the template.
                let (before, after) = rest.split_once(mark).unwrap_or((rest, ""));
                file.write_all(before.as_bytes())?;
                file.write_all(text.as_bytes())?;
                rest = after;
            }
            file.write_all(rest.as_bytes())
        })
        .and_then(|()| {
            std::fs::metadata(path)
                .map(|m| m.len())
                .map_err(|source| subsplat::files::Error::Io { path: path.to_owned(), source })
        })?;
        Ok(SaveReport { bytes, ..report })
    }

    fn settings(&self) -> String {
        let near = match self.options.convention {
            Convention::Standard => self.options.near,
            Convention::Mvsplat => NEAR_MVSPLAT * self.options.near,
        };
        let camera = |(name, camera): &(String, Camera)| {
            let mut value = json!(camera);
            value["name"] = json!(name);
            value
        };
        let settings = json!({
            "background": self.options.background,
            "near": near,
            "lowpass": self.options.lowpass,
            "photographs": self.photographs,
            "cameras": self.cameras.iter().map(camera).collect::<Vec<_>>(),
        });
        // No text may end the script element.
        settings.to_string().replace('<', "\\u003c")
    }
}

/// The .spz of a page. Gaussians that no pixel shows are left out.
fn encoded(splats: &Splats, save: &SaveOptions, path: &Path) -> Result<(Vec<u8>, SaveReport)> {
    let save = SaveOptions { min_opacity: save.min_opacity.max(ALPHA_MIN), ..save.clone() };
    Ok(encode_splats_with(SplatFormat::Spz, splats, &save, path)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_template_has_each_mark_once_and_the_viewer_ends_no_script() {
        let mut rest = TEMPLATE;
        for mark in ["{{title}}", "{{css}}", "{{settings}}", "{{scene}}", "{{js}}"] {
            assert_eq!(TEMPLATE.matches(mark).count(), 1, "{mark}");
            rest = rest.split_once(mark).unwrap().1;
        }
        assert!(!rest.contains("{{"));
        assert!(!VIEWER.contains("</script") && !VIEWER.contains("<!--"));
        assert!(!STYLE.contains("</style"));
        // Nothing is fetched from elsewhere.
        for text in [TEMPLATE, STYLE, VIEWER] {
            assert!(!text.contains("http:") && !text.contains("https:") && !text.contains("src="));
        }
    }

    #[test]
    fn the_viewer_has_every_file_of_its_folder_in_order() {
        let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../web/viewer");
        let mut files: Vec<_> =
            std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().path()).collect();
        files.sort();
        let joined: String = files.iter().map(|f| std::fs::read_to_string(f).unwrap()).collect();
        assert!(files.len() > 1 && joined == VIEWER);
    }

    #[test]
    fn a_page_within_a_limit_keeps_what_fits() {
        use subsplat_kernels::layout::ShBasis;
        // A surface of 60 by 60 Gaussians with colours of degree 1 that no compression shortens.
        let mut rows = Vec::new();
        let mut noise = 1u32;
        let mut next = || {
            noise = noise.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (noise >> 8) as f32 / (1 << 24) as f32
        };
        let sh: Vec<f32> = (0..3600 * 12).map(|_| next() - 0.5).collect();
        for i in 0..3600 {
            let (x, y) = ((i % 60) as f32 / 60.0, (i / 60) as f32 / 60.0);
            rows.extend([x, y, 2.0 + next(), 1.0, 0.0, 0.0, 0.0, 0.01, 0.01, 0.01, 0.9]);
        }
        let splats = Splats::new(rows, sh, Vec::new(), 1, ShBasis::Standard).unwrap();
        let options = RasterOptions::new(Convention::Standard);
        let page = Page {
            splats: &splats,
            cameras: &[],
            photographs: true,
            options: &options,
            title: "a",
        };
        let place = tempfile::tempdir().unwrap();
        let (path, save) = (place.path().join("a.html"), SaveOptions::default());
        let whole = page.write(&path, &save).unwrap();
        assert_eq!((whole.count, whole.sh_degree), (3600, 1));
        let rest = TEMPLATE.len() + STYLE.len() + VIEWER.len();
        let within = |most: usize| {
            let report = page.write_within(&path, &save, most, &mut Renderer::default()).unwrap();
            assert!(report.bytes as usize <= most + 1000, "{} of {most}", report.bytes);
            (report.count, report.sh_degree)
        };
        let scene = whole.bytes as usize - rest;
        assert_eq!(within(whole.bytes as usize + 100), (3600, 1));
        assert_eq!(within(rest + scene * 9 / 10), (3600, 0));
        let (count, degree) = within(rest + scene / 5);
        assert!(degree == 0 && (600..2400).contains(&count), "{count}");
        // More Gaussians than could fit are reduced without an encoding.
        let (count, _) = within(rest + 8000);
        assert!((100..700).contains(&count), "{count}");
    }
}
