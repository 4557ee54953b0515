//! 2-D convolution, forward and both gradients, as im2col in cache-sized blocks and products of
//! the `gemm` crate: a careful implementation without kernels of its own.
//!
//! x `[B, C, H, W]`, w `[O, C, kh, kw]`, y `[B, O, H', W']`, zero padding, one
//! stride for both axes.

use rayon::prelude::*;
use subsplat_kernels::cpu::gemm::{Mat, gemm};

/// Pixels of one output tile.
const TILE: usize = 512;
/// Rows (channel × tap) of one im2col block.
const BLOCK_ROWS: usize = 320;

/// Sizes of one convolution.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Geometry {
    /// C: input channels.
    pub in_channels: usize,
    /// O: output channels.
    pub out_channels: usize,
    /// kh, kw.
    pub kernel: [usize; 2],
    /// Step of the kernel, both axes.
    pub stride: usize,
    /// Zeros added on every side.
    pub padding: usize,
    /// H, W of the input.
    pub size: [usize; 2],
}

impl Geometry {
    /// H', W' of the output.
    pub fn out_size(&self) -> [usize; 2] {
        let side = |axis: usize| {
            let padded = self.size[axis] + 2 * self.padding;
            (padded + 1).saturating_sub(self.kernel[axis]).div_ceil(self.stride)
        };
        [side(0), side(1)]
    }

    fn taps(&self) -> usize {
        self.kernel[0] * self.kernel[1]
    }

    fn in_pixels(&self) -> usize {
        self.size[0] * self.size[1]
    }

    fn out_pixels(&self) -> usize {
        let [h, w] = self.out_size();
        h * w
    }

    /// Returns whether im2col of a channel equals the channel.
    fn pointwise(&self) -> bool {
        self.kernel == [1, 1] && self.stride == 1 && self.padding == 0
    }

    /// Returns the channels of one block.
    fn block(&self) -> usize {
        (BLOCK_ROWS / self.taps()).clamp(1, self.in_channels.max(1))
    }

    /// Returns the pixels of one tile. Small maps are divided, too, so that every thread has
    /// work. The size does not depend on the number of threads, so neither do the sums.
    fn tile(&self) -> usize {
        self.out_pixels().div_ceil(4).next_multiple_of(16).clamp(16, TILE)
    }

    /// Calls `f(offset in the range, row, first column, length)` for the segments of output
    /// pixels `start..start + len` that lie in one output row.
    fn segments(&self, start: usize, len: usize, mut f: impl FnMut(usize, usize, usize, usize)) {
        let width = self.out_size()[1];
        let mut done = 0;
        while done < len {
            let (row, col) = ((start + done) / width, (start + done) % width);
            let n = (width - col).min(len - done);
            f(done, row, col, n);
            done += n;
        }
    }

    /// Returns the output columns of `col..col + n` whose tap `kx` lies inside the picture, as
    /// offsets from `col`, and the input column of the first.
    fn inside(&self, kx: usize, col: usize, n: usize) -> (usize, usize, usize) {
        let (s, p, w) = (self.stride, self.padding, self.size[1]);
        // ix = (col + i)·s + kx − p must lie in 0..w.
        let first = p.saturating_sub(kx).div_ceil(s).saturating_sub(col).min(n);
        let past = (w + p).saturating_sub(kx).div_ceil(s).saturating_sub(col).min(n);
        let ix = ((col + first) * s + kx).saturating_sub(p);
        (first, past.max(first), ix)
    }

    /// Returns the input row of output row `row` and tap `ky`, if inside the picture.
    fn in_row(&self, row: usize, ky: usize) -> Option<usize> {
        (row * self.stride + ky).checked_sub(self.padding).filter(|&y| y < self.size[0])
    }
}

/// Writes output pixels `start..start + len` of a channel range as rows of (channel, ky, kx):
/// `out` is `[channels · taps, len]`, `x` those channels of one picture.
fn im2col(g: &Geometry, x: &[f32], start: usize, len: usize, out: &mut [f32]) {
    let [kh, kw] = g.kernel;
    let width = g.size[1];
    for (plane, rows) in x.chunks_exact(g.in_pixels()).zip(out.chunks_exact_mut(g.taps() * len)) {
        for (tap, row_out) in rows.chunks_exact_mut(len).enumerate() {
            let (ky, kx) = (tap / kw, tap % kw);
            debug_assert!(ky < kh);
            g.segments(start, len, |at, row, col, n| {
                let dst = &mut row_out[at..at + n];
                let Some(y) = g.in_row(row, ky) else {
                    dst.fill(0.0);
                    return;
                };
                let (first, past, ix) = g.inside(kx, col, n);
                dst[..first].fill(0.0);
                dst[past..].fill(0.0);
                let src = &plane[y * width..(y + 1) * width];
                if g.stride == 1 {
                    if past > first {
                        dst[first..past].copy_from_slice(&src[ix..ix + past - first]);
                    }
                } else {
                    for (i, v) in dst[first..past].iter_mut().enumerate() {
                        *v = src[ix + i * g.stride];
                    }
                }
            });
        }
    }
}

/// The transpose of [`im2col`]: adds `cols` back onto the channels `x`.
fn col2im(g: &Geometry, cols: &[f32], start: usize, len: usize, x: &mut [f32]) {
    let kw = g.kernel[1];
    let width = g.size[1];
    for (plane, rows) in x.chunks_exact_mut(g.in_pixels()).zip(cols.chunks_exact(g.taps() * len)) {
        for (tap, row_in) in rows.chunks_exact(len).enumerate() {
            let (ky, kx) = (tap / kw, tap % kw);
            g.segments(start, len, |at, row, col, n| {
                let Some(y) = g.in_row(row, ky) else { return };
                let (first, past, ix) = g.inside(kx, col, n);
                let dst = &mut plane[y * width..(y + 1) * width];
                for (i, v) in row_in[at + first..at + past].iter().enumerate() {
                    dst[ix + i * g.stride] += v;
                }
            });
        }
    }
}

/// One tile of the output: picture, first pixel, and a piece of every channel's row.
type Tile<'a> = (usize, usize, Vec<&'a mut [f32]>);

/// Divides `[B, rows, pixels]` into tiles of `tile` pixels across all rows.
fn tiles(y: &mut [f32], rows: usize, pixels: usize, tile: usize) -> Vec<Tile<'_>> {
    let mut out: Vec<Tile<'_>> = Vec::new();
    for (image, plane) in y.chunks_exact_mut(rows * pixels).enumerate() {
        let first = out.len();
        let count = pixels.div_ceil(tile);
        out.extend((0..count).map(|t| (image, t * tile, Vec::with_capacity(rows))));
        for row in plane.chunks_exact_mut(pixels) {
            for (t, piece) in row.chunks_mut(tile).enumerate() {
                out[first + t].2.push(piece);
            }
        }
    }
    out
}

/// y = x ∗ w + bias. `y` is overwritten; `bias` is empty or `[O]`.
pub fn forward(g: &Geometry, x: &[f32], w: &[f32], bias: &[f32], y: &mut [f32]) {
    let (o, k, pixels) = (g.out_channels, g.in_channels * g.taps(), g.out_pixels());
    let (image_len, block, taps) = (g.in_channels * g.in_pixels(), g.block(), g.taps());
    if y.is_empty() {
        return;
    }
    let work = tiles(y, o, pixels, g.tile());
    work.into_par_iter().for_each_init(
        || (Vec::new(), Vec::new()),
        |(cols, acc), (image, start, mut rows)| {
            let len = rows[0].len();
            let x = &x[image * image_len..(image + 1) * image_len];
            acc.resize(o * len, 0.0);
            if k == 0 {
                acc.fill(0.0);
            }
            if g.pointwise() && k > 0 {
                let rhs = Mat::new(&x[start..], k, len, pixels);
                gemm(acc, len, Mat::new(w, o, k, k), rhs, 1.0, false);
            } else {
                for c in (0..g.in_channels).step_by(block) {
                    let n = block.min(g.in_channels - c);
                    cols.resize(n * taps * len, 0.0);
                    im2col(g, &x[c * g.in_pixels()..(c + n) * g.in_pixels()], start, len, cols);
                    let lhs = Mat::new(&w[c * taps..], o, n * taps, k);
                    gemm(acc, len, lhs, Mat::new(cols, n * taps, len, len), 1.0, c > 0);
                }
            }
            for (i, (row, sum)) in rows.iter_mut().zip(acc.chunks_exact(len)).enumerate() {
                match bias.get(i) {
                    Some(b) => row.iter_mut().zip(sum).for_each(|(y, s)| *y = s + b),
                    None => row.copy_from_slice(sum),
                }
            }
        },
    );
}

/// Computes ∂L/∂x from ∂L/∂y; `dx` is overwritten. Pictures and channel blocks are divided among
/// the threads.
pub fn input_grad(g: &Geometry, dy: &[f32], w: &[f32], dx: &mut [f32]) {
    let (o, k, pixels, taps) = (g.out_channels, g.in_channels * g.taps(), g.out_pixels(), g.taps());
    let (block, tile) = (g.block(), g.tile());
    dx.fill(0.0);
    if dy.is_empty() || dx.is_empty() {
        return;
    }
    let image_len = g.in_channels * g.in_pixels();
    let jobs: Vec<(usize, usize, &mut [f32])> = dx
        .chunks_exact_mut(image_len)
        .enumerate()
        .flat_map(|(image, plane)| {
            plane
                .chunks_mut(block * g.in_pixels())
                .enumerate()
                .map(move |(i, part)| (image, i * block, part))
        })
        .collect();
    jobs.into_par_iter().for_each_init(Vec::new, |cols, (image, c, part)| {
        let n = part.len() / g.in_pixels();
        let dy = &dy[image * o * pixels..(image + 1) * o * pixels];
        let weights = Mat::new(&w[c * taps..], o, n * taps, k).t();
        for start in (0..pixels).step_by(tile) {
            let len = tile.min(pixels - start);
            cols.resize(n * taps * len, 0.0);
            gemm(cols, len, weights, Mat::new(&dy[start..], o, len, pixels), 1.0, false);
            col2im(g, cols, start, len, part);
        }
    });
}

/// Computes ∂L/∂w from x and ∂L/∂y; `dw` is overwritten. Channel blocks are divided among the
/// threads.
pub fn weight_grad(g: &Geometry, x: &[f32], dy: &[f32], dw: &mut [f32]) {
    let (o, k, pixels, taps) = (g.out_channels, g.in_channels * g.taps(), g.out_pixels(), g.taps());
    let (block, tile) = (g.block(), g.tile());
    dw.fill(0.0);
    if dy.is_empty() || x.is_empty() {
        return;
    }
    let image_len = g.in_channels * g.in_pixels();
    let starts: Vec<usize> = (0..g.in_channels).step_by(block).collect();
    let parts: Vec<Vec<f32>> = starts
        .par_iter()
        .map(|&c| {
            let n = block.min(g.in_channels - c);
            let mut sum = vec![0.0; o * n * taps];
            let mut cols = Vec::new();
            for (x, dy) in x.chunks_exact(image_len).zip(dy.chunks_exact(o * pixels)) {
                let x = &x[c * g.in_pixels()..(c + n) * g.in_pixels()];
                for start in (0..pixels).step_by(tile) {
                    let len = tile.min(pixels - start);
                    cols.resize(n * taps * len, 0.0);
                    im2col(g, x, start, len, &mut cols);
                    let lhs = Mat::new(&dy[start..], o, len, pixels);
                    gemm(
                        &mut sum,
                        n * taps,
                        lhs,
                        Mat::new(&cols, n * taps, len, len).t(),
                        1.0,
                        true,
                    );
                }
            }
            sum
        })
        .collect();
    for (&c, part) in starts.iter().zip(&parts) {
        let n = part.len() / o;
        for (row, src) in dw.chunks_exact_mut(k).zip(part.chunks_exact(n)) {
            row[c * taps..c * taps + n].copy_from_slice(src);
        }
    }
}
