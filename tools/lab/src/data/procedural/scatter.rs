//! Scenes of shapes at random places and of random sizes, indoors and outdoors.
//!
//! Training on such scenes serves real photographs as well as training on furnished rooms
//! (MegaSynth, arXiv 2412.14166; LRM-Zero, arXiv 2406.09371). The shapes are those on which depth
//! estimation fails: foliage, fences, cables, frames, thin plates, rough ground, and solids of any
//! size before one another.

use super::cameras::Rig;
use super::example::CONTEXT;
use super::foreground::ObjectBuilder;
use super::layout::Layout;
use super::light::Lighting;
use super::material::{Material, Palette, Role};
use super::rng::Rng;
use super::shape::Form;
use super::{Room, TextureBank};
use glam::{EulerRot, Mat3, Quat, Vec2, Vec3};
use std::f32::consts::TAU;
use subsplat_kernels::camera::Camera;

/// Key of the random numbers of these scenes.
const SCATTERED: u64 = 14;
/// Share of scenes under an open sky.
const OUTDOORS: f32 = 0.4;
/// Range of the number of groups of objects.
const GROUPS: [usize; 2] = [8, 24];
/// Number of solids above which no further group is added, a limit of the rendering time.
const MAX_SOLIDS: usize = 150;
/// Distance of a group from the camera, in units of the median depth of the empty scene.
const DISTANCE_SHARE: [f32; 2] = [0.18, 1.1];
/// Size of a group, in units of its distance.
const SIZE_SHARE: [f32; 2] = [0.05, 0.6];
/// Range of the number of groups that float in a furnished room.
const FLOATING_GROUPS: [usize; 2] = [3, 10];
/// Size of a floating group, in units of its distance.
const FLOATING_SIZE_SHARE: [f32; 2] = [0.04, 0.3];

impl Room {
    /// Builds an empty indoor or outdoor scene for [`Room::scatter_objects`].
    pub(super) fn scattered(seed: u64) -> Self {
        let mut rng = Rng::new(seed).fork(SCATTERED);
        let outdoors = rng.chance(OUTDOORS);
        let size = if outdoors {
            let side = rng.log_range(15.0, 150.0);
            Vec3::new(side, side * rng.range(0.2, 0.6), side * rng.log_range(0.6, 1.6))
        } else {
            let side = rng.log_range(2.5, 14.0);
            Vec3::new(side, (side * rng.range(0.3, 0.9)).max(2.2), side * rng.range(0.8, 2.0))
        };
        let mut layout = Layout::empty(rng, size);
        layout.scattered_shell(outdoors);
        let lighting = Lighting::new(layout.size, &mut layout.rng.fork(1));
        Self::lit(layout, lighting, TextureBank::shared())
    }

    /// Places groups of objects in the context views of `rig` and updates the rig's depths. Groups
    /// that touch a camera or reduce the views' overlap too far are removed.
    pub(super) fn scatter_objects(&mut self, rig: &mut Rig, rng: &mut Rng) {
        let palette = Palette::new(rng);
        for _ in 0..rng.count(GROUPS[0], GROUPS[1]) {
            let eye = rig.cameras[rng.count(0, CONTEXT - 1)];
            let (solids, materials) = (self.primitives.len(), self.materials.len());
            if solids > MAX_SOLIDS {
                return;
            }
            ObjectBuilder { room: self, palette: &palette, rng }.scatter(&eye, rig.median_depth);
            self.keep_valid_objects(rig, solids, materials);
        }
    }
}

impl Room {
    /// Places groups of solids, plates, frames and cables in the air of a furnished room, in the
    /// context views of `rig`, and updates the rig's depths. Groups that touch a camera or reduce
    /// the views' overlap too far are removed.
    ///
    /// Furnished rooms with floating objects gave the lowest errors of stereo networks on real
    /// pairs (WMGStereo, arXiv 2504.16930): support by furniture ties depth to height in the
    /// picture, and floating objects remove that tie.
    pub(super) fn add_floating(&mut self, rig: &mut Rig, rng: &mut Rng) {
        let palette = Palette::new(rng);
        for _ in 0..rng.count(FLOATING_GROUPS[0], FLOATING_GROUPS[1]) {
            let eye = rig.cameras[rng.count(0, CONTEXT - 1)];
            let (solids, materials) = (self.primitives.len(), self.materials.len());
            ObjectBuilder { room: self, palette: &palette, rng }.float(&eye, rig.median_depth);
            self.keep_valid_objects(rig, solids, materials);
        }
    }
}

impl Layout {
    /// Adds the shell: ground, walls and ceiling, or an emissive sky.
    fn scattered_shell(&mut self, outdoors: bool) {
        let first = self.materials.len();
        let extent = self.size.max_element();
        let open = outdoors && self.rng.chance(0.6);
        for face in 0..6 {
            // Faces −y and +y are ceiling and floor.
            let role = match face {
                2 if self.rng.chance(0.4) => Role::Ceiling,
                3 => Role::Floor,
                _ if self.rng.chance(0.35) => Role::Wall,
                _ => Role::Picture,
            };
            let mut material = Material::new(role, &self.palette, &mut self.rng);
            material = material.spread_over(extent * self.rng.log_range(0.04, 0.6));
            if outdoors && face == 2 || open && face != 3 {
                material = material.into_emissive(self.rng.log_range(0.5, 2.5));
            }
            self.add_material(material);
        }
        let centre = Vec3::new(0.0, -0.5 * self.size.y, 0.0);
        self.add(Form::Shell, centre, Mat3::IDENTITY, 0.5 * self.size, first);
    }
}

impl ObjectBuilder<'_> {
    /// Samples the place and the size of a group in the picture of `camera`.
    fn place_in_view(&mut self, camera: &Camera, median: f32, sizes: [f32; 2]) -> (Vec3, f32) {
        let k = &camera.intrinsics();
        let z = median * self.rng.log_range(DISTANCE_SHARE[0], DISTANCE_SHARE[1]);
        let size = z * self.rng.log_range(sizes[0], sizes[1]);
        let share = Vec2::new(self.rng.range(-0.1, 1.1), self.rng.range(-0.1, 1.1));
        let px = share * Vec2::new(k.width as f32, k.height as f32);
        (camera.position() + camera.rotation() * k.unproject(px) * z, size)
    }

    /// Places a random group that needs no support in the picture of `camera`.
    fn float(&mut self, camera: &Camera, median: f32) {
        let (at, size) = self.place_in_view(camera, median, FLOATING_SIZE_SHARE);
        let dice = self.rng.unit();
        if dice < 0.65 {
            self.solids(at, size);
        } else if dice < 0.85 {
            self.plates(at, size);
        } else if dice < 0.95 {
            self.frame(at, size);
        } else {
            self.cables(at, size);
        }
    }

    /// Places a random group in the picture of `camera`.
    fn scatter(&mut self, camera: &Camera, median: f32) {
        let (at, size) = self.place_in_view(camera, median, SIZE_SHARE);
        let dice = self.rng.unit();
        if dice < 0.4 {
            self.solids(at, size);
        } else if dice < 0.55 {
            self.foliage(at, size);
        } else if dice < 0.68 {
            self.fence(at, size);
        } else if dice < 0.76 {
            self.cables(at, size);
        } else if dice < 0.84 {
            self.frame(at, size);
        } else if dice < 0.93 {
            self.plates(at, size);
        } else {
            self.rough_ground(at, size);
        }
    }

    /// Adds a material whose texture has about the size of the object.
    fn sized_material(&mut self, role: Role, size: f32) -> usize {
        let period = size * self.rng.log_range(0.4, 3.0);
        let material = Material::new(role, self.palette, self.rng).spread_over(period);
        self.add_material(material)
    }

    /// Samples a rotation: level in half of the cases, else any.
    fn axes(&mut self) -> Mat3 {
        let turn = self.rng.range(0.0, TAU);
        let tilt = if self.rng.chance(0.5) {
            [0.0, 0.0]
        } else {
            [self.rng.range(0.0, TAU), self.rng.range(0.0, TAU)]
        };
        Mat3::from_quat(Quat::from_euler(EulerRot::YXZ, turn, tilt[0], tilt[1]))
    }

    /// Samples a displacement with standard deviation `size`.
    fn displacement(&mut self, size: f32) -> Vec3 {
        size * Vec3::new(self.rng.normal(), self.rng.normal(), self.rng.normal())
    }

    /// Adds one to five solids of any proportions.
    fn solids(&mut self, at: Vec3, size: f32) {
        for _ in 0..self.rng.count(1, 5) {
            let material = self.sized_material(Role::Object, size);
            let shape = [(); 3].map(|()| self.rng.log_range(0.12, 1.0));
            let form = [Form::Block, Form::Cylinder, Form::Ellipsoid][self.rng.count(0, 2)];
            let axes = self.axes();
            let offset = self.displacement(0.8 * size);
            self.add(form, at + offset, axes, size * Vec3::from(shape), material);
        }
    }

    /// Adds thin leaves around a point.
    fn foliage(&mut self, at: Vec3, size: f32) {
        let green = [(); 3].map(|()| self.sized_material(Role::Leaf, 0.3 * size));
        let (length, slim) = (self.rng.log_range(0.12, 0.5), self.rng.range(0.1, 0.6));
        for i in 0..self.rng.count(10, 40) {
            let leaf = size * length * self.rng.range(0.5, 1.0) * Vec3::new(1.0, 0.03, slim);
            let angles = [(); 3].map(|()| self.rng.range(0.0, TAU));
            let turn = Quat::from_euler(EulerRot::YXZ, angles[0], angles[1], angles[2]);
            let offset = self.displacement(0.5 * size);
            self.add(Form::Ellipsoid, at + offset, Mat3::from_quat(turn), leaf, green[i % 3]);
        }
    }

    /// Adds parallel bars with one or two rails.
    fn fence(&mut self, at: Vec3, size: f32) {
        let material = self.sized_material(Role::Furniture, size);
        let axes = self.axes();
        let count = self.rng.count(4, 14);
        let pitch = size * self.rng.log_range(0.12, 0.5);
        let thick = pitch * self.rng.range(0.06, 0.3);
        let height = pitch * self.rng.range(1.5, 6.0);
        let form = if self.rng.chance(0.5) { Form::Cylinder } else { Form::Block };
        let reach = 0.5 * pitch * (count - 1) as f32;
        for i in 0..count {
            let x = pitch * i as f32 - reach;
            let position = at + axes * Vec3::new(x, 0.0, 0.0);
            self.add(form, position, axes, Vec3::new(thick, height, thick), material);
        }
        for _ in 0..self.rng.count(0, 2) {
            let y = height * self.rng.range(-0.9, 0.9);
            let position = at + axes * Vec3::new(0.0, y, 0.0);
            self.add(Form::Block, position, axes, Vec3::new(reach, thick, thick), material);
        }
    }

    /// Adds long thin cylinders in any direction.
    fn cables(&mut self, at: Vec3, size: f32) {
        let material = self.sized_material(Role::Furniture, size);
        for _ in 0..self.rng.count(1, 5) {
            let angles = [(); 3].map(|()| self.rng.range(0.0, TAU));
            let turn = Quat::from_euler(EulerRot::YXZ, angles[0], angles[1], angles[2]);
            let thick = size * self.rng.log_range(0.008, 0.05);
            let half = Vec3::new(thick, size * self.rng.range(1.0, 5.0), thick);
            let offset = self.displacement(0.4 * size);
            self.add(Form::Cylinder, at + offset, Mat3::from_quat(turn), half, material);
        }
    }

    /// Adds the twelve edges of a box.
    fn frame(&mut self, at: Vec3, size: f32) {
        let material = self.sized_material(Role::Furniture, size);
        let axes = self.axes();
        let half = size * Vec3::from([(); 3].map(|()| self.rng.log_range(0.3, 1.2)));
        let thick = size * self.rng.log_range(0.015, 0.1);
        for along in 0..3 {
            for (u, v) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
                let mut place = half;
                let mut edge = Vec3::splat(thick);
                (place[along], edge[along]) = (0.0, half[along] + thick);
                place[(along + 1) % 3] *= u;
                place[(along + 2) % 3] *= v;
                self.add(Form::Block, at + axes * place, axes, edge, material);
            }
        }
    }

    /// Adds thin plates: signs, pages, boards.
    fn plates(&mut self, at: Vec3, size: f32) {
        for _ in 0..self.rng.count(1, 4) {
            let material = self.sized_material(Role::Picture, size);
            let half =
                Vec3::new(self.rng.log_range(0.3, 1.5), self.rng.log_range(0.3, 1.5), 0.004) * size;
            let axes = self.axes();
            let offset = self.displacement(0.6 * size);
            self.add(Form::Block, at + offset, axes, half, material);
        }
    }

    /// Adds flat ellipsoids on the ground below `at`.
    fn rough_ground(&mut self, at: Vec3, size: f32) {
        let material = self.sized_material(Role::Floor, size);
        for _ in 0..self.rng.count(6, 16) {
            let offset = self.displacement(1.5 * size);
            let centre = Vec3::new(at.x + offset.x, 0.0, at.z + offset.z);
            let wide = size * self.rng.log_range(0.4, 1.6);
            let half = Vec3::new(wide, wide * self.rng.range(0.1, 0.5), wide);
            let axes = Mat3::from_rotation_y(self.rng.range(0.0, TAU));
            self.add(Form::Ellipsoid, centre, axes, half, material);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::cameras::{CLEARANCE, CameraRange, CameraSpec, sample_cameras};
    use super::super::shape::Primitive;
    use super::*;

    #[test]
    fn objects_float_in_furnished_rooms() {
        let range = CameraRange::LogBaseline;
        let spec = CameraSpec { width: 64, height: 48, targets: 1, crop: 0.3, range };
        let (mut placed, mut off_ground, mut nearer) = (0, 0, 0);
        for seed in 0..60 {
            let mut room = Room::new(seed);
            let Some(mut rig) = sample_cameras(&room, seed, &spec) else { continue };
            let (solids, was) = (room.solids(), rig.clone());
            room.add_floating(&mut rig, &mut Rng::new(seed));
            assert_eq!(rig.cameras, was.cameras);
            for camera in &rig.cameras {
                assert!(room.clearance(camera.position()) >= CLEARANCE, "seed {seed}");
            }
            let added = &room.primitives[solids..];
            placed += usize::from(added.len() > 4);
            // A solid whose bounding sphere reaches neither the floor nor the ceiling.
            let free = |p: &&Primitive| {
                p.centre.y + p.radius < 0.0 && p.centre.y - p.radius > -room.size.y
            };
            off_ground += usize::from(2 * added.iter().filter(free).count() > added.len());
            nearer += usize::from(rig.near_depth < 0.8 * was.near_depth);
        }
        assert!(placed > 45 && off_ground > 35 && nearer > 20, "{placed} {off_ground} {nearer}");
    }

    #[test]
    fn scattered_scenes_have_objects_at_many_distances() {
        let range = CameraRange::Wide;
        let spec = CameraSpec { width: 64, height: 48, targets: 1, crop: 0.3, range };
        let (mut placed, mut nearer, mut deep) = (0, 0, 0);
        for seed in 0..60 {
            let mut room = Room::scattered(seed);
            let Some(mut rig) = sample_cameras(&room, seed, &spec) else { continue };
            assert_eq!(room.solids(), 1, "the shell alone");
            let empty = rig.clone();
            room.scatter_objects(&mut rig, &mut Rng::new(seed));
            assert_eq!(rig.cameras, empty.cameras);
            for camera in &rig.cameras {
                assert!(room.clearance(camera.position()) >= CLEARANCE, "seed {seed}");
            }
            assert!(room.solids() <= MAX_SOLIDS + 60, "{}", room.solids());
            placed += usize::from(room.solids() > 10);
            nearer += usize::from(rig.near_depth < 0.6 * empty.near_depth);
            deep += usize::from(rig.far_depth > 10.0 * rig.near_depth);
        }
        assert!(placed > 45 && nearer > 25 && deep > 8, "{placed} {nearer} {deep}");
    }
}
