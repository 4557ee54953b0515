//! Ops of the small backbone, against tensor operations.

use candle_core::{D, Result, Tensor, Var};
use subsplat::network::ops::cat::cat_upsampled;
use subsplat::network::ops::small::{
    Candidates, MeanOver, Start, add_scores, expectation, head_input, head_output,
    normalize_channels, ray_distance, upsample_convex,
};
use subsplat_test_support::same::{far, gradient, noise, same};

fn nearest(x: &Tensor, s: usize) -> Result<Tensor> {
    let (b, c, h, w) = x.dims4()?;
    let x = x.reshape(&[b, c, h, 1, w, 1][..])?.broadcast_as(&[b, c, h, s, w, s][..])?;
    x.contiguous()?.reshape((b, c, s * h, s * w))
}

#[test]
fn channels_are_concatenated() -> Result<()> {
    for s in [1, 2, 3] {
        let inputs = [noise(&[2, 3, 6, 18], 1)?, noise(&[2, 5, 6 / s, 18 / s], 2)?];
        same(
            &inputs,
            |x| Ok(vec![cat_upsampled(&x[0], &x[1], s)?]),
            |x| Ok(vec![Tensor::cat(&[&x[0], &nearest(&x[1], s)?], 1)?]),
        )?;
    }
    let x = noise(&[2, 3, 6, 4], 1)?;
    assert!(cat_upsampled(&x, &x, 2).is_err());
    Ok(())
}

#[test]
fn expectations_agree_with_the_definition() -> Result<()> {
    // 5·7 pixels: whole vectors and a rest.
    let (d, window) = (11, 2);
    let plain = |x: &Tensor, over: MeanOver| -> Result<Vec<Tensor>> {
        let e = x.broadcast_sub(&x.detach().max_keepdim(1)?)?.exp()?;
        let p = e.broadcast_div(&e.sum_keepdim(1)?)?;
        let k = Tensor::arange(0f32, d as f32, x.device())?.reshape((1, d, 1, 1))?;
        let mode = x.detach().argmax_keepdim(1)?.to_dtype(candle_core::DType::F32)?;
        let near = k.broadcast_sub(&mode)?.abs()?.le(window as f64 + 0.5)?;
        let near = (&p * near.to_dtype(candle_core::DType::F32)?)?;
        let mass = near.sum_keepdim(1)?;
        let mean = match over {
            MeanOver::Window => (near.broadcast_mul(&k)?.sum_keepdim(1)? / &mass)?,
            MeanOver::All => p.broadcast_mul(&k)?.sum_keepdim(1)?,
        };
        Ok(vec![mean, mass])
    };
    for over in [MeanOver::All, MeanOver::Window] {
        same(
            &[(noise(&[3, d, 5, 7], 3)? * 3.0)?],
            |x| expectation(&x[0], window, over).map(|(a, b)| vec![a, b]),
            |x| plain(&x[0], over),
        )?;
    }
    Ok(())
}

#[test]
fn added_scores_agree_with_the_definition() -> Result<()> {
    let inputs = [noise(&[2, 3, 90, 61], 4)?, noise(&[2, 3, 90, 61], 5)?, noise(&[1], 6)?];
    same(
        &inputs,
        |x| Ok(vec![add_scores(&x[0], &x[1], &x[2])?]),
        |x| Ok(vec![(&x[0] + (&x[1] * 4.0)?.broadcast_mul(&x[2])?)?]),
    )
}

#[test]
fn convex_upsampling_agrees_with_the_definition() -> Result<()> {
    let (b, h, w) = (2, 3, 19);
    let start: Vec<f32> = (0..144).map(|i| 0.05 + (i % 7) as f32 / 10.0).collect();
    let plain = |mask: &Tensor, x: &Tensor| -> Result<Tensor> {
        let logits = mask.reshape((b, 16, 9, h * w))?.permute((0, 3, 1, 2))?.contiguous()?;
        let start = Tensor::from_vec(start.clone(), (1, 1, 16, 9), mask.device())?.log()?;
        let e = logits.broadcast_add(&start)?.exp()?;
        let p = e.broadcast_div(&e.sum_keepdim(3)?)?.reshape((b, h, w, 16, 9))?;
        let x = x.pad_with_same(2, 1, 1)?.pad_with_same(3, 1, 1)?;
        let around =
            (0..9).map(|k| x.narrow(2, k / 3, h)?.narrow(3, k % 3, w)?.reshape((b, h, w, 1, 1)));
        let around = around.collect::<Result<Vec<_>>>()?;
        let fine = p.broadcast_mul(&Tensor::cat(&around, 4)?)?.sum(D::Minus1)?;
        let fine = fine.reshape(&[b, h, w, 4, 4][..])?.permute([0, 1, 3, 2, 4])?;
        fine.contiguous()?.reshape((b, 1, 4 * h, 4 * w))
    };
    let inputs = [noise(&[b, 144, h, w], 7)?, noise(&[b, 1, h, w], 8)?, noise(&[b, 1, h, w], 9)?];
    same(
        &inputs,
        |x| upsample_convex(&x[0], [&x[1], &x[2]], &start).map(Vec::from),
        |x| Ok(vec![plain(&x[0], &x[1])?, plain(&x[0], &x[2])?]),
    )
}

fn sigma(x: &Tensor) -> Result<Tensor> {
    (x.neg()?.exp()? + 1.0)?.recip()
}

#[test]
fn head_inputs_agree_with_the_definition() -> Result<()> {
    let rgb = noise(&[2, 3, 12, 20], 10)?;
    let inputs =
        [noise(&[2, 6, 3, 5], 11)?, noise(&[2, 1, 12, 20], 12)?, noise(&[2, 1, 12, 20], 13)?];
    same(
        &inputs,
        |x| Ok(vec![head_input(&x[0], &rgb, &x[1], &x[2], 0.25)?]),
        |x| {
            let up = subsplat::network::ops::resize::resize_bilinear(&x[0], 12, 20)?;
            Ok(vec![Tensor::cat(&[&up, &rgb, &(&x[1] * 0.25)?, &sigma(&x[2])?], 1)?])
        },
    )
}

#[test]
fn head_outputs_agree_with_the_definition() -> Result<()> {
    let (b, r, h, w) = (2, 37, 5, 41);
    let rgb = noise(&[b, 3, h, w], 14)?;
    let row: Vec<f32> = (0..r).map(|i| i as f32 / 10.0).collect();
    for (confident, colour) in [(true, Some(([9, 20, 31], 2.0, -1.0))), (false, None)] {
        let start = Start { row: row.clone(), colour, confident };
        let plain = |x: &[Tensor]| -> Result<Vec<Tensor>> {
            let mut raw = x[0].narrow(1, 0, r)?.flatten_from(2)?.transpose(1, 2)?.contiguous()?;
            raw = raw.broadcast_add(&Tensor::from_vec(row.clone(), (1, 1, r), x[0].device())?)?;
            if let Some((places, factor, offset)) = colour {
                let mut own =
                    vec![Tensor::zeros((b, h * w, 1), candle_core::DType::F32, x[0].device())?; r];
                for (k, place) in places.into_iter().enumerate() {
                    own[place] = rgb
                        .narrow(1, k, 1)?
                        .affine(f64::from(factor), f64::from(offset))?
                        .reshape((b, h * w, 1))?;
                }
                raw = (raw + Tensor::cat(&own, 2)?)?;
            }
            let residual = x[0].narrow(1, r, 1)?;
            let opacity = match confident {
                true => sigma(&(&x[1] + residual)?)?.sqr()?,
                // The confidence takes no part; its gradient must be there, and 0.
                false => (sigma(&(residual + 2.0)?)? + (&x[1] * 1e-12)?)?,
            };
            Ok(vec![raw, opacity])
        };
        let inputs = [noise(&[b, r + 1, h, w], 15)?, noise(&[b, 1, h, w], 16)?];
        same(
            &inputs,
            |x| head_output(&x[0], &x[1], &rgb, start.clone()).map(|(a, b)| vec![a, b]),
            plain,
        )?;
        // Either result alone.
        for which in [0, 1] {
            let x = inputs.iter().map(Var::from_tensor).collect::<Result<Vec<_>>>()?;
            let t: Vec<Tensor> = x.iter().map(|v| v.as_tensor().clone()).collect();
            let (raw, opacity) = head_output(&t[0], &t[1], &rgb, start.clone())?;
            let got = if which == 0 { raw } else { opacity };
            let got = got.sum_all()?.backward()?;
            let want = plain(&t)?.swap_remove(which).sum_all()?.backward()?;
            assert!(far(&gradient(&got, &x[0])?, &gradient(&want, &x[0])?)? < 1e-5);
        }
    }
    Ok(())
}

#[test]
fn distances_agree_with_the_definition() -> Result<()> {
    let candidates = |low, step| Candidates { low, step };
    let (ranges, n) = (vec![candidates(0.01, 0.02), candidates(0.1, 0.03)], 3 * 7);
    let lengths: Vec<f32> = (0..2 * n).map(|i| 1.0 + i as f32 / 50.0).collect();
    let plain = |x: &Tensor| -> Result<Tensor> {
        let all = (0..2).map(|b| {
            let at =
                Tensor::from_vec(lengths[b * n..(b + 1) * n].to_vec(), (1, 1, 3, 7), x.device())?;
            at / x.narrow(0, b, 1)?.affine(f64::from(ranges[b].step), f64::from(ranges[b].low))?
        });
        Tensor::cat(&all.collect::<Result<Vec<_>>>()?, 0)
    };
    same(
        &[((noise(&[2, 1, 3, 7], 17)? + 3.0)? * 5.0)?],
        |x| Ok(vec![ray_distance(&x[0], ranges.clone(), lengths.clone())?]),
        |x| Ok(vec![plain(&x[0])?]),
    )
}

#[test]
fn normalize_channels_agree_with_the_definition() -> Result<()> {
    same(
        &[noise(&[2, 5, 17, 19], 18)?],
        |x| Ok(vec![normalize_channels(&x[0])?]),
        |x| Ok(vec![x[0].broadcast_div(&(x[0].sqr()?.sum_keepdim(1)? + 1e-8)?.sqrt()?)?]),
    )
}
