//! Agisoft Metashape's export of cameras (Export Cameras, "Agisoft XML").
//!
//! A camera's `transform`, 16 numbers by rows, is camera-to-chunk in OpenCV axes. The `transform` of its
//! component, or of its chunk, leads to the world: x ↦ scale · R · x + t. In a coordinate system of the earth the
//! world is geocentric, millions of metres from its origin; `assemble` subtracts an origin.
//!
//! Intrinsics are in pixels, cx and cy from the picture's middle, fx = f + b1; P1 and P2 are OpenCV's p2 and p1, b2
//! is the skew. Sensors that are read: `frame`, `fisheye` (equidistant) and `spherical` (a picture becomes several
//! frames, `super::panoramas`). Cameras refer to the stored pixels.
//!
//! Components and chunks share no coordinates: the one with most cameras is read. A camera's label names its
//! picture, often without the extension. Of two cameras with one label each has its picture in a folder of its
//! group's name. Disabled cameras, and those without a transform, are left out.
//!
//! Sources: Metashape's manual, "Camera models"; nerfstudio, `process_data/metashape_utils.py` and its issue 3714
//! (order of p1 and p2); PhotogrammetryCommunity/metashape-expert-manual, `chunk-frame-vs-camera-frame.md` and
//! `fisheye-spherical-camera-types.md`.

use super::assemble::{Draft, Lens, assemble};
use super::cameras_json::side;
use super::json::utf8;
use super::reading::Reading;
use super::scene::{Scene, SceneFormat};
use crate::files::photos::distortion::Distortion;
use crate::files::photos::views::panorama_intrinsics;
use crate::files::{Error, Result, first_bytes, read};
use glam::{DMat3, DMat4, DVec3};
use roxmltree::{Document, Node};
use std::collections::HashMap;
use std::path::Path;

/// For messages.
const TYPES_READ: &str = "a sensor of type frame, fisheye or spherical";
/// Bytes from the start of a file in which its first chunk begins.
const START: usize = 4096;

/// Intrinsics of a sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct MetashapeSensor {
    /// Width and height of its pictures, px.
    pub size: (usize, usize),
    /// fx, fy, cx, cy, px.
    pub focal_and_center: [f64; 4],
    /// Lens distortion.
    pub distortion: Distortion,
}

/// A camera that Metashape placed.
#[derive(Clone, Debug, PartialEq)]
pub struct PlacedCamera {
    /// Its sensor.
    pub sensor: MetashapeSensor,
    /// OpenCV pose in the world.
    pub world_from_camera: DMat4,
}

/// An entry of the file.
#[derive(Debug)]
pub struct MetashapeCamera {
    /// Name of the picture.
    pub label: String,
    /// Name of the group that it is in.
    pub group: Option<String>,
    /// The camera; an error where it has none that is read.
    pub placed: Result<PlacedCamera>,
}

/// The cameras of the component with most of them.
#[derive(Debug)]
pub struct MetashapeCameras {
    /// Entries in the file's order, those of its chunk without a place included.
    pub cameras: Vec<MetashapeCamera>,
    /// Numbers of placed cameras of the other components, the largest first.
    pub others: Vec<usize>,
}

/// Numbered entries of each component.
type Components<'a> = Vec<(Option<&'a str>, Vec<(usize, MetashapeCamera)>)>;

/// Reports whether a file begins as an export of cameras does.
pub(super) fn is_export(path: &Path) -> bool {
    let start = first_bytes(path, START).unwrap_or_default();
    let start = utf8(&start);
    let text = String::from_utf8_lossy(&start);
    text.contains("<document") && text.contains("<chunk")
}

/// Reports whether a file is an export that names cameras: one of markers has none.
pub(super) fn has_cameras(path: &Path) -> bool {
    let names_one = |bytes: Vec<u8>| String::from_utf8_lossy(&utf8(&bytes)).contains("<camera ");
    is_export(path) && read(path).is_ok_and(names_one)
}

/// Number of placed cameras; 0 where the file cannot be read.
pub(super) fn count(path: &Path) -> usize {
    let cameras = read(path).and_then(|bytes| parse(path, &bytes)).map(|file| file.cameras);
    cameras.map_or(0, |cameras| cameras.iter().filter(|c| c.placed.is_ok()).count())
}

/// Reads an export; `path` is for messages.
///
/// # Errors
/// Malformed XML, XML of another layout, a transform of a component that is no similarity. What is wrong with one
/// camera is the error of that camera.
pub fn parse(path: impl AsRef<Path>, bytes: &[u8]) -> Result<MetashapeCameras> {
    cameras(path.as_ref(), bytes)
}

fn cameras(path: &Path, bytes: &[u8]) -> Result<MetashapeCameras> {
    let bytes = utf8(bytes);
    let text = std::str::from_utf8(&bytes).map_err(|e| {
        let place = format!(" at byte {}", e.valid_up_to());
        Error::format(path, "UTF-8 text", "other bytes").at(place)
    })?;
    let expected = "cameras of Metashape as XML (document, chunk, cameras)";
    let document =
        Document::parse(text).map_err(|e| Error::format(path, expected, e.to_string()))?;
    let root = document.root_element();
    let chunks = root.children().filter(|node| node.has_tag_name("chunk"));
    let chunks: Vec<Node<'_, '_>> =
        chunks.filter(|node| child(*node, "cameras").is_some()).collect();
    if !root.has_tag_name("document") || chunks.is_empty() {
        return Err(Error::format(path, expected, format!("`{}`", root.tag_name().name())));
    }
    let mut largest = MetashapeCameras { cameras: Vec::new(), others: Vec::new() };
    let mut most = None;
    for chunk in chunks {
        let mut unplaced = Vec::new();
        let mut components: Components<'_> = Vec::new();
        for (component, camera) in entries(path, chunk)? {
            match components.iter_mut().find(|(id, _)| *id == component) {
                _ if camera.1.placed.is_err() => unplaced.push(camera),
                Some((_, cameras)) => cameras.push(camera),
                None => components.push((component, vec![camera])),
            }
        }
        if components.is_empty() && most.is_none() {
            largest.cameras = unplaced.into_iter().map(|(_, camera)| camera).collect();
            continue;
        }
        // The first of several with as many cameras.
        components.sort_by_key(|(_, cameras)| std::cmp::Reverse(cameras.len()));
        let counts: Vec<usize> = components.iter().map(|(_, cameras)| cameras.len()).collect();
        let first = counts.first().copied();
        if first <= most {
            largest.others.extend(counts);
            continue;
        }
        let mut cameras = components.swap_remove(0).1;
        cameras.extend(unplaced);
        cameras.sort_by_key(|(index, _)| *index);
        largest.cameras = cameras.into_iter().map(|(_, camera)| camera).collect();
        largest.others.extend(most);
        largest.others.extend(&counts[1..]);
        most = first;
    }
    largest.others.sort_unstable_by(|a, b| b.cmp(a));
    Ok(largest)
}

/// Name of a component, and a camera of it with its number.
type Entry<'a> = (Option<&'a str>, (usize, MetashapeCamera));

/// The entries of a chunk, numbered, each with its component.
fn entries<'a>(path: &Path, chunk: Node<'a, '_>) -> Result<Vec<Entry<'a>>> {
    let sensors: HashMap<&str, Result<MetashapeSensor>> = children(chunk, "sensors", "sensor")
        .filter_map(|node| Some((node.attribute("id")?, sensor(path, node))))
        .collect();
    let whole = child(chunk, "transform").map(|node| similarity(path, node)).transpose()?;
    let mut worlds = HashMap::new();
    for component in children(chunk, "components", "component") {
        let own = child(component, "transform").map(|node| similarity(path, node)).transpose()?;
        worlds.insert(component.attribute("id"), own.or(whole));
    }
    let nodes = child(chunk, "cameras").into_iter().flat_map(|node| node.descendants());
    let nodes = nodes.filter(|node| node.has_tag_name("camera"));
    let entry = |(index, node): (usize, Node<'a, '_>)| {
        let component = node.attribute("component_id");
        let world = worlds.get(&component).copied().unwrap_or(whole).unwrap_or_default();
        let label = node.attribute("label").unwrap_or_default().to_owned();
        let place = format!(" camera {label}");
        let placed = placed(path, &place, node, &sensors, &world);
        let parent = node.parent().filter(|parent| parent.has_tag_name("group"));
        let group = parent.and_then(|group| group.attribute("label")).map(str::to_owned);
        (component, (index, MetashapeCamera { label, group, placed }))
    };
    Ok(nodes.enumerate().map(entry).collect())
}

/// Similarity from a chunk or a component to the world.
#[derive(Clone, Copy, Debug)]
struct Similarity {
    rotation: DMat3,
    translation: DVec3,
    scale: f64,
}

impl Default for Similarity {
    fn default() -> Self {
        Self { rotation: DMat3::IDENTITY, translation: DVec3::ZERO, scale: 1.0 }
    }
}

impl Similarity {
    /// A pose in the world. Its rotation stays one.
    fn pose(&self, pose: DMat4) -> DMat4 {
        let position = self.rotation * pose.w_axis.truncate() * self.scale + self.translation;
        let rotation = self.rotation * DMat3::from_mat4(pose);
        DMat4::from_mat3_translation(rotation, position)
    }
}

/// The similarity of a `transform`. A part that is missing is that of the identity.
fn similarity(path: &Path, node: Node<'_, '_>) -> Result<Similarity> {
    let place = " transform";
    let part = |name: &str| child(node, name);
    let mut found = Similarity::default();
    if let Some(node) = part("rotation") {
        found.rotation = DMat3::from_cols_array(&numbers::<9>(path, place, node)?).transpose();
    }
    if let Some(node) = part("translation") {
        found.translation = DVec3::from_array(numbers(path, place, node)?);
    }
    if let Some(node) = part("scale") {
        [found.scale] = numbers(path, place, node)?;
    }
    let Similarity { rotation, translation, scale } = found;
    let size = rotation.determinant();
    if !(translation.is_finite() && scale.is_finite() && scale > 0.0 && (size - 1.0).abs() < 0.03) {
        let got = format!("scale {scale}, translation {translation}, determinant {size}");
        return Err(
            Error::format(path, "a rotation, a finite translation, a scale above 0", got).at(place)
        );
    }
    Ok(found)
}

fn placed(
    path: &Path,
    place: &str,
    node: Node<'_, '_>,
    sensors: &HashMap<&str, Result<MetashapeSensor>>,
    world: &Similarity,
) -> Result<PlacedCamera> {
    let bad = |expected: &str, got: &str| Err(Error::format(path, expected, got).at(place));
    if matches!(node.attribute("enabled"), Some("false" | "0")) {
        return bad("a camera that is enabled", "one that is disabled");
    }
    let Some(transform) = child(node, "transform") else {
        return bad("a transform, which a camera that Metashape aligned has", "none");
    };
    let rows = DMat4::from_cols_array(&numbers(path, place, transform)?);
    let sensor = match node.attribute("sensor_id").and_then(|id| sensors.get(id)) {
        Some(Ok(sensor)) => sensor.clone(),
        Some(Err(error)) => return Err(error.copy()),
        None => return bad("the id of a sensor", node.attribute("sensor_id").unwrap_or("none")),
    };
    Ok(PlacedCamera { sensor, world_from_camera: world.pose(rows.transpose()) })
}

fn sensor(path: &Path, node: Node<'_, '_>) -> Result<MetashapeSensor> {
    let name = node.attribute("label").or(node.attribute("id")).unwrap_or_default();
    let place = format!(" sensor {name}");
    let bad = |expected: &str, got: String| Error::format(path, expected, got).at(&place);
    let calibrations = || node.children().filter(|child| child.has_tag_name("calibration"));
    let adjusted = calibrations().find(|one| one.attribute("class") == Some("adjusted"));
    let calibration = adjusted.or_else(|| calibrations().next());
    let size = calibration.and_then(size).or_else(|| size(node));
    let (width, height) = size.ok_or_else(|| bad("a resolution in whole pixels", "none".into()))?;
    let [w, h] = [width, height].map(|side| side as f64);
    let kind = node.attribute("type").unwrap_or("frame");
    if kind == "spherical" {
        return Ok(MetashapeSensor {
            size: (width, height),
            focal_and_center: panorama_intrinsics(w, h),
            distortion: Distortion::Equirectangular,
        });
    }
    let calibration = calibration.ok_or_else(|| bad("a calibration", "none".into()))?;
    let number = |name: &str| match child(calibration, name) {
        Some(node) => numbers(path, &place, node).map(|[value]| value),
        None => Ok(0.0),
    };
    if child(calibration, "f").is_none() {
        let expected =
            "a focal length f, which files of Metashape and of PhotoScan 1.3 and later have";
        return Err(bad(expected, "none".into()));
    }
    let (f, b1, b2) = (number("f")?, number("b1")?, number("b2")?);
    let (p3, p4) = (number("p3")?, number("p4")?);
    if p3 != 0.0 || p4 != 0.0 {
        return Err(bad("p3 and p4 of 0: other terms are not read", format!("{p3}, {p4}")));
    }
    let k = [number("k1")?, number("k2")?, number("k3")?, number("k4")?];
    let p = [number("p2")?, number("p1")?];
    let distortion = match kind {
        "frame" => Distortion::polynomial(k, p, b2 / (f + b1)),
        "fisheye" if b2 != 0.0 => {
            return Err(bad("b2 of 0: the skew of a fisheye is not read", b2.to_string()));
        }
        "fisheye" if p == [0.0; 2] => Distortion::fisheye(k),
        // The lens's polynomial is one of the angle, as a thin prism's without its prism.
        "fisheye" => Distortion::ThinPrismFisheye { k, p, s: [0.0; 2] },
        other => return Err(bad(TYPES_READ, format!("`{other}`"))),
    };
    let center = [0.5 * w + number("cx")?, 0.5 * h + number("cy")?];
    let focal_and_center = [f + b1, f, center[0], center[1]];
    Ok(MetashapeSensor { size: (width, height), focal_and_center, distortion })
}

/// The `resolution` of a sensor or a calibration.
fn size(node: Node<'_, '_>) -> Option<(usize, usize)> {
    let resolution = child(node, "resolution")?;
    let side = |name| side(resolution.attribute(name)?.trim().parse().ok()?);
    Some((side("width")?, side("height")?))
}

fn child<'a, 'b>(node: Node<'a, 'b>, name: &str) -> Option<Node<'a, 'b>> {
    node.children().find(|child| child.has_tag_name(name))
}

/// The elements `name` of the list `list` in `node`.
fn children<'a: 'c, 'b: 'c, 'c>(
    node: Node<'a, 'b>,
    list: &str,
    name: &'c str,
) -> impl Iterator<Item = Node<'a, 'b>> + 'c {
    let all = child(node, list).into_iter().flat_map(|list| list.children());
    all.filter(move |child| child.has_tag_name(name))
}

/// The numbers of an element's text.
fn numbers<const N: usize>(path: &Path, place: &str, node: Node<'_, '_>) -> Result<[f64; N]> {
    let text = node.text().unwrap_or_default();
    let found: std::result::Result<Vec<f64>, _> =
        text.split_ascii_whitespace().map(str::parse).collect();
    found.ok().and_then(|found| found.try_into().ok()).ok_or_else(|| {
        let many = if N == 1 { "a number".to_owned() } else { format!("{N} numbers") };
        let expected = format!("{many} in `{}`", node.tag_name().name());
        let start: String = text.trim().chars().take(40).collect();
        Error::format(path, expected, format!("`{start}`")).at(place)
    })
}

/// Reads an export. Pictures may lie beside the file, in its parent, and in an `images` folder of either.
pub(super) fn load(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let MetashapeCameras { cameras, others } = parse(path, &read(path)?)?;
    let folder = path.parent().unwrap_or(Path::new(""));
    let roots = [folder, folder.parent().unwrap_or(folder)];
    let mut labels: HashMap<String, usize> = HashMap::new();
    for camera in cameras.iter().filter(|camera| camera.placed.is_ok()) {
        *labels.entry(camera.label.clone()).or_default() += 1;
    }
    let count: usize = labels.values().sum();
    let drafts = cameras.into_iter().map(|camera| {
        let several = labels.get(&camera.label).is_some_and(|count| *count > 1);
        let name = match camera.group {
            Some(group) if several => format!("{group}/{}", camera.label),
            _ => camera.label,
        };
        draft(path, &name, several, camera.placed, reading, &roots)
            .unwrap_or_else(|error| Draft::refused(name.clone(), error))
    });
    let mut scene = assemble(path, SceneFormat::Metashape, reading, drafts.collect())?;
    if !others.is_empty() {
        let counts: Vec<String> = others.iter().map(usize::to_string).collect();
        scene.warnings.push(format!(
            "{}: the component with most cameras is read, with {count}; the others have {}",
            path.display(),
            counts.join(", ")
        ));
    }
    Ok(scene)
}

fn draft(
    path: &Path,
    name: &str,
    several: bool,
    placed: Result<PlacedCamera>,
    reading: &Reading<'_>,
    roots: &[&Path],
) -> Result<Draft> {
    let PlacedCamera { sensor, world_from_camera } = placed?;
    let place = format!(" camera {name}");
    let image = if several { reading.find_exact(roots, name) } else { reading.find(roots, name) };
    if several && (image.is_none() || !name.contains(['/', '\\'])) {
        let expected =
            "a label that one camera has, or its picture in a folder of its group's name";
        return Err(Error::format(path, expected, "a label that several cameras have").at(place));
    }
    Ok(Draft {
        image,
        size: Some(sensor.size),
        distortion: sensor.distortion,
        ..Draft::new(
            place,
            name.to_owned(),
            Lens::Pixels(sensor.focal_and_center),
            world_from_camera,
        )
    })
}
