//! Frames and cameras of the arguments.

use super::pair::folder_of;
use anyhow::{Context, Result, bail, ensure};
use glam::{Mat4, Quat, Vec3};
use std::path::{Path, PathBuf};
use subsplat::files::poses::protocol::{Views, load_protocol};
use subsplat::files::poses::scene::{Scene, frame_name};
use subsplat_kernels::camera::Camera;

fn stem(file: &str) -> String {
    frame_name(file).rsplit('/').next().unwrap_or_default().to_owned()
}

/// Finds the frames that the words of `flag` name: by index, or by name with or without folder and extension. A number
/// that is the name of one frame is a name: of files 1.jpg, 2.jpg, …, `1` is the first, and not the second frame.
pub fn pick(frames: &[&str], wanted: &[String], flag: &str) -> Result<Vec<usize>> {
    let one = |word: &String| -> Result<usize> {
        if let Ok(i) = word.parse::<usize>()
            && i < frames.len()
            && i.to_string() == *word
            && frames.iter().filter(|f| stem(f) == *word).count() != 1
        {
            return Ok(i);
        }
        let exact = frames.iter().any(|f| f == word);
        let is_same = |f: &str| if exact { f == word } else { stem(f) == stem(word) };
        let mut same = (0..frames.len()).filter(|&i| is_same(frames[i]));
        let found = same.next().with_context(|| expected_frame(flag, frames.len(), word))?;
        if let Some(other) = same.next() {
            bail!(
                "{flag}: `{word}` may be photograph {found} ({}) or {other} ({}): give the number",
                frames[found],
                frames[other]
            );
        }
        Ok(found)
    };
    wanted.iter().map(one).collect()
}

/// Refuses words of flags that can name none of the photographs, each with its flag.
///
/// # Errors
/// The first such word.
pub fn check_words(photographs: &[PathBuf], wanted: &[(&str, &[String])]) -> Result<()> {
    let name = |path: &PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let names: Vec<String> = photographs.iter().map(name).collect();
    for (flag, words) in wanted {
        for word in *words {
            let is_number = word.parse::<usize>().is_ok_and(|i| i < names.len());
            let known = is_number || names.iter().any(|name| stem(name) == stem(word));
            ensure!(known, expected_frame(flag, names.len(), word));
        }
    }
    Ok(())
}

fn expected_frame(flag: &str, count: usize, word: &str) -> String {
    format!("{flag}: expected a number below {count} or a photograph's name, got `{word}`")
}

/// Finds frames of a scene by [`pick`]. Numbers are those of the pose file's entries, so that an entry that is
/// left out does not shift the others.
pub fn indices(scene: &Scene, wanted: &[String], flag: &str) -> Result<Vec<usize>> {
    let mut names = vec![""; scene.entries()];
    for left in &scene.left_out {
        names[left.entry] = &left.name;
    }
    for frame in &scene.frames {
        names[frame.entry] = &frame.name;
    }
    pick(&names, wanted, flag)?.into_iter().map(|entry| of_entry(scene, entry, flag)).collect()
}

/// The frame of an entry; `from` names the origin of the number in messages.
fn of_entry(scene: &Scene, entry: usize, from: &str) -> Result<usize> {
    scene.frame_of_entry(entry).with_context(|| {
        let left = scene.left_out.iter().find(|left| left.entry == entry);
        let why = left.map(|left| format!("{}, which is left out: {}", left.name, left.reason));
        format!(
            "{from}: expected a photograph that can be used, got {entry} ({})",
            why.unwrap_or_default()
        )
    })
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

/// Reads the tests of the scene's protocol.json, if it has one. A protocol.json beside two single
/// photographs belongs to another scene.
pub fn protocol(path: &Path, scene: &Scene) -> Result<Vec<Views>> {
    let file = folder_of(path).join("protocol.json");
    if !scene.source.has_file() || !file.is_file() {
        return Ok(Vec::new());
    }
    let mut tests = load_protocol(&file)?.tests;
    let name = file.display().to_string();
    for test in &mut tests {
        test.check(&file, scene.entries())?;
        for entry in test.context.iter_mut().chain(&mut test.target) {
            *entry = of_entry(scene, *entry, &name)?;
        }
    }
    Ok(tests)
}

/// Cameras from the first to the last of `through`, evenly in time: positions along a
/// Catmull-Rom curve, rotations by slerp, focal lengths in proportion.
pub fn interpolate(through: &[Camera], frames: usize) -> Result<Vec<Camera>> {
    let last = through.len().saturating_sub(1) as f32;
    cameras_at(through, (0..frames).map(|i| i as f32 / (frames - 1).max(1) as f32 * last))
}

/// Cameras on the same way from the first to the last and back, slow at both ends.
pub fn there_and_back(through: &[Camera], frames: usize) -> Result<Vec<Camera>> {
    let last = through.len().saturating_sub(1) as f32;
    let turn = |i: usize| std::f32::consts::TAU * i as f32 / frames as f32;
    cameras_at(through, (0..frames).map(|i| last * 0.5 * (1.0 - turn(i).cos())))
}

/// Cameras on the same way, none of them at a place of `through`.
pub fn between(through: &[Camera], frames: usize) -> Result<Vec<Camera>> {
    let last = through.len().saturating_sub(1) as f32;
    let time = |i: usize| {
        let t = (i as f32 + 0.5) / frames as f32 * last;
        t.floor() + t.fract().clamp(0.25, 0.75)
    };
    cameras_at(through, (0..frames).map(time))
}

/// Cameras at the times `times` of the way through all of `through`, which has one at each whole number.
fn cameras_at(through: &[Camera], times: impl Iterator<Item = f32>) -> Result<Vec<Camera>> {
    ensure!(through.len() >= 2, "a path needs at least 2 cameras, got {}", through.len());
    let last = through.len() - 1;
    let at = |t: f32| {
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
        let a = through[k].intrinsics();
        let b = through[k + 1].intrinsics();
        let mut intrinsics = a;
        let b = b.resized(a.width, a.height);
        intrinsics.fx += f * (b.fx - a.fx);
        intrinsics.fy += f * (b.fy - a.fy);
        intrinsics.cx += f * (b.cx - a.cx);
        intrinsics.cy += f * (b.cy - a.cy);
        Ok(Camera::new(intrinsics, Mat4::from_rotation_translation(rotation, position))?)
    };
    times.map(at).collect()
}

fn catmull_rom(p: [Vec3; 4], t: f32) -> Vec3 {
    let (a, b) = (2.0 * p[1], p[2] - p[0]);
    let c = 2.0 * p[0] - 5.0 * p[1] + 4.0 * p[2] - p[3];
    let d = 3.0 * (p[1] - p[2]) + p[3] - p[0];
    0.5 * (a + t * (b + t * (c + t * d)))
}

/// Depths of a scene in front of its cameras, camera z: quantiles of 10, 50 and 90 %.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DepthSpread {
    near: f32,
    /// The median.
    pub middle: f32,
    far: f32,
}

impl DepthSpread {
    /// The spread of the values above 0; all 1 without any.
    pub fn of(values: impl Iterator<Item = f32>) -> Self {
        let mut sorted: Vec<f32> = values.filter(|z| *z > 0.0 && z.is_finite()).collect();
        sorted.sort_by(f32::total_cmp);
        let at = |tenths: usize| sorted.get(sorted.len() * tenths / 10).copied().unwrap_or(1.0);
        Self { near: at(1), middle: at(5), far: at(9) }
    }

    /// Radius at which near points shift against far ones by a fixed share of the picture's
    /// width, world units. A flat scene has a limit.
    fn radius(&self, camera: &Camera) -> f32 {
        let k = camera.intrinsics();
        let parallax = (1.0 / self.near - 1.0 / self.far) * k.fx / k.width as f32;
        let radius = ORBIT_SHIFT / parallax.max(1e-9);
        radius.clamp(ORBIT_RADIUS.0 * self.middle, ORBIT_RADIUS.1 * self.middle)
    }
}

/// Shift of near against far points over the radius of a path, share of the picture's width.
const ORBIT_SHIFT: f32 = 0.06;
/// Limits of the radius, share of the median depth. Photographs show no more than what lies
/// around their own places.
const ORBIT_RADIUS: (f32, f32) = (0.02, 0.15);

/// A closed path around the middle of the cameras.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Loop {
    /// A circle across the line of sight.
    Orbit,
    /// Two turns whose width and distance change, as 3DGS and NeRF viewers have it.
    Spiral,
    /// Towards the scene and back.
    Dolly,
}

impl Loop {
    /// Offset from the middle at a share of the path, radii: right, down, forward.
    fn offset(self, share: f32) -> Vec3 {
        let angle = std::f32::consts::TAU * share;
        match self {
            Self::Orbit => Vec3::new(angle.cos(), angle.sin(), 0.0),
            Self::Spiral => {
                let width = 0.6 + 0.4 * angle.cos();
                let (sin, cos) = (2.0 * angle).sin_cos();
                Vec3::new(width * cos, width * sin, 0.8 * angle.sin())
            }
            Self::Dolly => Vec3::new(0.0, 0.0, 2.0 * angle.sin()),
        }
    }
}

/// `frames` cameras on a closed path around the middle of `cameras`, looking at what lies at the
/// median depth in front of it. Default of `radius`, world units: by the scene's parallax
/// ([`DepthSpread`]), or half the cameras' spread where that is larger.
pub fn closed_path(
    path: Loop,
    cameras: &[Camera],
    depths: DepthSpread,
    frames: usize,
    radius: Option<f32>,
) -> Result<Vec<Camera>> {
    let Some(first) = cameras.first() else { bail!("a path needs at least 1 camera, got none") };
    let count = cameras.len() as f32;
    let middle = cameras.iter().map(Camera::position).sum::<Vec3>() / count;
    let spread = cameras.iter().map(|c| c.position().distance(middle)).fold(0.0f32, f32::max);
    let radius = radius.unwrap_or_else(|| depths.radius(first).max(0.5 * spread));
    let turn = if cameras.len() == 1 {
        Quat::from_mat3(&first.rotation())
    } else {
        let last = cameras[cameras.len() - 1].rotation();
        Quat::from_mat3(&first.rotation()).slerp(Quat::from_mat3(&last), 0.5)
    };
    let aim = middle + turn * (Vec3::Z * depths.middle);
    let at = |i: usize| {
        let eye = middle + turn * (radius * path.offset(i as f32 / frames as f32));
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
    use subsplat_kernels::camera::Intrinsics;

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
    fn a_clip_goes_to_the_last_camera_and_back() {
        let through = [camera(0.0, 0.0), camera(1.0, 0.3), camera(3.0, 0.1)];
        let path = there_and_back(&through, 8).unwrap();
        let apart = |i: usize, camera: &Camera| path[i].position().distance(camera.position());
        assert!(apart(0, &through[0]) < 1e-5 && apart(4, &through[2]) < 1e-5);
        assert!((1..4).all(|i| apart(i, &path[8 - i]) < 1e-5));
        // Slow at the ends, and the next repetition goes on from the last view.
        assert!(apart(0, &path[1]) < 0.5 * apart(1, &path[2]));
        assert!(there_and_back(&through[..1], 8).is_err());
    }

    #[test]
    fn views_between_photographs_are_none_of_them() {
        let through: Vec<Camera> = (0..5).map(|i| camera(i as f32, 0.1 * i as f32)).collect();
        for count in 2..=5 {
            let views = between(&through[..count], 3).unwrap();
            assert_eq!(views.len(), 3);
            for view in &views {
                let x = view.position().x;
                assert!((x - x.round()).abs() > 0.2, "{count} photographs: {x}");
                assert!(x > 0.0 && x < (count - 1) as f32);
            }
        }
        assert!(between(&through[..1], 3).is_err());
    }

    #[test]
    fn closed_paths_look_at_their_aim_and_return() {
        let cameras = [camera(-1.0, 0.0), camera(1.0, 0.0)];
        let depths = DepthSpread::of([3.0, 4.0, 5.0].into_iter());
        for path in [Loop::Orbit, Loop::Spiral, Loop::Dolly] {
            let all = closed_path(path, &cameras, depths, 8, None).unwrap();
            assert_eq!(all.len(), 8);
            for c in &all {
                let px = c.project(Vec3::new(0.0, 0.0, 4.0)).unwrap();
                assert!((px.x - 32.0).abs() < 1e-3 && (px.y - 24.0).abs() < 1e-3, "{px}");
                assert!(Camera::new(c.intrinsics(), c.world_from_camera()).is_ok());
            }
            // A frame after the last would be the first one.
            assert!(path.offset(1.0).distance(path.offset(0.0)) < 1e-5);
        }
        let dolly = closed_path(Loop::Dolly, &cameras, depths, 4, Some(0.5)).unwrap();
        let z: Vec<f32> = dolly.iter().map(|c| c.position().z).collect();
        assert!((z[1] - 1.0).abs() < 1e-5 && (z[3] + 1.0).abs() < 1e-5, "{z:?}");
        assert!(closed_path(Loop::Orbit, &[], depths, 8, None).is_err());
    }

    #[test]
    fn the_radius_follows_the_parallax() {
        let one = [camera(0.0, 0.0)];
        let radius = |depths: &[f32], radius| {
            let depths = DepthSpread::of(depths.iter().copied());
            let path = closed_path(Loop::Orbit, &one, depths, 4, radius).unwrap();
            path[0].position().distance(path[2].position()) / 2.0
        };
        let deep: Vec<f32> = (0..100).map(|i| 2.0 + 0.08 * i as f32).collect();
        let shift = |z: f32, r: f32| r * one[0].intrinsics().fx / z / 64.0;
        let r = radius(&deep, None);
        let moved = shift(deep[10], r) - shift(deep[90], r);
        assert!((moved - 0.06).abs() < 1e-3, "{moved}");
        // A flat scene has no parallax: the radius is limited.
        assert!((radius(&[4.0; 10], None) - 0.6).abs() < 1e-4);
        assert!((radius(&deep, Some(0.25)) - 0.25).abs() < 1e-6);
        // Half the spread of cameras that stand wide apart.
        let wide = [camera(-4.0, 0.0), camera(4.0, 0.0)];
        let spread = DepthSpread::of(deep.iter().copied());
        let path = closed_path(Loop::Orbit, &wide, spread, 4, None).unwrap();
        assert!(path[0].position().distance(path[2].position()) / 2.0 > 2.0);
        assert_eq!(
            DepthSpread::of([0.0, f32::NAN].into_iter()),
            DepthSpread::of([1.0].into_iter())
        );
    }

    #[test]
    fn frames_by_index_and_by_name() {
        let frames = ["0001", "0012", "left/2", "right/2", "1"];
        let pick = |word: &str| super::pick(&frames, &[word.to_owned()], "--target");
        for (word, expected) in [
            ("0", 0),
            ("3", 3),
            // A name before an index.
            ("1", 4),
            ("0001", 0),
            ("0012.jpg", 1),
            ("images/0001.png", 0),
            ("left/2", 2),
        ] {
            assert_eq!(pick(word).unwrap(), [expected], "{word}");
        }
        // `2` is an index, because two frames have the name `2`.
        assert_eq!(pick("2").unwrap(), [2]);
        for (word, hint) in [("2.png", "give the number"), ("9", "below 5"), ("", "below 5")] {
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
