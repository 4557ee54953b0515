//! Tiles of pictures, sixteen at once: where they are read, and their transform.
//!
//! Where the tiles of a row make whole vectors, rows of pictures are read as they lie and
//! turned in registers; what lies beyond a border is masked. Other rows are packed first,
//! and each tile is read for itself. The tiles of a vector lie in the order of [`transpose4x4_index`],
//! which costs the fewest turns.

use super::Buffer;
use super::forms::{Form, Places, TILE, put};
use super::plan::{Axes, Layout, Pack, Plan};
use crate::cpu::simd::{Kernel, LANES, Mask, Simd, transpose4x4_index};
use std::array::from_fn;

/// The tiles of a block, row by row, of one picture after the other.
#[derive(Clone, Copy)]
pub(super) struct Tiles {
    pub count: usize,
    /// Tiles of a row.
    pub across: usize,
    /// Tiles of a picture.
    pub picture: usize,
}

impl Tiles {
    /// Lanes of their vectors.
    pub fn length(&self) -> usize {
        self.count.next_multiple_of(LANES)
    }

    /// Whether their vectors are in the order of [`transpose4x4_index`]: a few tiles come first in
    /// their only vector.
    fn squared(&self) -> bool {
        self.count >= LANES
    }

    /// The lane of tile `t`.
    pub fn lane(&self, t: usize) -> usize {
        if self.squared() { t / LANES * LANES + transpose4x4_index(t % LANES) } else { t }
    }

    /// Lanes up to the last that holds a tile, others between them perhaps.
    pub fn lanes(&self) -> usize {
        if self.squared() { self.length() } else { self.count }
    }
}

/// Where a block of tiles is read, the same in every channel.
pub(super) struct Gather<'a> {
    /// From row to row.
    pitch: usize,
    /// Floats of a channel, from its first picture to its last.
    floats: usize,
    rows: Rows<'a>,
}

enum Rows<'a> {
    /// In the pictures; for each vector of tiles.
    Lying(Vec<Spans>),
    /// In a packed copy of the channel.
    Packed(Packed<'a>),
}

/// Floats past a packed channel's end that may be read and not used.
const SLACK: usize = 2 * LANES;

/// Sixteen tiles in spans: neighbours, of which one row makes a vector. There are as many
/// spans as places from tile to tile; those are a tile's own, and what it reads besides is
/// its neighbours'.
struct Spans {
    /// Where the first tile's own of each begins: before the picture, where it has a border.
    at: [isize; 8],
    /// For each row of tiles and span, the lanes that the picture has.
    lanes: [[u16; 8]; ROWS],
    /// The tiles whose neighbours are in no lane beside them: before the first of a row,
    /// after the last.
    firsts: Vec<End>,
    lasts: Vec<End>,
}

/// Most rows of a tile.
const ROWS: usize = 9;

/// A place that a tile reads of a neighbour.
struct End {
    /// The tile's lane as a bit.
    lane: u32,
    at: isize,
    /// Whether the picture has it, for each row of the tile.
    has: [bool; ROWS],
}

struct Packed<'a> {
    /// What the copy is made for.
    reader: &'a Plan,
    layout: Layout,
    start: Axes,
    /// From picture to picture.
    stride: usize,
    /// Where each tile begins, by vectors.
    at: Vec<[usize; LANES]>,
}

impl<'a> Gather<'a> {
    /// Of `tiles` from grid position `start` on, of pictures `stride` floats apart;
    /// `reader` reads every place between the first and the last.
    pub fn new<F, const IN: usize, const POINTS: usize, const OUT: usize>(
        reader: &'a Plan,
        tiles: Tiles,
        [depth, top, left]: Axes,
        stride: usize,
    ) -> Self
    where
        F: Form<IN, POINTS, OUT>,
    {
        let Tiles { count, across, picture } = tiles;
        let start = [depth, top * F::READ / TILE, left * F::READ / TILE];
        let [slices, height, width] = reader.src_size;
        let floats = count.div_ceil(picture).saturating_sub(1) * stride + slices * height * width;
        // Tiles of a span.
        let group = LANES / F::READ;
        if !across.is_multiple_of(group) || !tiles.squared() {
            let layout = reader.layout([1, picture / across * F::READ, across * F::READ]);
            let place = |t: usize| {
                let (picture, t) = (t / picture, t % picture);
                let place = (t / across * layout.pitch() + t % across) * F::READ;
                picture * layout.channel + place
            };
            // Lanes without a tile repeat the last.
            let mut at = vec![[place(count - 1); LANES]; count.div_ceil(LANES)];
            let lanes = at.as_flattened_mut();
            (0..count).for_each(|t| lanes[tiles.lane(t)] = place(t));
            let rows = Rows::Packed(Packed { reader, layout, start, stride, at });
            return Self { pitch: layout.pitch(), floats, rows };
        }
        let origin = reader.origin;
        let [depth, top, left]: [isize; 3] = from_fn(|a| start[a] as isize + origin[a]);
        let has_depth = usize::try_from(depth).is_ok_and(|d| d < slices);
        // Place `column` of tile t in the channel and in its row, and the rows that there are.
        let place = |t: usize, column: isize| {
            let (image, t) = (t / picture, t % picture);
            let top = top + (t / across * F::READ) as isize;
            let left = left + (t % across * F::READ) as isize + column;
            let row = (depth * height as isize + top) * width as isize;
            let clamp = |v: isize| v.clamp(0, IN as isize).unsigned_abs();
            let past = if has_depth { clamp(height as isize - top) } else { 0 };
            let first = clamp(-top).min(past);
            ((image * stride) as isize + row + left, left, first..past)
        };
        let has = |column: isize| (0..width as isize).contains(&column);
        let end = |i: usize, t: usize, column: isize| {
            let (at, left, rows) = place(t, column);
            let mut end = End { lane: 1 << transpose4x4_index(i), at, has: [false; ROWS] };
            end.has[rows].fill(has(left));
            end
        };
        let own = F::BEFORE as isize;
        let vector = |first: usize| {
            // Spans beyond the last repeat it.
            let begin = |k: usize| (first + k * group).min(count - group);
            let (mut at, mut lanes) = ([0; 8], [[0; 8]; ROWS]);
            for k in 0..F::READ {
                let (first, left, rows) = place(begin(k), own);
                let columns = (0..LANES).filter(|lane| has(left + *lane as isize));
                let columns = columns.fold(0, |bits, lane| bits | 1 << lane);
                at[k] = first;
                lanes[rows].iter_mut().for_each(|row| row[k] = columns);
            }
            let tile = |i: usize| begin(i / group) + i % group;
            let first = |i: &usize| *i == 0 || tile(*i).is_multiple_of(across);
            let last = |i: &usize| i + 1 == LANES || (tile(*i) + 1).is_multiple_of(across);
            let all = 0..LANES;
            let firsts = all.clone().filter(first).map(|i| end(i, tile(i), own - 1)).collect();
            let next = own + F::READ as isize;
            let lasts = all.filter(last).map(|i| end(i, tile(i), next)).collect();
            Spans { at, lanes, firsts, lasts }
        };
        let vectors = (0..count).step_by(LANES).map(vector).collect();
        Self { pitch: width, floats, rows: Rows::Lying(vectors) }
    }

    /// Reads the tiles of a channel that begins with `x` and writes them, transformed,
    /// to channel `c` of `tiles`. `patch` holds the packed copy, `rows` those of tiles.
    #[inline(always)]
    pub fn channel<S, F, const IN: usize, const POINTS: usize, const OUT: usize>(
        &self,
        s: S,
        x: &[f32],
        patch: &mut Buffer,
        rows: &mut [[S::F; POINTS]; IN],
        tiles: &mut [f32],
        (places, c): (&Places, usize),
    ) where
        S: Simd,
        F: Form<IN, POINTS, OUT>,
    {
        let x = &x[..self.floats];
        let packed = match &self.rows {
            Rows::Lying(vectors) => {
                for (v, spans) in vectors.iter().enumerate() {
                    for r in 0..IN {
                        let row = self.row::<S, F, IN, POINTS, OUT>(s, x, spans, r);
                        put(&mut rows[r], F::points(s, row));
                    }
                    scatter::<S, F, IN, POINTS, OUT>(s, rows, tiles, places, [c, v * LANES]);
                }
                return;
            }
            Rows::Packed(packed) => packed,
        };
        let pixels: usize = packed.reader.src_size.iter().product();
        let pictures = x.chunks(packed.stride);
        let patch = patch.room(pictures.len() * packed.layout.channel + SLACK);
        for (x, to) in pictures.zip(patch.chunks_exact_mut(packed.layout.channel)) {
            let (plan, layout, start) = (packed.reader, &packed.layout, packed.start);
            Pack { plan, layout, x: &x[..pixels], start, out: to }.run(s);
        }
        for (v, at) in packed.at.iter().enumerate() {
            for r in 0..IN {
                let mut row = [s.splat(0.0); IN];
                for part in 0..IN.div_ceil(4) {
                    let four = s.gather4(patch, at, r * self.pitch + part * 4);
                    for j in 0..4 {
                        if part * 4 + j < IN {
                            row[part * 4 + j] = four[j];
                        }
                    }
                }
                put(&mut rows[r], F::points(s, row));
            }
            scatter::<S, F, IN, POINTS, OUT>(s, rows, tiles, places, [c, v * LANES]);
        }
    }

    /// Row `r` of sixteen tiles.
    #[inline(always)]
    fn row<S, F, const IN: usize, const POINTS: usize, const OUT: usize>(
        &self,
        s: S,
        x: &[f32],
        Spans { at, lanes, firsts, lasts }: &Spans,
        r: usize,
    ) -> [S::F; IN]
    where
        S: Simd,
        F: Form<IN, POINTS, OUT>,
    {
        let down = (r * self.pitch) as isize;
        let mut v = [s.splat(0.0); 8];
        for k in 0..F::READ {
            let from = x.as_ptr().wrapping_offset(at[k] + down);
            // The next channel's, which the cache may not have.
            s.prefetch_l2(from.wrapping_add(self.floats));
            // SAFETY: `new` sets the lanes that the picture has, and the channel all
            // `floats` of it.
            v[k] = unsafe { s.load_masked(from, lanes[r][k]) };
        }
        let own = match F::READ {
            8 => s.columns_of_8(v),
            _ => {
                let [a, b, c, d] = s.transpose_quarters([v[0], v[1], v[2], v[3]]);
                [a, b, c, d, v[4], v[5], v[6], v[7]]
            }
        };
        let mut row = [s.splat(0.0); IN];
        for j in 0..IN {
            row[j] = match j {
                _ if j < F::BEFORE => {
                    with_ends(s, s.rotate_right(own[F::READ - 1]), firsts, x, r, down)
                }
                _ if j < F::BEFORE + F::READ => own[j - F::BEFORE],
                _ => with_ends(s, s.rotate_left(own[0]), lasts, x, r, down),
            };
        }
        row
    }
}

/// `row` with the neighbours of `ends`, for their rows `r`, which lie `down` floats on.
#[inline(always)]
fn with_ends<S: Simd>(s: S, mut row: S::F, ends: &[End], x: &[f32], r: usize, down: isize) -> S::F {
    for end in ends {
        let from = x.as_ptr().wrapping_offset(end.at + down);
        s.prefetch_l2(from.wrapping_add(x.len()));
        // SAFETY: `new` sets whether the picture has it, and the channel all of the picture.
        let v = if end.has[r] { unsafe { *from } } else { 0.0 };
        row = s.mask_from_bits(end.lane).select(s.splat(v), row);
    }
    row
}

/// Transforms the other axis of sixteen tiles, and writes them from tile `first` of
/// channel `c` on.
#[inline(always)]
fn scatter<S, F, const IN: usize, const POINTS: usize, const OUT: usize>(
    s: S,
    rows: &[[S::F; POINTS]; IN],
    tiles: &mut [f32],
    places: &Places,
    [c, first]: [usize; 2],
) where
    S: Simd,
    F: Form<IN, POINTS, OUT>,
{
    assert!(tiles.len() >= places.floats);
    let (vectors, tiles) = (places.vectors(c, first), tiles.as_mut_ptr());
    for j in 0..POINTS {
        let mut column = [s.splat(0.0); IN];
        for i in 0..IN {
            column[i] = rows[i][j];
        }
        let column = F::points(s, column);
        for i in 0..POINTS {
            let to = tiles.wrapping_add(vectors.place(POINTS, i, j));
            // SAFETY: inside `places` (its promise), and those inside `tiles` (asserted).
            s.store(column[i], unsafe { &mut *to.cast() });
        }
    }
}
