//! A scene as one HTML file: the Gaussians as .spz in base64, and the viewer of `tools/web`.
//!
//! The file loads nothing else, so it opens from a disk, an attachment or any server.

use crate::report::escaped;
use anyhow::Result;
use serde_json::json;
use std::io::Write;
use std::path::Path;
use subsplat::files::{SaveOptions, SaveReport, SplatFormat, encode_splats_with, write_atomic};
use subsplat::scene::splats::Splats;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::layout::{ALPHA_MIN, Convention, NEAR_MVSPLAT, RasterOptions};

const TEMPLATE: &str = include_str!("../../../web/scene.html");
const STYLE: &str = include_str!("../../../web/viewer.css");
const VIEWER: &str =
    concat!(include_str!("../../../web/range.js"), include_str!("../../../web/viewer.js"));

/// A scene to be written.
pub struct Page<'a> {
    /// The Gaussians.
    pub splats: &'a Splats,
    /// Names and places that the viewer offers, its first one first; without any it shows the whole scene.
    pub cameras: &'a [(String, Camera)],
    /// Whether the cameras are those of the photographs that the scene was made from.
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
        let save = SaveOptions { min_opacity: save.min_opacity.max(ALPHA_MIN), ..save.clone() };
        let (scene, report) = encode_splats_with(SplatFormat::Spz, self.splats, &save, path)?;
        let parts = [
            ("{{title}}", escaped(self.title)),
            ("{{css}}", STYLE.to_owned()),
            ("{{settings}}", self.settings()),
            ("{{scene}}", base64::encode(&scene)),
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
}
