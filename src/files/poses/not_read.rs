//! Cameras in layouts that are not read: a line that names them, and how to export them.

use super::assemble::files;
use super::find::JSON_FILES;
use super::json::is_list;
use super::matrices::parse_matrix;
use super::metashape;
use crate::files::{first_bytes, lower_extension, read};
use std::path::{Path, PathBuf};

/// Projects whose cameras are read when their program has exported them: extension, maker and export.
const PROJECTS: [[&str; 3]; 4] = [
    ["psx", "a Metashape project", "XML"],
    ["rcproj", "a RealityCapture project", "CSV"],
    ["rsproj", "a RealityScan project", "CSV"],
    ["nvm", "a VisualSFM scene", "Bundler's bundle.out"],
];
/// Files and folders: those that are there together, and their maker.
const NAMES: [(&[&str], &str); 7] = [
    (&["odometry.csv", "camera_matrix.csv"], "Stray Scanner"),
    (&["groundtruth.txt", "rgb.txt"], "TUM RGB-D, which has no intrinsics"),
    (&["sensors/trajectories.txt", "sensors/sensors.txt"], "Kapture: kapture_export_colmap.py"),
    (&["camera_path.json"], "a path of nerfstudio's viewer, which has no photographs"),
    (&["project.files"], "a Metashape project"),
    (&["sfm_data.bin"], "OpenMVG's binary form"),
    (&["sfm.abc"], "Meshroom's Alembic form"),
];
/// Names of files with cameras that are read where their content allows it.
const DAMAGED: [&str; 5] =
    ["sfm_data.json", "cameras.sfm", "sfm.json", "cameras_sphere.npz", "cameras.npz"];
/// Words of the names of Pix4D's cameras, and the folders in which they lie.
const PIX4D: ([&str; 2], [&str; 3]) =
    (["_calibrated_", "camera_parameters.txt"], ["", "params", "1_initial/params"]);
/// Replica's trajectory, as NICE-SLAM has it.
const REPLICA: &str = "traj.txt";
/// Bytes from the start of a file in which a pose or a name space stands.
const START: usize = 4096;

/// A line about cameras in `folder` in a layout that is not read.
pub fn not_read(folder: impl AsRef<Path>) -> Option<String> {
    line(folder.as_ref())
}

fn line(folder: &Path) -> Option<String> {
    let own = files(folder);
    let of_project = |path: &PathBuf| {
        let extension = lower_extension(path);
        let [_, maker, export] = PROJECTS.into_iter().find(|[own, ..]| *own == extension)?;
        Some(format!("{} is {maker}: export its cameras as {export}", path.display()))
    };
    if let Some(line) = own.iter().find_map(of_project) {
        return Some(line);
    }
    if let Some(line) = damaged(folder) {
        return Some(line);
    }
    let is_empty_export = |path: &&PathBuf| {
        lower_extension(path) == "xml"
            && metashape::is_export(path)
            && !metashape::has_cameras(path)
    };
    if let Some(path) = own.iter().find(is_empty_export) {
        return Some(format!("{}: Metashape has exported no cameras into it", path.display()));
    }
    if let Some(path) = reality_capture(folder, &own) {
        return Some(format!(
            "{}: RealityCapture's cameras in .xmp files are not read: export its cameras as CSV",
            path.display()
        ));
    }
    let list = JSON_FILES[1..].iter().find(|file| {
        let path = folder.join(file);
        path.is_file() && is_list(&read(path).unwrap_or_default())
    });
    let list = list.map(|file| format!("{file} (a list of poses without focal lengths)"));
    let named = || {
        let there = |names: &[&str]| names.iter().all(|name| folder.join(name).exists());
        let (names, maker) = NAMES.iter().find(|(names, _)| there(names))?;
        Some(format!("{} ({maker})", names[0]))
    };
    let cameras = list.or_else(named).or_else(|| pix4d(folder)).or_else(|| replica(folder))?;
    Some(format!(
        "{}: cameras in {cameras} are not read: export them as COLMAP or as transforms.json",
        folder.display()
    ))
}

/// A line about a file that is called as cameras of OpenMVG, Meshroom or NeuS are, and has no content of theirs.
fn damaged(folder: &Path) -> Option<String> {
    let is_damaged = |path: &PathBuf| {
        let bytes = || read(path).unwrap_or_default();
        let archive = lower_extension(path) == "npz";
        path.is_file() && (archive || super::json::value(&bytes()).is_err())
    };
    let path = DAMAGED.into_iter().map(|name| folder.join(name)).find(is_damaged)?;
    Some(format!(
        "{}: its cameras are not read: the file is damaged or of another kind",
        path.display()
    ))
}

/// The first file of RealityCapture beside pictures.
fn reality_capture(folder: &Path, own: &[PathBuf]) -> Option<PathBuf> {
    let is_camera = |path: &&PathBuf| {
        let start = || first_bytes(path, START).unwrap_or_default();
        lower_extension(path) == "xmp" && String::from_utf8_lossy(&start()).contains("xcr:")
    };
    let first = |files: &[PathBuf]| files.iter().find(is_camera).cloned();
    first(own).or_else(|| first(&files(&folder.join("images"))))
}

fn pix4d(folder: &Path) -> Option<String> {
    let (words, folders) = PIX4D;
    let all = folders.into_iter().flat_map(|name| files(&folder.join(name)));
    let mut names =
        all.map(|path| path.file_name().unwrap_or_default().to_string_lossy().into_owned());
    let is_one = |name: &String| words.iter().all(|word| name.contains(word));
    names.find(is_one).map(|name| format!("{name} (Pix4D)"))
}

fn replica(folder: &Path) -> Option<String> {
    let start = first_bytes(&folder.join(REPLICA), START).ok()?;
    let start = String::from_utf8_lossy(&start);
    parse_matrix(start.lines().next()?).ok()?;
    Some(format!("{REPLICA} (Replica or NICE-SLAM, which has no intrinsics)"))
}
