//! The Gaussian adapter as candle ops with gradients: raw head rows, distances and
//! densities to packed rows and SH. Formulas and layouts: [`subsplat_kernels::cpu::adapter`]. The
//! same in tensor operations: `tests/support/src/primaries_reference.rs`.

use super::{Number, borrowed, by_dtype, slice};
use candle_core::backend::BackendStorage;
use candle_core::{CpuStorage, CustomOp1, CustomOp3, Layout, Result, Shape, Tensor, bail};
use std::sync::{Arc, Mutex, PoisonError};
use subsplat_kernels::cpu::adapter as cpu;
use subsplat_kernels::cpu::adapter::colour::Frame;
use subsplat_kernels::layout::SPLAT_STRIDE;

pub use cpu::colour::Turn;
pub use cpu::{Adapter, View};

const NAME: &str = "adapter";

/// Packed rows of all Gaussians, and the sources of their SH, which are made on demand.
pub struct Placed {
    /// `[views·H·W·G, 11]`, offsets in [`subsplat_kernels::layout`].
    pub rows: Tensor,
    raw: Tensor,
    adapter: Arc<Adapter>,
    slots: Slots,
}

/// Gradients of the two SH ([`Frame`]). candle's operations have one result each. The input of the SH
/// operation is the rows, so its backward pass runs first. It stores its gradient here for the
/// backward pass of the rows.
type Slots = Arc<Mutex<[Option<Tensor>; 2]>>;

/// Gaussians of `raw` `[…, H·W, 9 + 3·D]`, `depths` and `densities` `[…, H·W, G]`, the
/// dimensions in front counting the views, all f32 or all f64.
///
/// # Errors
/// Shapes that do not fit `adapter`, mixed dtypes.
pub fn place(
    raw: &Tensor,
    depths: &Tensor,
    densities: &Tensor,
    adapter: Adapter,
) -> Result<Placed> {
    let v = adapter.views.len();
    let [h, w] = adapter.size;
    let lanes = adapter.raw_lanes();
    let g = adapter.per_pixel;
    for (what, x, last) in [("raw", raw, lanes), ("depths", depths, g), ("densities", densities, g)]
    {
        let fits = x.dims().ends_with(&[h * w, last]) && x.elem_count() == v * h * w * last;
        if !fits || x.elem_count() == 0 {
            bail!("{NAME} {what}: expected {v} views of [{}, {last}], got {:?}", h * w, x.dims());
        }
    }
    if ![1, 4, 9, 16, 25].contains(&adapter.functions) {
        bail!("{NAME}: expected 1, 4, 9, 16 or 25 SH functions, got {}", adapter.functions);
    }
    let raw = raw.contiguous()?;
    let adapter = Arc::new(adapter);
    let slots = Slots::default();
    let op = Rows { adapter: adapter.clone(), slots: slots.clone() };
    let rows = raw.apply_op3(&depths.contiguous()?, &densities.contiguous()?, op)?;
    Ok(Placed { rows, raw: raw.detach(), adapter, slots })
}

impl Placed {
    /// SH in world frame, `[views·H·W·G, D, 3]`.
    ///
    /// # Errors
    /// Errors of candle.
    pub fn sh(&self) -> Result<Tensor> {
        self.colours(Frame::World)
    }

    /// SH in the source view's frame, `[views·H·W·G, 3, D]`.
    ///
    /// # Errors
    /// Errors of candle.
    pub fn sh_camera(&self) -> Result<Tensor> {
        self.colours(Frame::Camera)
    }

    fn colours(&self, frame: Frame) -> Result<Tensor> {
        let Self { rows, raw, adapter, slots } = self;
        let op =
            Colours { frame, raw: raw.clone(), adapter: adapter.clone(), slots: slots.clone() };
        rows.apply_op1(op)
    }
}

struct Rows {
    adapter: Arc<Adapter>,
    slots: Slots,
}

impl CustomOp3 for Rows {
    fn name(&self) -> &'static str {
        NAME
    }

    fn cpu_fwd(
        &self,
        s1: &CpuStorage,
        l1: &Layout,
        s2: &CpuStorage,
        l2: &Layout,
        s3: &CpuStorage,
        l3: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        by_dtype!(NAME, s1.dtype(), rows(&self.adapter, [(s1, l1), (s2, l2), (s3, l3)]))
    }

    fn bwd(
        &self,
        raw: &Tensor,
        depths: &Tensor,
        densities: &Tensor,
        _: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let slots = std::mem::take(&mut *self.slots.lock().unwrap_or_else(PoisonError::into_inner));
        by_dtype!(NAME, raw.dtype(), backward(&self.adapter, [raw, depths, densities], dy, slots))
    }
}

fn rows<T: Number>(
    adapter: &Adapter,
    [raw, depths, densities]: [(&CpuStorage, &Layout); 3],
) -> Result<(CpuStorage, Shape)> {
    let raw = slice::<T>(NAME, "raw", raw.0, raw.1)?;
    let depths = slice::<T>(NAME, "depths", depths.0, depths.1)?;
    let densities = slice::<T>(NAME, "densities", densities.0, densities.1)?;
    let n = depths.len();
    let mut out = vec![T::default(); n * SPLAT_STRIDE];
    cpu::forward(adapter, [raw, depths, densities], &mut out);
    Ok((T::to_cpu_storage_owned(out), Shape::from((n, SPLAT_STRIDE))))
}

type Triple = (Option<Tensor>, Option<Tensor>, Option<Tensor>);

fn backward<T: Number>(
    adapter: &Adapter,
    inputs: [&Tensor; 3],
    dy: &Tensor,
    slots: [Option<Tensor>; 2],
) -> Result<Triple> {
    let [raw, depths, densities] = inputs;
    let dy = dy.contiguous()?;
    // A slot that nothing reached is read as the rows' gradient, and left out below.
    let [world, camera] = [0, 1].map(|i| slots[i].as_ref().unwrap_or(&dy));
    let all = [raw, depths, densities, &dy, world, camera];
    let d = borrowed::<T, _, 6>(NAME, all, |[raw, depths, densities, rows, world, camera]| {
        let colours = [slots[0].as_ref().map(|_| world), slots[1].as_ref().map(|_| camera)];
        cpu::backward(adapter, [raw, depths, densities], cpu::Reached { rows, colours })
    })?;
    let tensor = |data: Vec<T>, like: &Tensor| Tensor::from_vec(data, like.dims(), like.device());
    Ok((
        Some(tensor(d.raw, raw)?),
        Some(tensor(d.depths, depths)?),
        Some(tensor(d.densities, densities)?),
    ))
}

struct Colours {
    frame: Frame,
    raw: Tensor,
    adapter: Arc<Adapter>,
    slots: Slots,
}

impl CustomOp1 for Colours {
    fn name(&self) -> &'static str {
        NAME
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        by_dtype!(NAME, s.dtype(), colours(self, l))
    }

    fn bwd(&self, rows: &Tensor, _: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let mut slots = self.slots.lock().unwrap_or_else(PoisonError::into_inner);
        let slot = match self.frame {
            Frame::World => &mut slots[0],
            Frame::Camera => &mut slots[1],
        };
        // The gradient of SH that were requested twice has two parts.
        *slot = Some(match slot.take() {
            Some(before) => (before + dy)?,
            None => dy.contiguous()?,
        });
        rows.zeros_like().map(Some)
    }
}

fn colours<T: Number>(op: &Colours, rows: &Layout) -> Result<(CpuStorage, Shape)> {
    let (n, _) = rows.shape().dims2()?;
    let d = op.adapter.functions;
    let mut out = vec![T::default(); n * 3 * d];
    borrowed::<T, _, 1>(NAME, [&op.raw], |[raw]| {
        cpu::colour::forward(&op.adapter, op.frame, raw, &mut out);
    })?;
    let shape = match op.frame {
        Frame::World => (n, d, 3),
        Frame::Camera => (n, 3, d),
    };
    Ok((T::to_cpu_storage_owned(out), Shape::from(shape)))
}
