//! Compares products with three loops in f64, at every SIMD level.

use super::*;

fn numbers(n: usize, k: f32) -> Vec<f32> {
    (0..n).map(|i| ((i as f32 + 0.5) * k).sin()).collect()
}

/// Returns Σ lhs(i, x)·rhs(x, j) in f64.
fn dot(lhs: Mat<'_>, rhs: Mat<'_>, i: usize, j: usize) -> f64 {
    let at = |m: Mat<'_>, i: usize, j: usize| m.data[i * m.row_stride + j * m.col_stride];
    (0..lhs.cols).map(|x| f64::from(at(lhs, i, x)) * f64::from(at(rhs, x, j))).sum()
}

/// Sizes around every limit: rows of a tile, vectors and panels of columns, parts of the
/// sums. Each factor as it is and transposed.
#[test]
fn agrees_with_three_loops() {
    for (m, k, n) in [(7, 13, 9), (6, 129, 64), (23, 256, 80), (1, 1, 1), (40, 300, 150)] {
        let (a, b) = (numbers(m * k, 0.7), numbers(k * n, 0.3));
        let own = numbers(m * (n + 2), 1.9);
        let row = numbers(n, 2.3);
        for transposed in 0..4 {
            let lhs = match transposed & 1 {
                0 => Mat::new(&a, m, k, k),
                _ => Mat::new(&a, k, m, m).t(),
            };
            let rhs = match transposed & 2 {
                0 => Mat::new(&b, k, n, n),
                _ => Mat::new(&b, n, k, k).t(),
            };
            for base in [Base::Zero, Base::Own, Base::Row(&row)] {
                let mut dst = own.clone();
                let packed = Packed::new(rhs);
                product((&mut dst, n + 2), lhs, &packed, 2.0, base);
                for (at, (&v, &before)) in dst.iter().zip(&own).enumerate() {
                    let (i, j) = (at / (n + 2), at % (n + 2));
                    if j >= n {
                        assert_eq!(v, before, "{m} {k} {n}: beyond the row at {i} {j}");
                        continue;
                    }
                    let base = match base {
                        Base::Zero => 0.0,
                        Base::Own => before,
                        Base::Row(row) => row[j],
                    };
                    let want = f64::from(base) + 2.0 * dot(lhs, rhs, i, j);
                    let far = (f64::from(v) - want).abs();
                    assert!(far < 4e-6 * (k as f64).sqrt() + 1e-6, "{m} {k} {n} {i} {j}: {far}");
                }
            }
        }
    }
}

#[test]
fn every_level_agrees_and_rows_may_be_cut_anywhere() {
    let (m, k, n) = (31, 200, 100);
    let (a, b) = (numbers(m * k, 0.7), numbers(k * n, 0.3));
    let rhs = Packed::new(Mat::new(&b, k, n, n));
    let run = |level: SimdLevel, cut: usize| {
        let mut dst = vec![0.0; m * n];
        for (first, dst) in (0..m).step_by(cut).zip(dst.chunks_mut(cut * n)) {
            let lhs = Mat::new(&a[first * k..], dst.len() / n, k, k);
            let dst = OutputRows { at: dst.as_mut_ptr(), row_stride: n };
            let (rhs, base) = (&rhs, Base::Zero);
            level.run(Product { dst, lhs, rhs, scale: 1.0, base });
        }
        dst
    };
    let mut fused = None;
    for &level in SimdLevel::available() {
        let whole = run(level, m);
        for cut in [1, 5, 8] {
            assert_eq!(run(level, cut), whole, "{level:?} in blocks of {cut}");
        }
        if level == SimdLevel::Baseline {
            continue;
        }
        assert_eq!(fused.get_or_insert_with(|| whole.clone()), &whole, "{level:?}");
    }
}

#[test]
fn empty_sums_give_the_base() {
    let mut dst = [5.0; 4];
    product(
        (&mut dst, 2),
        Mat::new(&[], 2, 0, 0),
        &Packed::new(Mat::new(&[], 0, 2, 2)),
        1.0,
        Base::Row(&[1.0, 2.0]),
    );
    assert_eq!(dst, [1.0, 2.0, 1.0, 2.0]);
}

#[test]
#[should_panic(expected = "gemm: destination")]
fn short_destination_is_refused() {
    let a = [1.0; 4];
    gemm(&mut [0.0; 3], 2, Mat::new(&a, 2, 2, 2), Mat::new(&a, 2, 2, 2), 1.0, false);
}
