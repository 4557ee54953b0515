//! Frames and cameras of the arguments.

use super::pair::folder_of;
use anyhow::{Context, Result, bail, ensure};
use glam::{Mat4, Quat, Vec3};
use std::path::Path;
use subsplat::camera::Camera;
use subsplat::io::protocol::{Views, load_protocol};
use subsplat::io::scene::Scene;

fn stem(file: &str) -> String {
    Path::new(file).file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// Finds the frames that the words of `flag` name: by index, or by name with or without folder
/// and extension. Digits with leading zeros are a name.
pub fn pick(frames: &[&str], wanted: &[String], flag: &str) -> Result<Vec<usize>> {
    let one = |word: &String| -> Result<usize> {
        if let Ok(i) = word.parse::<usize>()
            && i < frames.len()
            && i.to_string() == *word
        {
            return Ok(i);
        }
        if let Some(i) = frames.iter().position(|f| f == word) {
            return Ok(i);
        }
        let mut same = (0..frames.len()).filter(|&i| stem(frames[i]) == stem(word));
        let found = same.next().with_context(|| {
            format!(
                "{flag}: expected an index below {} or a frame's name, got `{word}`",
                frames.len()
            )
        })?;
        if let Some(other) = same.next() {
            bail!(
                "{flag}: `{word}` may be frame {found} ({}) or {other} ({}): give the index",
                frames[found],
                frames[other]
            );
        }
        Ok(found)
    };
    wanted.iter().map(one).collect()
}

/// Finds frames of a scene by [`pick`].
pub fn indices(scene: &Scene, wanted: &[String], flag: &str) -> Result<Vec<usize>> {
    let names: Vec<&str> = scene.frames.iter().map(|f| f.name.as_str()).collect();
    pick(&names, wanted, flag)
}

/// Distinct file stems for pictures of `names`.
pub fn file_stems(names: &[String]) -> Vec<String> {
    let plain = |n: &String| n.replace(['/', '\\', ':'], "_");
    let mut taken = std::collections::BTreeSet::new();
    let unique = |(i, name): (usize, &String)| {
        let mut stem = plain(name);
        while !taken.insert(stem.clone()) {
            stem = format!("{stem}_{i}");
        }
        stem
    };
    names.iter().enumerate().map(unique).collect()
}

/// Reads the tests of the scene's protocol.json, if it has one. A protocol.json beside two loose
/// photographs belongs to another scene.
pub fn protocol(path: &Path, scene: &Scene) -> Result<Vec<Views>> {
    let file = folder_of(path).join("protocol.json");
    if !scene.source.has_file() || !file.is_file() {
        return Ok(Vec::new());
    }
    let tests = load_protocol(&file)?.tests;
    for test in &tests {
        test.check(&file, scene.frames.len())?;
    }
    Ok(tests)
}

/// Cameras from the first to the last of `through`, evenly in time: positions along a
/// Catmull-Rom curve, rotations by slerp, focal lengths in proportion.
pub fn interpolate(through: &[Camera], frames: usize) -> Result<Vec<Camera>> {
    ensure!(through.len() >= 2, "a path needs at least 2 cameras, got {}", through.len());
    let last = through.len() - 1;
    let at = |i: usize| {
        let t = i as f32 / (frames - 1).max(1) as f32 * last as f32;
        let k = (t.floor() as usize).min(last - 1);
        let f = t - k as f32;
        let p = |i: isize| {
            // Mirrored beyond the ends: the curve starts along the first chord.
            let clamped = i.clamp(0, last as isize) as usize;
            let mirror = 2.0 * through[clamped].position();
            match i {
                -1 => mirror - through[1].position(),
                _ if i as usize > last => mirror - through[last - 1].position(),
                _ => through[clamped].position(),
            }
        };
        let k_signed = k as isize;
        let position =
            catmull_rom([p(k_signed - 1), p(k_signed), p(k_signed + 1), p(k_signed + 2)], f);
        let turn = |i: usize| Quat::from_mat3(&through[i].rotation());
        let rotation = turn(k).slerp(turn(k + 1), f);
        let (a, b) = (through[k].intrinsics(), through[k + 1].intrinsics());
        let mut intrinsics = a;
        let b = b.resized(a.width, a.height);
        intrinsics.fx += f * (b.fx - a.fx);
        intrinsics.fy += f * (b.fy - a.fy);
        intrinsics.cx += f * (b.cx - a.cx);
        intrinsics.cy += f * (b.cy - a.cy);
        Ok(Camera::new(intrinsics, Mat4::from_rotation_translation(rotation, position))?)
    };
    (0..frames).map(at).collect()
}

fn catmull_rom(p: [Vec3; 4], t: f32) -> Vec3 {
    let (a, b) = (2.0 * p[1], p[2] - p[0]);
    let c = 2.0 * p[0] - 5.0 * p[1] + 4.0 * p[2] - p[3];
    let d = 3.0 * (p[1] - p[2]) + p[3] - p[0];
    0.5 * (a + t * (b + t * (c + t * d)))
}

/// `frames` cameras on a small circle around the middle of `cameras`, looking at what
/// lies `depth` in front of it. Radius: half the cameras' spread, or 5 % of `depth`.
pub fn orbit(cameras: &[Camera], depth: f32, frames: usize) -> Result<Vec<Camera>> {
    let Some(first) = cameras.first() else { bail!("an orbit needs at least 1 camera, got none") };
    let count = cameras.len() as f32;
    let middle = cameras.iter().map(Camera::position).sum::<Vec3>() / count;
    let spread = cameras.iter().map(|c| c.position().distance(middle)).fold(0.0f32, f32::max);
    let radius = if spread > 0.0 { 0.5 * spread } else { 0.05 * depth };
    let turn = if cameras.len() == 1 {
        Quat::from_mat3(&first.rotation())
    } else {
        let last = cameras[cameras.len() - 1].rotation();
        Quat::from_mat3(&first.rotation()).slerp(Quat::from_mat3(&last), 0.5)
    };
    let aim = middle + turn * (Vec3::Z * depth);
    let at = |i: usize| {
        let angle = std::f32::consts::TAU * i as f32 / frames as f32;
        let eye = middle + turn * (radius * Vec3::new(angle.cos(), angle.sin(), 0.0));
        let forward = (aim - eye).normalize_or(turn * Vec3::Z);
        let right = (turn * Vec3::Y).cross(forward).normalize_or(turn * Vec3::X);
        let down = forward.cross(right);
        let pose = Mat4::from_cols(
            right.extend(0.0),
            down.extend(0.0),
            forward.extend(0.0),
            eye.extend(1.0),
        );
        Ok(Camera::new(first.intrinsics(), pose)?)
    };
    (0..frames).map(at).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use subsplat::camera::Intrinsics;

    fn camera(x: f32, turn: f32) -> Camera {
        let k = Intrinsics::from_fov_x(1.0, 64, 48);
        let pose = Mat4::from_rotation_translation(
            Quat::from_rotation_y(turn),
            Vec3::new(x, 0.2 * x, 0.0),
        );
        Camera::new(k, pose).unwrap()
    }

    #[test]
    fn a_path_goes_through_its_cameras() {
        let through = [camera(0.0, 0.0), camera(1.0, 0.3), camera(3.0, 0.1)];
        let path = interpolate(&through, 5).unwrap();
        for (i, expected) in [(0, &through[0]), (2, &through[1]), (4, &through[2])] {
            assert!(path[i].position().distance(expected.position()) < 1e-5);
            assert!(Camera::new(path[i].intrinsics(), path[i].world_from_camera()).is_ok());
        }
        assert!(interpolate(&through[..1], 5).is_err());
    }

    #[test]
    fn an_orbit_looks_at_its_aim() {
        let cameras = [camera(-1.0, 0.0), camera(1.0, 0.0)];
        for c in orbit(&cameras, 4.0, 8).unwrap() {
            let px = c.project(Vec3::new(0.0, 0.0, 4.0)).unwrap();
            assert!((px.x - 32.0).abs() < 1e-3 && (px.y - 24.0).abs() < 1e-3, "{px}");
            assert!(Camera::new(c.intrinsics(), c.world_from_camera()).is_ok());
        }
    }

    #[test]
    fn frames_by_index_and_by_name() {
        let frames = ["0001", "0012", "left/2", "right/2", "1"];
        let pick = |word: &str| super::pick(&frames, &[word.to_owned()], "--target");
        for (word, expected) in [
            ("0", 0),
            ("1", 1),
            ("0001", 0),
            ("0012.jpg", 1),
            ("images/0001.png", 0),
            ("left/2", 2),
        ] {
            assert_eq!(pick(word).unwrap(), [expected], "{word}");
        }
        // `2` is an index; `2.png` is a name that two frames have.
        assert_eq!(pick("2").unwrap(), [2]);
        for (word, hint) in [("2.png", "give the index"), ("9", "below 5"), ("", "below 5")] {
            let error = pick(word).unwrap_err().to_string();
            assert!(error.contains(hint) && error.contains("--target"), "{error}");
        }
    }

    #[test]
    fn pictures_do_not_overwrite_one_another() {
        let names = ["a/1", "a_1", "b:1", "a/1"].map(str::to_owned);
        let mut stems = file_stems(&names);
        assert_eq!(stems[..3], ["a_1", "a_1_1", "b_1"]);
        stems.sort();
        stems.dedup();
        assert_eq!(stems.len(), 4);
    }
}
