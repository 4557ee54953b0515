//! Positions of K children in their parent's pixel.
//!
//! K that is no square has the lattice or grid with the widest spacing. The R2 sequence was considered, but its
//! first points are not centred in their pixel. Squares serve better than other K
//! (`tools/lab/tried.md`, "Limits on the Gaussians"), so limits on the number of Gaussians choose among them.

/// Positions of the K children in (−½, ½)², input px: a grid for square K, else the better one of a
/// grid of whole rows and a lattice.
///
/// A lattice has one child in each of K columns and of K rows: child k is in column k and in row
/// g·k mod K (a rank-1 lattice; Niederreiter, Random Number Generation and Quasi-Monte Carlo
/// Methods, chapter 5). The better one has the larger distance between neighbours, those in the
/// next pixels among them. The mean position is the pixel's centre in all cases.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Positions {
    /// Columns that hold children.
    pub columns: u32,
    /// Rows that hold children.
    pub rows: u32,
    /// g of a lattice; 0 of a grid.
    pub step: u32,
}

impl Positions {
    /// Positions of `children` (K).
    pub fn new(children: usize) -> Self {
        let k = children.max(1) as u32;
        let side = k.isqrt();
        if side * side == k {
            return Self { columns: side, rows: side, step: 0 };
        }
        let grids = (2..=side).filter(|rows| k.is_multiple_of(*rows));
        let grids = grids.map(|rows| Self { columns: k / rows, rows, step: 0 });
        let lattices = (1..k).filter(|step| coprime(*step, k));
        let lattices = lattices.map(|step| Self { columns: k, rows: k, step });
        let mut best = Self { columns: k, rows: k, step: 1 };
        for candidate in lattices.chain(grids) {
            if candidate.nearest_sq() > best.nearest_sq() {
                best = candidate;
            }
        }
        best
    }

    /// Returns K.
    pub fn children(self) -> usize {
        let rows = if self.step == 0 { self.rows } else { 1 };
        (self.columns * rows) as usize
    }

    /// Column and row of child `k`, from the top left.
    pub fn cell(self, k: usize) -> [usize; 2] {
        let (columns, rows, step) = (self.columns as usize, self.rows as usize, self.step as usize);
        match step {
            0 => [k % columns, k / columns],
            step => [k, step * k % rows],
        }
    }

    /// Position of child `k` relative to its parent's pixel centre, input px, x and y.
    pub fn of(self, k: usize) -> [f64; 2] {
        let [column, row] = self.cell(k);
        let along = |at: usize, cells: u32| (at as f64 + 0.5) * (1.0 / f64::from(cells)) - 0.5;
        [along(column, self.columns), along(row, self.rows)]
    }

    /// Squared distance of nearest children in a plane of pixels, in units of 1/K² px², so that it is
    /// a whole number.
    fn nearest_sq(self) -> u32 {
        let k = self.children() as u32;
        let across = |of: u32, cells: u32| of.min(cells - of) * (k / cells);
        let from_first = |i: u32| {
            let [column, row] = self.cell(i as usize).map(|at| at as u32);
            across(column, self.columns).pow(2) + across(row, self.rows).pow(2)
        };
        (1..k).map(from_first).min().unwrap_or(k * k)
    }
}

/// Returns whether 1 is the only common divisor.
fn coprime(a: u32, b: u32) -> bool {
    match b {
        0 => a == 1,
        b => coprime(b, a % b),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn square_numbers_make_grids_and_others_the_widest_pattern() {
        let pattern = |k| {
            let p = Positions::new(k);
            (p.columns, p.rows, p.step)
        };
        assert_eq!([1, 4, 9, 64].map(pattern), [(1, 1, 0), (2, 2, 0), (3, 3, 0), (8, 8, 0)]);
        assert_eq!([2, 3, 5, 8].map(pattern), [(2, 2, 1), (3, 3, 1), (5, 5, 2), (8, 8, 3)]);
        assert_eq!(pattern(6), (3, 2, 0));
        assert_eq!([0, 1].map(|k| Positions::new(2).of(k)), [[-0.25, -0.25], [0.25, 0.25]]);
        let [x, y] = Positions::new(9).of(5);
        assert!((x - 1.0 / 3.0).abs() < 1e-15 && y.abs() < 1e-15);
    }

    /// Checked against every pair of children and every pixel around: in the pixel, all at different
    /// places, their mean in the centre, and no further apart than circles can be packed.
    #[test]
    fn children_are_apart_and_centred() {
        for k in 2..=super::super::CHILDREN_MAX {
            let positions = Positions::new(k);
            assert_eq!(positions.children(), k);
            let at: Vec<[f64; 2]> = (0..k).map(|i| positions.of(i)).collect();
            let mut nearest = f64::INFINITY;
            for (i, a) in at.iter().enumerate() {
                assert!(a.iter().all(|x| x.abs() < 0.5), "{k} {a:?}");
                for b in &at[..i] {
                    let across = [0, 1].map(|c| (a[c] - b[c]).abs()).map(|d| d.min(1.0 - d));
                    nearest = nearest.min(across[0].hypot(across[1]));
                }
            }
            for c in [0, 1] {
                assert!(at.iter().map(|p| p[c]).sum::<f64>().abs() < 1e-9 * k as f64, "{k}");
            }
            // Hexagonal packing; primes have good lattices, and so have most numbers.
            let densest = (2.0 / (3f64.sqrt() * k as f64)).sqrt();
            assert!(
                nearest <= densest + 1e-9 && nearest > 0.5 * densest,
                "{k} {nearest} {densest}"
            );
        }
    }
}
