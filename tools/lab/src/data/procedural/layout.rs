//! Builds the shell of a room and the objects on its walls. `furniture.rs` places the furniture.
//!
//! World: metres, y down (as a camera's), floor at y = 0, the middle of the room above the origin.

use super::material::{Material, Palette, Role};
use super::rng::Rng;
use super::shape::{Form, Primitive};
use glam::{Mat3, Vec2, Vec3};

/// Extras (panels, bars, knobs) are omitted once a room has this many solids.
const MAX_SOLIDS_FOR_EXTRAS: usize = 62;

/// A level surface for small objects.
#[derive(Clone, Copy, Debug)]
pub(super) struct Top {
    /// Centre, world.
    pub(super) centre: Vec3,
    /// Axes of the surface, y vertical.
    pub(super) axes: Mat3,
    /// Half sizes along the surface's x and z, m.
    pub(super) half: Vec2,
}

/// One wall, seen from inside.
#[derive(Clone, Copy, Debug)]
pub(super) struct Wall {
    /// Middle of the lower edge.
    pub(super) foot: Vec3,
    /// Columns: along the wall, down, into the room.
    pub(super) axes: Mat3,
    /// Length, m.
    pub(super) length: f32,
}

/// Builder of a room.
pub(super) struct Layout {
    pub(super) rng: Rng,
    pub(super) palette: Palette,
    /// Width (x), height (y), length (z), m.
    pub(super) size: Vec3,
    pub(super) primitives: Vec<Primitive>,
    pub(super) materials: Vec<Material>,
    pub(super) tops: Vec<Top>,
    /// Occupied circles of the floor: centre (x, z) and radius, m.
    pub(super) occupied_floor: Vec<(Vec2, f32)>,
    /// Occupied rectangles of the walls.
    occupied_walls: Vec<WallArea>,
}

/// A rectangle on a wall.
#[derive(Clone, Copy, Debug)]
struct WallArea {
    /// Index of the wall.
    wall: usize,
    /// Middle, along the wall and up, m.
    middle: Vec2,
    /// Half sizes, m.
    half: Vec2,
}

/// Returns the rotation by `angle` about the vertical.
pub(super) fn yaw(angle: f32) -> Mat3 {
    Mat3::from_rotation_y(angle)
}

impl Layout {
    /// Builds a complete room from a seed.
    pub(super) fn furnished(seed: u64) -> Self {
        let mut rng = Rng::new(seed);
        let size = Vec3::new(rng.range(2.2, 7.0), rng.range(2.3, 3.4), rng.range(3.0, 11.0));
        let mut layout = Self::empty(rng, size);
        layout.shell();
        layout.furnish();
        layout.furnish_walls();
        layout.place_objects();
        layout
    }

    /// Returns a layout without solids.
    pub(super) fn empty(mut rng: Rng, size: Vec3) -> Self {
        let palette = Palette::new(&mut rng);
        Self {
            rng,
            palette,
            size,
            primitives: Vec::with_capacity(80),
            materials: Vec::with_capacity(90),
            tops: Vec::new(),
            occupied_floor: Vec::new(),
            occupied_walls: Vec::new(),
        }
    }

    /// Adds a random material for `role` and returns its index.
    pub(super) fn material(&mut self, role: Role) -> usize {
        let material = Material::new(role, &self.palette, &mut self.rng);
        self.add_material(material)
    }

    /// Adds a material and returns its index.
    pub(super) fn add_material(&mut self, material: Material) -> usize {
        self.materials.push(material);
        self.materials.len() - 1
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
        self.primitives.push(primitive);
    }

    /// Returns true while the room has few enough solids for extras.
    pub(super) fn accepts_extras(&self) -> bool {
        self.primitives.len() < MAX_SOLIDS_FOR_EXTRAS
    }

    /// Adds floor, ceiling, walls, skirting and a carpet.
    fn shell(&mut self) {
        let walls = self.material(Role::Wall);
        for _ in 1..6 {
            let copy = self.materials[walls].clone();
            self.add_material(copy);
        }
        // Faces −y and +y are ceiling and floor. One wall in three has a material of its own.
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
            let position = Vec3::new(0.2 * self.rng.normal(), -half.y, 0.5 * self.rng.normal());
            let axes = yaw(0.1 * self.rng.normal());
            self.add(Form::Block, position, axes, half, material);
        }
    }

    /// Adds skirting boards to all walls.
    fn skirting(&mut self) {
        let material = self.material(Role::Ceiling);
        let height = self.rng.range(0.04, 0.1);
        for wall in self.walls() {
            let half = Vec3::new(0.5 * wall.length, height, 0.012);
            let centre = wall.foot - Vec3::Y * height + wall.axes.z_axis * half.z;
            self.add(Form::Block, centre, wall.axes, half, material);
        }
    }

    /// Returns the four walls.
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

    /// Reserves a free rectangle on a wall and returns the wall and the rectangle's middle (along,
    /// up). `up` bounds the height of the middle. Returns `None` after 12 failed attempts.
    fn free_spot(&mut self, half: Vec2, up: [f32; 2]) -> Option<(usize, Vec2)> {
        for _ in 0..12 {
            let w = self.rng.count(0, 3);
            let reach = 0.5 * self.walls()[w].length - half.x - 0.05;
            let low = up[0].max(half.y);
            let high = up[1].min(self.size.y - half.y - 0.05);
            if reach <= 0.0 || low > high {
                continue;
            }
            let at = Vec2::new(self.rng.range(-reach, reach), self.rng.range(low, high));
            let clear = self.occupied_walls.iter().all(|other| {
                let gap = other.half + half + Vec2::splat(0.04);
                other.wall != w || (at - other.middle).abs().cmpgt(gap).any()
            });
            if clear {
                self.occupied_walls.push(WallArea { wall: w, middle: at, half });
                return Some((w, at));
            }
        }
        None
    }

    /// Adds a block to a wall: `at` along and up, `half` along, up and out, at a distance of `lift`
    /// from the wall.
    fn mount(&mut self, wall: usize, at: Vec2, half: Vec3, lift: f32, material: usize) {
        let wall = self.walls()[wall];
        let centre = wall.foot + wall.axes * Vec3::new(at.x, -at.y, half.z + lift);
        self.add(Form::Block, centre, wall.axes, half, material);
    }

    /// Adds 4 to 17 objects to the walls.
    fn furnish_walls(&mut self) {
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
                self.niche();
            }
        }
    }

    /// Adds a picture, with or without a frame.
    fn picture(&mut self) {
        let half = Vec2::new(self.rng.log_range(0.1, 0.8), self.rng.log_range(0.1, 0.6));
        let Some((wall, at)) = self.free_spot(half, [1.1, 2.0]) else { return };
        let canvas = Material::new(Role::Picture, &self.palette, &mut self.rng);
        let extent = half.max_element() * self.rng.range(0.8, 2.0);
        let canvas = self.add_material(canvas.spread_over(extent));
        let depth = self.rng.range(0.006, 0.025);
        if self.accepts_extras() && self.rng.chance(0.6) {
            let frame = self.material(Role::Furniture);
            let rim = self.rng.range(0.012, 0.05);
            self.mount(wall, at, half.extend(depth), 0.0, frame);
            let inner = (half - Vec2::splat(rim)).max(Vec2::splat(0.03));
            self.mount(wall, at, inner.extend(depth + 0.002), 0.0, canvas);
        } else {
            self.mount(wall, at, half.extend(depth), 0.0, canvas);
        }
    }

    /// Adds a mirror.
    fn mirror(&mut self) {
        let half = Vec2::new(self.rng.range(0.2, 0.5), self.rng.range(0.3, 0.7));
        let Some((wall, at)) = self.free_spot(half, [1.1, 1.6]) else { return };
        let glass = Material::new(Role::Wall, &self.palette, &mut self.rng).into_mirror();
        let glass = self.add_material(glass);
        self.mount(wall, at, half.extend(0.01), 0.0, glass);
    }

    /// Adds a door with frame and handle.
    fn door(&mut self) {
        let half = Vec2::new(self.rng.range(0.38, 0.5), self.rng.range(0.97, 1.05));
        let Some((wall, at)) = self.free_spot(half, [half.y, half.y + 0.01]) else { return };
        let (frame, leaf) = (self.material(Role::Ceiling), self.material(Role::Furniture));
        self.mount(wall, at, half.extend(0.02), 0.0, frame);
        self.mount(wall, at - Vec2::Y * 0.03, (half - Vec2::splat(0.06)).extend(0.026), 0.0, leaf);
        if self.accepts_extras() {
            let handle = self.material(Role::Object);
            let position = at + Vec2::new((half.x - 0.13) * self.rng.sign(), 1.02 - half.y);
            self.mount(wall, position, Vec3::new(0.06, 0.012, 0.012), 0.09, handle);
        }
    }

    /// Adds a window whose pane emits light.
    fn window(&mut self) {
        let half = Vec2::new(self.rng.range(0.3, 0.9), self.rng.range(0.3, 0.7));
        let Some((wall, at)) = self.free_spot(half, [1.3, 1.7]) else { return };
        let frame = self.material(Role::Ceiling);
        let radiance = self.rng.log_range(1.0, 4.0);
        let outside = Material::new(Role::Picture, &self.palette, &mut self.rng);
        let outside = self.add_material(outside.spread_over(1.5 * half.x).into_emissive(radiance));
        self.mount(wall, at, half.extend(0.015), 0.0, frame);
        let inner = half - Vec2::splat(0.05);
        self.mount(wall, at, inner.extend(0.02), 0.0, outside);
        if let Some(pane) = self.primitives.last_mut() {
            pane.casts_shadow = false;
        }
        if self.accepts_extras() {
            self.mount(wall, at, Vec3::new(0.02, inner.y, 0.03), 0.0, frame);
            self.mount(wall, at, Vec3::new(inner.x, 0.018, 0.028), 0.0, frame);
        }
    }

    /// Adds a shelf, which is a top for small objects.
    fn shelf(&mut self) {
        let half = Vec3::new(self.rng.range(0.2, 0.8), 0.015, self.rng.range(0.07, 0.16));
        let Some((w, at)) = self.free_spot(Vec2::new(half.x, 0.2), [0.9, 1.9]) else { return };
        let material = self.material(Role::Furniture);
        self.mount(w, at, half, 0.0, material);
        let wall = self.walls()[w];
        let centre = wall.foot + wall.axes * Vec3::new(at.x, -at.y - half.y, half.z);
        self.tops.push(Top { centre, axes: wall.axes, half: Vec2::new(half.x, half.z) });
    }

    /// Adds an emissive globe on a cord at the lamp's position, in half of the rooms.
    pub(super) fn add_lamp(&mut self, position: Vec3) {
        let mut rng = self.rng.fork(3);
        let shown = rng.chance(0.5);
        let radius = rng.range(0.07, 0.13);
        if !shown || self.primitives.iter().any(|p| p.distance(position) < radius) {
            return;
        }
        let globe = Material::new(Role::Ceiling, &self.palette, &mut rng).into_emissive(4.0);
        let globe = self.add_material(globe);
        let cord = self.material(Role::Furniture);
        let half = Vec3::new(0.006, 0.5 * (self.size.y + position.y), 0.006);
        let middle = position - Vec3::Y * half.y;
        self.add(Form::Ellipsoid, position, Mat3::IDENTITY, Vec3::splat(radius), globe);
        self.add(Form::Cylinder, middle, Mat3::IDENTITY, half, cord);
        for part in self.primitives.iter_mut().rev().take(2) {
            part.casts_shadow = false;
        }
    }

    /// Adds a niche: a dark back within four boards that extend from the wall.
    fn niche(&mut self) {
        let half = Vec2::new(self.rng.range(0.15, 0.5), self.rng.range(0.15, 0.5));
        let Some((wall, at)) = self.free_spot(half, [0.8, 1.8]) else { return };
        let (back, board) = (self.material(Role::Furniture), self.material(Role::Furniture));
        let depth = self.rng.range(0.05, 0.14);
        let thick = 0.012;
        self.mount(wall, at, half.extend(0.004), 0.0, back);
        if self.accepts_extras() {
            for side in [-1.0, 1.0] {
                let up = at + Vec2::Y * side * (half.y - thick);
                self.mount(wall, up, Vec3::new(half.x, thick, depth), 0.0, board);
                let along = at + Vec2::X * side * (half.x - thick);
                self.mount(wall, along, Vec3::new(thick, half.y, depth), 0.0, board);
            }
        }
    }
}
