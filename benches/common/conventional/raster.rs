//! A conventional rasterizer (the algorithm of 3DGS on one CPU thread): 16×16 tiles, a square box
//! of some σ around each splat, one sort of (tile, depth) pairs. Each pixel processes its tile's
//! list front to back. The backward pass processes it back to front from a stored last position
//! and recovers T by division. With `keeps`, the splats that each pixel blended are stored
//! instead, as some programs do: a faster backward pass that needs much memory.

#![expect(clippy::needless_range_loop, reason = "plain loops, as such programs have them")]

use super::project::{Gradients, Options, Projected, ProjectedGrad, Splats, View};
use subsplat_kernels::camera::Camera;

const TILE: usize = 16;
const ALPHA_MIN: f32 = 1.0 / 255.0;
const ALPHA_MAX: f32 = 0.999;
const T_MIN: f32 = 1e-4;

/// A picture and the inputs of the backward pass.
#[derive(Default)]
pub struct Frame {
    /// `[H, W, 3]`.
    pub rgb: Vec<f32>,
    /// `[H, W]`: 1 − T.
    pub alpha: Vec<f32>,
    /// `[H, W]`: Σ w·z.
    pub depth_sum: Vec<f32>,
    /// `[H, W]`: T behind the last splat.
    transmittance: Vec<f32>,
    /// Blended splats, front to back, pixel after pixel, if stored.
    blended: Vec<u32>,
    /// `[H, W]`: half-open range of a pixel's splats in `blended`, else in the pairs.
    spans: Vec<(usize, usize)>,
}

/// The rasterizer with its buffers.
#[derive(Default)]
pub struct Rasterizer {
    projected: Vec<Projected>,
    /// (tile, depth bits) above, splat below, sorted.
    pairs: Vec<(u64, u32)>,
    /// Half-open range of pairs of each tile.
    ranges: Vec<(u32, u32)>,
    /// Whether the blended splats are stored for the backward pass.
    keeps: bool,
    pub frame: Frame,
}

/// Returns alpha at (dx, dy) from the mean before the cap, with its Gaussian factor.
#[inline]
fn alpha_at(s: &Projected, dx: f32, dy: f32) -> Option<(f32, f32)> {
    let [a, b, c] = s.conic;
    let sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy;
    if sigma < 0.0 {
        return None;
    }
    let falloff = (-sigma).exp();
    let alpha = s.opacity * falloff;
    (alpha >= ALPHA_MIN).then_some((alpha, falloff))
}

impl Rasterizer {
    /// Creates a rasterizer; with `keeps`, blended splats are stored for the backward pass.
    pub fn new(keeps: bool) -> Self {
        Self { keeps, ..Self::default() }
    }

    /// Renders into `frame`.
    pub fn forward(&mut self, splats: &Splats, camera: &Camera, options: Options) {
        let view = View::new(camera, options);
        self.projected.clear();
        self.projected.extend((0..splats.len()).map(|i| view.project(splats, i)));
        self.list(view.size);
        let [width, height] = view.size;
        let f = &mut self.frame;
        f.rgb.resize(3 * width * height, 0.0);
        for plane in [&mut f.alpha, &mut f.depth_sum, &mut f.transmittance] {
            plane.resize(width * height, 0.0);
        }
        f.spans.resize(width * height, (0, 0));
        f.blended.clear();
        let columns = width.div_ceil(TILE);
        for tile in 0..self.ranges.len() {
            let (x0, y0) = (tile % columns * TILE, tile / columns * TILE);
            for y in y0..(y0 + TILE).min(height) {
                for x in x0..(x0 + TILE).min(width) {
                    self.pixel(tile, x, y, width, view.background());
                }
            }
        }
    }

    /// Computes pairs and ranges.
    fn list(&mut self, [width, height]: [usize; 2]) {
        let (columns, rows) = (width.div_ceil(TILE), height.div_ceil(TILE));
        self.pairs.clear();
        for (i, s) in self.projected.iter().enumerate().filter(|(_, s)| s.radius > 0.0) {
            let to_tile = |v: f32, most: usize| ((v / TILE as f32).max(0.0) as usize).min(most);
            let ceil = TILE as f32 - 1.0;
            let (x0, x1) = (s.uv[0] - s.radius, s.uv[0] + s.radius + ceil);
            let (y0, y1) = (s.uv[1] - s.radius, s.uv[1] + s.radius + ceil);
            for row in to_tile(y0, rows)..to_tile(y1, rows) {
                for column in to_tile(x0, columns)..to_tile(x1, columns) {
                    let tile = (row * columns + column) as u64;
                    self.pairs.push((tile << 32 | u64::from(s.z.to_bits()), i as u32));
                }
            }
        }
        // The index orders equal depths.
        self.pairs.sort_unstable();
        self.ranges.clear();
        self.ranges.resize(columns * rows, (0, 0));
        let mut from = 0;
        for i in 1..=self.pairs.len() {
            let tile = self.pairs[i - 1].0 >> 32;
            if i == self.pairs.len() || self.pairs[i].0 >> 32 != tile {
                self.ranges[tile as usize] = (from, i as u32);
                from = i as u32;
            }
        }
    }

    fn pixel(&mut self, tile: usize, x: usize, y: usize, width: usize, background: [f32; 3]) {
        let (px, py) = (x as f32 + 0.5, y as f32 + 0.5);
        let (from, to) = self.ranges[tile];
        let (mut t, mut rgb, mut depth) = (1.0f32, [0.0f32; 3], 0.0f32);
        let first = if self.keeps { self.frame.blended.len() } else { from as usize };
        let mut past = first;
        for k in from as usize..to as usize {
            let i = self.pairs[k].1;
            let s = &self.projected[i as usize];
            let Some((alpha, _)) = alpha_at(s, px - s.uv[0], py - s.uv[1]) else { continue };
            let alpha = alpha.min(ALPHA_MAX);
            let rest = t * (1.0 - alpha);
            if rest <= T_MIN {
                break;
            }
            let weight = t * alpha;
            for c in 0..3 {
                rgb[c] += weight * s.rgb[c];
            }
            depth += weight * s.z;
            t = rest;
            past = k + 1;
            if self.keeps {
                self.frame.blended.push(i);
                past = self.frame.blended.len();
            }
        }
        let at = y * width + x;
        for c in 0..3 {
            self.frame.rgb[3 * at + c] = rgb[c] + t * background[c];
        }
        self.frame.alpha[at] = 1.0 - t;
        self.frame.depth_sum[at] = depth;
        self.frame.transmittance[at] = t;
        self.frame.spans[at] = (first, past);
    }

    /// Computes the gradients of Σ rgb·v_rgb + Σ alpha·v_alpha of the last
    /// [`Rasterizer::forward`], which had the same arguments.
    pub fn backward(
        &self,
        splats: &Splats,
        camera: &Camera,
        options: Options,
        v_rgb: &[f32],
        v_alpha: &[f32],
    ) -> Gradients {
        let view = View::new(camera, options);
        let [width, height] = view.size;
        let columns = width.div_ceil(TILE);
        let mut flat = vec![ProjectedGrad::default(); splats.len()];
        let mut out = Gradients {
            rows: vec![0.0; splats.rows.len()],
            sh: vec![0.0; splats.sh.len()],
            gain: vec![0.0; splats.gain.len()],
            background: [0.0; 3],
        };
        for tile in 0..self.ranges.len() {
            let (x0, y0) = (tile % columns * TILE, tile / columns * TILE);
            for y in y0..(y0 + TILE).min(height) {
                for x in x0..(x0 + TILE).min(width) {
                    let at = y * width + x;
                    let v = [v_rgb[3 * at], v_rgb[3 * at + 1], v_rgb[3 * at + 2]];
                    for c in 0..3 {
                        out.background[c] += self.frame.transmittance[at] * v[c];
                    }
                    let b = view.background();
                    // d loss / d T_final.
                    let v_t = v[0] * b[0] + v[1] * b[1] + v[2] * b[2] - v_alpha[at];
                    self.pixel_backward([x, y], at, v, v_t, &mut flat);
                }
            }
        }
        for (i, g) in flat.iter().enumerate() {
            if self.projected[i].radius > 0.0 {
                view.backward(splats, i, g, &mut out);
            }
        }
        out
    }

    fn pixel_backward(
        &self,
        [x, y]: [usize; 2],
        at: usize,
        v: [f32; 3],
        v_t: f32,
        flat: &mut [ProjectedGrad],
    ) {
        let (px, py) = (x as f32 + 0.5, y as f32 + 0.5);
        let last = self.frame.transmittance[at];
        let mut t = last;
        // Σ w·(c·v) over the farther splats.
        let mut behind = 0.0;
        let (first, past) = self.frame.spans[at];
        for k in (first..past).rev() {
            let i = if self.keeps { self.frame.blended[k] } else { self.pairs[k].1 } as usize;
            let s = &self.projected[i];
            let (dx, dy) = (px - s.uv[0], py - s.uv[1]);
            let Some((raw, falloff)) = alpha_at(s, dx, dy) else { continue };
            let alpha = raw.min(ALPHA_MAX);
            let inverse = 1.0 / (1.0 - alpha);
            t *= inverse;
            let weight = t * alpha;
            let g = &mut flat[i];
            for c in 0..3 {
                g.rgb[c] += weight * v[c];
            }
            let colour = s.rgb[0] * v[0] + s.rgb[1] * v[1] + s.rgb[2] * v[2];
            let v_alpha = t * colour - (behind + last * v_t) * inverse;
            behind += weight * colour;
            if raw >= ALPHA_MAX {
                continue;
            }
            g.opacity += falloff * v_alpha;
            let v_sigma = -raw * v_alpha;
            g.conic[0] += 0.5 * v_sigma * dx * dx;
            g.conic[1] += v_sigma * dx * dy;
            g.conic[2] += 0.5 * v_sigma * dy * dy;
            g.uv[0] -= v_sigma * (s.conic[0] * dx + s.conic[1] * dy);
            g.uv[1] -= v_sigma * (s.conic[1] * dx + s.conic[2] * dy);
        }
    }
}
