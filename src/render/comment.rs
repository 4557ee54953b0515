//! Rasterizer options as a comment of a scene file.
//!
//! A .ply or .glb file does not state which rules its Gaussians were made for. Convention, near
//! plane, low-pass and background therefore travel as one comment line.

use crate::abi::{Convention, RasterOptions};

/// First words of the comment.
const PREFIX: &str = "subsplat render:";

/// Formats `options` as a comment for a scene file; [`options_of_comments`] reads it.
pub fn comment_of_options(options: &RasterOptions) -> String {
    let convention = match options.convention {
        Convention::Standard => "standard",
        Convention::Mvsplat => "mvsplat",
    };
    let [r, g, b] = options.background;
    format!(
        "{PREFIX} convention={convention} near={} lowpass={} background={r},{g},{b}",
        options.near, options.lowpass
    )
}

/// Reads convention, near plane, low-pass and background from a file's comments; `None` where
/// no comment holds valid ones.
pub fn options_of_comments(comments: &[String]) -> Option<RasterOptions> {
    let text = comments.iter().find_map(|c| c.trim().strip_prefix(PREFIX))?;
    let value = |key: &str| text.split_whitespace().find_map(|w| w.strip_prefix(key));
    let number = |key: &str| value(key)?.parse::<f32>().ok().filter(|v| v.is_finite());
    let convention = match value("convention=")? {
        "standard" => Convention::Standard,
        "mvsplat" => Convention::Mvsplat,
        _ => return None,
    };
    let near = number("near=").filter(|v| *v > 0.0)?;
    let lowpass = number("lowpass=").filter(|v| *v >= 0.0)?;
    let mut options = RasterOptions { near, lowpass, ..RasterOptions::new(convention) };
    // Files of earlier versions have no background.
    let channels = value("background=").map(|v| v.split(',').map(str::parse::<f32>));
    if let Some(Ok(rgb)) = channels.map(|all| all.collect::<Result<Vec<_>, _>>())
        && let Ok(rgb) = <[f32; 3]>::try_from(rgb)
        && rgb.iter().all(|v| (0.0..=1.0).contains(v))
    {
        options.background = rgb;
    }
    Some(options)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_comment_restores_the_options() {
        for (convention, near, lowpass) in
            [(Convention::Standard, 0.01f32, 0.3f32), (Convention::Mvsplat, 1.25, 1.2)]
        {
            let background = [near.min(1.0), 0.25, 0.0];
            let plain = RasterOptions::new(convention);
            let options = RasterOptions { near, lowpass, background, ..plain };
            let comments = ["up is -y".to_owned(), comment_of_options(&options)];
            assert_eq!(options_of_comments(&comments), Some(options));
        }
        for bad in [
            "",
            "convention=gsplat near=1 lowpass=0.3",
            "convention=standard near=-1 lowpass=0.3",
            "convention=standard near=1 lowpass=nan",
            "near=1 lowpass=0.3",
        ] {
            assert_eq!(options_of_comments(&[format!("{PREFIX} {bad}")]), None, "{bad}");
        }
    }
}
