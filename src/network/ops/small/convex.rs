use crate::network::ops::{borrowed, output, slice, tensor_like};
use candle_core::{CpuStorage, CustomOp3, Layout, Result, Shape, Tensor, bail};
use subsplat_kernels::cpu::small::convex as cpu;
use subsplat_kernels::cpu::small::convex::Convex;

const NAME: &str = "convex upsampling";

/// ×4 upsampling of `maps`, each `[B, 1, h, w]`, to `[B, 1, 4h, 4w]`: each fine pixel
/// is a mean of the 3×3 coarse pixels around it, edges repeated, weighted by the
/// softmax over them of `logits` `[B, 144, h, w]` (fine pixel, then neighbour; both
/// row-major) plus ln `start` `[16, 9]`.
///
/// # Errors
/// Shapes that do not fit; a dtype other than f32.
pub fn upsample_convex(logits: &Tensor, maps: [&Tensor; 2], start: &[f32]) -> Result<[Tensor; 2]> {
    let (b, m, h, w) = logits.dims4()?;
    let fits = maps.iter().all(|x| x.dims() == [b, 1, h, w]);
    if m != 144 || !fits || start.len() != 144 || b * h * w == 0 {
        bail!(
            "{NAME}: expected logits [B, 144, h, w], maps [B, 1, h, w] and 144 shares, got {:?}, \
             {:?}, {:?} and {}",
            logits.dims(),
            maps[0].dims(),
            maps[1].dims(),
            start.len()
        );
    }
    let op = Op(Convex { size: [h, w], start: start.iter().map(|s| s.ln()).collect() });
    let [first, second] = maps;
    let both = logits.contiguous()?.apply_op3(&first.contiguous()?, &second.contiguous()?, op)?;
    Ok([both.get(0)?, both.get(1)?])
}

struct Op(Convex);

impl CustomOp3 for Op {
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
        let logits = slice::<f32>(NAME, "logits", s1, l1)?;
        let first = slice::<f32>(NAME, "first map", s2, l2)?;
        let second = slice::<f32>(NAME, "second map", s3, l3)?;
        let [h, w] = self.0.size;
        let mut out = vec![0.0; 2 * 16 * first.len()];
        cpu::forward(&self.0, logits, [first, second], &mut out);
        output(out, vec![2, l1.dims()[0], 1, 4 * h, 4 * w])
    }

    fn bwd(
        &self,
        logits: &Tensor,
        first: &Tensor,
        second: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let dy = dy.contiguous()?;
        let run = |[x, a, b, dy]: [&[f32]; 4]| cpu::backward(&self.0, x, [a, b], dy);
        let (dx, da, db) = borrowed(NAME, [logits, first, second, &dy], run)?;
        Ok((
            Some(tensor_like(dx, logits)?),
            Some(tensor_like(da, first)?),
            Some(tensor_like(db, second)?),
        ))
    }
}
