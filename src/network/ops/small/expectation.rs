use crate::network::ops::{borrowed, output, slice, tensor_like};
use candle_core::{CpuStorage, CustomOp1, CustomOp3, Layout, Result, Shape, Tensor, bail};
use rayon::prelude::*;
use subsplat_kernels::cpu::small::expectation as cpu;
use subsplat_kernels::cpu::small::expectation::{Expectation, MeanOver};

const NAME: &str = "expectation";
const ADD_SCORES: &str = "add scores";

/// Of p = softmax over `logits` `[B, D, h, w]`: (mean of the candidate index, Σ p over
/// |k − mode| ≤ `window`), both `[B, 1, h, w]`. `mean` selects the candidates of
/// the mean. The mode is a constant to gradients.
///
/// # Errors
/// Another rank, no candidate, a dtype other than f32.
pub fn expectation(logits: &Tensor, window: usize, mean: MeanOver) -> Result<(Tensor, Tensor)> {
    let (b, d, h, w) = logits.dims4()?;
    if b * d * h * w == 0 {
        bail!("{NAME}: expected logits [B, D, h, w], none of them 0, got {:?}", logits.dims());
    }
    let op = Op(Expectation { candidates: d, pixels: h * w, window, mean });
    let both = logits.contiguous()?.apply_op1(op)?;
    Ok((both.get(0)?, both.get(1)?))
}

struct Op(Expectation);

impl CustomOp1 for Op {
    fn name(&self) -> &'static str {
        NAME
    }

    fn cpu_fwd(&self, s: &CpuStorage, l: &Layout) -> Result<(CpuStorage, Shape)> {
        let logits = slice::<f32>(NAME, "logits", s, l)?;
        let (b, _, h, w) = l.shape().dims4()?;
        let mut out = vec![0.0; 2 * b * h * w];
        cpu::forward(&self.0, logits, &mut out);
        output(out, vec![2, b, 1, h, w])
    }

    fn bwd(&self, logits: &Tensor, _y: &Tensor, dy: &Tensor) -> Result<Option<Tensor>> {
        let dy = dy.contiguous()?;
        let mut dx = vec![0.0; logits.elem_count()];
        borrowed(NAME, [logits, &dy], |[x, dy]: [&[f32]; 2]| {
            cpu::backward(&self.0, x, dy, &mut dx);
        })?;
        tensor_like(dx, logits).map(Some)
    }
}

/// Computes logits + 4·factor·scores, `factor` `[1]`.
///
/// # Errors
/// Shapes that differ, a dtype other than f32.
pub fn add_scores(logits: &Tensor, scores: &Tensor, factor: &Tensor) -> Result<Tensor> {
    if logits.dims() != scores.dims() || factor.dims() != [1] {
        bail!(
            "{ADD_SCORES}: expected scores like logits {:?} and a factor [1], got {:?} and {:?}",
            logits.dims(),
            scores.dims(),
            factor.dims()
        );
    }
    logits.contiguous()?.apply_op3(&scores.contiguous()?, factor, AddScores)
}

/// Gain of the scores in [`add_scores`]: the network was trained with fourfold scores.
pub(in crate::network::ops) const SCORE_GAIN: f32 = 4.0;
/// Elements per task.
const CHUNK: usize = 16_384;

struct AddScores;

impl CustomOp3 for AddScores {
    fn name(&self) -> &'static str {
        ADD_SCORES
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
        let logits = slice::<f32>(ADD_SCORES, "logits", s1, l1)?;
        let scores = slice::<f32>(ADD_SCORES, "scores", s2, l2)?;
        let gain = SCORE_GAIN * slice::<f32>(ADD_SCORES, "factor", s3, l3)?.iter().sum::<f32>();
        let mut y = vec![0.0; logits.len()];
        let parts = logits.par_chunks(CHUNK).zip(scores.par_chunks(CHUNK));
        parts.zip(y.par_chunks_mut(CHUNK)).for_each(|((a, b), y)| {
            a.iter().zip(b).zip(y).for_each(|((a, b), y)| *y = a + gain * b);
        });
        output(y, l1.shape().clone())
    }

    fn bwd(
        &self,
        _logits: &Tensor,
        scores: &Tensor,
        factor: &Tensor,
        _y: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>, Option<Tensor>)> {
        let dy = dy.contiguous()?;
        let gain = SCORE_GAIN * factor.flatten_all()?.to_vec1::<f32>()?.iter().sum::<f32>();
        let mut d_scores = vec![0.0; scores.elem_count()];
        let sums: Vec<f64> = borrowed(ADD_SCORES, [scores, &dy], |[x, dy]: [&[f32]; 2]| {
            let parts = x.par_chunks(CHUNK).zip(dy.par_chunks(CHUNK));
            let parts = parts.zip(d_scores.par_chunks_mut(CHUNK));
            let one = |((x, dy), dx): ((&[f32], &[f32]), &mut [f32])| {
                dx.iter_mut().zip(dy).for_each(|(dx, dy)| *dx = gain * dy);
                f64::from(subsplat_kernels::cpu::sums::dot(x, dy))
            };
            parts.map(one).collect()
        })?;
        let d_factor = (f64::from(SCORE_GAIN) * sums.iter().sum::<f64>()) as f32;
        let d_factor = Tensor::from_vec(vec![d_factor], 1, factor.device())?;
        Ok((Some(dy), Some(tensor_like(d_scores, scores)?), Some(d_factor)))
    }
}
