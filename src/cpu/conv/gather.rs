//! Tiles of pictures, sixteen at once: where they are read, and their transform.
//!
//! Where the tiles of a row make whole vectors, rows of pictures are read as they lie and
//! turned in registers; what lies beyond a border is masked. Other rows are packed first,
//! and each tile is read for itself.

use super::Buffer;
use super::forms::{Form, Places, TILE, put};
use super::plan::{Axes, Layout, Pack, Plan};
use crate::cpu::simd::{Kernel, LANES, Simd};
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
/// spans as places that a tile reads of a row before the next tile begins.
struct Spans {
    /// Where the first tile of each begins: before the picture, where it has a border.
    at: [isize; 8],
    /// For each row of tiles and span, the lanes that the picture has.
    lanes: [[u16; 8]; ROWS],
    /// The tiles that end a row: what they read of the next is not in these vectors.
    ends: Vec<End>,
}

/// Most rows of a tile.
const ROWS: usize = 9;

struct End {
    /// The tile as a bit.
    lane: u32,
    /// Where the next one would begin.
    at: isize,
    /// Whether the picture has the first two places there, for each row of the tile.
    has: [[bool; 2]; ROWS],
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
        if !across.is_multiple_of(group) {
            let layout = reader.layout([1, picture / across * F::READ, across * F::READ]);
            let place = |t: usize| {
                // Lanes beyond the last tile repeat it.
                let t = t.min(count - 1);
                let (picture, t) = (t / picture, t % picture);
                let place = (t / across * layout.pitch() + t % across) * F::READ;
                picture * layout.channel + place
            };
            let vector = |first: usize| from_fn(|i| place(first + i));
            let at = (0..count).step_by(LANES).map(vector).collect();
            let rows = Rows::Packed(Packed { reader, layout, start, stride, at });
            return Self { pitch: layout.pitch(), floats, rows };
        }
        let origin = reader.origin;
        let [depth, top, left]: [isize; 3] = from_fn(|a| start[a] as isize + origin[a]);
        let has_depth = usize::try_from(depth).is_ok_and(|d| d < slices);
        // Where a tile begins in the channel and in its row, and the rows that there are.
        let corner = |t: usize| {
            let (image, t) = (t / picture, t % picture);
            let top = top + (t / across * F::READ) as isize;
            let left = left + (t % across * F::READ) as isize;
            let row = (depth * height as isize + top) * width as isize;
            let clamp = |v: isize| v.clamp(0, IN as isize).unsigned_abs();
            let past = if has_depth { clamp(height as isize - top) } else { 0 };
            let first = clamp(-top).min(past);
            ((image * stride) as isize + row + left, left, first..past)
        };
        let has = |column: isize| (0..width as isize).contains(&column);
        let end = |lane: usize, t: usize| {
            let (at, left, rows) = corner(t);
            let [at, left] = [at, left].map(|v| v + F::READ as isize);
            let mut end = End { lane: 1 << lane, at, has: [[false; 2]; ROWS] };
            end.has[rows].fill([has(left), has(left + 1)]);
            end
        };
        let vector = |first: usize| {
            // Spans beyond the last repeat it.
            let begin = |k: usize| (first + k * group).min(count - group);
            let (mut at, mut lanes) = ([0; 8], [[0; 8]; ROWS]);
            for k in 0..F::READ {
                let (first, left, rows) = corner(begin(k));
                let columns = (0..LANES).filter(|lane| has(left + *lane as isize));
                let columns = columns.fold(0, |bits, lane| bits | 1 << lane);
                at[k] = first;
                lanes[rows].iter_mut().for_each(|row| row[k] = columns);
            }
            let tile = |lane: usize| begin(lane / group) + lane % group;
            let ends = |lane: &usize| (tile(*lane) + 1).is_multiple_of(across) || lane + 1 == LANES;
            let ends = (0..LANES).filter(ends).map(|lane| end(lane, tile(lane))).collect();
            Spans { at, lanes, ends }
        };
        let vectors = (0..count).step_by(LANES).map(vector).collect();
        Self { pitch: width, floats, rows: Rows::Lying(vectors) }
    }

    /// Reads the tiles of a channel that begins with `x` and writes them, transformed,
    /// to channel `c` of `tiles`. `patch` holds the packed copy.
    #[inline(always)]
    pub fn channel<S, F, const IN: usize, const POINTS: usize, const OUT: usize>(
        &self,
        s: S,
        x: &[f32],
        patch: &mut Buffer,
        tiles: &mut [f32],
        (places, c): (&Places, usize),
    ) where
        S: Simd,
        F: Form<IN, POINTS, OUT>,
    {
        let x = &x[..self.floats];
        let mut rows = [[s.splat(0.0); POINTS]; IN];
        let packed = match &self.rows {
            Rows::Lying(vectors) => {
                for (v, spans) in vectors.iter().enumerate() {
                    for r in 0..IN {
                        let row = self.row::<S, F, IN, POINTS, OUT>(s, x, spans, r);
                        put(&mut rows[r], F::points(s, row));
                    }
                    scatter::<S, F, IN, POINTS, OUT>(s, &rows, tiles, places, [c, v * LANES]);
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
                    let four = s.load4(patch, at, r * self.pitch + part * 4);
                    for j in 0..4 {
                        if part * 4 + j < IN {
                            row[part * 4 + j] = four[j];
                        }
                    }
                }
                put(&mut rows[r], F::points(s, row));
            }
            scatter::<S, F, IN, POINTS, OUT>(s, &rows, tiles, places, [c, v * LANES]);
        }
    }

    /// Row `r` of sixteen tiles.
    #[inline(always)]
    fn row<S, F, const IN: usize, const POINTS: usize, const OUT: usize>(
        &self,
        s: S,
        x: &[f32],
        Spans { at, lanes, ends }: &Spans,
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
            s.prefetch(from.wrapping_add(self.floats));
            // SAFETY: `new` sets the lanes that the picture has, and the channel all
            // `floats` of it.
            v[k] = unsafe { s.load_lanes(from, lanes[r][k]) };
        }
        let own = match F::READ {
            8 => s.columns8(v),
            _ => {
                let [a, b, c, d] = s.columns4([v[0], v[1], v[2], v[3]]);
                [a, b, c, d, v[4], v[5], v[6], v[7]]
            }
        };
        let mut row = [s.splat(0.0); IN];
        for j in 0..IN {
            if j < F::READ {
                row[j] = own[j];
                continue;
            }
            // The next tile's first.
            let next = j - F::READ;
            row[j] = s.rotate(own[next]);
            for end in ends {
                let from = x.as_ptr().wrapping_offset(end.at + down).wrapping_add(next);
                // SAFETY: as above.
                let v = if end.has[r][next] { unsafe { *from } } else { 0.0 };
                row[j] = s.select(s.mask(end.lane), s.splat(v), row[j]);
            }
        }
        row
    }
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
    for j in 0..POINTS {
        let mut column = [s.splat(0.0); IN];
        for i in 0..IN {
            column[i] = rows[i][j];
        }
        let column = F::points(s, column);
        for i in 0..POINTS {
            let p = i * POINTS + j;
            let at = places.at[p] + c * places.step[p] + first;
            if let Some(to) = tiles.get_mut(at..).and_then(|to| to.first_chunk_mut()) {
                s.store(column[i], to);
            }
        }
    }
}
