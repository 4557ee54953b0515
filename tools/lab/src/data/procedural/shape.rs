//! The four solids of a room and their intersections with rays.
//!
//! World units are metres. The local frame of a solid has its axes along x, y, z and its centre at
//! the origin.

use glam::{Mat3, Vec2, Vec3};

/// Smallest ray parameter of a hit. It excludes the surface at the origin of a reflected or shadow
/// ray.
const T_MIN: f32 = 1e-4;

/// Kind of a solid.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Form {
    /// A box seen from inside: the shell of the room, with six materials, one per face.
    Shell,
    /// A box.
    Block,
    /// An ellipsoid.
    Ellipsoid,
    /// A capped cylinder along its local y, elliptic in x and z.
    Cylinder,
}

/// A placed solid.
#[derive(Clone, Debug)]
pub(super) struct Primitive {
    pub(super) form: Form,
    pub(super) centre: Vec3,
    /// Local axes as columns, world frame.
    pub(super) world_from_local: Mat3,
    local_from_world: Mat3,
    /// Half sizes along the local axes, m.
    pub(super) half: Vec3,
    /// Radius of the bounding sphere around the centre, m.
    pub(super) radius: f32,
    /// Index of the material; of the first of six for [`Form::Shell`].
    pub(super) material: usize,
    /// False for emissive solids.
    pub(super) casts_shadow: bool,
}

/// A ray. The direction may have any length, and the parameter of a hit is in units of that length.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ray {
    pub(super) origin: Vec3,
    pub(super) direction: Vec3,
}

impl Ray {
    /// Returns the point at parameter `t`.
    pub(super) fn at(&self, t: f32) -> Vec3 {
        self.origin + self.direction * t
    }
}

/// Surface properties at a hit.
#[derive(Clone, Copy, Debug)]
pub(super) struct Surface {
    /// Unit normal, world frame, directed out of the solid (into the room for the shell).
    pub(super) normal: Vec3,
    /// Position on the surface, m.
    pub(super) uv: Vec2,
    /// Face 0 to 5 of a box: axis and sign, −x, +x, −y, +y, −z, +z; 0 otherwise.
    pub(super) face: usize,
}

impl Primitive {
    /// Places a solid with material 0.
    pub(super) fn new(form: Form, centre: Vec3, world_from_local: Mat3, half: Vec3) -> Self {
        let radius = match form {
            Form::Shell | Form::Block => half.length(),
            Form::Ellipsoid => half.max_element(),
            Form::Cylinder => half.x.max(half.z).hypot(half.y),
        };
        Self {
            form,
            centre,
            world_from_local,
            local_from_world: world_from_local.transpose(),
            half,
            radius,
            material: 0,
            casts_shadow: form != Form::Shell,
        }
    }

    /// Returns true for the shell of the room.
    pub(super) fn is_shell(&self) -> bool {
        self.form == Form::Shell
    }

    /// Transforms a world point to the local frame.
    fn to_local(&self, in_world: Vec3) -> Vec3 {
        self.local_from_world * (in_world - self.centre)
    }

    /// Returns the smallest parameter in (T_MIN, `t_max`) at which the ray enters the solid (leaves
    /// it, for the shell). A ray that starts inside a solid does not hit it.
    pub(super) fn intersect(&self, ray: &Ray, t_max: f32) -> Option<f32> {
        let offset = ray.origin - self.centre;
        if self.form != Form::Shell {
            let along = offset.dot(ray.direction);
            let outside = offset.length_squared() - self.radius * self.radius;
            // Discriminant of the bounding sphere's quadratic.
            let hit = along * along - ray.direction.length_squared() * outside;
            if hit < 0.0 || (along > 0.0 && outside > 0.0) {
                return None;
            }
        }
        let (o, d) = (self.local_from_world * offset, self.local_from_world * ray.direction);
        let t = match self.form {
            Form::Shell => slabs(o, d, self.half).1,
            Form::Block => {
                let (enter, leave) = slabs(o, d, self.half);
                if enter > leave {
                    return None;
                }
                enter
            }
            Form::Ellipsoid => ellipsoid(o / self.half, d / self.half)?,
            Form::Cylinder => cylinder(o / self.half, d / self.half)?,
        };
        (t > T_MIN && t < t_max).then_some(t)
    }

    /// Returns the surface properties near `in_world`, a point on the surface up to rounding.
    pub(super) fn surface(&self, in_world: Vec3) -> Surface {
        let p = self.to_local(in_world);
        let (normal, uv, face) = match self.form {
            Form::Shell | Form::Block => {
                let depth = p.abs() - self.half;
                let (axis, positive) = largest(depth, p);
                let mut normal = Vec3::ZERO;
                normal[axis] = if positive { 1.0 } else { -1.0 };
                if self.form == Form::Shell {
                    normal = -normal;
                }
                (normal, face_uv(p, axis), 2 * axis + usize::from(positive))
            }
            Form::Ellipsoid => {
                let unit = p / self.half;
                let (axis, _) = largest(unit.abs(), unit);
                (unit / self.half, face_uv(p, axis), 0)
            }
            Form::Cylinder => {
                let radial = Vec2::new(p.x / self.half.x, p.z / self.half.z);
                let out = (radial.length() - 1.0) * self.half.x.min(self.half.z);
                if p.y.abs() - self.half.y > out {
                    (Vec3::new(0.0, p.y.signum(), 0.0), Vec2::new(p.x, p.z), 0)
                } else {
                    let side = Vec3::new(radial.x / self.half.x, 0.0, radial.y / self.half.z);
                    let around = radial.y.atan2(radial.x) * 0.5 * (self.half.x + self.half.z);
                    (side, Vec2::new(around, p.y), 0)
                }
            }
        };
        Surface { normal: (self.world_from_local * normal).normalize_or(Vec3::NEG_Y), uv, face }
    }

    /// Returns the distance from `in_world` to the solid, m; negative inside (outside, for the
    /// shell). It is exact for boxes and first-order for the others.
    pub(super) fn distance(&self, in_world: Vec3) -> f32 {
        let p = self.to_local(in_world);
        match self.form {
            Form::Shell => (self.half - p.abs()).min_element(),
            Form::Block => box_distance(p.abs() - self.half),
            Form::Ellipsoid => {
                let unit = p / self.half;
                implicit_distance(
                    unit.length(),
                    (unit / self.half).length(),
                    self.half.min_element(),
                )
            }
            Form::Cylinder => {
                let half = Vec2::new(self.half.x, self.half.z);
                let unit = Vec2::new(p.x, p.z) / half;
                let out =
                    implicit_distance(unit.length(), (unit / half).length(), half.min_element());
                let up = p.y.abs() - self.half.y;
                out.max(up).min(0.0) + Vec2::new(out, up).max(Vec2::ZERO).length()
            }
        }
    }
}

/// Returns the first-order distance to an ellipse or ellipsoid from `k` = |p/h| and `slope` =
/// |p/h²|: (k − 1) over the length of its gradient.
fn implicit_distance(k: f32, slope: f32, smallest_half: f32) -> f32 {
    if k < 1e-3 { -smallest_half } else { k * (k - 1.0) / slope }
}

/// Returns the distance to a box from the signed distances to its slabs.
fn box_distance(out: Vec3) -> f32 {
    out.max(Vec3::ZERO).length() + out.max_element().min(0.0)
}

/// Returns the axis of the largest entry of `size`, and true if `p` is positive there.
fn largest(size: Vec3, p: Vec3) -> (usize, bool) {
    let axis = if size.x >= size.y && size.x >= size.z {
        0
    } else if size.y >= size.z {
        1
    } else {
        2
    };
    (axis, p[axis] >= 0.0)
}

/// Returns horizontal and vertical position on a face perpendicular to `axis`, m. v is the local y
/// on upright faces.
fn face_uv(p: Vec3, axis: usize) -> Vec2 {
    match axis {
        0 => Vec2::new(p.z, p.y),
        1 => Vec2::new(p.x, p.z),
        _ => Vec2::new(p.x, p.y),
    }
}

/// Returns the parameters at which a line enters and leaves a box of half size `half`. `f32::min`
/// and `max` discard the NaN of 0 · ∞ for a line within a face.
fn slabs(o: Vec3, d: Vec3, half: Vec3) -> (f32, f32) {
    let (mut enter, mut leave) = (f32::NEG_INFINITY, f32::INFINITY);
    for axis in 0..3 {
        let inverse = 1.0 / d[axis];
        let a = (-half[axis] - o[axis]) * inverse;
        let b = (half[axis] - o[axis]) * inverse;
        enter = enter.max(a.min(b));
        leave = leave.min(a.max(b));
    }
    (enter, leave)
}

/// Returns the first parameter on the unit sphere.
fn ellipsoid(o: Vec3, d: Vec3) -> Option<f32> {
    let a = d.length_squared();
    let b = o.dot(d);
    // |o|² − b²/a is the squared distance of line and centre. It has less cancellation than b² − a·c for a small, distant sphere.
    let nearest = o - d * (b / a);
    let inside = 1.0 - nearest.length_squared();
    (inside > 0.0).then(|| -b / a - (inside / a).sqrt())
}

/// Returns the first parameter on the unit cylinder |x, z| ≤ 1, |y| ≤ 1.
fn cylinder(o: Vec3, d: Vec3) -> Option<f32> {
    let (o2, d2) = (Vec2::new(o.x, o.z), Vec2::new(d.x, d.z));
    let (mut enter, mut leave) = (f32::NEG_INFINITY, f32::INFINITY);
    let a = d2.length_squared();
    if a > 1e-12 {
        let middle = -o2.dot(d2) / a;
        let inside = 1.0 - (o2 + d2 * middle).length_squared();
        if inside <= 0.0 {
            return None;
        }
        let reach = (inside / a).sqrt();
        (enter, leave) = (middle - reach, middle + reach);
    } else if o2.length_squared() > 1.0 {
        return None;
    }
    let inverse = 1.0 / d.y;
    let c = (-1.0 - o.y) * inverse;
    let e = (1.0 - o.y) * inverse;
    enter = enter.max(c.min(e));
    leave = leave.min(c.max(e));
    (enter <= leave).then_some(enter)
}

#[cfg(test)]
mod tests {
    use super::super::rng::Rng;
    use super::*;
    use glam::{EulerRot, Quat};

    fn vector(rng: &mut Rng, reach: f32) -> Vec3 {
        Vec3::new(rng.range(-reach, reach), rng.range(-reach, reach), rng.range(-reach, reach))
    }

    fn placed(form: Form, rng: &mut Rng) -> Primitive {
        let q = Quat::from_euler(
            EulerRot::XYZ,
            rng.range(-3.0, 3.0),
            rng.range(-1.5, 1.5),
            rng.range(-3.0, 3.0),
        );
        let half = Vec3::new(rng.range(0.1, 1.0), rng.range(0.1, 1.0), rng.range(0.1, 1.0));
        Primitive::new(form, vector(rng, 1.0), Mat3::from_quat(q), half)
    }

    /// Advances along the ray by a hundredth of the smallest size until the sign of the solid's
    /// implicit function changes.
    fn marched(p: &Primitive, ray: &Ray) -> Option<f32> {
        let inside = |t: f32| {
            let q = p.to_local(ray.at(t)) / p.half;
            match p.form {
                Form::Shell | Form::Block => q.abs().max_element() < 1.0,
                Form::Ellipsoid => q.length() < 1.0,
                Form::Cylinder => q.y.abs() < 1.0 && q.x.hypot(q.z) < 1.0,
            }
        };
        let start = inside(T_MIN);
        (0..8000).map(|i| T_MIN + i as f32 * 1e-3).find(|t| inside(*t) != start)
    }

    #[test]
    fn hits_agree_with_marching() {
        let mut rng = Rng::new(5);
        for form in [Form::Shell, Form::Block, Form::Ellipsoid, Form::Cylinder] {
            let (mut hits, mut misses) = (0, 0);
            for _ in 0..300 {
                let p = placed(form, &mut rng);
                let origin = if form == Form::Shell {
                    p.centre + p.world_from_local * (p.half * vector(&mut rng, 0.9))
                } else {
                    p.centre + vector(&mut rng, 1.0).normalize() * 3.0
                };
                let aim = p.centre + vector(&mut rng, 0.8);
                let ray = Ray { origin, direction: (aim - origin).normalize() };
                match (p.intersect(&ray, 1e9), marched(&p, &ray)) {
                    (Some(t), Some(m)) => {
                        assert!((t - m).abs() < 2e-3, "{form:?}: {t} {m}");
                        assert!(p.distance(ray.at(t)).abs() < 1e-4);
                        let outward = p.surface(ray.at(t)).normal.dot(ray.direction);
                        assert!(outward < 1e-4, "{form:?} normal along the ray: {outward}");
                        hits += 1;
                    }
                    (None, None) => misses += 1,
                    // A grazing hit shorter than a step.
                    (Some(t), None) => {
                        assert!(p.distance(ray.at(t + 1e-3)).abs() < 2e-3);
                    }
                    (None, Some(m)) => panic!("{form:?} missed at {m}"),
                }
            }
            assert!(hits > 60 && (misses > 30 || form == Form::Shell), "{form:?} {hits} {misses}");
        }
    }

    #[test]
    fn normals_are_gradients_of_distance() {
        let mut rng = Rng::new(6);
        for form in [Form::Shell, Form::Block, Form::Ellipsoid, Form::Cylinder] {
            for _ in 0..100 {
                let p = placed(form, &mut rng);
                let ray = Ray {
                    origin: p.centre + if form == Form::Shell { 0.0 } else { 3.0 } * Vec3::Y,
                    direction: vector(&mut rng, 1.0)
                        - if form == Form::Shell { 0.0 } else { 3.0 } * Vec3::Y,
                };
                let Some(t) = p.intersect(&ray, 1e9) else { continue };
                let (point, h) = (ray.at(t), 2e-3);
                let normal = p.surface(point).normal;
                // The distance increases along the normal with slope 1.
                let step = |v: Vec3| (p.distance(point + v * h) - p.distance(point)) / h;
                assert!((step(normal) - 1.0).abs() < 0.05, "{form:?} {}", step(normal));
            }
        }
    }

    #[test]
    fn a_ray_along_a_face_does_not_yield_nan() {
        let p = Primitive::new(Form::Block, Vec3::ZERO, Mat3::IDENTITY, Vec3::ONE);
        let ray = Ray { origin: Vec3::new(-3.0, 1.0, 0.0), direction: Vec3::X };
        assert!(p.intersect(&ray, 1e9).is_none_or(|t| (t - 2.0).abs() < 1e-6));
        let c = Primitive::new(Form::Cylinder, Vec3::ZERO, Mat3::IDENTITY, Vec3::ONE);
        let down = Ray { origin: Vec3::new(0.3, -3.0, 0.0), direction: Vec3::Y };
        assert!((c.intersect(&down, 1e9).unwrap() - 2.0).abs() < 1e-6);
    }
}
