//! PSNR and SSIM against values that other programs computed.

use subsplat_test_support as common;
use subsplat_test_support::noise;

use safetensors::SafeTensors;
use subsplat::scene::metrics::{psnr, ssim};

fn png(path: &std::path::Path) -> (Vec<f32>, usize, usize) {
    let image = image::open(path).unwrap().to_rgb8();
    let (w, h) = (image.width() as usize, image.height() as usize);
    (image.into_raw().iter().map(|v| f32::from(*v) / 255.0).collect(), w, h)
}

/// The pictures of tools/make_metrics_golden.py: a ramp, and the ramp with some noise.
#[test]
fn agrees_with_skimage_on_made_up_pictures() {
    let mut lines = 0;
    for line in include_str!("../goldens/metrics.txt").lines().filter(|l| !l.starts_with('#')) {
        let words: Vec<&str> = line.split(' ').collect();
        let [w, h, weight] = [0, 1, 2].map(|i| words[i].parse::<usize>().unwrap());
        let [want_psnr, want_ssim] = [3, 4].map(|i| words[i].parse::<f64>().unwrap());
        let ramp: Vec<usize> = (0..w * h * 3)
            .map(|i| (3 * (i / 3 % w) + 5 * (i / 3 / w) + 40 * (i % 3)) % 256)
            .collect();
        let noise = noise::noise(w, h).data;
        let mixed = |(a, b): (&usize, &u8)| (a * (256 - weight) + usize::from(*b) * weight) / 256;
        let display = |v: usize| v as f32 / 255.0;
        let b: Vec<f32> = ramp.iter().zip(&noise).map(mixed).map(display).collect();
        let a: Vec<f32> = ramp.into_iter().map(display).collect();
        let (p, s) = (psnr(&a, &b, w, h).unwrap(), ssim(&a, &b, w, h).unwrap());
        assert!((p - want_psnr).abs() < 1e-9, "{line}: psnr {p}");
        assert!((s - want_ssim).abs() < 1e-9, "{line}: ssim {s}");
        lines += 1;
    }
    assert_eq!(lines, 5);
}

#[test]
fn agrees_with_skimage_on_pictures() {
    let Some(folder) = common::shared("fixtures/metrics") else { return };
    let text = std::fs::read_to_string(folder.join("expected.json")).unwrap();
    let expected: serde_json::Value = serde_json::from_str(&text).unwrap();
    let cases = expected["values"].as_array().unwrap();
    assert_eq!(cases.len(), 3);
    for case in cases {
        let (a, w, h) = png(&folder.join(case["a"].as_str().unwrap()));
        let (b, ..) = png(&folder.join(case["b"].as_str().unwrap()));
        let (p, s) = (psnr(&a, &b, w, h).unwrap(), ssim(&a, &b, w, h).unwrap());
        let dp = p - case["psnr"].as_f64().unwrap();
        let ds = s - case["ssim_mvsplat"].as_f64().unwrap();
        // The reference squares f32 values in f64, or in f32: 1e-6 relative.
        assert!(dp.abs() < 1e-5 && ds.abs() < 1e-6, "{case}: got {p} ({dp:e}), {s} ({ds:e})");
    }
}

#[test]
fn agrees_with_mvsplat_on_tensors() {
    let Some(path) = common::shared("golden/metrics_lpips_randvgg.safetensors") else { return };
    let bytes = std::fs::read(path).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let read = |name: &str| -> Vec<f32> {
        bytemuck::pod_collect_to_vec(file.tensor(name).unwrap().data())
    };
    let (h, w) = (64, 80);
    let plane = h * w;
    let (gt, pred) = (read("gt"), read("pred"));
    let (want_psnr, want_ssim) = (read("psnr"), read("ssim"));
    let interleave = |planes: &[f32], i: usize| -> Vec<f32> {
        let picture = &planes[i * 3 * plane..(i + 1) * 3 * plane];
        (0..plane * 3).map(|j| picture[(j % 3) * plane + j / 3]).collect()
    };
    for i in 0..2 {
        let (a, b) = (interleave(&gt, i), interleave(&pred, i));
        let dp = psnr(&a, &b, w, h).unwrap() - f64::from(want_psnr[i]);
        let ds = ssim(&a, &b, w, h).unwrap() - f64::from(want_ssim[i]);
        // Expected values are stored in f32: half a unit in the last place is 1e-6 at 30 dB.
        assert!(dp.abs() < 5e-6 && ds.abs() < 1e-6, "pair {i}: {dp:e} {ds:e}");
    }
}
