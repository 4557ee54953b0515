//! Rows of records to vectors and back: lane r of vector i is element i of row r.

use super::{LANES, Simd, Vector, first_lanes_bits};

/// Layout of rows in a slice.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RowLayout {
    /// Elements from the start of one row to the start of the next.
    pub stride: usize,
    /// Number of rows, at least 1.
    pub count: usize,
}

impl RowLayout {
    /// First element of the row of `lane`; lanes past the last row repeat it.
    #[inline(always)]
    fn start(self, lane: usize) -> usize {
        lane.min(self.count - 1) * self.stride
    }

    /// Returns whether `length` elements of every row lie inside a slice of `len` elements.
    #[inline(always)]
    pub(super) fn fits(self, length: usize, len: usize) -> bool {
        self.count > 0 && self.start(LANES - 1) + length <= len
    }
}

/// [`Vector::load_rows`] element by element.
#[inline(always)]
pub(super) fn load<V: Vector, const L: usize>(rows: &[V::Element], layout: RowLayout) -> [V; L] {
    let mut tile = [[V::Element::default(); LANES]; L];
    for lane in 0..V::LANES {
        let start = layout.start(lane);
        for (out, &v) in tile.iter_mut().zip(&rows[start..start + L]) {
            out[lane] = v;
        }
    }
    let mut out = [V::constant(0.0); L];
    for (out, tile) in out.iter_mut().zip(&tile) {
        *out = V::load(tile);
    }
    out
}

/// [`Vector::store_rows`] element by element.
#[inline(always)]
pub(super) fn store<V: Vector, const L: usize>(
    from: &[V; L],
    layout: RowLayout,
    rows: &mut [V::Element],
) {
    let mut tile = [[V::Element::default(); LANES]; L];
    for (v, tile) in from.iter().zip(&mut tile) {
        v.store(tile);
    }
    for lane in 0..layout.count {
        let start = lane * layout.stride;
        for (v, tile) in rows[start..start + L].iter_mut().zip(&tile) {
            *v = tile[lane];
        }
    }
}

/// [`Vector::store_rows`] by a transpose and copies of whole rows: masked stores take dozens of
/// cycles on AMD's processors.
#[inline(always)]
pub(super) fn store_transposed<S: Simd, const L: usize>(
    s: S,
    from: &[S::F; L],
    layout: RowLayout,
    rows: &mut [f32],
) {
    let lines = transposed(s, from);
    for (lane, line) in lines.iter().enumerate().take(layout.count) {
        let mut row = [0.0; LANES];
        line.store(&mut row);
        let start = lane * layout.stride;
        rows[start..start + L].copy_from_slice(&row[..L]);
    }
}

/// [`Vector::load_rows`] by masked loads and a transpose.
#[inline(always)]
pub(super) fn load_transposed<S: Simd, const L: usize>(
    s: S,
    rows: &[f32],
    layout: RowLayout,
) -> [S::F; L] {
    assert!(L <= LANES && layout.fits(L, rows.len()), "rows: past the end of the slice");
    let bits = first_lanes_bits(L);
    let mut lines = [s.splat(0.0); LANES];
    for (lane, line) in lines.iter_mut().enumerate() {
        // SAFETY: the first L elements of every row lie in `rows` by the check above.
        *line = unsafe { s.load_masked(rows.as_ptr().add(layout.start(lane)), bits) };
    }
    let columns = s.transpose(lines);
    let mut out = [s.splat(0.0); L];
    out.copy_from_slice(&columns[..L]);
    out
}

/// Lane r of the vectors in `from` as row r, with zeros behind element `L` − 1.
#[inline(always)]
pub(super) fn transposed<S: Simd, const L: usize>(s: S, from: &[S::F; L]) -> [S::F; LANES] {
    const { assert!(L <= LANES) };
    let mut columns = [s.splat(0.0); LANES];
    columns[..L].copy_from_slice(from);
    s.transpose(columns)
}
