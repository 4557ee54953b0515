//! Finished scenes in folders: what a training of 3D Gaussian Splatting wrote, and splat files of other trainers.

use anyhow::{Error, anyhow};
use std::path::{Path, PathBuf};
use subsplat::files::is_splat_file;
use subsplat::files::poses::find::folders;
use subsplat::files::poses::scene::has_scene;

/// Folder of the states of a training of 3D Gaussian Splatting, and the file of each.
const TRAINED: [&str; 2] = ["point_cloud", "point_cloud.ply"];
/// File with the arguments of the training.
const ARGUMENTS: &str = "cfg_args";
/// Bytes from the start of a .ply in which its header states the number and the properties of its rows.
const START: usize = 4096;
/// Words of the header of a .ply of Gaussians: scales, or the packed form of SuperSplat.
const GAUSSIANS: [&str; 2] = [" scale_0", " packed_position"];
/// Extensions of splat files beside .ply. Other programs have zip archives and meshes of the same first bytes.
const EXTENSIONS: [&str; 4] = ["spz", "splat", "ksplat", "sog"];
/// Most files of a folder that are looked at, and most scenes that a message names.
const MOST: (usize, usize) = (200, 4);

/// The last state of a training that has Gaussians.
pub struct Trained {
    /// Its file.
    pub file: PathBuf,
    /// A line about later states without Gaussians.
    pub note: Option<String>,
}

/// The last state of a training: `point_cloud/iteration_N/point_cloud.ply` with the largest N that has Gaussians.
pub fn trained(folder: &Path) -> Option<Trained> {
    let [states, file] = TRAINED;
    let steps = |state: &PathBuf| -> Option<u64> {
        state.file_name()?.to_str()?.strip_prefix("iteration_")?.parse().ok()
    };
    let name = |state: &Path| state.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let mut all = folders(folder.join(states));
    all.retain(|state| steps(state).is_some());
    all.sort_by_key(steps);
    let mut empty = Vec::new();
    while let Some(state) = all.pop() {
        let found = state.join(file);
        if has_rows(&found) {
            let note = (!empty.is_empty()).then(|| {
                format!(
                    "{}: no splats in {}: the scene is read from {}",
                    folder.display(),
                    empty.join(", "),
                    name(&state)
                )
            });
            return Some(Trained { file: found, note });
        }
        empty.push(name(&state));
    }
    None
}

/// Returns whether a training of 3D Gaussian Splatting wrote the folder.
pub fn is_of_training(folder: &Path) -> bool {
    folder.join(ARGUMENTS).is_file() || trained(folder).is_some()
}

/// Folder in which cameras of the scene `file` lie: its own, or that of the training.
pub fn folder_of(file: &Path) -> &Path {
    let own = file.parent().unwrap_or(Path::new(""));
    let states = own.parent().filter(|states| states.ends_with(TRAINED[0]));
    states.and_then(Path::parent).unwrap_or(own)
}

/// Start of a file as text.
fn start(file: &Path) -> String {
    use std::io::Read;
    let mut bytes = Vec::new();
    // A file that cannot be read is as empty as one without a header.
    if let Ok(opened) = std::fs::File::open(file) {
        drop(opened.take(START as u64).read_to_end(&mut bytes));
    }
    String::from_utf8_lossy(&bytes).into_owned()
}

/// Returns whether a .ply states at least one row.
fn has_rows(file: &Path) -> bool {
    let start = start(file);
    let rows =
        start.split("element vertex ").nth(1).and_then(|rest| rest.split_whitespace().next());
    start.starts_with("ply") && rows.is_some_and(|rows| rows != "0")
}

/// Returns whether a file has splats: of a .ply its properties decide, as a cloud of points is one too.
fn is_finished(file: &Path) -> bool {
    let extension = file.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    let gaussians = || {
        let start = start(file);
        GAUSSIANS.iter().any(|word| start.contains(word)) && has_rows(file)
    };
    match extension.as_str() {
        "ply" => gaussians(),
        other => EXTENSIONS.contains(&other) && is_splat_file(file),
    }
}

/// Finished scenes in `folder` and in the two levels below: folders of trainings, and splat files.
pub fn finished(folder: &Path) -> Vec<PathBuf> {
    let mut level = vec![folder.to_owned()];
    for _ in 0..3 {
        let mut found = Vec::new();
        let mut below = Vec::new();
        for folder in level {
            if trained(&folder).is_some() {
                found.push(folder);
                continue;
            }
            let entries = std::fs::read_dir(&folder).into_iter().flatten().flatten();
            let mut files: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
            files.retain(|path| path.is_file());
            files.sort();
            found.extend(files.into_iter().take(MOST.0).filter(|file| is_finished(file)));
            below.extend(folders(&folder));
        }
        if !found.is_empty() {
            return found;
        }
        level = below;
    }
    Vec::new()
}

/// Names scenes in a message.
pub fn named(scenes: &[PathBuf]) -> String {
    let names: Vec<String> = scenes.iter().take(MOST.1).map(|s| s.display().to_string()).collect();
    let more = if scenes.len() > MOST.1 { ", …" } else { "" };
    format!("{}{more}", names.join(", "))
}

/// The error of a folder that should have photographs and has finished scenes alone; `None` for another one.
pub fn instead_of_photographs(folder: &Path) -> Option<Error> {
    let at = folder.display();
    let photographs = || match source(folder) {
        Some(source) if has_scene(&source) => {
            let source = source.display();
            format!("its photographs are in {source} ({ARGUMENTS}): `subsplat run {source}`")
        }
        Some(source) => format!(
            "its photographs were in {} ({ARGUMENTS}), which is not here: give the folder where they are now",
            source.display()
        ),
        None => "give the folder of its photographs to make a scene anew".to_owned(),
    };
    if trained(folder).is_some() {
        return Some(anyhow!(
            "{at}: expected photographs, got a scene that 3D Gaussian Splatting has trained: `subsplat view {at}` \
             shows it, `render` and `export` read it too; {}",
            photographs()
        ));
    }
    if folder.join(ARGUMENTS).is_file() {
        return Some(anyhow!(
            "{at}: expected photographs, got the folder of a training of 3D Gaussian Splatting ({ARGUMENTS}) without \
             splats ({}/iteration_N/{}); {}",
            TRAINED[0],
            TRAINED[1],
            photographs()
        ));
    }
    let scenes = finished(folder);
    let first = scenes.first()?.display();
    Some(anyhow!(
        "{at}: expected photographs, got finished scenes and no photographs: {}; `subsplat view {first}` shows the \
         first, `render` and `export` read it too",
        named(&scenes)
    ))
}

/// The folder of photographs that the arguments of a training name.
fn source(folder: &Path) -> Option<PathBuf> {
    let text = start(&folder.join(ARGUMENTS));
    let value = text.split("source_path=").nth(1)?;
    let quote = value.chars().next().filter(|c| ['\'', '"'].contains(c))?;
    let path = value[1..].split(quote).next().filter(|path| !path.is_empty())?;
    Some(PathBuf::from(path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::{create_dir_all, write};

    const HEADER: &str =
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float scale_0\nend_header\n";

    #[test]
    fn the_last_state_with_splats_is_read() {
        let place = tempfile::tempdir().unwrap();
        let at = |name: &str| place.path().join("point_cloud").join(name);
        assert!(trained(place.path()).is_none());
        for state in ["iteration_7000", "iteration_15000", "iteration_30000", "other"] {
            create_dir_all(at(state)).unwrap();
            write(at(state).join("point_cloud.ply"), HEADER).unwrap();
        }
        let last = trained(place.path()).unwrap();
        assert_eq!((last.file, last.note), (at("iteration_30000/point_cloud.ply"), None));
        // No rows, no bytes, no file.
        let none = HEADER.replace("vertex 3", "vertex 0");
        write(at("iteration_30000/point_cloud.ply"), none).unwrap();
        let last = trained(place.path()).unwrap();
        assert_eq!(last.file, at("iteration_15000/point_cloud.ply"));
        assert!(
            last.note.unwrap().ends_with(
                ": no splats in iteration_30000: the scene is read from iteration_15000"
            )
        );
        write(at("iteration_30000/point_cloud.ply"), "").unwrap();
        std::fs::remove_file(at("iteration_15000/point_cloud.ply")).unwrap();
        let last = trained(place.path()).unwrap();
        assert_eq!(last.file, at("iteration_7000/point_cloud.ply"));
        assert!(last.note.unwrap().contains("in iteration_30000, iteration_15000: "));
        assert_eq!(folder_of(&last.file), place.path());
        std::fs::remove_dir_all(at("iteration_7000")).unwrap();
        assert!(trained(place.path()).is_none());
    }

    #[test]
    fn scenes_of_other_trainers_are_found() {
        let place = tempfile::tempdir().unwrap();
        let at = |name: &str| place.path().join(name);
        create_dir_all(at("a/ply")).unwrap();
        // A cloud of points is no scene.
        write(at("points3D.ply"), HEADER.replace("scale_0", "red")).unwrap();
        assert!(finished(place.path()).is_empty());
        assert!(instead_of_photographs(place.path()).is_none());
        write(at("a/ply/one.ply"), HEADER).unwrap();
        write(at("a/ply/checkpoint.pt"), b"PK\x03\x04").unwrap();
        assert_eq!(finished(place.path()), [at("a/ply/one.ply")]);
        write(at("two.ply"), HEADER).unwrap();
        write(at("three.ply"), HEADER).unwrap();
        let error = instead_of_photographs(place.path()).unwrap().to_string();
        assert!(
            error.contains("three.ply, ") && error.contains("two.ply; `subsplat view"),
            "{error}"
        );
        // A training names its photographs.
        let source = place.path().join("photographs");
        let arguments = format!("Namespace(images='images', source_path='{}')", source.display());
        write(at("cfg_args"), arguments).unwrap();
        let error = instead_of_photographs(place.path()).unwrap().to_string();
        assert!(error.contains("without splats") && error.contains("which is not here"), "{error}");
        create_dir_all(at("point_cloud/iteration_7")).unwrap();
        write(at("point_cloud/iteration_7/point_cloud.ply"), HEADER).unwrap();
        create_dir_all(&source).unwrap();
        write(source.join("transforms.json"), "{}").unwrap();
        let error = instead_of_photographs(place.path()).unwrap().to_string();
        assert!(error.contains(&format!("`subsplat run {}`", source.display())), "{error}");
    }
}
