//! Panoramas by their metadata: the properties `GPano` of the XMP block, which cameras, phones and stitchers write.
//!
//! A picture may be a part of a panorama: `FullPanoWidthPixels` and `FullPanoHeightPixels` have the size of the whole,
//! `CroppedAreaLeftPixels` and `CroppedAreaTopPixels` the place of the part in it, `CroppedAreaImageWidthPixels` and
//! `CroppedAreaImageHeightPixels` its size. The part is put at its place in the whole, whose other pixels are masked, so
//! that all code behind sees panoramas of 360° by 180° alone.
//!
//! Source: Google, "Photo Sphere XMP Metadata".

use super::image::MAX_PIXELS;
use super::views::has_panorama_shape;
use crate::scene::mask::Mask;
use crate::scene::pictures::Rgb;

/// Largest difference of the picture's size from the stated one in x and y, relative: programs that reduce pictures keep
/// the properties.
const SCALES: f64 = 0.01;

/// Most pixels of the whole for each pixel of the picture: views that show so little of it are not used (`projections.rs`),
/// and a small file may state a large whole.
const LARGEST: u64 = 64;

/// Properties of an equirectangular panorama.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Gpano {
    /// Size of the whole, place and size of the part, px as the file states them.
    part: Option<[[f64; 2]; 3]>,
}

/// Place of a picture in the whole panorama, px of the picture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Place {
    /// Size of the whole.
    whole: [usize; 2],
    /// Left and top edge of the picture in it.
    at: [usize; 2],
}

impl Gpano {
    /// The properties of an XMP block; `None` where it states no equirectangular panorama.
    pub fn of_xmp(text: &str) -> Option<Self> {
        if !value(text, "ProjectionType")?.starts_with("equirectangular") {
            return None;
        }
        let number = |name: &str| {
            let value = value(text, name)?;
            let end = value.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(value.len());
            value[..end].parse::<f64>().ok()
        };
        let pair = |[x, y]: [&str; 2]| Some([number(x)?, number(y)?]);
        let part = || {
            let whole = pair(["FullPanoWidthPixels", "FullPanoHeightPixels"])?;
            let at = pair(["CroppedAreaLeftPixels", "CroppedAreaTopPixels"])?;
            let size = pair(["CroppedAreaImageWidthPixels", "CroppedAreaImageHeightPixels"])?;
            Some([whole, at, size])
        };
        Some(Self { part: part() })
    }

    /// Place of a picture of `width` × `height` px in the whole; `None` where it is the whole, or where the properties
    /// contradict themselves or the picture.
    pub fn place(&self, width: usize, height: usize) -> Option<Place> {
        let [whole, at, size] = self.part?;
        let scale = [width as f64 / size[0], height as f64 / size[1]];
        if !(scale[0] / scale[1] - 1.0).abs().le(&SCALES) || has_panorama_shape(width, height) {
            return None;
        }
        let scaled = |v: [f64; 2]| [0, 1].map(|i| (v[i] * scale[i]).round() as usize);
        let (whole, at) = (scaled(whole), scaled(at));
        let ends = |i: usize, side| at[i].checked_add(side).is_some_and(|end| end <= whole[i]);
        let inside = ends(0, width) && ends(1, height);
        let pixels = (whole[0] as u64).saturating_mul(whole[1] as u64);
        let most = MAX_PIXELS.min(LARGEST * width as u64 * height as u64);
        let is_whole = pixels > 0 && pixels <= most && has_panorama_shape(whole[0], whole[1]);
        (inside && is_whole).then_some(Place { whole, at })
    }
}

/// The text behind `name`, an attribute or an element.
fn value<'t>(text: &'t str, name: &str) -> Option<&'t str> {
    let rest = text.split(name).nth(1)?;
    Some(rest.trim_start_matches(['=', '>', '"', '\'', ' ']))
}

impl Place {
    /// The whole panorama, black around the picture, and the mask of the picture's pixels that `mask` keeps.
    pub fn whole(self, picture: &Rgb, mask: Option<&Mask>) -> (Rgb, Option<Mask>) {
        let [width, height] = self.whole;
        let [left, top] = self.at;
        let mut whole = Rgb::black(width, height);
        let mut kept = vec![false; width * height];
        for y in 0..picture.height {
            let (own, start) = (y * picture.width, (y + top) * width + left);
            let row = &picture.data[3 * own..3 * (own + picture.width)];
            whole.data[3 * start..3 * (start + picture.width)].copy_from_slice(row);
            let kept = &mut kept[start..start + picture.width];
            match mask {
                Some(mask) => kept.copy_from_slice(&mask.kept()[own..own + picture.width]),
                None => kept.fill(true),
            }
        }
        (whole, Mask::new(width, height, kept))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn xmp(values: [usize; 6]) -> String {
        let names = [
            "FullPanoWidthPixels",
            "FullPanoHeightPixels",
            "CroppedAreaLeftPixels",
            "CroppedAreaTopPixels",
            "CroppedAreaImageWidthPixels",
            "CroppedAreaImageHeightPixels",
        ];
        let values = names.iter().zip(values);
        let text: String = values.map(|(name, v)| format!(" GPano:{name}=\"{v}\"")).collect();
        format!("<rdf GPano:ProjectionType='equirectangular'{text}/>")
    }

    #[test]
    fn a_part_lies_at_its_place() {
        let place = |values, [w, h]: [usize; 2]| Gpano::of_xmp(&xmp(values)).unwrap().place(w, h);
        let part = [80, 40, 10, 4, 60, 20];
        assert_eq!(place(part, [60, 20]), Some(Place { whole: [80, 40], at: [10, 4] }));
        // A reduced copy.
        assert_eq!(place(part, [30, 10]), Some(Place { whole: [40, 20], at: [5, 2] }));
        // Another shape, no whole panorama, outside of it, and the whole.
        assert_eq!(place(part, [60, 25]), None);
        assert_eq!(place([80, 50, 10, 4, 60, 20], [60, 20]), None);
        assert_eq!(place([80, 40, 30, 4, 60, 20], [60, 20]), None);
        assert_eq!(place([80, 40, usize::MAX, 4, 60, 20], [60, 20]), None);
        assert_eq!(place([480, 240, 10, 4, 60, 20], [60, 20]), None);
        assert_eq!(place([80, 40, 0, 0, 80, 40], [80, 40]), None);
        assert_eq!(place([80, 40, 10, 4, 0, 0], [60, 20]), None);
        let elements = "<GPano:ProjectionType>equirectangular</GPano:ProjectionType>";
        assert_eq!(Gpano::of_xmp(elements), Some(Gpano { part: None }));
        let elements = "ProjectionType>equirectangular< FullPanoWidthPixels>80< FullPanoHeightPixels>40< \
                        CroppedAreaLeftPixels>1< CroppedAreaTopPixels>2< CroppedAreaImageWidthPixels>8< \
                        CroppedAreaImageHeightPixels>9<";
        let part = [[80.0, 40.0], [1.0, 2.0], [8.0, 9.0]];
        assert_eq!(Gpano::of_xmp(elements), Some(Gpano { part: Some(part) }));
        assert_eq!(Gpano::of_xmp("GPano:ProjectionType=\"cylindrical\""), None);
        assert_eq!(Gpano::of_xmp(""), None);
    }

    #[test]
    fn the_whole_is_black_and_masked_around_its_part() {
        let picture = Rgb { width: 3, height: 2, data: (1..=18).collect() };
        let place = Place { whole: [8, 4], at: [4, 1] };
        let (whole, mask) = place.whole(&picture, None);
        assert_eq!(whole.data[3 * (8 + 4)..3 * (8 + 7)], picture.data[..9]);
        assert_eq!(whole.data.iter().map(|v| u32::from(*v)).sum::<u32>(), 171);
        assert_eq!(mask.unwrap().count(), 6);
        let own = Mask::new(3, 2, vec![true, false, true, true, true, true]).unwrap();
        let mask = place.whole(&picture, Some(&own)).1.unwrap();
        assert!(mask.count() == 5 && !mask.kept()[8 + 5] && mask.kept()[16 + 5]);
    }
}
