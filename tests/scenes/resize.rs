//! Tests that pictures are resampled as by Pillow, bit for bit.

use subsplat_test_support::noise;

use noise::noise;
use subsplat::files::photos::resize::{Filter, resize};

#[test]
fn resampling_equals_pillow() {
    let size = |s: &str| -> (usize, usize) {
        let (w, h) = s.split_once('x').unwrap();
        (w.parse().unwrap(), h.parse().unwrap())
    };
    let mut lines = 0;
    for line in include_str!("../goldens/resize.txt").lines().filter(|l| !l.starts_with('#')) {
        let words: Vec<&str> = line.split(' ').collect();
        let filter = match words[0] {
            "box" => Filter::Box,
            "bilinear" => Filter::Bilinear,
            "bicubic" => Filter::Bicubic,
            "lanczos" => Filter::Lanczos,
            other => panic!("{other}"),
        };
        let ((w, h), (to_w, to_h)) = (size(words[1]), size(words[2]));
        let out = resize(&noise(w, h), to_w, to_h, filter);
        if words[3] == "crc" {
            let mut crc = flate2::Crc::new();
            crc.update(&out.data);
            assert_eq!(crc.sum(), words[4].parse::<u32>().unwrap(), "{}", &line[..30]);
        } else {
            let hex: String = out.data.iter().map(|b| format!("{b:02x}")).collect();
            assert_eq!(hex, words[3], "{} {} {}", words[0], words[1], words[2]);
        }
        lines += 1;
    }
    assert_eq!(lines, 56);
}
