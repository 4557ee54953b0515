//! Photographs without a pose file: EXIF orientation and camera, truncated files, ICC profiles, pixel formats,
//! HEIC.

use exif::experimental::Writer;
use exif::{Context, Field, In, Rational, Tag, Value};
use glam::{DMat3, DVec3, Mat4};
use jpeg_encoder::{ColorType, Encoder, SamplingFactor};
use moxcms::{ColorProfile, ToneReprCurve};
use std::path::{Path, PathBuf};
use subsplat::files::photos::exif::{FocalSource, parse_exif};
use subsplat::files::photos::image;
use subsplat::files::photos::image::{LoadOptions, Truncated};
use subsplat::files::photos::photograph::{
    Photograph, load_photograph, parse_photograph, probe_photograph,
};
use subsplat::files::poses::cameras_json::{
    CameraFile, NamedCamera, load_cameras_json, save_cameras_json,
};
use subsplat::files::poses::scene::{Pixels, Scene, Units, load_scene};
use subsplat::image as image_crate;
use subsplat::image::codecs::png::PngEncoder;
use subsplat::image::codecs::tiff::TiffEncoder;
use subsplat::image::codecs::webp::WebPEncoder;
use subsplat::image::{ExtendedColorType, ImageEncoder};
use subsplat::scene::pictures::Rgb;
use subsplat_kernels::camera::{Camera, Intrinsics};

/// Makes an EXIF block.
fn block(fields: &[(Tag, Value)], little_endian: bool) -> Vec<u8> {
    let fields: Vec<Field> = fields
        .iter()
        .map(|(tag, value)| Field { tag: *tag, ifd_num: In::PRIMARY, value: value.clone() })
        .collect();
    let mut writer = Writer::new();
    fields.iter().for_each(|f| writer.push_field(f));
    let mut bytes = std::io::Cursor::new(Vec::new());
    writer.write(&mut bytes, little_endian).unwrap();
    bytes.into_inner()
}

fn short(v: u16) -> Value {
    Value::Short(vec![v])
}

fn long(v: u32) -> Value {
    Value::Long(vec![v])
}

fn ratio(num: u32, denom: u32) -> Value {
    Value::Rational(vec![Rational { num, denom }])
}

fn text(s: &str) -> Value {
    Value::Ascii(vec![s.as_bytes().to_vec()])
}

/// Encodes a PNG with an EXIF block and an ICC profile.
fn png(
    data: &[u8],
    [w, h]: [u32; 2],
    kind: ExtendedColorType,
    exif: Option<&[u8]>,
    icc: Option<Vec<u8>>,
) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = PngEncoder::new(&mut bytes);
    if let Some(exif) = exif {
        encoder.set_exif_metadata(exif.to_vec()).unwrap();
    }
    if let Some(icc) = icc {
        encoder.set_icc_profile(icc).unwrap();
    }
    encoder.write_image(data, w, h, kind).unwrap();
    bytes
}

fn rgb_png(picture: &Rgb, exif: Option<&[u8]>) -> Vec<u8> {
    let size = [picture.width as u32, picture.height as u32];
    png(&picture.data, size, ExtendedColorType::Rgb8, exif, None)
}

/// Encodes a JPEG of quality 100 without chroma subsampling; `change` sets further options.
fn jpeg(
    data: &[u8],
    [w, h]: [u16; 2],
    kind: ColorType,
    change: impl Fn(&mut Encoder<&mut Vec<u8>>),
) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut encoder = Encoder::new(&mut bytes, 100);
    encoder.set_sampling_factor(SamplingFactor::F_1_1);
    change(&mut encoder);
    encoder.encode(data, w, h, kind).unwrap();
    bytes
}

fn file(name: &str) -> PathBuf {
    PathBuf::from(name)
}

fn parse(bytes: &[u8]) -> Photograph {
    parse_photograph(bytes, &LoadOptions::default(), file("photo")).unwrap()
}

fn error(bytes: &[u8]) -> String {
    let upright = parse_photograph(bytes, &LoadOptions::default(), file("photo")).unwrap_err();
    let posed = image::parse_picture(bytes, file("photo")).unwrap_err();
    assert_eq!(upright.to_string(), posed.to_string());
    upright.to_string()
}

/// A smooth picture whose four corners differ.
fn gradient(width: usize, height: usize) -> Rgb {
    let pixel = |i: usize| {
        let (x, y) = (i % width, i / width);
        [40 + 2 * x, 60 + 3 * y, 200 - x - y].map(|v| v as u8)
    };
    Rgb { width, height, data: (0..width * height).flat_map(pixel).collect() }
}

fn assert_close(a: &Rgb, b: &Rgb, tolerance: u8, case: &str) {
    assert_eq!((a.width, a.height), (b.width, b.height), "{case}");
    let worst = a.data.iter().zip(&b.data).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
    assert!(worst <= tolerance, "{case}: differs by {worst}");
}

/// The six pixels of a 3×2 picture in the rows of the upright picture (EXIF 2.32, table 6).
const UPRIGHT: [([usize; 2], [u8; 6]); 8] = [
    ([3, 2], [0, 1, 2, 3, 4, 5]),
    ([3, 2], [2, 1, 0, 5, 4, 3]),
    ([3, 2], [5, 4, 3, 2, 1, 0]),
    ([3, 2], [3, 4, 5, 0, 1, 2]),
    ([2, 3], [0, 3, 1, 4, 2, 5]),
    ([2, 3], [3, 0, 4, 1, 5, 2]),
    ([2, 3], [5, 2, 4, 1, 3, 0]),
    ([2, 3], [2, 5, 1, 4, 0, 3]),
];

#[test]
fn photographs_are_upright_in_all_orientations() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.png");
    let colour = |i: u8| [10 * i, 255 - 20 * i, 7 * i + 3];
    let stored = Rgb { width: 3, height: 2, data: (0..6).flat_map(colour).collect() };
    for (i, (size, pixels)) in UPRIGHT.into_iter().enumerate() {
        let orientation = i as u8 + 1;
        let exif = block(&[(Tag::Orientation, short(orientation.into()))], i % 2 == 0);
        std::fs::write(&path, rgb_png(&stored, Some(&exif))).unwrap();
        let photograph = load_photograph(&path, &LoadOptions::default()).unwrap();
        let expected: Vec<u8> = pixels.into_iter().flat_map(colour).collect();
        assert_eq!(photograph.image.data, expected, "orientation {orientation}");
        let image = &photograph.image;
        assert_eq!([image.width, image.height], size, "orientation {orientation}");
        let turned = (orientation > 1).then_some(orientation);
        assert_eq!(photograph.orientation, turned);
        let header = probe_photograph(&path).unwrap();
        assert_eq!(([header.width, header.height], header.orientation), (size, turned));
        assert_eq!(image::load(&path).unwrap(), stored, "stored pixels stay");
        assert!(photograph.warnings.is_empty(), "{:?}", photograph.warnings);
    }
    // JPEG, TIFF and WebP keep their orientation in other places of the file.
    let stored = gradient(24, 16);
    let exif = block(&[(Tag::Orientation, short(6))], true);
    let with_exif = jpeg(&stored.data, [24, 16], ColorType::Rgb, |e| {
        e.add_exif_metadata(&exif).unwrap();
    });
    let mut webp = Vec::new();
    let mut encoder = WebPEncoder::new_lossless(&mut webp);
    encoder.set_exif_metadata(exif.clone()).unwrap();
    encoder.write_image(&stored.data, 24, 16, ExtendedColorType::Rgb8).unwrap();
    for (case, bytes) in
        [("JPEG", with_exif), ("WebP", webp), ("TIFF", tiff_with_tag(&stored, 0x0112, 6))]
    {
        let photograph = parse(&bytes);
        assert_eq!((photograph.image.width, photograph.image.height), (16, 24), "{case}");
        let corner = &photograph.image.data[..3];
        let bottom_left = &stored.data[3 * 24 * 15..][..3];
        let worst = corner.iter().zip(bottom_left).map(|(a, b)| a.abs_diff(*b)).max().unwrap();
        assert!(worst <= 3, "{case}: {corner:?} {bottom_left:?}");
    }
    // A DNG file begins with a preview, which is not read in its place.
    let preview = tiff_with_tag(&stored, 0xc612, 1);
    let e = parse_photograph(&preview, &LoadOptions::default(), file("a.dng"));
    let e = e.unwrap_err().to_string();
    assert!(e.contains("a.dng") && e.contains("a raw file of a camera"), "{e}");
}

/// Writes an uncompressed little-endian TIFF with one more tag of type SHORT.
fn tiff_with_tag(picture: &Rgb, tag: u16, value: u16) -> Vec<u8> {
    let (w, h) = (picture.width as u32, picture.height as u32);
    let mut entries: Vec<(u16, u16, u32, u32)> = vec![
        (0x100, 4, 1, w),
        (0x101, 4, 1, h),
        (0x102, 3, 3, 0),
        (0x103, 3, 1, 1),
        (0x106, 3, 1, 2),
        (0x111, 4, 1, 0),
        (0x115, 3, 1, 3),
        (0x116, 4, 1, h),
        (0x117, 4, 1, 3 * w * h),
        (tag, 3, 1, value.into()),
    ];
    entries.sort();
    let bits_at = 8 + 2 + 12 * entries.len() as u32 + 4;
    let mut bytes = b"II*\0\x08\0\0\0".to_vec();
    bytes.extend((entries.len() as u16).to_le_bytes());
    for (tag, kind, count, value) in entries {
        let value = match tag {
            0x102 => bits_at,
            0x111 => bits_at + 6,
            _ => value,
        };
        bytes.extend(tag.to_le_bytes());
        bytes.extend(kind.to_le_bytes());
        bytes.extend(count.to_le_bytes());
        bytes.extend(value.to_le_bytes());
    }
    bytes.extend([0; 4]);
    bytes.extend([8, 0, 8, 0, 8, 0]);
    bytes.extend(&picture.data);
    bytes
}

#[test]
fn focal_lengths_follow_the_tags() {
    let film = [(Tag::FocalLengthIn35mmFilm, short(26))];
    let size = |x, y| [(Tag::PixelXDimension, long(x)), (Tag::PixelYDimension, long(y))];
    let plane = [
        (Tag::FocalLength, ratio(50, 10)),
        (Tag::FocalPlaneXResolution, ratio(8000, 1)),
        (Tag::FocalPlaneYResolution, ratio(8000, 1)),
        (Tag::FocalPlaneResolutionUnit, short(3)),
    ];
    let zoom = |num, denom| (Tag::DigitalZoomRatio, ratio(num, denom));
    let film_px = |diagonal: f64| 26.0 * diagonal / 36f64.hypot(24.0);
    let diagonal = 4000f64.hypot(3000.0);
    let with = |fields: &[(Tag, Value)], more: &[(Tag, Value)]| [fields, more].concat();
    let none: [(Tag, Value); 0] = [];
    for (case, fields, size, expected) in [
        ("35 mm", with(&film, &none), [4000, 3000], Some(film_px(diagonal))),
        ("upright", with(&film, &size(4000, 3000)), [3000, 4000], Some(film_px(diagonal))),
        ("35 mm has the zoom", with(&film, &[zoom(2, 1)]), [4000, 3000], Some(film_px(diagonal))),
        ("resized", with(&film, &size(4000, 3000)), [1000, 750], Some(film_px(1250.0))),
        ("cropped", with(&film, &size(4000, 3000)), [3000, 3000], Some(film_px(diagonal))),
        ("35 mm first", with(&plane, &film), [4000, 3000], Some(film_px(diagonal))),
        ("focal plane, cm", with(&plane, &none), [4000, 3000], Some(5.0 * 800.0)),
        ("focal plane, resized", with(&plane, &size(4000, 3000)), [750, 1000], Some(1000.0)),
        ("focal plane, inch", with(&plane[..3], &none), [1000, 750], Some(5.0 * 8000.0 / 25.4)),
        ("zoom", with(&plane, &[zoom(3, 2)]), [4000, 3000], Some(6000.0)),
        ("zoom of 0", with(&plane, &[zoom(0, 1)]), [4000, 3000], Some(4000.0)),
        ("focal length alone", with(&plane[..1], &none), [4000, 3000], None),
        ("nothing", vec![(Tag::Make, text("Maker"))], [4000, 3000], None),
    ] {
        for little_endian in [false, true] {
            let report = parse_exif(&block(&fields, little_endian), size[0], size[1]);
            let found = report.camera.focal.map(|f| f.px);
            match (found, expected) {
                (None, None) => {}
                (Some(a), Some(b)) if (a / b - 1.0).abs() < 1e-9 => {}
                other => panic!("{case}: {other:?}"),
            }
            assert_eq!(report.warnings.len(), usize::from(case == "cropped"), "{report:?}");
        }
    }
    let fields = [(Tag::Make, text("Maker ")), (Tag::Model, text("M\x07 1\0"))];
    let camera = parse_exif(&block(&with(&fields, &plane), true), 4000, 3000).camera;
    assert_eq!((camera.make.as_deref(), camera.model.as_deref()), (Some("Maker"), Some("M 1")));
    let source = camera.focal.unwrap().source;
    assert_eq!(source, FocalSource::FocalPlane { mm: 5.0, px_per_mm: 800.0, zoom: 1.0 });
    assert!(source.to_string().contains("FocalLength 5 mm"), "{source}");
}

#[test]
fn nonsense_values_are_ignored_with_a_warning() {
    let film = |v| (Tag::FocalLengthIn35mmFilm, short(v));
    let plane = |mm: Value, x: Value, y: Value, unit| {
        vec![
            (Tag::FocalLength, mm),
            (Tag::FocalPlaneXResolution, x),
            (Tag::FocalPlaneYResolution, y),
            (Tag::FocalPlaneResolutionUnit, short(unit)),
        ]
    };
    let x = || ratio(8000, 1);
    for (fields, px, words) in [
        (vec![film(0)], None, &["FocalLengthIn35mmFilm", "got 0"][..]),
        (vec![film(60000)], None, &["FocalLengthIn35mmFilm", "60000", "field of view of 0.0"]),
        (vec![film(1)], None, &["FocalLengthIn35mmFilm 1 mm", "173"]),
        (plane(ratio(5, 0), x(), x(), 3), None, &["FocalLength", "got inf"]),
        (plane(ratio(0, 0), x(), x(), 3), None, &["FocalLength", "got NaN"]),
        (plane(ratio(5, 1), ratio(1, 9), ratio(1, 9), 3), None, &["FocalLength", "FocalPlaneX"]),
        (plane(ratio(5, 1), x(), ratio(4000, 1), 3), None, &["8000", "4000", "square"]),
        (plane(ratio(5, 1), x(), x(), 9), None, &["FocalPlaneResolutionUnit", "got 9"]),
        (plane(ratio(5, 1), ratio(0, 1), x(), 3), Some(4000.0), &["FocalPlaneXResolution", "0"]),
        (
            [plane(ratio(5, 1), x(), x(), 3), vec![(Tag::DigitalZoomRatio, ratio(1, 0))]].concat(),
            Some(4000.0),
            &["DigitalZoomRatio", "got inf"],
        ),
        (
            vec![film(26), (Tag::PixelXDimension, long(0)), (Tag::PixelYDimension, long(3000))],
            Some(26.0 * 5000.0 / 36f64.hypot(24.0)),
            &["PixelXDimension", "got 0"],
        ),
    ] {
        let report = parse_exif(&block(&fields, true), 4000, 3000);
        match (report.camera.focal.map(|f| f.px), px) {
            (None, None) => {}
            (Some(a), Some(b)) if (a / b - 1.0).abs() < 1e-9 => {}
            other => panic!("{words:?}: {other:?}"),
        }
        let warnings = report.warnings.join("; ");
        assert!(words.iter().all(|w| warnings.contains(w)), "{words:?}: {warnings}");
    }
    // The file's path stands before the warning of a photograph.
    let bytes = rgb_png(&gradient(4, 3), Some(&block(&[film(0)], true)));
    let photograph = parse(&bytes);
    assert!(photograph.warnings[0].starts_with("photo: EXIF Focal"), "{:?}", photograph.warnings);
    assert_eq!(photograph.intrinsics(), None);
    let bytes = rgb_png(&gradient(4, 3), Some(&block(&[film(26)], true)));
    let k = parse(&bytes).intrinsics().unwrap();
    assert_eq!((k.cx, k.cy, k.fx), (2.0, 1.5, k.fy));
    assert!((k.fx - 26.0 * 5.0 / 43.2666).abs() < 1e-4, "{k:?}");
}

#[test]
fn damaged_exif_never_panics() {
    let fields = [
        (Tag::Make, text("Maker")),
        (Tag::Orientation, short(6)),
        (Tag::FocalLengthIn35mmFilm, short(26)),
        (Tag::FocalLength, ratio(5, 1)),
        (Tag(Context::Tiff, 0xc612), long(1)),
    ];
    let whole = block(&fields, true);
    for length in 0..whole.len() {
        let report = parse_exif(&whole[..length], 8, 6);
        assert!(length > 60 || !report.warnings.is_empty(), "{length}: {report:?}");
    }
    let picture = gradient(8, 6);
    for at in 0..whole.len() {
        for value in [0, 1, 0x7f, 0xff] {
            let mut damaged = whole.clone();
            damaged[at] = value;
            let _ = parse_exif(&damaged, 8, 6);
            let bytes = rgb_png(&picture, Some(&damaged));
            let _ = parse_photograph(&bytes, &LoadOptions::default(), file("photo"));
        }
    }
}

#[test]
fn pairs_are_upright_and_pose_files_are_not() {
    let folder = tempfile::tempdir().unwrap();
    let stored = gradient(8, 6);
    let path = |name: &str| folder.path().join(name);
    let exif = block(&[(Tag::Orientation, short(6))], true);
    for name in ["a.png", "b.png"] {
        std::fs::write(path(name), rgb_png(&stored, Some(&exif))).unwrap();
    }
    let portrait = camera(6, 8);
    let scene = Scene::from_pair(path("a.png"), path("b.png"), portrait, portrait).unwrap();
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
    let (picture, found) = scene.frames[0].load().unwrap();
    assert_eq!((picture.width, picture.height, found), (6, 8, portrait));
    assert_eq!(picture.data[..3], stored.data[3 * 8 * 5..][..3]);
    let sideways = Scene::from_pair(path("a.png"), path("b.png"), camera(8, 6), portrait);
    let e = sideways.unwrap_err().to_string();
    assert!(e.contains("8x6") && e.contains("6x8"), "{e}");

    // cameras.json keeps the choice.
    let json = path("cameras.json");
    let upright = NamedCamera::of_frame(&scene.frames[0], "a.png");
    let cameras = vec![upright, NamedCamera::new("b.png", camera(8, 6))];
    let content =
        CameraFile { cameras, units: Units::Unknown, near_far: None, ..Default::default() };
    save_cameras_json(&json, &content).unwrap();
    assert_eq!(load_cameras_json(&json).unwrap(), content);
    let scene = load_scene(&json).unwrap();
    assert_eq!([scene.frames[0].pixels, scene.frames[1].pixels], [Pixels::Upright, Pixels::Stored]);
    assert_eq!(scene.frames[0].load().unwrap().0, picture);
    assert_eq!(scene.frames[1].load().unwrap().0, stored);
    assert!(scene.warnings[0].contains("1 of 2 frames have an EXIF"), "{:?}", scene.warnings);
    assert!(scene.warnings[0].contains("b.png"), "{:?}", scene.warnings);
    let text = std::fs::read_to_string(&json).unwrap();
    assert_eq!(text.matches("\"pixels\"").count(), 1, "{text}");
    std::fs::write(&json, text.replace("\"upright\"", "\"sideways\"")).unwrap();
    let e = load_scene(&json).unwrap_err().to_string();
    assert!(e.contains("frame 0") && e.contains("`upright`") && e.contains("`sideways`"), "{e}");
}

/// Position of the first scan's header.
fn scan_start(bytes: &[u8]) -> usize {
    bytes.windows(2).position(|w| w == [0xff, 0xda]).unwrap()
}

#[test]
fn truncated_jpegs_are_refused() {
    let picture = gradient(64, 48);
    let encode = |change: &dyn Fn(&mut Encoder<&mut Vec<u8>>)| {
        jpeg(&picture.data, [64, 48], ColorType::Rgb, change)
    };
    let baseline = encode(&|_| {});
    // A thumbnail inside EXIF has an end-of-image marker of its own.
    let field = Field { tag: Tag::Model, ifd_num: In::PRIMARY, value: text("M") };
    let mut writer = Writer::new();
    writer.push_field(&field);
    writer.set_jpeg(&baseline, In::THUMBNAIL);
    let mut thumbnail = std::io::Cursor::new(Vec::new());
    writer.write(&mut thumbnail, true).unwrap();
    let thumbnail = thumbnail.into_inner();
    for (case, bytes) in [
        ("baseline", baseline.clone()),
        ("progressive", encode(&|e| e.set_progressive(true))),
        ("restart markers", encode(&|e| e.set_restart_interval(3))),
        ("thumbnail", encode(&|e| e.add_exif_metadata(&thumbnail).unwrap())),
    ] {
        // Whole files, also with bytes after the end and with a second picture (MPO).
        for more in [&b""[..], b"trailing bytes \xff\xda\0\x08", &baseline] {
            let bytes = [&bytes, more].concat();
            assert_close(&parse(&bytes).image, &picture, 3, case);
            assert!(parse(&bytes).warnings.is_empty(), "{case}");
        }
        let header = if case == "thumbnail" { thumbnail.len() } else { 0 };
        let start = header + scan_start(&bytes[header..]);
        let cuts = (1..16).map(|i| start + (bytes.len() - start) * i / 16);
        for cut in cuts.chain([20, start + 3, bytes.len() - 2, bytes.len() - 1]) {
            let e = error(&bytes[..cut]);
            assert!(e.contains("photo: expected a whole JPEG"), "{case} at {cut}: {e}");
            assert!(e.contains(&format!("its {cut} bytes")), "{case} at {cut}: {e}");
        }
        // The cut is in the middle of the pixels; a program may have padded it.
        let half = start + (bytes.len() - start) / 2;
        let padded = [&bytes[..half], &[0; 300]].concat();
        assert!(error(&padded).contains("inside its pixels"), "{case}");
        let accept = LoadOptions { truncated: Truncated::Accept };
        let loaded = parse_photograph(&bytes[..half], &accept, file("photo")).unwrap();
        assert_eq!((loaded.image.width, loaded.image.height), (64, 48));
        assert!(loaded.warnings[0].contains("truncated"), "{:?}", loaded.warnings);
    }
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.jpg");
    std::fs::write(&path, &baseline[..baseline.len() / 2 + scan_start(&baseline) / 2]).unwrap();
    assert!(image::load(&path).unwrap_err().to_string().contains("truncated"));
    let accept = LoadOptions { truncated: Truncated::Accept };
    let loaded = image::load_with(&path, &accept).unwrap();
    assert!(loaded.warnings[0].contains("a.jpg"), "{:?}", loaded.warnings);
    let scene = Scene::from_pair(&path, &path, camera(64, 48), camera(64, 48)).unwrap();
    assert!(scene.frames[0].load().is_err());
    assert_eq!(scene.frames[0].load_with(&accept).unwrap().warnings, loaded.warnings);
}

fn camera(w: usize, h: usize) -> Camera {
    Camera::new(Intrinsics::from_fov_x(1.0, w, h), Mat4::IDENTITY).unwrap()
}

#[test]
fn truncated_files_of_other_formats_are_refused() {
    let picture = gradient(64, 48);
    let (data, kind) = (&picture.data, ExtendedColorType::Rgb8);
    let mut tiff = std::io::Cursor::new(Vec::new());
    TiffEncoder::new(&mut tiff).write_image(data, 64, 48, kind).unwrap();
    let mut webp = Vec::new();
    WebPEncoder::new_lossless(&mut webp).write_image(data, 64, 48, kind).unwrap();
    let mut bmp = Vec::new();
    image_crate::codecs::bmp::BmpEncoder::new(&mut bmp).write_image(data, 64, 48, kind).unwrap();
    let lossy = include_bytes!("../goldens/photographs/lossy.webp").to_vec();
    for (case, bytes) in [
        ("PNG", rgb_png(&picture, None)),
        ("TIFF", tiff.into_inner()),
        ("TIFF, header first", tiff_with_tag(&picture, 0x0112, 1)),
        ("WebP", webp),
        ("lossy WebP", lossy),
        ("BMP", bmp),
    ] {
        parse(&bytes);
        for i in 1..8 {
            let cut = bytes.len() * i / 8;
            let found = parse_photograph(&bytes[..cut], &LoadOptions::default(), file("photo"));
            assert!(found.is_err(), "{case} cut at {cut} of {}", bytes.len());
        }
    }
}

/// The matrix from linear RGB of the given primaries with white D65 to XYZ.
fn to_xyz(primaries: [[f64; 2]; 3]) -> DMat3 {
    let xyz = |[x, y]: [f64; 2]| DVec3::new(x / y, 1.0, (1.0 - x - y) / y);
    let columns = DMat3::from_cols(xyz(primaries[0]), xyz(primaries[1]), xyz(primaries[2]));
    let weights = columns.inverse() * xyz([0.3127, 0.3290]);
    columns * DMat3::from_diagonal(weights)
}

const SRGB: [[f64; 2]; 3] = [[0.64, 0.33], [0.30, 0.60], [0.15, 0.06]];
const DISPLAY_P3: [[f64; 2]; 3] = [[0.680, 0.320], [0.265, 0.690], [0.150, 0.060]];
const ADOBE_RGB: [[f64; 2]; 3] = [[0.64, 0.33], [0.21, 0.71], [0.15, 0.06]];

fn srgb_linear(v: f64) -> f64 {
    if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) }
}

fn srgb_encoded(l: f64) -> f64 {
    let l = l.clamp(0.0, 1.0);
    if l <= 0.0031308 { 12.92 * l } else { 1.055 * l.powf(1.0 / 2.4) - 0.055 }
}

/// Converts a colour to sRGB, levels of 0 to 255.
fn converted(colour: [u8; 3], primaries: [[f64; 2]; 3], linear: impl Fn(f64) -> f64) -> [f64; 3] {
    let colour = colour.map(|v| linear(f64::from(v) / 255.0));
    let srgb = to_xyz(SRGB).inverse() * to_xyz(primaries) * DVec3::from(colour);
    srgb.to_array().map(|l| 255.0 * srgb_encoded(l))
}

#[test]
fn icc_profiles_are_converted_to_srgb() {
    let adobe_linear = |v: f64| v.powf(563.0 / 256.0);
    let colours = [[180, 90, 60], [40, 200, 120], [90, 90, 200], [255, 255, 255], [0, 0, 0]];
    let profiles = [
        ("P3", ColorProfile::new_display_p3(), DISPLAY_P3, &srgb_linear as &dyn Fn(f64) -> f64),
        ("Adobe RGB", ColorProfile::new_adobe_rgb(), ADOBE_RGB, &adobe_linear),
    ];
    for (case, profile, primaries, linear) in profiles {
        let icc = profile.encode().unwrap();
        for colour in colours {
            let expected = converted(colour, primaries, linear);
            let close = |found: &[u8], tolerance: f64, form: &str| {
                for (f, e) in found.iter().zip(expected) {
                    assert!(
                        (f64::from(*f) - e).abs() <= tolerance,
                        "{case} {form} {colour:?}: {found:?} {expected:?}"
                    );
                }
            };
            let rgb8 = png(&colour, [1, 1], ExtendedColorType::Rgb8, None, Some(icc.clone()));
            close(&parse(&rgb8).image.data, 1.0, "PNG");
            assert_eq!(image::parse_picture(&rgb8, file("a")).unwrap(), parse(&rgb8).image);
            assert!(parse(&rgb8).warnings.is_empty());
            let [r, g, b] = colour;
            let kind = ExtendedColorType::Rgba8;
            let rgba8 = png(&[r, g, b, 255], [1, 1], kind, None, Some(icc.clone()));
            close(&parse(&rgba8).image.data, 1.0, "RGBA");
            let deep: Vec<u8> = colour.iter().flat_map(|v| [*v, *v]).collect();
            let deep = png(&deep, [1, 1], ExtendedColorType::Rgb16, None, Some(icc.clone()));
            close(&parse(&deep).image.data, 0.75, "16 bits");
            let flat = colour.repeat(16 * 16);
            let photograph = parse(&jpeg(&flat, [16, 16], ColorType::Rgb, |e| {
                e.add_icc_profile(&icc).unwrap();
            }));
            close(&photograph.image.data[3 * 136..][..3], 2.5, "JPEG");
        }
    }
    // Outside sRGB: clipped.
    let p3 = ColorProfile::new_display_p3().encode().unwrap();
    let red = png(&[255, 0, 0], [1, 1], ExtendedColorType::Rgb8, None, Some(p3.clone()));
    assert_eq!(parse(&red).image.data, [255, 0, 0]);
    // Transparency is blended with black after the conversion.
    let expected = converted([180, 90, 60], DISPLAY_P3, srgb_linear).map(|v| v * 128.0 / 255.0);
    let half = [180, 90, 60, 128, 0, 0, 0, 255];
    let half = png(&half, [2, 1], ExtendedColorType::Rgba8, None, Some(p3.clone()));
    for (f, e) in parse(&half).image.data.iter().zip(expected) {
        assert!((f64::from(*f) - e).abs() <= 1.0, "{:?} {expected:?}", parse(&half).image.data);
    }
    // Grey with a profile of its own, 8 and 16 bits, with and without alpha.
    let grey = ColorProfile::new_gray_with_gamma(1.8).encode().unwrap();
    let expected = 255.0 * srgb_encoded((100f64 / 255.0).powf(1.8));
    for (bytes, kind) in [
        (&[100u8][..], ExtendedColorType::L8),
        (&[100, 255], ExtendedColorType::La8),
        (&[100, 100], ExtendedColorType::L16),
        (&[100, 100, 255, 255], ExtendedColorType::La16),
    ] {
        let found = parse(&png(bytes, [1, 1], kind, None, Some(grey.clone())));
        assert!(found.warnings.is_empty(), "{kind:?} {:?}", found.warnings);
        for v in &found.image.data {
            assert!((f64::from(*v) - expected).abs() <= 1.0, "{kind:?} {v} {expected}");
        }
    }
    // ProPhoto has white D50; its greys stay grey.
    let pro_photo = ColorProfile::new_pro_photo_rgb().encode().unwrap();
    let white = png(&[255; 3], [1, 1], ExtendedColorType::Rgb8, None, Some(pro_photo));
    assert!(parse(&white).image.data.iter().all(|v| *v >= 254), "{:?}", parse(&white).image);
}

#[test]
fn srgb_profiles_keep_every_pixel() {
    let srgb = ColorProfile::new_srgb();
    // Makers round sRGB's curve in their own ways: this one is darker by up to one level.
    let mut rounded = srgb.clone();
    let curve = (0..64).map(|i| (65_100.0 * srgb_linear(f64::from(i) / 63.0)).round() as u16);
    let curve = Some(ToneReprCurve::Lut(curve.collect()));
    rounded.red_trc = curve.clone();
    rounded.green_trc = curve.clone();
    rounded.blue_trc = curve;
    rounded.cicp = None;
    let picture = gradient(64, 48);
    let size = [64, 48];
    for profile in [srgb, rounded] {
        let profile = Some(profile.encode().unwrap());
        let bytes = png(&picture.data, size, ExtendedColorType::Rgb8, None, profile);
        assert_eq!(parse(&bytes).image, picture);
        assert!(parse(&bytes).warnings.is_empty());
    }
    let p3 = ColorProfile::new_display_p3().encode().unwrap();
    let bytes = png(&picture.data, size, ExtendedColorType::Rgb8, None, Some(p3));
    assert_ne!(parse(&bytes).image, picture);
}

#[test]
fn malformed_profiles_give_a_warning() {
    let picture = gradient(8, 6);
    let p3 = ColorProfile::new_display_p3().encode().unwrap();
    let grey = ColorProfile::new_gray_with_gamma(1.8).encode().unwrap();
    for (case, profile) in [
        ("text", b"not a profile".to_vec()),
        ("cut", p3[..p3.len() / 2].to_vec()),
        ("grey", grey),
        ("zeros", vec![0; 200]),
    ] {
        let kind = ExtendedColorType::Rgb8;
        let found = parse(&png(&picture.data, [8, 6], kind, None, Some(profile)));
        assert_eq!(found.image, picture, "{case}");
        assert!(found.warnings[0].contains("ICC profile is ignored"), "{case}: {found:?}");
    }
    for at in 0..p3.len() {
        let mut damaged = p3.clone();
        damaged[at] ^= 0xff;
        let kind = ExtendedColorType::Rgb8;
        parse(&png(&picture.data, [8, 6], kind, None, Some(damaged)));
    }
}

#[test]
fn every_pixel_format_is_right_or_refused() {
    use ExtendedColorType::{L8, L16, La8, La16, Rgb16, Rgba8, Rgba16};
    let mut tiff = std::io::Cursor::new(Vec::new());
    let deep: Vec<u8> = [257 * 9u16, 257 * 9 + 200, 65535].map(u16::to_ne_bytes).concat();
    TiffEncoder::new(&mut tiff).write_image(&deep, 1, 1, Rgb16).unwrap();
    let wide = |v: u16| v.to_ne_bytes();
    let grey_jpeg = jpeg(&[77; 64], [8, 8], ColorType::Luma, |_| {});
    for (case, bytes, expected) in [
        ("grey", png(&[77], [1, 1], L8, None, None), [77; 3]),
        ("grey 16", png(&wide(257 * 77 + 20), [1, 1], L16, None, None), [77; 3]),
        // The second pixel is opaque: an alpha that is the same everywhere is none.
        ("grey alpha", png(&[200, 128, 0, 255], [2, 1], La8, None, None), [100; 3]),
        (
            "grey alpha 16",
            png(&[200u16, 128, 0, 255].map(|v| wide(257 * v)).concat(), [2, 1], La16, None, None),
            [100; 3],
        ),
        (
            "RGBA",
            png(&[200, 100, 255, 128, 0, 0, 0, 255], [2, 1], Rgba8, None, None),
            [100, 50, 128],
        ),
        (
            "RGBA 16",
            png(
                &[200u16, 100, 255, 128, 0, 0, 0, 255].map(|v| wide(257 * v)).concat(),
                [2, 1],
                Rgba16,
                None,
                None,
            ),
            [100, 50, 128],
        ),
        ("RGB 16", png(&deep, [1, 1], Rgb16, None, None), [9, 10, 255]),
        ("TIFF 16", tiff.into_inner(), [9, 10, 255]),
        ("grey JPEG", grey_jpeg, [77; 3]),
    ] {
        let found = parse(&bytes);
        assert_eq!(found.image.data[..3], expected, "{case}");
        assert!(found.warnings.is_empty(), "{case} {:?}", found.warnings);
        assert_eq!(image::parse_picture(&bytes, file("a")).unwrap(), found.image, "{case}");
    }
}

#[test]
fn cmyk_is_converted_with_adobes_marker_only() {
    let colours = [[0u8, 128, 255, 30], [200, 40, 90, 0], [0, 0, 0, 255], [0, 0, 0, 0]];
    for [c, m, y, k] in colours {
        let flat = [c, m, y, k].repeat(16 * 16);
        let expected = [c, m, y].map(|v| {
            let paper = |v: u8| 255.0 - f64::from(v);
            paper(v) * paper(k) / 255.0
        });
        for kind in [ColorType::Cmyk, ColorType::CmykAsYcck] {
            let bytes = jpeg(&flat, [16, 16], kind, |_| {});
            let found = parse(&bytes);
            for (f, e) in found.image.data[3 * 136..][..3].iter().zip(expected) {
                let difference = (f64::from(*f) - e).abs();
                assert!(difference <= 3.0, "{kind:?} {c} {m} {y} {k}: {f} {e}");
            }
            assert!(found.warnings[0].contains("CMYK"), "{:?}", found.warnings);
            let at = bytes.windows(2).position(|w| w == [0xff, 0xee]).unwrap();
            let length = u16::from_be_bytes([bytes[at + 2], bytes[at + 3]]) as usize;
            let without = [&bytes[..at], &bytes[at + 2 + length..]].concat();
            let e = error(&without);
            assert!(e.contains("CMYK JPEG without Adobe's marker"), "{e}");
        }
    }
}

fn heic(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/goldens/heic").join(name)
}

/// Returns whether a picture that needs a program is read; where none is installed, its error names what to install.
fn is_read(name: &str) -> bool {
    let Err(e) = load_photograph(heic(name), &LoadOptions::default()) else { return true };
    let e = e.to_string();
    assert!(e.contains(name) && e.contains("which no program here converts"), "{e}");
    assert!(e.contains("heif-convert") && e.contains("JPEG"), "{e}");
    assert_eq!(image::probe(heic(name)).unwrap_err().to_string(), e);
    eprintln!("SKIPPED: {name}: no program of this computer converts it");
    false
}

#[test]
fn avif_is_converted_by_a_program() {
    if is_read("colour.avif") {
        let photograph = load_photograph(heic("colour.avif"), &LoadOptions::default()).unwrap();
        assert!(psnr(&photograph.image, &gradient(64, 48)) > 30.0);
        let line = &photograph.warnings[0];
        assert!(line.contains("an AVIF picture is converted by `"), "{line}");
    }
}

/// With feature `heic` by the decoder, without it by a program.
#[test]
fn heic_equals_the_encoded_pictures() {
    if !is_read("colour.heic") {
        return;
    }
    let lines = usize::from(cfg!(not(feature = "heic")));
    let colour = gradient(64, 48);
    let grey = |i: usize| [(30 + 3 * (i % 64) + i / 64 / 2).min(255) as u8; 3];
    let grey = Rgb { width: 64, height: 48, data: (0..64 * 48).flat_map(grey).collect() };
    // Rotation by 90° clockwise and transposition of the stored picture.
    let at = |x: usize, y: usize| -> [u8; 3] {
        colour.data[3 * (y * 64 + x)..][..3].try_into().unwrap()
    };
    let turned = |pixel: &dyn Fn(usize, usize) -> [u8; 3]| {
        let data = (0..64).flat_map(|y| (0..48).flat_map(move |x| pixel(x, y)));
        Rgb { width: 48, height: 64, data: data.collect() }
    };
    let rotated = turned(&|x, y| at(y, 47 - x));
    let mirrored = turned(&|x, y| at(y, x));
    for (name, expected) in [
        ("colour.heic", &colour),
        ("grey.heic", &grey),
        ("rotated.heic", &rotated),
        ("mirrored.heic", &mirrored),
    ] {
        let photograph = load_photograph(heic(name), &LoadOptions::default()).unwrap();
        let psnr = psnr(&photograph.image, expected);
        assert!(psnr > 35.0, "{name}: {psnr} dB");
        assert_eq!(photograph.orientation, None, "{name}");
        assert_eq!(image::load(heic(name)).unwrap(), photograph.image, "{name}");
        let header = probe_photograph(heic(name)).unwrap();
        assert_eq!((header.width, header.height), (expected.width, expected.height), "{name}");
        assert_eq!(header.camera, photograph.camera);
        assert_eq!(photograph.warnings.len(), lines, "{name} {:?}", photograph.warnings);
    }
    let camera = load_photograph(heic("rotated.heic"), &LoadOptions::default()).unwrap().camera;
    assert_eq!((camera.make.as_deref(), camera.model.as_deref()), (Some("Maker"), Some("Model 1")));
    assert!((camera.focal.unwrap().px - 26.0 * 80.0 / 43.2666).abs() < 1e-3, "{camera:?}");
    // A file with EXIF orientation and no rotation of its own: the standard does not apply it.
    let turned = load_photograph(heic("exif_turned.heic"), &LoadOptions::default()).unwrap();
    assert_eq!((turned.image.width, turned.image.height), (64, 48));
    assert!(turned.warnings[lines].contains("EXIF orientation 6"), "{:?}", turned.warnings);
}

fn psnr(a: &Rgb, b: &Rgb) -> f64 {
    assert_eq!((a.width, a.height), (b.width, b.height));
    let squares = a.data.iter().zip(&b.data).map(|(a, b)| f64::from(a.abs_diff(*b)).powi(2));
    10.0 * (255f64.powi(2) * a.data.len() as f64 / squares.sum::<f64>()).log10()
}

#[cfg(feature = "heic")]
#[test]
fn damaged_heic_never_panics() {
    let whole = std::fs::read(heic("rotated.heic")).unwrap();
    // EXIF is last, after the pixels.
    let pixels = whole.len() - 104;
    for cut in 0..whole.len() {
        let found = parse_photograph(&whole[..cut], &LoadOptions::default(), file("photo"));
        match found {
            Err(_) => assert!(cut < pixels, "cut at {cut}"),
            Ok(found) => {
                assert!(cut >= pixels, "cut at {cut}");
                assert!(found.warnings[0].contains("EXIF block"), "{:?}", found.warnings);
            }
        }
    }
    for at in 0..whole.len() {
        let mut damaged = whole.clone();
        damaged[at] ^= 0x55;
        let _ = parse_photograph(&damaged, &LoadOptions::default(), file("photo"));
    }
}
