//! The reading of a scene: the source of cameras that a person names, else the first of a folder that can be read.

use super::assemble::Pictures;
use super::find::{self, Found, PoseFile, find, not_read};
use super::reading::{Reading, SceneOptions};
use super::scene::Scene;
use super::{
    bundler, cameras_json, colmap, llff, matrices, matrix_files, meshroom, metashape, mvsnet,
    nerfstudio, neus, openmvg, opensfm, polycam, re10k, reality_capture, record3d, scanner_app,
    transforms, without_camera,
};
use crate::files::{Error, Result, lower_extension};
use std::path::Path;

/// Reads the scene of a folder or of a pose file.
///
/// # Errors
/// Those of [`super::scene::load_scene_with`].
pub(super) fn load_at(path: &Path, pictures: Pictures, options: &SceneOptions) -> Result<Scene> {
    let metadata = std::fs::metadata(path).map_err(|e| Error::io(path, e))?;
    if let Some(images) = options.images.as_deref().filter(|images| !images.is_dir()) {
        return Err(Error::format(images, "a folder of pictures", "no folder"));
    }
    let folder = if metadata.is_dir() { path } else { path.parent().unwrap_or(Path::new("")) };
    let reading = Reading::with(pictures, options, options.model.as_ref().map(|_| folder));
    if let Some(model) = &options.model {
        let inside = folder.join(model);
        let model = if inside.exists() { inside } else { model.clone() };
        let scene = load_model(&model, &reading)?;
        return Ok(with_pictures_counted(scene, &model, &reading));
    }
    if !metadata.is_dir() {
        return Ok(with_pictures_counted(load_file(path, &reading)?, path, &reading));
    }
    match find(path)? {
        Some(found) => load_first(found, &reading),
        None => {
            let got = not_read(path).unwrap_or_else(|| "a folder with none of them".to_owned());
            Err(Error::format(path, SCENES, got))
        }
    }
}

/// Reads the first source of cameras of a folder that can be read, with a warning for each one before it.
///
/// # Errors
/// The error of the first source where none can be read, or where the reading is strict.
fn load_first(found: Found, reading: &Reading<'_>) -> Result<Scene> {
    let Found { file, notes, names_others, others } = found;
    let error = match load_found(&file.file, reading) {
        Ok(scene) => {
            // The others have the cameras of the other pictures.
            let mut scene = if names_others {
                scene
            } else {
                with_pictures_counted(scene, file.file.path(), reading)
            };
            scene.warnings.extend(notes);
            scene.other_sources = others.into_iter().map(|other| other.name).collect();
            return Ok(scene);
        }
        Err(error) => error,
    };
    if reading.strict {
        return Err(error);
    }
    let mut failed = vec![format!("{} is not used: {error}", file.name)];
    for (i, other) in others.iter().enumerate() {
        match load_found(&other.file, &reading.again()) {
            Ok(scene) => {
                let mut scene = with_pictures_counted(scene, other.file.path(), reading);
                failed.push(format!("the cameras come from {}", other.name));
                scene.warnings.splice(0..0, failed);
                scene.other_sources =
                    others[i + 1..].iter().map(|other| other.name.clone()).collect();
                return Ok(scene);
            }
            Err(error) => failed.push(format!("{} is not used: {error}", other.name)),
        }
    }
    Err(error)
}

/// Adds the line about pictures without a camera in the pose file `path`.
fn with_pictures_counted(mut scene: Scene, path: &Path, reading: &Reading<'_>) -> Scene {
    if reading.pictures == Pictures::Needed {
        let line = without_camera::line(path, &scene.frames, &scene.left_out);
        scene.warnings.extend(line);
    }
    scene
}

/// For messages: the pose files of a folder.
const SCENES: &str = "cameras.json, transforms.json, a COLMAP model (sparse/0), a RealEstate10K txt, poses.txt with \
     K.txt, or the cameras of OpenSfM, Polycam, Record3D, Bundler, LLFF, Metashape (XML), RealityCapture (CSV), \
     OpenMVG, Meshroom, 3D Scanner App, MVSNet, NeuS, ScanNet, 7-Scenes, NSVF or NeRF++";

/// Reads the pose file or the folder of one that [`SceneOptions::model`] names.
fn load_model(model: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let metadata = std::fs::metadata(model).map_err(|e| Error::io(model, e))?;
    if !metadata.is_dir() {
        return load_file(model, reading);
    }
    match find(model)? {
        Some(Found { file, .. }) => load_found(&file.file, reading),
        None => Err(Error::format(model, SCENES, "a folder with none of them")),
    }
}

fn load_found(file: &PoseFile, reading: &Reading<'_>) -> Result<Scene> {
    match file {
        PoseFile::Json(file) => load_json(file, reading),
        PoseFile::Colmap(folder) => colmap::load(folder, reading),
        PoseFile::ColmapText(file) => {
            colmap::load_text(file.parent().unwrap_or(Path::new("")), reading)
        }
        PoseFile::Re10k(file) => re10k::load(file, reading),
        PoseFile::Matrices(folder) => matrices::load_with(folder, reading),
        PoseFile::OpenSfm(file) => opensfm::load(file, reading),
        PoseFile::Polycam(folder) => polycam::load(folder, reading),
        PoseFile::Record3d(file) => record3d::load(file, reading),
        PoseFile::Bundler(file) => bundler::load(file, reading),
        PoseFile::Llff(file) => llff::load(file, reading),
        PoseFile::Metashape(file) => metashape::load(file, reading),
        PoseFile::RealityCapture(file) => reality_capture::load(file, reading),
        PoseFile::Nerfstudio(file) => nerfstudio::load(file, reading),
        PoseFile::OpenMvg(file) => openmvg::load(file, reading),
        PoseFile::Meshroom(file) => meshroom::load(file, reading),
        PoseFile::ScannerApp(folder) => scanner_app::load(folder, reading),
        PoseFile::MvsNet(folder) => mvsnet::load(folder, reading),
        PoseFile::Neus(file) => neus::load(file, reading),
        PoseFile::MatrixFiles(folder) => matrix_files::load(folder, reading),
    }
}

fn load_file(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    let folder = path.parent().unwrap_or(Path::new(""));
    let extension = lower_extension(path);
    match (name.as_str(), extension.as_str()) {
        (_, "json") | ("metadata", "") => match find::foreign_json(path) {
            Some(file) => load_found(&file, reading),
            None if scanner_app::is_frame(path) => scanner_app::load(folder, reading),
            None => load_json(path, reading),
        },
        (_, "npy") => llff::load(path, reading),
        (_, "npz") => neus::load(path, reading),
        (_, "sfm") => meshroom::load(path, reading),
        (_, "out") => bundler::load(path, reading),
        (_, "xml") => metashape::load(path, reading),
        (_, "csv") => reality_capture::load(path, reading),
        ("cameras.txt" | "images.txt" | "points3d.txt", _) => colmap::load_text(folder, reading),
        (_, "bin") => colmap::load(folder, reading),
        ("poses.txt" | "k.txt", _) => matrices::load_with(folder, reading),
        (name, "txt") if name.ends_with(mvsnet::ENDING) => mvsnet::load(folder, reading),
        (_, "txt") => match matrix_files::scene_of(path) {
            Some(scene) => matrix_files::load(scene, reading),
            None => re10k::load(path, reading),
        },
        _ => Err(Error::format(
            path,
            "a folder or a pose file (.json, .txt, .bin, .npy, .npz, .out, .xml, .csv, .sfm)",
            format!("a file with extension `{extension}`"),
        )),
    }
}

/// Reads `cameras.json`, `transforms.json`, or a file of one of their layouts.
fn load_json(path: &Path, reading: &Reading<'_>) -> Result<Scene> {
    if cameras_json::is_cameras_json(path)? {
        return cameras_json::load(path, reading);
    }
    transforms::load(path, reading)
}
