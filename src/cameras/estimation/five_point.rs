//! Essential matrices of five matched bearings.
//!
//! Source: D. Nistér, "An efficient solution to the five-point relative pose problem", PAMI 2004.
//! The ten cubic constraints are reduced to one polynomial of degree 10. Its real roots are found
//! between the roots of its derivative.

use super::two_view::Bearings;
use glam::{DMat3, DVec3};

/// Monomials of degree 3 or less in x, y, z, in the order in which the elimination needs them.
const MONOMIALS: [[u8; 3]; 20] = [
    [3, 0, 0],
    [0, 3, 0],
    [2, 1, 0],
    [1, 2, 0],
    [2, 0, 1],
    [2, 0, 0],
    [0, 2, 1],
    [0, 2, 0],
    [1, 1, 1],
    [1, 1, 0],
    [1, 0, 2],
    [1, 0, 1],
    [1, 0, 0],
    [0, 1, 2],
    [0, 1, 1],
    [0, 1, 0],
    [0, 0, 3],
    [0, 0, 2],
    [0, 0, 1],
    [0, 0, 0],
];

/// Position of x^i y^j z^k in [`MONOMIALS`].
const fn position(power: [usize; 3]) -> usize {
    let mut at = 0;
    while at < 20 {
        let m = MONOMIALS[at];
        if m[0] as usize == power[0] && m[1] as usize == power[1] && m[2] as usize == power[2] {
            return at;
        }
        at += 1;
    }
    0
}

/// `POSITIONS[i][j][k]` is the position of x^i y^j z^k; 0 where the degree exceeds 3.
const POSITIONS: [[[usize; 4]; 4]; 4] = {
    let mut table = [[[0; 4]; 4]; 4];
    let mut i = 0;
    while i < 4 {
        let mut j = 0;
        while i + j < 4 {
            let mut k = 0;
            while i + j + k < 4 {
                table[i][j][k] = position([i, j, k]);
                k += 1;
            }
            j += 1;
        }
        i += 1;
    }
    table
};

/// A linear polynomial: coefficients of x, y, z, 1.
type Linear = [f64; 4];
/// Powers of x, y, z in the terms of [`Linear`].
const UNITS: [[usize; 3]; 4] = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]];

/// A product of two linear polynomials, `[i][j]` for the terms i ≤ j.
type Quadratic = [[f64; 4]; 4];

/// Adds `scale · a · b` to `sum`.
fn add_product(sum: &mut Quadratic, a: &Linear, b: &Linear, scale: f64) {
    for i in 0..4 {
        for j in 0..4 {
            sum[i.min(j)][i.max(j)] += scale * a[i] * b[j];
        }
    }
}

/// Adds `q · l` to a row of 20 coefficients.
fn add_cubic(row: &mut [f64; 20], q: &Quadratic, l: &Linear) {
    for i in 0..4 {
        for j in i..4 {
            for (k, value) in l.iter().enumerate() {
                let power: [usize; 3] =
                    std::array::from_fn(|n| UNITS[i][n] + UNITS[j][n] + UNITS[k][n]);
                row[POSITIONS[power[0]][power[1]][power[2]]] += q[i][j] * value;
            }
        }
    }
}

/// Returns all real essential matrices with x_bᵀ E x_a = 0 for five bearings, at most ten. Their
/// length is arbitrary.
pub(super) fn essential_matrices(sample: &[Bearings; 5]) -> Vec<DMat3> {
    let Some(basis) = null_space(sample) else { return Vec::new() };
    // Entry (r, c) of E = x·B0 + y·B1 + z·B2 + B3, row-major.
    let e: [Linear; 9] = std::array::from_fn(|i| std::array::from_fn(|n| basis[n][i]));
    let Some(reduced) = eliminate(constraints(&e)) else { return Vec::new() };
    // Rows 4 to 9 begin with x²z, x², y²z, y², xyz, xy: the differences of neighbours, the second
    // times z, hold x, y and 1 times polynomials of z.
    let rows: [[Vec<f64>; 3]; 3] = std::array::from_fn(|i| {
        let (p, q) = (&reduced[4 + 2 * i], &reduced[5 + 2 * i]);
        [difference(&p[10..13], &q[10..13]), difference(&p[13..16], &q[13..16]), {
            difference(&p[16..20], &q[16..20])
        }]
    });
    let polynomial = determinant(&rows);
    real_roots(&polynomial)
        .into_iter()
        .filter_map(|z| {
            let m: [DVec3; 3] = std::array::from_fn(|i| {
                DVec3::from_array(std::array::from_fn(|j| evaluate(&rows[i][j], z)))
            });
            // The rows have rank 2: of the three cross products the longest is the most exact.
            let crosses = [m[0].cross(m[1]), m[0].cross(m[2]), m[1].cross(m[2])];
            let solution = crosses
                .into_iter()
                .reduce(|a, b| if b.length_squared() > a.length_squared() { b } else { a })?;
            let (x, y) = (solution.x / solution.z, solution.y / solution.z);
            let v: [f64; 9] =
                std::array::from_fn(|i| e[i][0] * x + e[i][1] * y + e[i][2] * z + e[i][3]);
            let matrix = DMat3::from_cols_array(&v).transpose();
            matrix.is_finite().then_some(matrix)
        })
        .collect()
}

/// Returns four orthonormal vectors that are orthogonal to the five equations x_bᵀ E x_a = 0.
fn null_space(sample: &[Bearings; 5]) -> Option<[[f64; 9]; 4]> {
    let mut found: Vec<[f64; 9]> = Vec::with_capacity(9);
    for m in sample {
        let [a, b] = m.rays().map(|ray| ray.to_array());
        let row = std::array::from_fn(|i| b[i / 3] * a[i % 3]);
        // Nearly dependent equations determine no geometry.
        found.push(orthonormal(row, &found, 1e-9)?);
    }
    // The axes with the largest part outside the span complete the basis.
    while found.len() < 9 {
        let outside = |axis: usize| 1.0 - found.iter().map(|v| v[axis] * v[axis]).sum::<f64>();
        let axis = (0..9).max_by(|&a, &b| outside(a).total_cmp(&outside(b)))?;
        let mut unit = [0.0; 9];
        unit[axis] = 1.0;
        found.push(orthonormal(unit, &found, 1e-9)?);
    }
    Some(std::array::from_fn(|i| found[5 + i]))
}

/// Removes the parts along `others` from `v`, twice for accuracy, and normalises. `None` where less
/// than `least` of its length remains.
fn orthonormal(mut v: [f64; 9], others: &[[f64; 9]], least: f64) -> Option<[f64; 9]> {
    let length = |v: &[f64; 9]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let before = length(&v);
    for _ in 0..2 {
        for o in others {
            let along: f64 = v.iter().zip(o).map(|(a, b)| a * b).sum();
            v.iter_mut().zip(o).for_each(|(a, b)| *a -= along * b);
        }
    }
    let after = length(&v);
    (after > least * before).then(|| v.map(|x| x / after))
}

/// Returns the ten equations 2·E Eᵀ E − tr(E Eᵀ)·E = 0 and det E = 0 as coefficients of
/// [`MONOMIALS`].
fn constraints(e: &[Linear; 9]) -> [[f64; 20]; 10] {
    let mut rows = [[0.0; 20]; 10];
    let mut square = [[[[0.0; 4]; 4]; 3]; 3];
    let mut trace: Quadratic = [[0.0; 4]; 4];
    for (i, line) in square.iter_mut().enumerate() {
        for (j, entry) in line.iter_mut().enumerate() {
            (0..3).for_each(|k| add_product(entry, &e[3 * i + k], &e[3 * j + k], 2.0));
        }
        (0..3).for_each(|k| add_product(&mut trace, &e[3 * i + k], &e[3 * i + k], -1.0));
    }
    for i in 0..3 {
        for j in 0..3 {
            let row = &mut rows[3 * i + j];
            (0..3).for_each(|k| add_cubic(row, &square[i][k], &e[3 * k + j]));
            add_cubic(row, &trace, &e[3 * i + j]);
        }
    }
    for (c, [d, f]) in [(0, [1, 2]), (1, [2, 0]), (2, [0, 1])] {
        let mut minor: Quadratic = [[0.0; 4]; 4];
        add_product(&mut minor, &e[3 + d], &e[6 + f], 1.0);
        add_product(&mut minor, &e[3 + f], &e[6 + d], -1.0);
        add_cubic(&mut rows[9], &minor, &e[c]);
    }
    rows
}

/// Gauss-Jordan elimination of the first ten columns with row pivots. `None` where they are
/// singular.
fn eliminate(mut rows: [[f64; 20]; 10]) -> Option<[[f64; 20]; 10]> {
    for column in 0..10 {
        let pivot = (column..10)
            .max_by(|&a, &b| rows[a][column].abs().total_cmp(&rows[b][column].abs()))?;
        rows.swap(column, pivot);
        let top = rows[column][column];
        if !(top.abs() > 1e-14) {
            return None;
        }
        rows[column].iter_mut().for_each(|v| *v /= top);
        let line = rows[column];
        for (r, row) in rows.iter_mut().enumerate() {
            let factor = row[column];
            if r != column && factor != 0.0 {
                row[column..].iter_mut().zip(&line[column..]).for_each(|(a, b)| *a -= factor * b);
            }
        }
    }
    Some(rows)
}

/// Returns p − z·q for polynomials with the highest power first.
fn difference(p: &[f64], q: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; p.len() + 1];
    out[1..].copy_from_slice(p);
    out.iter_mut().zip(q).for_each(|(o, v)| *o -= v);
    out
}

fn multiply(p: &[f64], q: &[f64]) -> Vec<f64> {
    let mut out = vec![0.0; p.len() + q.len() - 1];
    for (i, a) in p.iter().enumerate() {
        q.iter().enumerate().for_each(|(j, b)| out[i + j] += a * b);
    }
    out
}

/// Returns the determinant of a 3 × 3 matrix of polynomials; the three products have one degree.
fn determinant(m: &[[Vec<f64>; 3]; 3]) -> Vec<f64> {
    let mut sum = vec![0.0; 11];
    for (i, [j, k]) in [(0, [1, 2]), (1, [2, 0]), (2, [0, 1])] {
        let (p, q) = (multiply(&m[1][j], &m[2][k]), multiply(&m[1][k], &m[2][j]));
        let minor: Vec<f64> = p.iter().zip(&q).map(|(a, b)| a - b).collect();
        sum.iter_mut().zip(multiply(&m[0][i], &minor)).for_each(|(s, v)| *s += v);
    }
    sum
}

/// Evaluates a polynomial, highest power first.
fn evaluate(p: &[f64], x: f64) -> f64 {
    p.iter().fold(0.0, |sum, c| sum * x + c)
}

/// Returns the real roots of a polynomial, highest power first, in rising order. Between two roots
/// of the derivative there is at most one.
pub(super) fn real_roots(p: &[f64]) -> Vec<f64> {
    let largest = p.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    let first = p.iter().position(|v| v.abs() > 1e-14 * largest).unwrap_or(p.len());
    let p = &p[first..];
    let degree = p.len().saturating_sub(1);
    if degree == 0 || !largest.is_finite() {
        return Vec::new();
    }
    // Cauchy's bound contains all roots.
    let bound = 1.0 + p[1..].iter().fold(0.0f64, |m, v| m.max((v / p[0]).abs()));
    if degree == 1 {
        return vec![-p[1] / p[0]];
    }
    let derivative: Vec<f64> =
        p[..degree].iter().enumerate().map(|(i, v)| v * (degree - i) as f64).collect();
    let mut ends = vec![-bound];
    ends.extend(real_roots(&derivative).into_iter().filter(|r| r.abs() < bound));
    ends.push(bound);
    ends.windows(2).filter_map(|w| root_between(p, &derivative, w[0], w[1])).collect()
}

/// Finds the root of a monotone piece by Newton's steps, with bisection where they leave it.
fn root_between(p: &[f64], derivative: &[f64], mut low: f64, mut high: f64) -> Option<f64> {
    let (at_low, at_high) = (evaluate(p, low), evaluate(p, high));
    if at_low == 0.0 {
        return Some(low);
    }
    if (at_low > 0.0) == (at_high > 0.0) {
        return None;
    }
    let mut x = 0.5 * (low + high);
    for _ in 0..200 {
        let value = evaluate(p, x);
        if (value > 0.0) == (at_low > 0.0) {
            low = x;
        } else {
            high = x;
        }
        let newton = x - value / evaluate(derivative, x);
        let next = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
        if (next - x).abs() <= 1e-14 * (1.0 + x.abs()) {
            return Some(next);
        }
        x = next;
    }
    Some(x)
}

#[cfg(test)]
mod tests {
    use super::super::two_view::{Relative, tests::scene};
    use super::*;

    #[test]
    fn one_of_the_solutions_is_the_right_one() {
        let mut worst = 0.0f64;
        for seed in 0..200 {
            let (relative, points) = scene(5, 0.0, seed);
            let sample: [Bearings; 5] = std::array::from_fn(|i| points[i]);
            let solutions = essential_matrices(&sample);
            assert!(!solutions.is_empty() && solutions.len() <= 10, "seed {seed}");
            let right = Relative::essential(&relative);
            let distance = |e: &DMat3| {
                let e = *e * (1.0 / e.to_cols_array().iter().map(|v| v * v).sum::<f64>().sqrt());
                let r = right * (1.0 / 2f64.sqrt());
                let off =
                    |s: f64| (e - r * s).to_cols_array().iter().fold(0.0f64, |m, v| m.max(v.abs()));
                off(1.0).min(off(-1.0))
            };
            for e in &solutions {
                for m in &sample {
                    let residual = m.b.extend(1.0).dot(*e * m.a.extend(1.0));
                    assert!(residual.abs() < 1e-8, "seed {seed}: {residual}");
                }
            }
            let best = solutions.iter().map(distance).fold(f64::INFINITY, f64::min);
            worst = worst.max(best);
        }
        assert!(worst < 1e-5, "{worst}");
    }

    #[test]
    fn roots_of_polynomials_are_found_and_repeated_samples_give_none() {
        // (x − 1)(x + 2)(x − 3)(x² + 1)
        let p = multiply(
            &multiply(&[1.0, -1.0], &[1.0, 2.0]),
            &multiply(&[1.0, -3.0], &[1.0, 0.0, 1.0]),
        );
        let roots = real_roots(&p);
        assert_eq!(roots.len(), 3);
        for (r, want) in roots.iter().zip([-2.0, 1.0, 3.0]) {
            assert!((r - want).abs() < 1e-12, "{r}");
        }
        assert!(real_roots(&[0.0, 0.0]).is_empty() && real_roots(&[f64::NAN, 1.0]).is_empty());
        let (_, points) = scene(5, 0.0, 3);
        assert!(essential_matrices(&[points[0]; 5]).is_empty());
    }
}
