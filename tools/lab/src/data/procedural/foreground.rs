//! Places objects close to the cameras, partly outside the picture: chairs, plants, the edge of a
//! door, clutter.
//!
//! Photographs of furnished rooms often show such objects. A network trained without them
//! reconstructs them with large depth errors.

use super::Room;
use super::cameras::{CLEARANCE, Rig, extent, overlap, probe};
use super::example::CONTEXT;
use super::layout::yaw;
use super::material::{Material, Palette, Role};
use super::rng::Rng;
use super::shape::{Form, Primitive};
use glam::{EulerRot, Mat3, Quat, Vec2, Vec3};
use std::f32::consts::TAU;
use subsplat_kernels::camera::{Camera, NearFar};

/// Distance from the camera, as a share of the median depth.
const DISTANCE_SHARE: [f32; 2] = [0.14, 0.55];
/// Smallest distance from the camera, m.
const MIN_DISTANCE: f32 = 0.3;
/// Smallest share of a context view that the other sees after the objects are placed.
const MIN_OVERLAP: f32 = 0.3;

impl Room {
    /// Places one to three objects before the context cameras of `rig`, and updates the rig's
    /// depths. Objects too close to a camera and objects that reduce the overlap too far are
    /// removed.
    pub(super) fn add_foreground(&mut self, rig: &mut Rig, rng: &mut Rng) {
        let palette = Palette::new(rng);
        for _ in 0..rng.count(1, 3) {
            let eye = rig.cameras[rng.count(0, CONTEXT - 1)];
            let (solids, materials) = (self.primitives.len(), self.materials.len());
            ObjectBuilder { room: self, palette: &palette, rng }.place(&eye, rig.median_depth);
            self.keep_valid_objects(rig, solids, materials);
        }
    }

    /// Updates the depths of `rig` after new objects; removes the objects, which follow the first
    /// `solids` and `materials`, if the cameras are no longer valid.
    pub(super) fn keep_valid_objects(&mut self, rig: &mut Rig, solids: usize, materials: usize) {
        match self.valid_depths(rig) {
            Some(depths) => (rig.near_depth, rig.far_depth) = (depths.near, depths.far),
            None => {
                self.primitives.truncate(solids);
                self.materials.truncate(materials);
            }
        }
    }

    /// Returns nearest and farthest depth, or `None` if a camera touches a surface or the overlap
    /// is too small.
    fn valid_depths(&self, rig: &Rig) -> Option<NearFar> {
        if rig.cameras.iter().any(|c| self.clearance(c.position()) < CLEARANCE) {
            return None;
        }
        let [a, b] = [&rig.cameras[0], &rig.cameras[1]];
        let (from_a, from_b) = (probe(self, a), probe(self, b));
        let enough = overlap(self, [a, b], [&from_a, &from_b]) >= MIN_OVERLAP;
        if enough { extent(from_a.iter().chain(&from_b)) } else { None }
    }
}

/// Builder of one object.
pub(super) struct ObjectBuilder<'a> {
    pub(super) room: &'a mut Room,
    pub(super) palette: &'a Palette,
    pub(super) rng: &'a mut Rng,
}

impl ObjectBuilder<'_> {
    /// Places a random object away from the middle of the picture of `camera`, partly beyond its
    /// border.
    fn place(&mut self, camera: &Camera, median: f32) {
        let k = &camera.intrinsics();
        let z = (median * self.rng.range(DISTANCE_SHARE[0], DISTANCE_SHARE[1])).max(MIN_DISTANCE);
        let across = 0.5 + self.rng.sign() * self.rng.range(0.15, 0.6);
        let px = Vec2::new(across * k.width as f32, self.rng.range(0.3, 1.05) * k.height as f32);
        let at = camera.position() + camera.rotation() * k.unproject(px) * z;
        let dice = self.rng.unit();
        if dice < 0.35 {
            self.chair(at);
        } else if dice < 0.6 {
            self.plant(at, z);
        } else if dice < 0.75 {
            self.edge(at);
        } else {
            self.clutter(at, z);
        }
    }

    /// Adds a random material and returns its index.
    fn material(&mut self, role: Role) -> usize {
        let material = Material::new(role, self.palette, self.rng);
        self.add_material(material)
    }

    /// Adds a material and returns its index.
    pub(super) fn add_material(&mut self, material: Material) -> usize {
        self.room.materials.push(material);
        self.room.materials.len() - 1
    }

    /// Adds a solid.
    pub(super) fn add(
        &mut self,
        form: Form,
        centre: Vec3,
        axes: Mat3,
        half: Vec3,
        material: usize,
    ) {
        let mut primitive = Primitive::new(form, centre, axes, half);
        primitive.material = material;
        self.room.primitives.push(primitive);
    }

    /// Adds a chair: seat, four legs, and a back of slats or of one board. Its top is at the height
    /// of `at`.
    fn chair(&mut self, at: Vec3) {
        let top = (-at.y).clamp(0.6, 1.4);
        let seat = top * self.rng.range(0.42, 0.55);
        let wide = self.rng.range(0.18, 0.26);
        let axes = yaw(self.rng.range(0.0, TAU));
        let foot = Vec3::new(at.x, 0.0, at.z);
        let (frame, cover) = (self.material(Role::Furniture), self.material(Role::Furniture));
        let position = |x: f32, up: f32, z: f32| foot + axes * Vec3::new(x, -up, z);
        let thick = self.rng.range(0.01, 0.025);
        let plate = Vec3::new(wide, self.rng.range(0.01, 0.035), wide);
        self.add(Form::Block, position(0.0, seat, 0.0), axes, plate, cover);
        let form = if self.rng.chance(0.5) { Form::Cylinder } else { Form::Block };
        let inner = wide - thick;
        for (x, z) in [(-inner, -inner), (inner, -inner), (-inner, inner), (inner, inner)] {
            // The two rear legs continue as posts of the back.
            let height = if z < 0.0 { top } else { seat };
            let leg = Vec3::new(thick, 0.5 * height, thick);
            self.add(form, position(x, leg.y, z), axes, leg, frame);
        }
        let back = top - seat;
        if self.rng.chance(0.35) {
            let board = Vec3::new(inner, 0.35 * back, 0.6 * thick);
            self.add(Form::Block, position(0.0, top - board.y, -inner), axes, board, cover);
            return;
        }
        let rail = Vec3::new(inner, self.rng.range(0.015, 0.05), 0.8 * thick);
        self.add(Form::Block, position(0.0, top - rail.y, -inner), axes, rail, frame);
        let count = self.rng.count(2, 5);
        let upright = self.rng.chance(0.6);
        for i in 0..count {
            let share = (i + 1) as f32 / (count + 1) as f32;
            let (slat, x, up) = if upright {
                let half = Vec3::new(self.rng.range(0.006, 0.025), 0.5 * back, 0.5 * thick);
                (half, (2.0 * share - 1.0) * inner, seat + 0.5 * back)
            } else {
                let half = Vec3::new(inner, self.rng.range(0.008, 0.03), 0.5 * thick);
                (half, 0.0, seat + share * back)
            };
            self.add(Form::Block, position(x, up, -inner), axes, slat, frame);
        }
    }

    /// Adds a plant: long leaves that start near `at` and extend in all directions.
    fn plant(&mut self, at: Vec3, z: f32) {
        let green = [self.material(Role::Leaf), self.material(Role::Leaf)];
        let size = z.min(1.5) * self.rng.range(0.08, 0.3);
        let slim = self.rng.range(0.08, 0.35);
        for i in 0..self.rng.count(6, 18) {
            let leaf = size * self.rng.range(0.5, 1.0) * Vec3::new(1.0, 0.03, slim);
            let angles =
                [self.rng.range(0.0, TAU), 0.4 * self.rng.normal(), self.rng.range(-1.2, 0.9)];
            let axes =
                Mat3::from_quat(Quat::from_euler(EulerRot::YXZ, angles[0], angles[1], angles[2]));
            let root = at
                + 0.4 * size * Vec3::new(self.rng.normal(), self.rng.normal(), self.rng.normal());
            self.add(Form::Ellipsoid, root + axes.x_axis * leaf.x, axes, leaf, green[i % 2]);
        }
    }

    /// Adds the edge of a door, a pillar or the end of a wall, from floor to ceiling.
    fn edge(&mut self, at: Vec3) {
        let material = self.material(Role::Wall);
        let height = 0.5 * self.room.size.y;
        let half = Vec3::new(self.rng.log_range(0.02, 0.25), height, self.rng.log_range(0.02, 0.3));
        let axes = yaw(0.05 * self.rng.normal());
        self.add(Form::Block, Vec3::new(at.x, -height, at.z), axes, half, material);
    }

    /// Adds one to four boxes, cans and ellipsoids around `at`.
    fn clutter(&mut self, at: Vec3, z: f32) {
        for _ in 0..self.rng.count(1, 4) {
            let material = self.material(Role::Object);
            let size = z * self.rng.log_range(0.04, 0.25);
            let spread = Vec3::new(self.rng.normal(), self.rng.normal(), self.rng.normal());
            let shape = [(); 3].map(|()| self.rng.log_range(0.15, 1.0));
            let form = [Form::Block, Form::Cylinder, Form::Ellipsoid][self.rng.count(0, 2)];
            let axes =
                yaw(self.rng.range(0.0, TAU)) * Mat3::from_rotation_z(0.3 * self.rng.normal());
            self.add(form, at + spread * size, axes, size * Vec3::from(shape), material);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::{CameraSpec, sample_cameras};
    use super::*;

    #[test]
    fn foreground_objects_are_close_and_clear_of_the_cameras() {
        let spec =
            CameraSpec { width: 64, height: 48, targets: 2, crop: 0.3, range: Default::default() };
        let (mut crowded, mut nearer) = (0, 0);
        for seed in 0..60 {
            let mut room = Room::new(seed);
            let Some(mut rig) = sample_cameras(&room, seed, &spec) else { continue };
            let (solids, was) = (room.solids(), rig.clone());
            room.add_foreground(&mut rig, &mut Rng::new(seed));
            assert_eq!(rig.cameras, was.cameras);
            for camera in &rig.cameras {
                assert!(room.clearance(camera.position()) >= CLEARANCE, "seed {seed}");
            }
            let [a, b] = [0, 1].map(|i| probe(&room, &rig.cameras[i]));
            let shared = overlap(&room, [&rig.cameras[0], &rig.cameras[1]], [&a, &b]);
            assert!(shared >= MIN_OVERLAP, "seed {seed}: {shared}");
            assert!(rig.near_depth <= was.near_depth && rig.near_depth > 0.0);
            crowded += usize::from(room.solids() > solids);
            nearer += usize::from(rig.near_depth < 0.8 * was.near_depth);
        }
        assert!(crowded > 45 && nearer > 20, "{crowded} {nearer}");
    }
}
