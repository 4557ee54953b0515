//! The parts of MVSplat's encoder that the reference outputs (two square views) do not
//! reach, against naive readings of the specification: three views, non-square
//! pictures, several Gaussians per pixel.

use candle_core::{Device, Result, Tensor};
use glam::{Mat4, Quat, Vec3};
use std::collections::BTreeMap;
use subsplat::network::config::Mvsplat as Settings;
use subsplat::network::model::Views;
use subsplat::network::model::backbone::Mvsplat;
use subsplat::network::model::backbone::unet::UNet;
use subsplat::network::model::primaries::primaries;
use subsplat::network::model::trace::Trace;
use subsplat::network::model::weights::Weights;
use subsplat_kernels::camera::{Camera, Intrinsics, NearFar};

/// MVSplat with narrow layers: the same code at a hundredth of the work.
fn narrow() -> Settings {
    Settings {
        cnn_channels: [8, 12, 16],
        transformer_layers: 2,
        depth_candidates: 24,
        costvolume_channels: 32,
        refine_levels: 3,
        ..Settings::re10k()
    }
}

/// Seeded weights without dead branches: the zero-initialised norms get values.
fn lively(settings: &Settings) -> BTreeMap<String, Tensor> {
    let start = Weights::seeded(11).trainable();
    Mvsplat::new(settings, start.builder()).unwrap();
    let mut out = BTreeMap::new();
    for (i, (name, var)) in start.variables().into_iter().enumerate() {
        let mut t = var.as_tensor().detach();
        if name.contains("norm") || t.rank() == 1 {
            let wave: Vec<f32> =
                (0..t.elem_count()).map(|k| 0.3 * ((k * 7 + i) as f32).sin() + 0.4).collect();
            t = (t + Tensor::from_vec(wave, var.shape(), &Device::Cpu).unwrap()).unwrap();
        }
        out.insert(name, t);
    }
    out
}

fn pictures(views: usize, h: usize, w: usize) -> Tensor {
    let value = |i: usize| {
        let (x, y, c) = ((i % w) as f32, (i / w % h) as f32, (i / (w * h)) as f32);
        0.5 + 0.25 * (0.37 * x + 0.9 * c).sin() + 0.25 * (0.23 * y - 1.3 * c + 0.01 * x * y).cos()
    };
    let data: Vec<f32> = (0..views * 3 * h * w).map(value).collect();
    Tensor::from_vec(data, (1, views, 3, h, w), &Device::Cpu).unwrap()
}

/// Posed views with a focal length and a principal point each of their own.
fn posed(views: usize, h: usize, w: usize) -> Views {
    let camera = |i: usize| {
        let f = i as f32;
        let k = Intrinsics {
            fx: 0.9 * w as f32 + 5.0 * f,
            fy: 0.8 * w as f32 - 3.0 * f,
            cx: 0.48 * w as f32 + f,
            cy: 0.53 * h as f32 - f,
            width: w,
            height: h,
        };
        let turn = Quat::from_euler(glam::EulerRot::XYZ, 0.05 * f, -0.1 * f, 0.03 * f);
        let at = Vec3::new(0.3 * f, -0.1 * f * f, 0.15 * f);
        Camera::new(k, Mat4::from_rotation_translation(turn, at)).unwrap()
    };
    let near_far = (0..views).map(|i| NearFar::new(0.8 + 0.1 * i as f32, 40.0)).collect();
    Views::new(pictures(views, h, w), vec![(0..views).map(camera).collect()], vec![near_far])
        .unwrap()
}

fn flat(t: &Tensor) -> Vec<f64> {
    t.flatten_all().unwrap().to_vec1::<f32>().unwrap().into_iter().map(f64::from).collect()
}

fn traced(weights: &BTreeMap<String, Tensor>, s: &Settings, v: &Views) -> BTreeMap<String, Tensor> {
    let encoder = Mvsplat::new(s, Weights::from_tensors(weights.clone()).builder()).unwrap();
    let mut seen = BTreeMap::new();
    let mut look = |name: &str, t: &Tensor| {
        seen.insert(name.to_owned(), t.clone());
        Ok(())
    };
    encoder.forward(v, &mut Trace::to(&mut look)).unwrap();
    seen
}

/// Largest |a − b| over largest |b|.
fn far(a: &[f64], b: &[f64]) -> f64 {
    assert_eq!(a.len(), b.len());
    let top = |x: f64, y: f64| if y > x || y.is_nan() { y } else { x };
    let size = b.iter().map(|v| v.abs()).fold(0.0, top);
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, top) / size
}

/// One token's feature.
type Token = Vec<f64>;
/// `[V][h·w]`, raster order.
type Maps = Vec<Vec<Token>>;

/// The transformer of the specification's section 2, token by token.
struct Naive<'a> {
    weights: &'a BTreeMap<String, Tensor>,
    h: usize,
    w: usize,
    c: usize,
}

impl Naive<'_> {
    fn matrix(&self, name: &str) -> (Vec<f64>, usize) {
        let t = &self.weights[&format!("backbone.transformer.layers.{name}.weight")];
        (flat(t), t.dim(t.rank() - 1).unwrap())
    }

    fn linear(&self, name: &str, x: &[f64]) -> Token {
        let (m, n) = self.matrix(name);
        assert_eq!(n, x.len());
        m.chunks(n).map(|row| row.iter().zip(x).map(|(a, b)| a * b).sum()).collect()
    }

    fn norm(&self, name: &str, x: &[f64]) -> Token {
        let (w, _) = self.matrix(name);
        let b = flat(&self.weights[&format!("backbone.transformer.layers.{name}.bias")]);
        let n = x.len() as f64;
        let mean = x.iter().sum::<f64>() / n;
        let var = x.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n;
        let scaled = x.iter().map(|v| (v - mean) / (var + 1e-5).sqrt());
        scaled.zip(w.iter().zip(b)).map(|(v, (w, b))| v * w + b).collect()
    }

    /// Raster index of the pixel that stands at rolled position (y, x).
    fn unroll(&self, y: usize, x: usize, shift: [usize; 2]) -> usize {
        (y + shift[0]) % self.h * self.w + (x + shift[1]) % self.w
    }

    /// 3·ry + rx of a rolled position, as Swin labels it.
    fn label(&self, y: usize, x: usize, shift: [usize; 2]) -> usize {
        let third = |i: usize, n: usize, s: usize| match i {
            _ if i < n - n / 2 => 0,
            _ if i < n - s => 1,
            _ => 2,
        };
        3 * third(y, self.h, shift[0]) + third(x, self.w, shift[1])
    }

    /// Message of windowed attention from `source` to all of `targets`.
    fn attend(
        &self,
        name: &str,
        source: &[Token],
        targets: &[&Vec<Token>],
        shift: [usize; 2],
    ) -> Vec<Token> {
        let (wh, ww, m) = (self.h / 2, self.w / 2, targets.len());
        let project = |what: &str, map: &[Token]| -> Vec<Token> {
            map.iter().map(|t| self.linear(&format!("{name}.{what}"), t)).collect()
        };
        let q = project("q_proj", source);
        let k: Vec<_> = targets.iter().map(|t| project("k_proj", t)).collect();
        let v: Vec<_> = targets.iter().map(|t| project("v_proj", t)).collect();
        let mut out = vec![Vec::new(); source.len()];
        for window in 0..4 {
            let (top, left) = (window / 2 * wh, window % 2 * ww);
            let places: Vec<(usize, usize)> =
                (0..wh * ww).map(|i| (top + i / ww, left + i % ww)).collect();
            let labels: Vec<usize> = places.iter().map(|&(y, x)| self.label(y, x, shift)).collect();
            let len = places.len();
            for (i, &(y, x)) in places.iter().enumerate() {
                let own = self.unroll(y, x, shift);
                let mut logits = vec![0f64; len * m];
                for (column, logit) in logits.iter_mut().enumerate() {
                    // Keys: position-major, view-minor. Mask: tiled, column mod len.
                    let (position, view) = (column / m, column % m);
                    let at = self.unroll(places[position].0, places[position].1, shift);
                    let dot: f64 = q[own].iter().zip(&k[view][at]).map(|(a, b)| a * b).sum();
                    *logit = dot / (self.c as f64).sqrt();
                    if shift != [0, 0] && labels[i] != labels[column % len] {
                        *logit -= 100.0;
                    }
                }
                let top = logits.iter().copied().fold(f64::NEG_INFINITY, f64::max);
                let e: Vec<f64> = logits.iter().map(|l| (l - top).exp()).collect();
                let sum: f64 = e.iter().sum();
                let mut message = vec![0f64; self.c];
                for (column, e) in e.iter().enumerate() {
                    let (y, x) = places[column / m];
                    let value = &v[column % m][self.unroll(y, x, shift)];
                    message.iter_mut().zip(value).for_each(|(o, v)| *o += e / sum * v);
                }
                let merged = self.linear(&format!("{name}.merge"), &message);
                out[own] = self.norm(&format!("{name}.norm1"), &merged);
            }
        }
        out
    }

    fn layer(&self, index: usize, maps: &Maps) -> Maps {
        let shift = if index % 2 == 1 { [self.h / 4, self.w / 4] } else { [0, 0] };
        let mut out = Vec::new();
        for view in 0..maps.len() {
            let name = format!("{index}.self_attn");
            let own = self.attend(&name, &maps[view], &[&maps[view]], shift);
            let x: Vec<Token> = add(&maps[view], &own);
            let others: Vec<_> = (0..maps.len()).filter(|j| *j != view).map(|j| &maps[j]).collect();
            let name = format!("{index}.cross_attn_ffn");
            let message = self.attend(&name, &x, &others, shift);
            let fed: Vec<Token> = x
                .iter()
                .zip(&message)
                .map(|(x, m)| {
                    let joined = [x.as_slice(), m.as_slice()].concat();
                    let hidden = self.linear(&format!("{name}.mlp.0"), &joined);
                    let hidden: Token = hidden.into_iter().map(gelu).collect();
                    let y = self.linear(&format!("{name}.mlp.2"), &hidden);
                    self.norm(&format!("{name}.norm2"), &y)
                })
                .collect();
            out.push(add(&x, &fed));
        }
        out
    }
}

fn add(a: &[Token], b: &[Token]) -> Vec<Token> {
    let sum = |(a, b): (&Token, &Token)| a.iter().zip(b).map(|(a, b)| a + b).collect();
    a.iter().zip(b).map(sum).collect()
}

/// x·Φ(x) with erf by its series (|x| small enough here), by its limit elsewhere.
fn gelu(x: f64) -> f64 {
    let t = x / 2f64.sqrt();
    let erf = if t.abs() > 4.0 {
        t.signum()
    } else {
        let (mut term, mut sum) = (t, t);
        for n in 1..150 {
            term *= -t * t / n as f64;
            sum += term / (2 * n + 1) as f64;
        }
        sum * 2.0 / std::f64::consts::PI.sqrt()
    };
    0.5 * x * (1.0 + erf)
}

/// `[1, V, C, h, w]` to tokens.
fn tokens(t: &Tensor) -> Maps {
    let (_, v, c, h, w) = t.dims5().unwrap();
    let x = flat(t);
    let token = |view: usize, i: usize| (0..c).map(|k| x[(view * c + k) * h * w + i]).collect();
    (0..v).map(|view| (0..h * w).map(|i| token(view, i)).collect()).collect()
}

/// Section 2's encoding, restarting in each of the 2×2 windows.
fn encode(maps: &mut Maps, h: usize, w: usize, c: usize) {
    for map in maps {
        for (i, token) in map.iter_mut().enumerate() {
            for (k, v) in token.iter_mut().enumerate() {
                let (p, n) = if k < c / 2 { (i / w, h / 2) } else { (i % w, w / 2) };
                let k = k % (c / 2);
                let position = (p % n + 1) as f64 / (n as f64 + 1e-6) * std::f64::consts::TAU;
                let angle = position / 10_000f64.powf(2.0 * (k / 2) as f64 / (c / 2) as f64);
                *v += if k.is_multiple_of(2) { angle.sin() } else { angle.cos() };
            }
        }
    }
}

#[test]
fn three_non_square_views_pass_the_transformer_as_specified() {
    let (settings, views) = (narrow(), posed(3, 32, 48));
    let weights = lively(&settings);
    let seen = traced(&weights, &settings, &views);
    let features = &seen["cnn.features"];
    let (_, _, c, h, w) = features.dims5().unwrap();
    let naive = Naive { weights: &weights, h, w, c };
    let mut maps = tokens(features);
    encode(&mut maps, h, w, c);
    let flatten = |m: &Maps| m.iter().flatten().flatten().copied().collect::<Vec<_>>();
    let ours = |name: &str| tokens(&seen[name]);
    assert!(far(&flatten(&ours("transformer.pos_added")), &flatten(&maps)) < 1e-6);
    for layer in 0..2 {
        maps = naive.layer(layer, &maps);
        let name = format!("transformer.layer{layer}.out_vb");
        let e = far(&flat(&seen[&name]), &flatten(&maps));
        assert!(e < 1e-5, "layer {layer}: {e}");
    }
    assert!(far(&flatten(&ours("transformer.features")), &flatten(&maps)) < 1e-5);
}

/// Section 3 pixel by pixel in f64: correlation `[V, D, h, w]`.
fn naive_sweep(views: &Views, maps: &Maps, h: usize, w: usize, d: usize) -> Vec<f64> {
    let v = maps.len();
    let c = maps[0][0].len();
    let mut out = Vec::new();
    for i in 0..v {
        let NearFar { near, far } = views.near_far[0][i];
        let k = views.cameras[0][i].resized(w, h).unwrap().intrinsics().matrix().as_dmat3();
        for candidate in 0..d {
            let (low, high) = (1.0 / f64::from(far), 1.0 / f64::from(near));
            let disparity = low + candidate as f64 / (d - 1) as f64 * (high - low);
            for pixel in 0..h * w {
                let mut mean = 0.0;
                for offset in 1..v {
                    let j = (i + offset) % v;
                    let e = |n: usize| views.cameras[0][n].world_from_camera().as_dmat4();
                    let pose = e(j).inverse() * e(i);
                    let at = glam::DVec3::new((pixel % w) as f64, (pixel / w) as f64, 1.0);
                    let x = pose.transform_point3(k.inverse() * at / disparity);
                    // The reference's intrinsics on both sides.
                    let p = k * x;
                    let (u, v) = (p.x / p.z.max(1e-3), p.y / p.z.max(1e-3));
                    for (dx, dy) in [(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (1.0, 1.0)] {
                        let (tx, ty) = (u.floor() + dx, v.floor() + dy);
                        let weight = (1.0 - (u - tx).abs()) * (1.0 - (v - ty).abs());
                        if tx < 0.0 || ty < 0.0 || tx >= w as f64 || ty >= h as f64 {
                            continue;
                        }
                        let other = &maps[j][ty as usize * w + tx as usize];
                        let dot: f64 = maps[i][pixel].iter().zip(other).map(|(a, b)| a * b).sum();
                        mean += weight * dot / (c as f64).sqrt() / (v_count(maps) - 1.0);
                    }
                }
                out.push(mean);
            }
        }
    }
    out
}

fn v_count(maps: &Maps) -> f64 {
    maps.len() as f64
}

#[test]
fn the_plane_sweep_is_the_specification_in_double_precision() {
    for (v, h, w) in [(2, 32, 48), (3, 48, 32)] {
        let (settings, views) = (narrow(), posed(v, h, w));
        let seen = traced(&lively(&settings), &settings, &views);
        let maps = tokens(&seen["transformer.features"]);
        let want = naive_sweep(&views, &maps, h / 4, w / 4, settings.depth_candidates);
        let got = flat(&seen["cv.raw_correlation_vb"]);
        assert!(far(&got, &want) < 2e-5, "{v} views: {}", far(&got, &want));
        // Some candidates fall outside: the zero padding is exercised.
        assert!(want.contains(&0.0));
    }
}

#[test]
fn coarse_and_full_disparity_follow_from_the_logits() {
    let (settings, views) = (narrow(), posed(3, 32, 48));
    let seen = traced(&lively(&settings), &settings, &views);
    let logits = flat(&seen["depth.logits_vb"]);
    let (h, w, d) = (8, 12, settings.depth_candidates);
    let mut coarse = Vec::new();
    for view in 0..3 {
        let NearFar { near, far } = views.near_far[0][view];
        let (low, high) = (1.0 / f64::from(far), 1.0 / f64::from(near));
        for pixel in 0..h * w {
            let at = |k: usize| logits[(view * d + k) * h * w + pixel].exp();
            let sum: f64 = (0..d).map(at).sum();
            let value = |k: usize| low + k as f64 / (d - 1) as f64 * (high - low);
            coarse.push((0..d).map(|k| value(k) * at(k) / sum).sum::<f64>());
        }
    }
    assert!(far(&flat(&seen["depth.coarse_disp_vb"]), &coarse) < 5e-6);
    let mut full = Vec::new();
    for view in coarse.chunks(h * w) {
        for y in 0..4 * h {
            for x in 0..4 * w {
                let v = y as f64 * (h - 1) as f64 / (4 * h - 1) as f64;
                let u = x as f64 * (w - 1) as f64 / (4 * w - 1) as f64;
                let mut sum = 0.0;
                for (i, value) in view.iter().enumerate() {
                    let weight = |p: f64, q: usize| (1.0 - (p - q as f64).abs()).max(0.0);
                    sum += value * weight(v, i / w) * weight(u, i % w);
                }
                full.push(sum);
            }
        }
    }
    assert!(far(&flat(&seen["depth.fullres_disp_vb"]), &full) < 5e-6);
}

fn unet() -> (UNet, Tensor) {
    let start = Weights::seeded(5).trainable();
    UNet::new(32, 2, start.builder()).unwrap();
    let mut tensors = BTreeMap::new();
    for (name, var) in start.variables() {
        // Opens the branches that start closed.
        let t: Tensor = if var.rank() == 1 {
            (var.as_tensor() + 0.3).unwrap()
        } else {
            var.as_tensor().clone()
        };
        tensors.insert(name, t.detach());
    }
    let net = UNet::new(32, 2, Weights::from_tensors(tensors).builder()).unwrap();
    let wave: Vec<f32> =
        (0..3 * 32 * 48).map(|i| (0.7 * i as f32).sin() + 0.1 * (i / 1536) as f32).collect();
    (net, Tensor::from_vec(wave, (3, 32, 6, 8), &Device::Cpu).unwrap())
}

/// Attention joins the views of a scene and ignores their order; a view that is given twice has
/// twice the weight. The definition implies both for any V.
#[test]
fn the_unet_treats_views_as_a_set() -> Result<()> {
    let (net, x) = unet();
    let run = |x: &Tensor, views: usize| net.forward(x, views, &mut Trace::off(), "u");
    let rows = |order: &[usize]| -> Result<Tensor> {
        let parts = order.iter().map(|&i| x.narrow(0, i, 1));
        Tensor::cat(&parts.collect::<Result<Vec<_>>>()?, 0)
    };
    let y = run(&x, 3)?;
    let turned = run(&rows(&[2, 0, 1])?, 3)?;
    for (i, j) in [(0, 1), (1, 2), (2, 0)] {
        assert!(far(&flat(&y.get(i)?), &flat(&turned.get(j)?)) < 1e-5);
    }
    // Copies of one view have the features of the view alone.
    let alone = run(&rows(&[0])?, 1)?;
    let copies = run(&rows(&[0, 0, 0])?, 3)?;
    for i in 0..3 {
        assert!(far(&flat(&copies.get(i)?), &flat(&alone.get(0)?)) < 1e-5);
    }
    // Views do meet: in one scene, not in two.
    assert!(far(&flat(&y.get(0)?), &flat(&alone.get(0)?)) > 1e-4);
    let apart = run(&x, 1)?;
    assert!(far(&flat(&apart.get(0)?), &flat(&alone.get(0)?)) < 1e-5);
    Ok(())
}

#[test]
fn several_gaussians_per_pixel_share_all_but_depth_and_opacity() -> Result<()> {
    let settings = Settings { gaussians_per_pixel: 2, ..narrow() };
    let views = posed(2, 32, 48);
    let weights = Weights::from_tensors(lively(&settings));
    let encoder = Mvsplat::new(&settings, weights.builder())?;
    let mut head = None;
    let mut look = |name: &str, t: &Tensor| {
        if name == "depth.to_disparity_vb" {
            head = Some(t.clone());
        }
        Ok(())
    };
    let out = encoder.forward(&views, &mut Trace::to(&mut look))?;
    assert_eq!(out.depths.dims(), [1, 2, 32 * 48, 2]);
    let p = primaries(&out, &views, &settings.primaries, &mut Trace::off())?;
    assert_eq!(p.per_view, 2 * 32 * 48);
    let pairs = |t: &Tensor, n: usize| -> Result<(Vec<f64>, Vec<f64>)> {
        let t = t.reshape((2 * 32 * 48, 2, n))?;
        Ok((flat(&t.narrow(1, 0, 1)?), flat(&t.narrow(1, 1, 1)?)))
    };
    let (q0, q1) = pairs(&p.quats_wxyz, 4)?;
    let (sh0, sh1) = pairs(&p.sh, 75)?;
    assert!(q0 == q1 && sh0 == sh1);
    let (d0, d1) = pairs(&out.depths, 1)?;
    let (s0, s1) = pairs(&p.scales, 3)?;
    for i in 0..d0.len() {
        assert!((s0[3 * i] / s1[3 * i] / (d0[i] / d1[i]) - 1.0).abs() < 1e-5);
    }
    assert!(d0.iter().zip(&d1).any(|(a, b)| (a - b).abs() > 1e-3));
    // Channels of the head: all disparities first, then all logits.
    let head = head.expect("traced");
    let logits = flat(&head.narrow(1, 2, 2)?.flatten_from(2)?.transpose(1, 2)?.contiguous()?);
    for (alpha, logit) in flat(&p.opacities).into_iter().zip(logits) {
        assert!((alpha - 0.5 / (1.0 + (-logit).exp())).abs() < 1e-6);
    }
    Ok(())
}

/// With pixel centres at +½ and the source's own intrinsics, the sweep samples where
/// `camera.rs` projects: a source map that holds its own coordinates gives them back.
#[test]
fn the_sweep_samples_where_cameras_project() -> Result<()> {
    use subsplat::network::ops::plane_sweep::{
        Sweep, pair, plane_sweep, relative_pose, validity, warped,
    };
    let (h, w) = (8, 12);
    let views = posed(2, 32, 48);
    let cameras: Vec<Camera> = views.cameras[0].iter().map(|c| c.resized(w, h).unwrap()).collect();
    let pose = relative_pose(&cameras[0], &cameras[1]);
    let sweep = Sweep {
        pairs: vec![vec![pair(&cameras[0].intrinsics(), &cameras[1].intrinsics(), pose, 0)?]],
        depths: vec![vec![1.2, 3.0, 30.0]],
        centre: 0.5,
        min_z: 1e-3,
        scale: 1.0,
        channels: 2,
        size: [h, w],
    };
    let x: Vec<f32> = (0..h * w).map(|i| (i % w) as f32 + 0.5).collect();
    let y: Vec<f32> = (0..h * w).map(|i| (i / w) as f32 + 0.5).collect();
    let source = Tensor::from_vec([x, y].concat(), (1, 2, h, w), &Device::Cpu)?;
    let inside = flat(&validity(&sweep)?);
    let maps = flat(&warped(&source, &sweep, 0, &[0, 1, 2])?);
    let ones = Tensor::ones((1, 2, h, w), candle_core::DType::F32, &Device::Cpu)?;
    let sums = flat(&plane_sweep(&ones, &source, sweep.clone())?);
    let mut hits = 0;
    for (k, depth) in [1.2f32, 3.0, 30.0].into_iter().enumerate() {
        for i in 0..h * w {
            let px = glam::Vec2::new((i % w) as f32 + 0.5, (i / w) as f32 + 0.5);
            let at = cameras[0].intrinsics().unproject(px) * depth;
            let world = cameras[0].world_from_camera().transform_point3(at);
            let want = cameras[1].project(world).filter(|p| {
                p.x >= 0.5 && p.y >= 0.5 && p.x <= w as f32 - 0.5 && p.y <= h as f32 - 0.5
            });
            let Some(want) = want else {
                assert_eq!(inside[k * h * w + i], 0.0);
                continue;
            };
            hits += 1;
            assert_eq!(inside[k * h * w + i], 1.0);
            let got = (maps[k * h * w + i], maps[(3 + k) * h * w + i]);
            let (x, y) = (f64::from(want.x), f64::from(want.y));
            assert!((got.0 - x).abs() < 1e-4 && (got.1 - y).abs() < 1e-4, "{got:?} {want}");
            assert!((sums[k * h * w + i] - x - y).abs() < 2e-4);
        }
    }
    assert!(hits > 50 && hits < 3 * h * w, "{hits}");
    let mut wrong = sweep;
    wrong.pairs[0][0].source = 1;
    assert!(plane_sweep(&ones, &source, wrong).unwrap_err().to_string().contains("source row"));
    Ok(())
}
