//! Head records straight to footprints, against children in memory and the
//! rasterizer's own projection.

use subsplat_test_support::scenes;
use subsplat_test_support::spgr_calls;

use candle_core::DType;
use glam::{Mat4, Quat, Vec3};
use scenes::*;
use spgr_calls::*;
use subsplat::network::config::*;
use subsplat::network::ops::spgr::Spgr;
use subsplat_kernels::camera::Camera;
use subsplat_kernels::cpu::raster::ewa::Footprint;
use subsplat_kernels::cpu::spgr as kernel;
use subsplat_kernels::cpu::spgr::{Args, Target};
use subsplat_kernels::cpu::{Geometry, Rasterizer, SplatSlices};
use subsplat_kernels::layout::{
    Convention, RasterOptions, SPLAT_STRIDE, ShBasis, ShDirection, sh_coefficients,
};

struct Scene {
    call: Spgr,
    head: Vec<f32>,
    parents: Vec<f32>,
    sh: Vec<f32>,
    degree: usize,
}

impl Scene {
    fn new(config: &Config, degree: usize, seed: u64) -> Self {
        let call = call(config, 13);
        let mut r = Random(seed);
        let p = parents(&call.cameras, &mut r);
        let n = p.dim(0).unwrap();
        let h = head(n, call.rules.children(), 0.5, DType::F32, &mut r);
        let set = 3 * sh_coefficients(degree);
        let sh = r.normals(n * set, 0.3).iter().map(|&v| v as f32).collect();
        let flat = |t: &candle_core::Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
        Self { head: flat(&h), parents: flat(&p), call, sh, degree }
    }

    fn args(&self) -> Args<'_, f32> {
        let Spgr { rules, cameras, near, per_view, first } = &self.call;
        let source = kernel::Source { cameras, near, per_view: *per_view, first: *first };
        Args { rules, source, head: &self.head, parents: &self.parents }
    }

    fn len(&self) -> usize {
        self.parents.len() / SPLAT_STRIDE * self.call.rules.children()
    }

    fn direct(&self, camera: &Camera, options: &RasterOptions) -> (bool, Vec<Footprint>) {
        let target = Target { camera, options, sh: &self.sh, sh_degree: self.degree };
        let mut out = vec![Footprint::default(); self.len()];
        let finite = kernel::project(self.args(), target, &mut out);
        (finite, out)
    }

    /// Through children in memory.
    fn by_rows(&self, camera: &Camera, options: &RasterOptions) -> Vec<Footprint> {
        let mut rows = vec![0f32; self.len() * SPLAT_STRIDE];
        let mut gain = vec![0f32; self.len() * self.call.rules.gain_channels()];
        assert!(kernel::forward(self.args(), &mut rows, &mut gain));
        let splats = SplatSlices {
            geometry: Geometry::Packed(&rows),
            sh: &self.sh,
            gain: &gain,
            sh_degree: self.degree,
        };
        let mut raster = Rasterizer::new();
        raster.render(&splats, camera, options);
        raster.footprints().to_vec()
    }
}

/// A camera beside the context views, with a part of the scene in its picture and pixels
/// `zoom` times finer.
fn beside(scene: &Scene, zoom: f32) -> Camera {
    let camera = scene.call.cameras[0];
    let turn = Quat::from_euler(glam::EulerRot::XYZ, 0.1, -0.25, 0.3);
    let step = Mat4::from_rotation_translation(turn, Vec3::new(0.4, 0.1, 1.5));
    let mut k = camera.intrinsics();
    (k.fx, k.fy, k.cx, k.cy) = (k.fx * zoom, k.fy * zoom, k.cx * zoom, k.cy * zoom);
    (k.width, k.height) = ((k.width as f32 * zoom) as usize, (k.height as f32 * zoom) as usize);
    Camera::new(k, camera.world_from_camera() * step).unwrap()
}

fn numbers(f: &Footprint) -> [f32; 12] {
    [
        f.u,
        f.v,
        f.sx,
        f.shear,
        f.sy,
        f.power,
        f.rgb[0],
        f.rgb[1],
        f.rgb[2],
        f.z,
        f.half_width,
        f.half_height,
    ]
}

#[track_caller]
fn assert_same(got: &[Footprint], want: &[Footprint], what: &str) {
    assert_eq!(got.len(), want.len());
    let (mut visible, mut differ) = (0, 0);
    for (i, (g, w)) in got.iter().zip(want).enumerate() {
        visible += usize::from(w.visible());
        let extent = |f: &Footprint| [f.x0, f.y0, f.x1, f.y1];
        // Rounding may move a border that falls on a pixel centre.
        if g.visible() != w.visible() || extent(g) != extent(w) {
            differ += 1;
            continue;
        }
        for (lane, (a, b)) in numbers(g).into_iter().zip(numbers(w)).enumerate() {
            assert!((a - b).abs() <= 5e-4 * b.abs().max(0.2), "{what} {i} lane {lane}: {a} {b}");
        }
    }
    assert!(visible > got.len() / 10, "{what}: only {visible} visible");
    assert!(differ <= 2 + visible / 500, "{what}: {differ} extents of {visible} differ");
    // Dropped splats have no field set.
    assert!(got.iter().filter(|f| !f.visible()).all(|f| *f == Footprint::default()));
}

#[test]
fn direct_footprints_are_those_of_children_in_memory() {
    for side in [1, 2, 4] {
        for (i, (name, config)) in variants(side).into_iter().enumerate() {
            let scene = Scene::new(&config, i % 5, 41 + i as u64);
            for convention in [Convention::Standard, Convention::Mvsplat] {
                for sh_direction in [ShDirection::Child, ShDirection::Parent] {
                    let antialiased = convention == Convention::Standard && i % 2 == 0;
                    let sh_basis = [ShBasis::Standard, ShBasis::Mvsplat][i % 2];
                    let options = RasterOptions {
                        sh_direction,
                        sh_basis,
                        antialiased,
                        ..RasterOptions::new(convention)
                    };
                    let camera = beside(&scene, 2.0 * side as f32);
                    let (finite, got) = scene.direct(&camera, &options);
                    assert!(finite, "{name}");
                    let what = format!("{name} {convention:?} {sh_direction:?}");
                    assert_same(&got, &scene.by_rows(&camera, &options), &what);
                }
            }
        }
    }
}

#[test]
fn degrees_above_the_options_are_not_evaluated() {
    let scene = Scene::new(&Config::x2(), 4, 43);
    let camera = beside(&scene, 4.0);
    for sh_degree in 0..=4 {
        let options = RasterOptions { sh_degree, ..RasterOptions::default() };
        let (_, got) = scene.direct(&camera, &options);
        assert_same(&got, &scene.by_rows(&camera, &options), &format!("degree {sh_degree}"));
    }
}

#[test]
fn any_number_of_threads_projects_the_same_bytes() {
    let scene = Scene::new(&Config::x2(), 3, 44);
    let camera = beside(&scene, 4.0);
    let options = RasterOptions::default();
    let run = |n: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(n).build().unwrap();
        pool.install(|| scene.direct(&camera, &options).1)
    };
    assert!(run(1) == run(2));
}

#[test]
fn a_record_that_is_not_a_number_is_reported_and_kept_apart() {
    let mut scene = Scene::new(&Config::x2(), 1, 45);
    let camera = beside(&scene, 4.0);
    let options = RasterOptions::default();
    let (_, clean) = scene.direct(&camera, &options);
    scene.head[44 * 30 + 5] = f32::INFINITY;
    let (finite, got) = scene.direct(&camera, &options);
    assert!(!finite);
    assert!(got[..120] == clean[..120] && got[124..] == clean[124..]);
}
