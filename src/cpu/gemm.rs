//! Matrix product on slices: the safe face of the `gemm` crate, one thread.
//!
//! Callers parallelise over tiles themselves, so that the packed operands stay in
//! each core's own cache.

/// A matrix inside a slice, any strides.
#[derive(Clone, Copy)]
pub struct Mat<'a> {
    /// Storage; element (i, j) is `data[i * row_stride + j * col_stride]`.
    pub data: &'a [f32],
    /// Rows.
    pub rows: usize,
    /// Columns.
    pub cols: usize,
    /// Distance between rows, elements.
    pub row_stride: usize,
    /// Distance between columns, elements.
    pub col_stride: usize,
}

impl<'a> Mat<'a> {
    /// Row-major matrix whose rows lie `row_stride` elements apart.
    pub fn new(data: &'a [f32], rows: usize, cols: usize, row_stride: usize) -> Self {
        Self { data, rows, cols, row_stride, col_stride: 1 }
    }

    /// The transposed view.
    #[must_use]
    pub fn t(self) -> Self {
        Self {
            rows: self.cols,
            cols: self.rows,
            row_stride: self.col_stride,
            col_stride: self.row_stride,
            ..self
        }
    }

    /// One past the last element touched.
    fn extent(&self) -> usize {
        if self.rows == 0 || self.cols == 0 {
            return 0;
        }
        (self.rows - 1) * self.row_stride + (self.cols - 1) * self.col_stride + 1
    }
}

/// `dst = scale · lhs · rhs`, or `dst += …` with `accumulate`. `dst` is row-major,
/// its rows `row_stride` elements apart.
///
/// # Panics
/// Where a matrix reaches past its slice or the inner sizes differ: the bounds
/// check that makes the call below sound.
pub fn gemm(
    dst: &mut [f32],
    row_stride: usize,
    lhs: Mat<'_>,
    rhs: Mat<'_>,
    scale: f32,
    accumulate: bool,
) {
    let (m, k, n) = (lhs.rows, lhs.cols, rhs.cols);
    assert_eq!(k, rhs.rows, "gemm: inner sizes");
    assert!(lhs.extent() <= lhs.data.len() && rhs.extent() <= rhs.data.len(), "gemm: operands");
    if m == 0 || n == 0 {
        return;
    }
    assert!(row_stride >= n && (m - 1) * row_stride + n <= dst.len(), "gemm: destination");
    // SAFETY: every element that the product reads or writes lies inside its slice
    // (asserted above), `dst` is borrowed exclusively, and its rows do not overlap.
    #[allow(unsafe_code, reason = "the gemm crate takes raw pointers")]
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            dst.as_mut_ptr(),
            1,
            row_stride as isize,
            accumulate,
            lhs.data.as_ptr(),
            lhs.col_stride as isize,
            lhs.row_stride as isize,
            rhs.data.as_ptr(),
            rhs.col_stride as isize,
            rhs.row_stride as isize,
            1.0,
            scale,
            false,
            false,
            false,
            gemm::Parallelism::None,
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn agrees_with_three_loops() {
        let (m, k, n) = (7, 13, 9);
        let a: Vec<f32> = (0..m * k).map(|i| (i as f32 * 0.7).sin()).collect();
        let b: Vec<f32> = (0..k * n).map(|i| (i as f32 * 0.3).cos()).collect();
        let mut dst = vec![1.0; m * (n + 2)];
        gemm(&mut dst, n + 2, Mat::new(&a, m, k, k), Mat::new(&b, k, n, n), 2.0, true);
        for i in 0..m {
            for j in 0..n + 2 {
                let dot: f32 =
                    (0..k).map(|x| if j < n { a[i * k + x] * b[x * n + j] } else { 0.0 }).sum();
                let v = dst[i * (n + 2) + j];
                assert!((v - 1.0 - 2.0 * dot).abs() < 1e-5, "{i} {j}: {v}");
            }
        }
    }

    #[test]
    #[should_panic(expected = "gemm: destination")]
    fn short_destination_is_refused() {
        let a = [1.0; 4];
        gemm(&mut [0.0; 3], 2, Mat::new(&a, 2, 2, 2), Mat::new(&a, 2, 2, 2), 1.0, false);
    }
}
