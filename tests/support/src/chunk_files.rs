//! Made-up data sets in pixelSplat's chunk format.

use super::noise::noise;
use super::torch_writer::{Checkpoint, Py, dict, text};
use std::path::Path;
use subsplat::files::photos::image::png_bytes;
use subsplat::scene::pictures::Rgb;

/// A video of a chunk.
pub struct Video {
    pub key: String,
    pub frames: usize,
    /// fx over the width.
    pub fx: f32,
    pub size: (usize, usize),
}

/// A video of 96×64 pixels with a usual lens.
pub fn video(key: &str, frames: usize) -> Video {
    Video { key: key.to_owned(), frames, fx: 0.9, size: (96, 64) }
}

/// Frame `i` of a video: noise with one pixel that names the frame and the video.
pub fn frame(video: &Video, i: usize) -> Rgb {
    let mut picture = noise(video.size.0, video.size.1);
    let sum = video.key.bytes().fold(0u8, u8::wrapping_add);
    picture.data.iter_mut().for_each(|v| *v = v.wrapping_add(sum).wrapping_add(7 * i as u8));
    picture
}

/// Row of `cameras`: frame `i` stands at (0.1·i, 0, 0) and looks along +z.
pub fn row(video: &Video, i: usize) -> [f32; 18] {
    let fy = video.fx * video.size.0 as f32 / video.size.1 as f32;
    let x = -0.1 * i as f32;
    [video.fx, fy, 0.5, 0.5, 0., 0., 1., 0., 0., x, 0., 1., 0., 0., 0., 0., 1., 0.]
}

/// The chunk's bytes.
pub fn chunk(videos: &[Video]) -> Vec<u8> {
    let mut file = Checkpoint::default();
    let mut list = Vec::new();
    for video in videos {
        let n = video.frames;
        let stamps: Vec<u8> = (0..n as i64).flat_map(|i| (i * 33_000).to_le_bytes()).collect();
        let rows: Vec<f32> = (0..n).flat_map(|i| row(video, i)).collect();
        let images = (0..n).map(|i| {
            let png = png_bytes(&frame(video, i), Path::new("frame")).unwrap();
            file.tensor("torch ByteStorage", &png, &[png.len()])
        });
        let images = Py::List(images.collect());
        list.push(dict(vec![
            ("key", text(&video.key)),
            ("url", text("https://example.org")),
            ("timestamps", file.tensor("torch LongStorage", &stamps, &[n])),
            ("cameras", file.floats(&rows, &[n, 18])),
            ("images", images),
        ]));
    }
    file.file(&Py::List(list))
}

/// Writes chunks `000000.torch`, … and `index.json` into `folder`.
pub fn write(folder: &Path, chunks: &[&[Video]]) {
    std::fs::create_dir_all(folder).unwrap();
    let mut index = serde_json::Map::new();
    for (i, videos) in chunks.iter().enumerate() {
        let name = format!("{i:06}.torch");
        std::fs::write(folder.join(&name), chunk(videos)).unwrap();
        for video in *videos {
            index.insert(video.key.clone(), name.clone().into());
        }
    }
    let text = serde_json::to_string(&index).unwrap();
    std::fs::write(folder.join("index.json"), text).unwrap();
}
