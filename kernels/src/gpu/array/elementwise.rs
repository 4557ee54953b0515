//! Functions of one or two arrays, element by element, and copies in another order.
//!
//! WGSL: wgsl/network/elementwise.wgsl.

use super::{ALIGNMENT, Array, misfit};
use crate::gpu::commands::Groups;
use crate::gpu::error::GpuError;
use crate::gpu::kernel::{Kernel, wgsl};
use crate::gpu::uniforms::ElementwiseUniform;

pub(crate) static ELEMENTWISE: Kernel = Kernel {
    name: "elementwise",
    entry: "main",
    source: wgsl!(ElementwiseUniform; "shared/grid", "shared/activation", "network/elementwise"),
};

const THREADS: usize = 64;
/// Axes of the kernel.
const AXES: usize = 7;

/// An activation function, numbered as in wgsl/shared/activation.wgsl.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PointwiseFunction {
    /// x.
    None = 0,
    /// max(0, x).
    Relu = 1,
    /// x·σ(x).
    Silu = 2,
    /// x·Φ(x).
    Gelu = 3,
    /// σ(x).
    Sigmoid = 4,
}

/// A function of wgsl/network/elementwise.wgsl.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Function {
    /// x.
    Copy,
    /// factor·x + offset.
    Affine(f32, f32),
    /// |x|.
    Absolute,
    /// x².
    Square,
    /// 1/x.
    Reciprocal,
    /// x within [low, high].
    Clamp(f32, f32),
    /// x + y.
    Plus,
    /// x − y.
    Minus,
    /// x·y.
    Times,
    /// x/y.
    Over,
    /// An activation function.
    Activation(PointwiseFunction),
    /// √x.
    SquareRoot,
    /// x where y is above the first number, else the second.
    WhereAbove(f32, f32),
    /// x times the slope of an activation function at y.
    Slope(PointwiseFunction),
    /// x, with its sign changed where y is negative.
    Signed,
    /// x where y lies in [low, high], else 0.
    Within(f32, f32),
}

impl Function {
    /// Returns the number in the kernel, and the two parameters.
    fn parts(self) -> (u32, [f32; 2]) {
        match self {
            Self::Copy => (0, [0.0; 2]),
            Self::Affine(factor, offset) => (1, [factor, offset]),
            Self::Absolute => (2, [0.0; 2]),
            Self::Square => (3, [0.0; 2]),
            Self::Reciprocal => (4, [0.0; 2]),
            Self::Clamp(low, high) => (5, [low, high]),
            Self::Plus => (6, [0.0; 2]),
            Self::Minus => (7, [0.0; 2]),
            Self::Times => (8, [0.0; 2]),
            Self::Over => (9, [0.0; 2]),
            Self::Activation(_) => (10, [0.0; 2]),
            Self::SquareRoot => (11, [0.0; 2]),
            Self::WhereAbove(least, fill) => (12, [least, fill]),
            Self::Slope(_) => (13, [0.0; 2]),
            Self::Signed => (14, [0.0; 2]),
            Self::Within(low, high) => (15, [low, high]),
        }
    }
}

impl Function {
    /// Returns the name under which calls are counted.
    fn name(self) -> &'static str {
        match self {
            Self::Copy => "elementwise copy",
            Self::Activation(_) => "elementwise activation",
            Self::Plus => "elementwise sum",
            _ => "elementwise other",
        }
    }

    /// Returns whether there is a second operand.
    fn has_right(self) -> bool {
        match self {
            Self::Plus
            | Self::Minus
            | Self::Times
            | Self::Over
            | Self::WhereAbove(..)
            | Self::Slope(_)
            | Self::Signed
            | Self::Within(..) => true,
            Self::Copy
            | Self::Affine(..)
            | Self::Absolute
            | Self::Square
            | Self::Reciprocal
            | Self::Clamp(..)
            | Self::Activation(_)
            | Self::SquareRoot => false,
        }
    }
}

/// Strides of the axes, outermost first, and the first element.
#[derive(Clone, Debug)]
struct Walk {
    strides: Vec<usize>,
    first: usize,
}

impl Walk {
    /// Returns the strides of a contiguous array.
    fn contiguous(dims: &[usize]) -> Self {
        let mut strides = vec![1; dims.len()];
        for i in (1..dims.len()).rev() {
            strides[i - 1] = strides[i] * dims[i];
        }
        Self { strides, first: 0 }
    }

    /// Returns the strides in which an array of sizes `own` repeats its sizes of 1.
    fn repeating(own: &[usize]) -> Self {
        let mut walk = Self::contiguous(own);
        for (stride, size) in walk.strides.iter_mut().zip(own) {
            *stride *= usize::from(*size != 1);
        }
        walk
    }

    fn words(&self) -> [[u32; 4]; 2] {
        table(&self.strides, 0, self.first)
    }
}

/// `values` for the last axes, `fill` for those before, then `last`.
fn table(values: &[usize], fill: u32, last: usize) -> [[u32; 4]; 2] {
    let mut out = [fill; 8];
    for (to, value) in out[..AXES].iter_mut().rev().zip(values.iter().rev()) {
        *to = *value as u32;
    }
    out[AXES] = last as u32;
    let [a, b, c, d, e, f, g, h] = out;
    [[a, b, c, d], [e, f, g, h]]
}

/// Joins neighbouring axes that all `walks` visit as one axis, and drops axes of one index. An
/// index of the kernel costs a division for each axis.
fn merged(sizes: &[usize], walks: [&Walk; 3]) -> (Vec<usize>, [Walk; 3]) {
    let mut out = walks.map(|walk| Walk { strides: Vec::new(), first: walk.first });
    let mut kept: Vec<usize> = Vec::new();
    for (axis, &size) in sizes.iter().enumerate().filter(|(_, size)| **size != 1) {
        let strides = walks.map(|walk| walk.strides[axis]);
        let continues = |(walk, stride): (&Walk, usize)| {
            walk.strides.last().is_some_and(|outer| *outer == stride * size)
        };
        let joins = out.iter().zip(strides).all(continues);
        match kept.last_mut().filter(|_| joins) {
            Some(last) => *last *= size,
            None => kept.push(size),
        }
        for (walk, stride) in out.iter_mut().zip(strides) {
            match walk.strides.last_mut().filter(|_| joins) {
                Some(last) => *last = stride,
                None => walk.strides.push(stride),
            }
        }
    }
    if kept.is_empty() {
        kept.push(1);
        out.iter_mut().for_each(|walk| walk.strides.push(0));
    }
    (kept, out)
}

/// One call: result[…] = after(function(left[…], right[…])) over `sizes`.
struct Call<'a> {
    function: Function,
    after: PointwiseFunction,
    sizes: &'a [usize],
    left: (&'a Array, Walk),
    right: (&'a Array, Walk),
    result: (&'a Array, Walk),
}

impl Call<'_> {
    fn run(self) -> Result<(), GpuError> {
        let count: usize = self.sizes.iter().product();
        let walks = [&self.left.1, &self.right.1, &self.result.1];
        let (sizes, [left, right, result]) = merged(self.sizes, walks);
        if sizes.len() > AXES {
            return Err(misfit(ELEMENTWISE.name, format!("at most {AXES} axes"), self.sizes));
        }
        if count == 0 {
            return Ok(());
        }
        let recorder = &self.result.0.recorder;
        let (number, [first, second]) = self.function.parts();
        let uniform = ElementwiseUniform {
            count: count as u32,
            first,
            second,
            axes: sizes.len() as u32,
            sizes: table(&sizes, 1, 0),
            left: left.words(),
            right: right.words(),
            result: result.words(),
        };
        let kind = match self.function {
            Function::Activation(kind) | Function::Slope(kind) => f64::from(kind as u32),
            _ => 0.0,
        };
        let constants = [
            ("FUNCTION", f64::from(number)),
            ("ACTIVATION_KIND", kind),
            ("AFTER_KIND", f64::from(self.after as u32)),
        ];
        let [left, right, result] = [self.left.0, self.right.0, self.result.0].map(Array::binding);
        // A second operand that is not read is no traffic.
        let right = if self.function.has_right() { right } else { self.right.0.first_binding() };
        let call = (self.function.name(), &ELEMENTWISE);
        let groups = Groups::of(count, THREADS);
        recorder.call_named(call, &constants, &uniform, &[left, right, result], groups)
    }
}

impl Array {
    /// Computes `function` of every element.
    ///
    /// # Errors
    /// Errors of the device.
    pub fn map(&self, function: Function) -> Result<Self, GpuError> {
        let result = self.recorder.empty(&self.dims)?;
        let flat = [self.count()];
        let walk = Walk::contiguous(&flat);
        Call {
            function,
            after: PointwiseFunction::None,
            sizes: &flat,
            left: (self, walk.clone()),
            right: (self, walk.clone()),
            result: (&result, walk),
        }
        .run()?;
        Ok(result)
    }

    pub(super) fn copied(&self) -> Result<Self, GpuError> {
        self.map(Function::Copy)
    }

    /// Computes `function` of this array and `other`, whose sizes of 1 are repeated.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn with(&self, other: &Self, function: Function) -> Result<Self, GpuError> {
        self.with_then(other, function, PointwiseFunction::None)
    }

    /// [`Array::with`], then an activation function, in one call.
    ///
    /// # Errors
    /// As [`Array::with`].
    pub fn with_then(
        &self,
        other: &Self,
        function: Function,
        after: PointwiseFunction,
    ) -> Result<Self, GpuError> {
        let fits = self.dims.len() == other.dims.len()
            && self.dims.iter().zip(&other.dims).all(|(a, b)| a == b || *b == 1);
        if !fits {
            let expected = format!("{:?} or sizes of 1", self.dims);
            return Err(misfit(ELEMENTWISE.name, expected, &other.dims));
        }
        let result = self.recorder.empty(&self.dims)?;
        let walk = Walk::contiguous(&self.dims);
        Call {
            function,
            after,
            sizes: &self.dims,
            left: (self, walk.clone()),
            right: (other, Walk::repeating(&other.dims)),
            result: (&result, walk),
        }
        .run()?;
        Ok(result)
    }

    /// Copies elements that `walk` visits over `dims`.
    fn gathered(&self, dims: &[usize], walk: Walk) -> Result<Self, GpuError> {
        let result = self.recorder.empty(dims)?;
        Call {
            function: Function::Copy,
            after: PointwiseFunction::None,
            sizes: dims,
            left: (self, walk.clone()),
            right: (self, walk),
            result: (&result, Walk::contiguous(dims)),
        }
        .run()?;
        Ok(result)
    }

    /// Returns `len` indices from `start` on of dimension `dim`.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for a range outside the dimension; errors of the device.
    pub fn narrow(&self, dim: usize, start: usize, len: usize) -> Result<Self, GpuError> {
        let [outer, length, inner] = self.around(dim)?;
        if start + len > length {
            let expected = format!("indices below {length}");
            return Err(misfit("narrow", expected, &[start, len]));
        }
        let mut dims = self.dims.clone();
        dims[dim] = len;
        if outer == 1 && (self.offset + start * inner).is_multiple_of(ALIGNMENT) {
            return Ok(Self { offset: self.offset + start * inner, dims, ..self.clone() });
        }
        let mut walk = Walk::contiguous(&self.dims);
        walk.first = start * inner;
        self.gathered(&dims, walk)
    }

    /// Reorders the dimensions: dimension i of the result is dimension `order[i]`.
    ///
    /// # Errors
    /// [`GpuError::Argument`] where `order` is no permutation; errors of the device.
    pub fn permuted(&self, order: &[usize]) -> Result<Self, GpuError> {
        let mut sorted = order.to_vec();
        sorted.sort_unstable();
        if !sorted.iter().copied().eq(0..self.dims.len()) {
            let expected = format!("a permutation of {} dimensions", self.dims.len());
            return Err(misfit("permute", expected, order));
        }
        let own = Walk::contiguous(&self.dims);
        let dims: Vec<usize> = order.iter().map(|&i| self.dims[i]).collect();
        let strides = order.iter().map(|&i| own.strides[i]).collect();
        self.gathered(&dims, Walk { strides, first: 0 })
    }

    /// Repeats sizes of 1 until the dimensions are `dims`.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub fn expanded(&self, dims: &[usize]) -> Result<Self, GpuError> {
        let fits = self.dims.len() == dims.len()
            && self.dims.iter().zip(dims).all(|(own, size)| own == size || *own == 1);
        if fits {
            self.gathered(dims, Walk::repeating(&self.dims))
        } else {
            Err(misfit("expand", format!("{dims:?} or sizes of 1"), &self.dims))
        }
    }

    /// Joins `parts` along dimension `dim`.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for no parts or other sizes; errors of the device.
    pub fn joined(parts: &[&Self], dim: usize) -> Result<Self, GpuError> {
        let Some(first) = parts.first() else {
            return Err(misfit("join", "an array".to_owned(), &[]));
        };
        first.around(dim)?;
        let mut dims = first.dims.clone();
        dims[dim] = 0;
        for part in parts {
            let same = |(i, (a, b)): (usize, (&usize, &usize))| i == dim || a == b;
            let fits = part.dims.len() == dims.len()
                && part.dims.iter().zip(&first.dims).enumerate().all(same);
            if !fits {
                let expected = format!("{:?} except in dimension {dim}", first.dims);
                return Err(misfit("join", expected, &part.dims));
            }
            dims[dim] += part.dims[dim];
        }
        let result = first.recorder.empty(&dims)?;
        let whole = Walk::contiguous(&dims);
        let mut start = 0;
        for part in parts {
            let walk = Walk::contiguous(&part.dims);
            let to = Walk { first: start * whole.strides[dim], ..whole.clone() };
            Call {
                function: Function::Copy,
                after: PointwiseFunction::None,
                sizes: &part.dims,
                left: (part, walk.clone()),
                right: (part, walk),
                result: (&result, to),
            }
            .run()?;
            start += part.dims[dim];
        }
        Ok(result)
    }

    /// Returns an array of zeros of sizes `dims` with this array's elements at every `stride`-th
    /// place of each dimension, from index `first` on.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for sizes that do not fit; errors of the device.
    pub(super) fn spread(
        &self,
        dims: &[usize],
        strides: &[usize],
        first: &[usize],
    ) -> Result<Self, GpuError> {
        let fits = dims.len() == self.dims.len()
            && (0..dims.len()).all(|i| {
                let last = self.dims[i].saturating_sub(1) * strides[i] + first[i];
                last < dims[i]
            });
        if !fits {
            return Err(misfit("spread", format!("sizes within {dims:?}"), &self.dims));
        }
        let result = self.recorder.zeros(dims)?;
        let whole = Walk::contiguous(dims);
        let walk = Walk::contiguous(&self.dims);
        let to = Walk {
            strides: whole.strides.iter().zip(strides).map(|(own, step)| own * step).collect(),
            first: whole.strides.iter().zip(first).map(|(own, at)| own * at).sum(),
        };
        Call {
            function: Function::Copy,
            after: PointwiseFunction::None,
            sizes: &self.dims,
            left: (self, walk.clone()),
            right: (self, walk),
            result: (&result, to),
        }
        .run()?;
        Ok(result)
    }

    /// Repeats each pixel of `[B, C, h, w]` `s` × `s` times.
    ///
    /// # Errors
    /// [`GpuError::Argument`] for another rank; errors of the device.
    pub fn repeated(&self, s: usize) -> Result<Self, GpuError> {
        let &[b, c, h, w] = self.dims.as_slice() else {
            return Err(misfit("repeat", "[B, C, h, w]".to_owned(), &self.dims));
        };
        let strides = vec![c * h * w, h * w, w, 0, 1, 0];
        self.gathered(&[b, c, h, s, w, s], Walk { strides, first: 0 })?.reshape(&[
            b,
            c,
            s * h,
            s * w,
        ])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn axes_are_merged_where_all_arrays_continue() {
        let walk = |strides: &[usize]| Walk { strides: strides.to_vec(), first: 3 };
        let whole = walk(&[60, 20, 5, 1]);
        let (sizes, walks) = merged(&[2, 3, 4, 5], [&whole, &whole, &whole]);
        assert_eq!((sizes, walks[0].strides.clone(), walks[0].first), (vec![120], vec![1], 3));
        // A row of three channels is repeated over the pixels.
        let row = walk(&[0, 1, 0, 0]);
        let (sizes, walks) = merged(&[2, 3, 4, 5], [&whole, &row, &whole]);
        assert_eq!(sizes, [2, 3, 20]);
        assert_eq!(walks.map(|w| w.strides), [vec![60, 20, 1], vec![0, 1, 0], vec![60, 20, 1]]);
        // Axes in another order; an axis of one index.
        let turned = walk(&[1, 7, 24, 6]);
        let (sizes, walks) = merged(&[6, 1, 2, 4], [&turned, &turned, &walk(&[8, 8, 4, 1])]);
        assert_eq!((sizes, walks[0].strides.clone()), (vec![6, 8], vec![1, 6]));
        let one = walk(&[1, 1]);
        assert_eq!(merged(&[1, 1], [&one, &one, &one]).0, [1]);
    }
}
