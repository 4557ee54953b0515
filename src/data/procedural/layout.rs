//! What stands where: the shell of a room and what hangs on its walls. Furniture is in
//! `furniture.rs`.
//!
//! World: metres, y down (as a camera's), the floor at y = 0, the room's middle above
//! the origin.

use super::material::{Material, Palette, Role};
use super::rng::Rng;
use super::shape::{Form, Primitive};
use glam::{Mat3, Vec2, Vec3};

/// Extras (panels, bars, knobs) are left out once a room has this many solids.
const ENOUGH: usize = 62;

/// A level surface that small things can stand on.
#[derive(Clone, Copy, Debug)]
pub(super) struct Top {
    /// Its centre, world.
    pub(super) centre: Vec3,
    /// Own axes, y vertical.
    pub(super) axes: Mat3,
    /// Half extent along the own x and z, m.
    pub(super) half: Vec2,
}

/// One wall as seen from inside.
#[derive(Clone, Copy, Debug)]
pub(super) struct Wall {
    /// Middle of its lower edge.
    pub(super) foot: Vec3,
    /// Columns: along the wall, down, into the room.
    pub(super) axes: Mat3,
    /// Length, m.
    pub(super) length: f32,
}

/// A room under construction.
pub(super) struct Layout {
    pub(super) rng: Rng,
    pub(super) palette: Palette,
    /// Width (x), height (y), length (z), m.
    pub(super) size: Vec3,
    pub(super) primitives: Vec<Primitive>,
    pub(super) materials: Vec<Material>,
    pub(super) tops: Vec<Top>,
    /// Circles of the floor that are taken: centre (x, z) and radius, m.
    pub(super) taken: Vec<(Vec2, f32)>,
    /// Rectangles of the walls that are taken: wall, middle along and up, half sizes.
    hung: Vec<(usize, Vec2, Vec2)>,
}

/// Rotation by `angle` about the vertical.
pub(super) fn yaw(angle: f32) -> Mat3 {
    Mat3::from_rotation_y(angle)
}

impl Layout {
    /// A whole furnished room.
    pub(super) fn furnished(seed: u64) -> Self {
        let mut rng = Rng::new(seed);
        let size = Vec3::new(rng.range(2.2, 7.0), rng.range(2.3, 3.4), rng.range(3.0, 11.0));
        let palette = Palette::new(&mut rng);
        let mut layout = Self {
            rng,
            palette,
            size,
            primitives: Vec::with_capacity(80),
            materials: Vec::with_capacity(90),
            tops: Vec::new(),
            taken: Vec::new(),
            hung: Vec::new(),
        };
        layout.shell();
        layout.furnish();
        layout.hang();
        layout.strew();
        layout
    }

    pub(super) fn material(&mut self, role: Role) -> usize {
        let material = Material::new(role, &self.palette, &mut self.rng);
        self.keep(material)
    }

    pub(super) fn keep(&mut self, material: Material) -> usize {
        self.materials.push(material);
        self.materials.len() - 1
    }

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
        self.primitives.push(primitive);
    }

    /// True while extras are welcome.
    pub(super) fn has_room(&self) -> bool {
        self.primitives.len() < ENOUGH
    }

    fn shell(&mut self) {
        let walls = self.material(Role::Wall);
        for _ in 1..6 {
            let like_the_first = self.materials[walls].clone();
            self.keep(like_the_first);
        }
        // Faces −y and +y are ceiling and floor; one wall in three differs.
        self.materials[walls + 2] = Material::new(Role::Ceiling, &self.palette, &mut self.rng);
        self.materials[walls + 3] = Material::new(Role::Floor, &self.palette, &mut self.rng);
        for face in [0, 1, 4, 5] {
            if self.rng.chance(0.33) {
                self.materials[walls + face] =
                    Material::new(Role::Wall, &self.palette, &mut self.rng);
            }
        }
        let centre = Vec3::new(0.0, -0.5 * self.size.y, 0.0);
        self.add(Form::Shell, centre, Mat3::IDENTITY, 0.5 * self.size, walls);
        if self.rng.chance(0.6) {
            self.skirting();
        }
        if self.rng.chance(0.5) {
            let material = self.material(Role::Picture);
            let half = Vec3::new(
                self.size.x * self.rng.range(0.15, 0.35),
                0.006,
                self.size.z * self.rng.range(0.12, 0.3),
            );
            let place = Vec3::new(0.2 * self.rng.normal(), -half.y, 0.5 * self.rng.normal());
            let axes = yaw(0.1 * self.rng.normal());
            self.add(Form::Block, place, axes, half, material);
        }
    }

    fn skirting(&mut self) {
        let material = self.material(Role::Ceiling);
        let height = self.rng.range(0.04, 0.1);
        for wall in self.walls() {
            let half = Vec3::new(0.5 * wall.length, height, 0.012);
            let centre = wall.foot - Vec3::Y * height + wall.axes.z_axis * half.z;
            self.add(Form::Block, centre, wall.axes, half, material);
        }
    }

    /// The four walls.
    pub(super) fn walls(&self) -> [Wall; 4] {
        let (x, z) = (0.5 * self.size.x, 0.5 * self.size.z);
        let wall = |foot: Vec3, length: f32| {
            let inward = -foot.normalize_or(Vec3::Z);
            Wall { foot, axes: Mat3::from_cols(Vec3::Y.cross(inward), Vec3::Y, inward), length }
        };
        [
            wall(Vec3::new(0.0, 0.0, z), self.size.x),
            wall(Vec3::new(x, 0.0, 0.0), self.size.z),
            wall(Vec3::new(0.0, 0.0, -z), self.size.x),
            wall(Vec3::new(-x, 0.0, 0.0), self.size.z),
        ]
    }

    /// A free rectangle on a wall: (wall, position along, height of its middle), or
    /// `None` after some tries. `up` bounds the height of the middle.
    fn free_spot(&mut self, half: Vec2, up: [f32; 2]) -> Option<(usize, Vec2)> {
        for _ in 0..12 {
            let w = self.rng.count(0, 3);
            let reach = 0.5 * self.walls()[w].length - half.x - 0.05;
            let (low, high) = (up[0].max(half.y), up[1].min(self.size.y - half.y - 0.05));
            if reach <= 0.0 || low > high {
                continue;
            }
            let at = Vec2::new(self.rng.range(-reach, reach), self.rng.range(low, high));
            let clear = self.hung.iter().all(|(other, p, h)| {
                *other != w || (at - *p).abs().cmpgt(*h + half + Vec2::splat(0.04)).any()
            });
            if clear {
                self.hung.push((w, at, half));
                return Some((w, at));
            }
        }
        None
    }

    /// A block on a wall: `at` along and up, `half` along, up and out, standing
    /// `lift` off the wall.
    fn mount(&mut self, wall: usize, at: Vec2, half: Vec3, lift: f32, material: usize) {
        let wall = self.walls()[wall];
        let centre = wall.foot + wall.axes * Vec3::new(at.x, -at.y, half.z + lift);
        self.add(Form::Block, centre, wall.axes, half, material);
    }

    /// 4 to 17 things on walls.
    fn hang(&mut self) {
        if self.rng.chance(0.08) {
            self.mirror();
        }
        for _ in 0..self.rng.count(4, 17) {
            let dice = self.rng.unit();
            if dice < 0.45 {
                self.picture();
            } else if dice < 0.57 {
                self.door();
            } else if dice < 0.75 {
                self.window();
            } else if dice < 0.9 {
                self.shelf();
            } else {
                self.inset();
            }
        }
    }

    fn picture(&mut self) {
        let half = Vec2::new(self.rng.log_range(0.1, 0.8), self.rng.log_range(0.1, 0.6));
        let Some((wall, at)) = self.free_spot(half, [1.1, 2.0]) else { return };
        let canvas = Material::new(Role::Picture, &self.palette, &mut self.rng);
        let extent = half.max_element() * self.rng.range(0.8, 2.0);
        let canvas = self.keep(canvas.spread_over(extent));
        let depth = self.rng.range(0.006, 0.025);
        if self.has_room() && self.rng.chance(0.6) {
            let frame = self.material(Role::Furniture);
            let rim = self.rng.range(0.012, 0.05);
            self.mount(wall, at, half.extend(depth), 0.0, frame);
            let inner = (half - Vec2::splat(rim)).max(Vec2::splat(0.03));
            self.mount(wall, at, inner.extend(depth + 0.002), 0.0, canvas);
        } else {
            self.mount(wall, at, half.extend(depth), 0.0, canvas);
        }
    }

    fn mirror(&mut self) {
        let half = Vec2::new(self.rng.range(0.2, 0.5), self.rng.range(0.3, 0.7));
        let Some((wall, at)) = self.free_spot(half, [1.1, 1.6]) else { return };
        let glass = Material::new(Role::Wall, &self.palette, &mut self.rng).into_mirror();
        let glass = self.keep(glass);
        self.mount(wall, at, half.extend(0.01), 0.0, glass);
    }

    fn door(&mut self) {
        let half = Vec2::new(self.rng.range(0.38, 0.5), self.rng.range(0.97, 1.05));
        let Some((wall, at)) = self.free_spot(half, [half.y, half.y + 0.01]) else { return };
        let (frame, leaf) = (self.material(Role::Ceiling), self.material(Role::Furniture));
        self.mount(wall, at, half.extend(0.02), 0.0, frame);
        self.mount(wall, at - Vec2::Y * 0.03, (half - Vec2::splat(0.06)).extend(0.026), 0.0, leaf);
        if self.has_room() {
            let handle = self.material(Role::Thing);
            let place = at + Vec2::new((half.x - 0.13) * self.rng.sign(), 1.02 - half.y);
            self.mount(wall, place, Vec3::new(0.06, 0.012, 0.012), 0.09, handle);
        }
    }

    fn window(&mut self) {
        let half = Vec2::new(self.rng.range(0.3, 0.9), self.rng.range(0.3, 0.7));
        let Some((wall, at)) = self.free_spot(half, [1.3, 1.7]) else { return };
        let frame = self.material(Role::Ceiling);
        let radiance = self.rng.log_range(1.0, 4.0);
        let outside = Material::new(Role::Picture, &self.palette, &mut self.rng);
        let outside = self.keep(outside.spread_over(1.5 * half.x).into_glowing(radiance));
        self.mount(wall, at, half.extend(0.015), 0.0, frame);
        let inner = half - Vec2::splat(0.05);
        self.mount(wall, at, inner.extend(0.02), 0.0, outside);
        if let Some(pane) = self.primitives.last_mut() {
            pane.casts_shadow = false;
        }
        if self.has_room() {
            self.mount(wall, at, Vec3::new(0.02, inner.y, 0.03), 0.0, frame);
            self.mount(wall, at, Vec3::new(inner.x, 0.018, 0.028), 0.0, frame);
        }
    }

    fn shelf(&mut self) {
        let half = Vec3::new(self.rng.range(0.2, 0.8), 0.015, self.rng.range(0.07, 0.16));
        let Some((w, at)) = self.free_spot(Vec2::new(half.x, 0.2), [0.9, 1.9]) else { return };
        let material = self.material(Role::Furniture);
        self.mount(w, at, half, 0.0, material);
        let wall = self.walls()[w];
        let centre = wall.foot + wall.axes * Vec3::new(at.x, -at.y - half.y, half.z);
        self.tops.push(Top { centre, axes: wall.axes, half: Vec2::new(half.x, half.z) });
    }

    /// A glowing globe on a cord around the lamp at `place`, in half of the rooms.
    pub(super) fn hang_lamp(&mut self, place: Vec3) {
        let mut rng = self.rng.fork(3);
        let (shown, radius) = (rng.chance(0.5), rng.range(0.07, 0.13));
        if !shown || self.primitives.iter().any(|p| p.distance(place) < radius) {
            return;
        }
        let globe = Material::new(Role::Ceiling, &self.palette, &mut rng).into_glowing(4.0);
        let (globe, cord) = (self.keep(globe), self.material(Role::Furniture));
        let half = Vec3::new(0.006, 0.5 * (self.size.y + place.y), 0.006);
        let middle = place - Vec3::Y * half.y;
        self.add(Form::Ellipsoid, place, Mat3::IDENTITY, Vec3::splat(radius), globe);
        self.add(Form::Cylinder, middle, Mat3::IDENTITY, half, cord);
        for part in self.primitives.iter_mut().rev().take(2) {
            part.casts_shadow = false;
        }
    }

    /// A niche: a dark back within four boards that stand out from the wall.
    fn inset(&mut self) {
        let half = Vec2::new(self.rng.range(0.15, 0.5), self.rng.range(0.15, 0.5));
        let Some((wall, at)) = self.free_spot(half, [0.8, 1.8]) else { return };
        let (back, board) = (self.material(Role::Furniture), self.material(Role::Furniture));
        let (depth, thick) = (self.rng.range(0.05, 0.14), 0.012);
        self.mount(wall, at, half.extend(0.004), 0.0, back);
        if self.has_room() {
            for side in [-1.0, 1.0] {
                let up = at + Vec2::Y * side * (half.y - thick);
                self.mount(wall, up, Vec3::new(half.x, thick, depth), 0.0, board);
                let along = at + Vec2::X * side * (half.x - thick);
                self.mount(wall, along, Vec3::new(thick, half.y, depth), 0.0, board);
            }
        }
    }
}
