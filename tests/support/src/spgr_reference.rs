//! Sub-pixel Gaussian reparameterization in tensor operations (SubSplat 3.2, A.3): the
//! reference for the fused op `subsplat::network::ops::spgr`, with candle's gradients to head
//! records and parents.
//!
//! The choice of the primary view, the growth factor c of the minimum footprint (it
//! would cancel the scale's own gradient) and the share of a disc step are constants of
//! the graph. Every 3-vector is three tensors `[n, 1]` (parent) or `[n, K]` (child).

use candle_core::{Result, Tensor};
use glam::Vec3;
use subsplat::network::ops::redistribute::{OpacityRule, redistribute};
use subsplat::network::ops::spgr::{Rules, Spgr};
use subsplat_kernels::layout::{
    AMinMode, AREA_SQ_EPS, AreaAt, DEPTH_FRACTION_MIN, DepthDir, DepthUnit, FRUSTUM_MARGIN,
    GROWTH_MAX, GainSpace, HEAD_DEPTH_OFFSET, HEAD_GAIN_OFFSET, HEAD_LOG_SCALE_OFFSET,
    HEAD_LOGIT_OFFSET, HEAD_ROTATION_OFFSET, HEAD_UV_OFFSET, MEAN_OFFSET, OPACITY_OFFSET,
    Positions, PrimaryView, QUAT_OFFSET, SCALE_OFFSET, Slide, VISIBLE_Z_MIN,
};

type V3 = [Tensor; 3];

fn mul(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    a.broadcast_mul(b)
}

fn add(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    a.broadcast_add(b)
}

fn sub(a: &Tensor, b: &Tensor) -> Result<Tensor> {
    a.broadcast_sub(b)
}

fn scaled(a: &Tensor, factor: f64) -> Result<Tensor> {
    a.affine(factor, 0.0)
}

fn dot(a: &V3, b: &V3) -> Result<Tensor> {
    add(&add(&mul(&a[0], &b[0])?, &mul(&a[1], &b[1])?)?, &mul(&a[2], &b[2])?)
}

/// Σ_i rows[i][j]·v[i]: the transpose of `rows` times v.
fn transposed(rows: &[V3; 3], v: &V3) -> Result<V3> {
    let column = |j: usize| dot(&[rows[0][j].clone(), rows[1][j].clone(), rows[2][j].clone()], v);
    Ok([column(0)?, column(1)?, column(2)?])
}

fn times(rows: &[V3; 3], v: &V3) -> Result<V3> {
    Ok([dot(&rows[0], v)?, dot(&rows[1], v)?, dot(&rows[2], v)?])
}

/// Numbers of the primary view of each parent, `[n, 1]` each.
struct View {
    rotation: [V3; 3],
    position: V3,
    focal: [Tensor; 2],
    z_min: Tensor,
    low: [Tensor; 2],
    high: [Tensor; 2],
}

impl View {
    /// Looks the chosen view of each parent up in a table of all.
    fn new(call: &Spgr, chosen: &[u32], like: &Tensor) -> Result<Self> {
        let mut table = Vec::new();
        for (camera, &near) in call.cameras.iter().zip(&call.near) {
            let k = camera.intrinsics();
            let r = camera.rotation();
            for i in 0..3 {
                table.extend(r.row(i).to_array().map(f64::from));
            }
            table.extend(camera.position().to_array().map(f64::from));
            let focal = [f64::from(k.fx), f64::from(k.fy)];
            let centre = [f64::from(k.cx), f64::from(k.cy)];
            let size = [k.width as f64, k.height as f64];
            table.extend(focal);
            table.push((0.01 * f64::from(near)).max(1e-3));
            for i in 0..2 {
                let margin = FRUSTUM_MARGIN * 0.5 * size[i] / focal[i];
                table.push(-centre[i] / focal[i] - margin);
                table.push((size[i] - centre[i]) / focal[i] + margin);
            }
        }
        let (views, device) = (call.cameras.len(), like.device());
        let width = table.len() / views;
        let table = Tensor::from_vec(table, (views, width), device)?.to_dtype(like.dtype())?;
        let index = Tensor::from_vec(chosen.to_vec(), chosen.len(), device)?;
        let rows = table.index_select(&index, 0)?;
        let column = |i: usize| rows.narrow(1, i, 1);
        let vector = |i: usize| -> Result<V3> { Ok([column(i)?, column(i + 1)?, column(i + 2)?]) };
        Ok(Self {
            rotation: [vector(0)?, vector(3)?, vector(6)?],
            position: vector(9)?,
            focal: [column(12)?, column(13)?],
            z_min: column(14)?,
            low: [column(15)?, column(17)?],
            high: [column(16)?, column(18)?],
        })
    }

    /// Rows of the guarded Jacobian at camera point `p`, times `zoom`.
    fn jacobian(&self, p: &V3, zoom: f64) -> Result<[V3; 2]> {
        let z = p[2].broadcast_maximum(&self.z_min)?;
        let row = |i: usize| -> Result<(Tensor, Tensor)> {
            let f = scaled(&self.focal[i], zoom)?.broadcast_div(&z)?;
            let slope = p[i].broadcast_div(&z)?;
            let slope = slope.broadcast_maximum(&self.low[i])?.broadcast_minimum(&self.high[i])?;
            Ok((f.clone(), mul(&f, &slope)?.neg()?))
        };
        let ((fx, gx), (fy, gy)) = (row(0)?, row(1)?);
        let zero = fx.zeros_like()?;
        Ok([[fx, zero.clone(), gx], [zero, fy, gy]])
    }

    /// Rows of R_w2c·R(q)·diag(s).
    fn ellipsoid(&self, quat: &[Tensor; 4], scale: &V3) -> Result<[V3; 3]> {
        let r = matrix(quat)?;
        let row = |i: usize| -> Result<V3> {
            let w: V3 = std::array::from_fn(|m| self.rotation[m][i].clone());
            let turned = transposed(&r, &w)?;
            Ok([
                mul(&turned[0], &scale[0])?,
                mul(&turned[1], &scale[1])?,
                mul(&turned[2], &scale[2])?,
            ])
        };
        Ok([row(0)?, row(1)?, row(2)?])
    }
}

/// Rows of the rotation matrix of a unit quaternion.
fn matrix([w, x, y, z]: &[Tensor; 4]) -> Result<[V3; 3]> {
    let on = |a: &Tensor, b: &Tensor| -> Result<Tensor> {
        add(&mul(a, a)?, &mul(b, b)?)?.affine(-2.0, 1.0)
    };
    let off = |a: &Tensor, b: &Tensor, c: &Tensor, sign: f64| -> Result<Tensor> {
        scaled(&add(&mul(a, b)?, &scaled(&mul(w, c)?, sign)?)?, 2.0)
    };
    Ok([
        [on(y, z)?, off(x, y, z, -1.0)?, off(x, z, y, 1.0)?],
        [off(x, y, z, 1.0)?, on(x, z)?, off(y, z, x, -1.0)?],
        [off(x, z, y, -1.0)?, off(y, z, x, 1.0)?, on(x, y)?],
    ])
}

/// Hamilton product.
fn multiply(a: &[Tensor; 4], b: &[Tensor; 4]) -> Result<[Tensor; 4]> {
    let sum = |terms: [(usize, usize, f64); 4]| -> Result<Tensor> {
        let mut total: Option<Tensor> = None;
        for (i, j, sign) in terms {
            let term = scaled(&mul(&a[i], &b[j])?, sign)?;
            total = Some(match total {
                Some(t) => t.add(&term)?,
                None => term,
            });
        }
        total.ok_or_else(|| candle_core::Error::Msg("empty sum".to_owned()))
    };
    Ok([
        sum([(0, 0, 1.0), (1, 1, -1.0), (2, 2, -1.0), (3, 3, -1.0)])?,
        sum([(0, 1, 1.0), (1, 0, 1.0), (2, 3, 1.0), (3, 2, -1.0)])?,
        sum([(0, 2, 1.0), (1, 3, -1.0), (2, 0, 1.0), (3, 1, 1.0)])?,
        sum([(0, 3, 1.0), (1, 2, 1.0), (2, 1, -1.0), (3, 0, 1.0)])?,
    ])
}

fn normalise(q: &[Tensor; 4]) -> Result<[Tensor; 4]> {
    let mut squared = q[0].sqr()?;
    for v in &q[1..] {
        squared = add(&squared, &v.sqr()?)?;
    }
    let inverse = squared.maximum(AREA_SQ_EPS)?.sqrt()?.recip()?;
    Ok([mul(&q[0], &inverse)?, mul(&q[1], &inverse)?, mul(&q[2], &inverse)?, mul(&q[3], &inverse)?])
}

/// Quaternion of a rotation vector, by series below 1e-3 radians: no 0/0, and the
/// gradient at zero is that of ½·r.
fn exponential(r: &V3) -> Result<[Tensor; 4]> {
    let squared = dot(r, r)?;
    let small = squared.lt(1e-6)?;
    let theta = squared.maximum(1e-6)?.sqrt()?;
    let half = scaled(&theta, 0.5)?;
    let s = small.where_cond(&squared.affine(-0.5 / 24.0, 0.5)?, &half.sin()?.div(&theta)?)?;
    let w = small.where_cond(&squared.affine(-0.125, 1.0)?, &half.cos()?)?;
    Ok([w, mul(&s, &r[0])?, mul(&s, &r[1])?, mul(&s, &r[2])?])
}

/// M = J·R·S, 2×3.
struct Footprint([V3; 2]);

impl Footprint {
    fn new(j: &[V3; 2], ellipsoid: &[V3; 3]) -> Result<Self> {
        Ok(Self([transposed(ellipsoid, &j[0])?, transposed(ellipsoid, &j[1])?]))
    }

    fn cross(&self, i: usize, j: usize) -> Result<Tensor> {
        let [a, b] = &self.0;
        sub(&mul(&a[i], &b[j])?, &mul(&a[j], &b[i])?)
    }

    fn area(&self) -> Result<Tensor> {
        let n = [self.cross(1, 2)?, self.cross(2, 0)?, self.cross(0, 1)?];
        dot(&n, &n)?.affine(1.0, AREA_SQ_EPS)?.sqrt()
    }

    fn blurred(&self, area: &Tensor, lowpass: f64) -> Result<Tensor> {
        let trace = add(&dot(&self.0[0], &self.0[0])?, &dot(&self.0[1], &self.0[1])?)?;
        add(&area.sqr()?, &trace.affine(lowpass, lowpass * lowpass)?)?.sqrt()
    }

    /// Factors of the three σ, constants of the graph.
    fn growth(&self, area: &Tensor, rules: &Rules) -> Result<V3> {
        let detached = |v: &V3| [v[0].detach(), v[1].detach(), v[2].detach()];
        let m = Footprint([detached(&self.0[0]), detached(&self.0[1])]);
        let area = area.detach();
        let one = area.ones_like()?;
        let small = area.lt(rules.a_min)?;
        let bounded = |c: Tensor| small.where_cond(&c.minimum(GROWTH_MAX)?, &one);
        if rules.a_min_mode == AMinMode::Iso {
            let c = bounded(area.recip()?.affine(rules.a_min, 0.0)?.sqrt()?)?;
            return Ok([c.clone(), c.clone(), c]);
        }
        let length = |i: usize| add(&m.0[0][i].sqr()?, &m.0[1][i].sqr()?);
        let (l0, l1, l2) = (length(0)?, length(1)?, length(2)?);
        let is = |t: Tensor| t.to_dtype(area.dtype());
        let first = mul(&is(l0.le(&l1)?)?, &is(l0.le(&l2)?)?)?;
        let second = mul(&first.affine(-1.0, 1.0)?, &is(l1.le(&l2)?)?)?;
        let third = add(&first, &second)?.affine(-1.0, 1.0)?;
        let squares = [m.cross(1, 2)?.sqr()?, m.cross(2, 0)?.sqr()?, m.cross(0, 1)?.sqr()?];
        let still = [first, second, third];
        let p = dot(&still, &squares)?;
        let others =
            [still[0].affine(-1.0, 1.0)?, still[1].affine(-1.0, 1.0)?, still[2].affine(-1.0, 1.0)?];
        let q = dot(&others, &squares)?;
        let target = rules.a_min * rules.a_min;
        let root = add(&q.sqr()?, &scaled(&p, 4.0 * target)?)?.sqrt()?;
        let c = bounded(add(&q, &root)?.recip()?.affine(2.0 * target, 0.0)?.sqrt()?)?;
        let factor = |i: usize| add(&mul(&others[i], &c)?, &still[i]);
        Ok([factor(0)?, factor(1)?, factor(2)?])
    }

    fn grown(&self, factors: &V3) -> Result<Self> {
        let row = |v: &V3| -> Result<V3> {
            Ok([mul(&v[0], &factors[0])?, mul(&v[1], &factors[1])?, mul(&v[2], &factors[2])?])
        };
        Ok(Self([row(&self.0[0])?, row(&self.0[1])?]))
    }
}

/// The parents in their primary views, `[n, 1]` each.
struct Parents {
    view: View,
    mean: V3,
    quat: [Tensor; 4],
    scale: V3,
    in_camera: V3,
    z: Tensor,
}

impl Parents {
    fn new(parents: &Tensor, call: &Spgr) -> Result<Self> {
        let lane = |i: usize| parents.narrow(1, i, 1);
        let vector = |i: usize| -> Result<V3> { Ok([lane(i)?, lane(i + 1)?, lane(i + 2)?]) };
        let view = View::new(call, &primary_views(parents, call)?, parents)?;
        let mean = vector(MEAN_OFFSET)?;
        let p = &view.position;
        let offset = [sub(&mean[0], &p[0])?, sub(&mean[1], &p[1])?, sub(&mean[2], &p[2])?];
        let in_camera = transposed(&view.rotation, &offset)?;
        let z = in_camera[2].maximum(&view.z_min)?;
        let q = QUAT_OFFSET;
        Ok(Self {
            mean,
            quat: [lane(q)?, lane(q + 1)?, lane(q + 2)?, lane(q + 3)?],
            scale: vector(SCALE_OFFSET)?,
            view,
            in_camera,
            z,
        })
    }

    fn ellipsoid(&self) -> Result<[V3; 3]> {
        self.view.ellipsoid(&normalise(&self.quat)?, &self.scale)
    }

    /// Lateral camera-frame step for offsets `[n, K]` in input px.
    fn lateral(&self, rules: &Rules, offset: &[Tensor; 2]) -> Result<V3> {
        let flat = |i: usize| mul(&self.z.div(&self.view.focal[i])?, &offset[i]);
        let (x, y) = (flat(0)?, flat(1)?);
        let zero = x.zeros_like()?;
        let flat = [x, y, zero];
        if rules.slide == Slide::ZConst {
            return Ok(flat);
        }
        let g = self.ellipsoid()?;
        let f = [self.view.focal[0].div(&self.z)?, self.view.focal[1].div(&self.z)?];
        let slope = |i: usize| f[i].mul(&self.in_camera[i])?.div(&self.z)?.neg();
        let none = self.z.zeros_like()?;
        let j = [[f[0].clone(), none.clone(), slope(0)?], [none, f[1].clone(), slope(1)?]];
        let m = Footprint::new(&j, &g)?;
        let area = m.area()?.sqr()?;
        let solid = area.gt(1e-20)?;
        let det = solid.where_cond(&area, &area.ones_like()?)?;
        let [a, b] = &m.0;
        let (aa, ab, bb) = (dot(a, a)?, dot(a, b)?, dot(b, b)?);
        let wa = sub(&mul(&bb, &offset[0])?, &mul(&ab, &offset[1])?)?.broadcast_div(&det)?;
        let wb = sub(&mul(&aa, &offset[1])?, &mul(&ab, &offset[0])?)?.broadcast_div(&det)?;
        let t = |i: usize| add(&mul(&wa, &a[i])?, &mul(&wb, &b[i])?);
        let slid = times(&g, &[t(0)?, t(1)?, t(2)?])?;
        let tenth = scaled(&self.z.detach(), DEPTH_FRACTION_MIN)?;
        let reach = slid[2].detach().abs()?.broadcast_maximum(&tenth)?;
        let share = tenth.broadcast_div(&reach)?;
        let share = mul(&share, &solid.to_dtype(share.dtype())?)?;
        let mix = |i: usize| add(&flat[i], &mul(&share, &sub(&slid[i], &flat[i])?)?);
        Ok([mix(0)?, mix(1)?, mix(2)?])
    }

    /// Camera-frame step of all children, `[n, K]` each.
    fn step(&self, rules: &Rules, lane: &dyn Fn(usize) -> Result<Tensor>) -> Result<V3> {
        let offset = |i: usize| -> Result<Tensor> {
            let learned = lane(HEAD_UV_OFFSET + i)?;
            let learned = match rules.offset_bound {
                Some(bound) => scaled(&learned.tanh()?, bound)?,
                None => learned,
            };
            let place = |k: usize| {
                let Positions { columns, rows, step } = rules.positions;
                let (columns, rows) = (columns as usize, rows as usize);
                let cell = match (i, step) {
                    (0, _) => k % columns,
                    (_, 0) => k / columns,
                    (_, step) => k * step as usize % rows,
                };
                (cell as f64 + 0.5) / [columns, rows][i] as f64 - 0.5
            };
            let grid: Vec<f64> = (0..rules.children()).map(place).collect();
            let grid = Tensor::from_vec(grid, (1, rules.children()), learned.device())?;
            add(
                &scaled(&learned, 1.0 / (rules.children() as f64).sqrt())?,
                &grid.to_dtype(learned.dtype())?,
            )
        };
        let mut s = self.lateral(rules, &[offset(0)?, offset(1)?])?;
        let mut dz = scaled(&lane(HEAD_DEPTH_OFFSET)?.tanh()?, rules.beta_z)?;
        if rules.depth_unit == DepthUnit::Relative {
            dz = mul(&dz, &self.z)?;
        }
        let least = sub(&scaled(&self.z, DEPTH_FRACTION_MIN - 1.0)?, &s[2])?;
        let dz = dz.broadcast_maximum(&least)?;
        if rules.depth_dir == DepthDir::Ray {
            let depth = add(&self.in_camera[2], &s[2])?.broadcast_maximum(&self.view.z_min)?;
            let share = dz.div(&depth)?;
            for (i, s) in s.iter_mut().enumerate().take(2) {
                *s = add(s, &mul(&share, &add(&self.in_camera[i], s)?)?)?;
            }
        }
        s[2] = add(&s[2], &dz)?;
        Ok(s)
    }

    /// The parents' own footprints, target px², `[n]`.
    fn area(&self, rules: &Rules) -> Result<Tensor> {
        let m = Footprint::new(&self.view.jacobian(&self.in_camera, 1.0)?, &self.ellipsoid()?)?;
        let area = m.area()?;
        let area = match rules.opacity {
            OpacityRule::OpticalDepth => m.blurred(&area, rules.lowpass_input)?,
            _ => area,
        };
        scaled(&area, rules.children() as f64)?.squeeze(1)
    }
}

/// v* of each parent.
fn primary_views(parents: &Tensor, call: &Spgr) -> Result<Vec<u32>> {
    let means = parents.narrow(1, MEAN_OFFSET, 3)?.to_dtype(candle_core::DType::F32)?;
    let means = means.to_vec2::<f32>()?;
    let chosen = means.iter().enumerate().map(|(n, mean)| {
        let source = ((call.first + n) / call.per_view).min(call.cameras.len() - 1);
        if call.rules.primary_view == PrimaryView::Source {
            return source as u32;
        }
        let seen = call.cameras.iter().enumerate().filter_map(|(v, camera)| {
            let p = camera.to_camera(Vec3::new(mean[0], mean[1], mean[2]));
            let (k, at) = (camera.intrinsics(), camera.intrinsics().project(p));
            let inside =
                at.x > 0.0 && at.y > 0.0 && at.x < k.width as f32 && at.y < k.height as f32;
            (inside && p.z > VISIBLE_Z_MIN as f32).then_some((v, p.z))
        });
        let nearest = seen.reduce(|a, b| if b.1 < a.1 { b } else { a });
        nearest.map_or(source, |(v, _)| v) as u32
    });
    Ok(chosen.collect())
}

/// Children `[n·K, 11]` and gains `[n·K]` or `[n·K, 4]`, as
/// `subsplat::network::ops::spgr::spgr`, differentiable in `head` `[n, K, 11]` and `parents`
/// `[n, 11]`.
///
/// # Errors
/// Shapes that do not fit.
pub fn spgr(head: &Tensor, parents: &Tensor, call: &Spgr) -> Result<(Tensor, Tensor)> {
    let rules = &call.rules;
    let (n, k, _) = head.dims3()?;
    let lane = |i: usize| head.narrow(2, i, 1)?.squeeze(2);
    let p = Parents::new(parents, call)?;
    let step = p.step(rules, &lane)?;
    let in_world = times(&p.view.rotation, &step)?;
    let scale = |i: usize| -> Result<Tensor> {
        let soft = scaled(&lane(HEAD_LOG_SCALE_OFFSET + i)?, 1.0 / rules.dlog_clamp)?.tanh()?;
        mul(&scaled(&soft, rules.dlog_clamp)?.exp()?, &scaled(&p.scale[i], rules.lambda_s)?)
    };
    let scale = [scale(0)?, scale(1)?, scale(2)?];
    let turn = [
        lane(HEAD_ROTATION_OFFSET)?,
        lane(HEAD_ROTATION_OFFSET + 1)?,
        lane(HEAD_ROTATION_OFFSET + 2)?,
    ];
    let quat = normalise(&multiply(&p.quat, &exponential(&turn)?)?)?;
    let at = |i: usize| match rules.area_at {
        AreaAt::Parent => Ok(p.in_camera[i].clone()),
        AreaAt::Child => add(&p.in_camera[i], &step[i]),
    };
    let j = p.view.jacobian(&[at(0)?, at(1)?, at(2)?], (rules.children() as f64).sqrt())?;
    let m = Footprint::new(&j, &p.view.ellipsoid(&quat, &scale)?)?;
    let area = m.area()?;
    let growth = m.growth(&area, rules)?;
    let clamped = area.maximum(rules.a_min)?;
    let areas = match rules.opacity {
        OpacityRule::OpticalDepth => m.grown(&growth)?.blurred(&clamped, rules.lowpass_target)?,
        _ => clamped,
    };
    let own = if rules.opacity.areas_are_relative() { Some(p.area(rules)?) } else { None };
    let opacities = parents.narrow(1, OPACITY_OFFSET, 1)?.squeeze(1)?;
    let alpha =
        redistribute(rules.opacity, &lane(HEAD_LOGIT_OFFSET)?, &areas, &opacities, own.as_ref())?;
    let mut lanes = Vec::with_capacity(11);
    for (step, mean) in in_world.iter().zip(&p.mean) {
        lanes.push(add(step, mean)?);
    }
    lanes.extend(quat);
    for (scale, growth) in scale.iter().zip(&growth) {
        lanes.push(mul(scale, growth)?);
    }
    lanes.push(alpha);
    let rows = Tensor::stack(&lanes, 2)?.reshape((n * k, lanes.len()))?;
    Ok((rows, gains(rules, &lane(HEAD_GAIN_OFFSET)?)?))
}

/// γ, or γ and δ three times.
fn gains(rules: &Rules, raw: &Tensor) -> Result<Tensor> {
    let extra = scaled(&raw.tanh()?, rules.delta)?.flatten_all()?;
    let gamma = extra.affine(1.0, 1.0)?;
    if rules.gain_space == GainSpace::Sh {
        return Ok(gamma);
    }
    let residual = scaled(&extra, 0.5)?;
    Tensor::stack(&[&gamma, &residual, &residual, &residual], 1)
}
