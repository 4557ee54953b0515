//! Places furniture on the floor, and small objects on top of it.

use super::layout::{Layout, Top, yaw};
use super::material::{Material, Role};
use super::shape::Form;
use glam::{EulerRot, Mat3, Quat, Vec2, Vec3};

impl Layout {
    /// Places all large objects: 3 to 13 cabinets, tables, partitions, poles, boards, a plant,
    /// balls.
    pub(super) fn furnish(&mut self) {
        for _ in 0..self.rng.count(0, 2) {
            self.table();
        }
        for _ in 0..self.rng.count(3, 13) {
            self.cabinet();
        }
        for _ in 0..self.rng.count(0, 2) {
            self.partition();
        }
        for _ in 0..self.rng.count(0, 3) {
            self.pole();
        }
        for _ in 0..self.rng.count(0, 2) {
            self.board();
        }
        if self.rng.chance(0.25) {
            self.plant();
        }
        for _ in 0..self.rng.count(0, 3) {
            self.ball();
        }
    }

    /// Reserves a free circle of the floor. Returns `None` after 12 failed attempts.
    fn free_floor(&mut self, radius: f32) -> Option<Vec2> {
        let reach = Vec2::new(0.5 * self.size.x, 0.5 * self.size.z) - Vec2::splat(radius);
        if reach.min_element() <= 0.0 {
            return None;
        }
        for _ in 0..12 {
            let at =
                Vec2::new(self.rng.range(-reach.x, reach.x), self.rng.range(-reach.y, reach.y));
            if self.is_clear(at, radius) {
                self.occupied_floor.push((at, radius));
                return Some(at);
            }
        }
        None
    }

    /// Tests a circle against the occupied floor. Neighbours may overlap by a fifth, because
    /// circles around boxes are larger than the boxes.
    fn is_clear(&self, at: Vec2, radius: f32) -> bool {
        self.occupied_floor.iter().all(|(p, r)| p.distance(at) > 0.8 * (r + radius))
    }

    /// Adds a box on the floor, in six of ten cases along a wall, with doors where it is tall.
    fn cabinet(&mut self) {
        let half = Vec3::new(
            self.rng.log_range(0.15, 0.9),
            0.5 * self.rng.log_range(0.3, 2.1),
            self.rng.range(0.12, 0.35),
        );
        let radius = 0.8 * half.x.hypot(half.z);
        let (centre, axes) = if self.rng.chance(0.6) {
            let wall = self.walls()[self.rng.count(0, 3)];
            let reach = 0.5 * wall.length - half.x;
            let along = self.rng.range(-1.0, 1.0) * reach;
            let centre = wall.foot + wall.axes * Vec3::new(along, -half.y, half.z + 0.03);
            let at = Vec2::new(centre.x, centre.z);
            if reach <= 0.0 || !self.is_clear(at, radius) {
                return;
            }
            self.occupied_floor.push((at, radius));
            (centre, wall.axes)
        } else {
            let Some(at) = self.free_floor(radius) else { return };
            (Vec3::new(at.x, -half.y, at.y), yaw(self.rng.range(0.0, std::f32::consts::TAU)))
        };
        let material = self.material(Role::Furniture);
        self.add(Form::Block, centre, axes, half, material);
        if half.y < 0.8 {
            let top = centre - Vec3::Y * half.y;
            self.tops.push(Top { centre: top, axes, half: Vec2::new(half.x, half.z) });
        }
        if half.y > 0.3 && self.accepts_extras() && self.rng.chance(0.5) {
            self.doors(centre, axes, half);
        }
    }

    /// Adds one to three panels to the front of a cabinet.
    fn doors(&mut self, centre: Vec3, axes: Mat3, half: Vec3) {
        let count = self.rng.count(1, 3);
        let material = self.material(Role::Furniture);
        let upright = half.x > half.y;
        let share = if upright { half.x } else { half.y } / count as f32;
        for i in 0..count {
            let offset = (2 * i + 1) as f32 * share;
            let (position, panel) = if upright {
                (
                    Vec3::new(offset - half.x, 0.0, half.z),
                    Vec3::new(share - 0.012, half.y - 0.02, 0.008),
                )
            } else {
                (
                    Vec3::new(0.0, offset - half.y, half.z),
                    Vec3::new(half.x - 0.02, share - 0.012, 0.008),
                )
            };
            self.add(Form::Block, centre + axes * position, axes, panel, material);
        }
    }

    /// Adds a table: a plate on four legs.
    fn table(&mut self) {
        let plate = Vec3::new(
            self.rng.range(0.3, 0.9),
            self.rng.range(0.01, 0.03),
            self.rng.range(0.25, 0.5),
        );
        let height = self.rng.range(0.4, 0.8);
        let Some(at) = self.free_floor(0.8 * plate.x.hypot(plate.z)) else { return };
        let axes = yaw(self.rng.range(0.0, std::f32::consts::TAU));
        let (material, legs) = (self.material(Role::Furniture), self.material(Role::Furniture));
        let centre = Vec3::new(at.x, -height, at.y);
        self.add(Form::Block, centre, axes, plate, material);
        let thick = self.rng.range(0.012, 0.035);
        let round = if self.rng.chance(0.5) { Form::Cylinder } else { Form::Block };
        let leg = Vec3::new(thick, 0.5 * (height - plate.y), thick);
        for corner in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
            let (x, z) = (corner.0 * (plate.x - 0.05), corner.1 * (plate.z - 0.05));
            let foot = centre + axes * Vec3::new(x, 0.0, z);
            self.add(round, Vec3::new(foot.x, -leg.y, foot.z), axes, leg, legs);
        }
        let top = centre - Vec3::Y * plate.y;
        self.tops.push(Top { centre: top, axes, half: Vec2::new(plate.x, plate.z) });
    }

    /// Adds a thin wall that extends from one of the four walls.
    fn partition(&mut self) {
        let wall = self.walls()[self.rng.count(0, 3)];
        let half = Vec3::new(
            self.rng.range(0.025, 0.075),
            0.5 * self.rng.range(0.9, self.size.y),
            self.rng.range(0.3, 1.0).min(0.2 * self.size.x.min(self.size.z)),
        );
        let along = self.rng.range(-0.35, 0.35) * wall.length;
        let material = self.material(Role::Wall);
        let centre = wall.foot + wall.axes * Vec3::new(along, -half.y, half.z);
        self.add(Form::Block, centre, wall.axes, half, material);
        self.occupied_floor.push((Vec2::new(centre.x, centre.z), 0.8 * half.z));
    }

    /// Adds a rod of 8 mm to 12 cm diameter: from floor to ceiling, inclined, or level.
    fn pole(&mut self) {
        let radius = 0.5 * self.rng.log_range(0.008, 0.12);
        let material = self.material(Role::Furniture);
        let dice = self.rng.unit();
        let Some(at) = self.free_floor(radius + 0.1) else { return };
        let (half, tilt, up) = if dice < 0.5 {
            (0.5 * self.size.y, 0.0, 0.5 * self.size.y)
        } else if dice < 0.8 {
            let half = self.rng.range(0.4, 0.9);
            let tilt = 0.15 * self.rng.normal();
            (half, tilt, half * tilt.cos())
        } else {
            (self.rng.range(0.3, 0.8), std::f32::consts::FRAC_PI_2, self.rng.range(0.3, 1.9))
        };
        let axes = yaw(self.rng.range(0.0, 3.0)) * Mat3::from_rotation_z(tilt);
        let half = Vec3::new(radius, half, radius);
        self.add(Form::Cylinder, Vec3::new(at.x, -up, at.y), axes, half, material);
    }

    /// Adds an inclined board.
    fn board(&mut self) {
        let half = Vec3::new(self.rng.range(0.2, 0.6), self.rng.range(0.2, 0.7), 0.012);
        let Some(at) = self.free_floor(half.x) else { return };
        let tilt = self.rng.range(0.25, 1.1) * self.rng.sign();
        let axes = yaw(self.rng.range(0.0, std::f32::consts::TAU)) * Mat3::from_rotation_x(tilt);
        let material = self.material(Role::Picture);
        let centre = Vec3::new(at.x, -half.y * tilt.cos() - 0.02, at.y);
        self.add(Form::Block, centre, axes, half, material);
    }

    /// Adds a plant: a pot, a stem and leaves of flat ellipsoids.
    fn plant(&mut self) {
        let Some(at) = self.free_floor(0.3) else { return };
        let (pot, green) = (self.material(Role::Object), self.material(Role::Leaf));
        let foot = Vec3::new(at.x, 0.0, at.y);
        let (radius, height) = (self.rng.range(0.1, 0.2), self.rng.range(0.2, 0.4));
        let half = Vec3::new(radius, 0.5 * height, radius);
        self.add(Form::Cylinder, foot - Vec3::Y * half.y, Mat3::IDENTITY, half, pot);
        let tall = self.rng.range(0.4, 1.2);
        let stem = Vec3::new(0.012, 0.5 * tall, 0.012);
        self.add(Form::Cylinder, foot - Vec3::Y * (height + stem.y), Mat3::IDENTITY, stem, green);
        for _ in 0..self.rng.count(5, 9) {
            let around = yaw(self.rng.range(0.0, std::f32::consts::TAU));
            let axes = around * Mat3::from_rotation_z(self.rng.range(-0.9, 0.3));
            let leaf = Vec3::new(
                self.rng.range(0.12, 0.26),
                self.rng.range(0.01, 0.05),
                self.rng.range(0.04, 0.1),
            );
            let up = height + tall * self.rng.range(0.35, 1.05);
            let centre = foot - Vec3::Y * up + axes.x_axis * 0.8 * leaf.x;
            self.add(Form::Ellipsoid, centre, axes, leaf, green);
        }
    }

    /// Adds a ball on the floor.
    fn ball(&mut self) {
        let radius = self.rng.log_range(0.08, 0.4);
        let Some(at) = self.free_floor(radius) else { return };
        let material = self.material(Role::Object);
        let centre = Vec3::new(at.x, -radius, at.y);
        self.add(Form::Ellipsoid, centre, Mat3::IDENTITY, Vec3::splat(radius), material);
    }

    /// Places 2 to 15 small objects on tops, or on the floor where there is no top.
    pub(super) fn place_objects(&mut self) {
        for _ in 0..self.rng.count(2, 15) {
            let top = if self.tops.is_empty() {
                let Some(at) = self.free_floor(0.1) else { continue };
                Top {
                    centre: Vec3::new(at.x, 0.0, at.y),
                    axes: Mat3::IDENTITY,
                    half: Vec2::splat(0.1),
                }
            } else {
                let i = self.rng.count(0, self.tops.len() - 1);
                self.tops[i]
            };
            let reach = (top.half - Vec2::splat(0.05)).max(Vec2::ZERO);
            let offset = Vec3::new(
                self.rng.range(-reach.x, reach.x),
                0.0,
                self.rng.range(-reach.y, reach.y),
            );
            self.object(top.centre + top.axes * offset, top.axes);
        }
    }

    /// Adds a box, a can, an ellipsoid or a standing picture with its lowest point at `foot`.
    fn object(&mut self, foot: Vec3, axes: Mat3) {
        let dice = self.rng.unit();
        let material = Material::new(Role::Object, &self.palette, &mut self.rng);
        let (form, half, rotation) = if dice < 0.4 {
            let half = Vec3::new(
                self.rng.log_range(0.03, 0.14),
                self.rng.log_range(0.02, 0.18),
                self.rng.log_range(0.03, 0.12),
            );
            (Form::Block, half, yaw(0.5 * self.rng.normal()))
        } else if dice < 0.7 {
            let r = self.rng.log_range(0.02, 0.09);
            (Form::Cylinder, Vec3::new(r, r * self.rng.range(0.6, 3.0), r), Mat3::IDENTITY)
        } else if dice < 0.9 {
            let r = self.rng.log_range(0.03, 0.11);
            (Form::Ellipsoid, Vec3::new(r, r * self.rng.range(0.6, 1.5), r), Mat3::IDENTITY)
        } else {
            let half = Vec3::new(self.rng.range(0.06, 0.14), self.rng.range(0.08, 0.18), 0.008);
            let lean = Quat::from_euler(EulerRot::YXZ, 0.6 * self.rng.normal(), -0.22, 0.0);
            (Form::Block, half, Mat3::from_quat(lean))
        };
        let material = self.add_material(material.spread_over(2.2 * half.max_element()));
        self.add(form, foot - Vec3::Y * half.y, axes * rotation, half, material);
    }
}
