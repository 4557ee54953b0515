//! TensorBoard event files of a training: scalars and sheets. The messages are those of
//! TensorFlow's `event.proto` and `summary.proto`, with the fields that are used.
//!
//! A record is its length (u64), a masked CRC-32C of the length, the message, and a masked
//! CRC-32C of the message, little-endian (TensorFlow, `record_writer.h`).

use crate::train::run::{Event, StepReport};
use crate::train::validate::Found;
use anyhow::{Context, Result};
use prost::Message;
use std::fs::File;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

/// Content of the first record.
const FILE_VERSION: &str = "brain.Event:2";
/// TensorFlow's mask of a checksum.
const MASK: u32 = 0xA282_EAD8;
/// Channels of a sheet.
const RGB: i32 = 3;

#[derive(Clone, PartialEq, Message)]
struct Record {
    #[prost(double, tag = "1")]
    wall_time: f64,
    #[prost(int64, tag = "2")]
    step: i64,
    #[prost(oneof = "Content", tags = "3, 5")]
    content: Option<Content>,
}

#[derive(Clone, PartialEq, prost::Oneof)]
enum Content {
    #[prost(string, tag = "3")]
    FileVersion(String),
    #[prost(message, tag = "5")]
    Summary(Summary),
}

#[derive(Clone, PartialEq, Message)]
struct Summary {
    #[prost(message, repeated, tag = "1")]
    value: Vec<Tagged>,
}

#[derive(Clone, PartialEq, Message)]
struct Tagged {
    #[prost(string, tag = "1")]
    tag: String,
    #[prost(oneof = "Value", tags = "2, 4")]
    value: Option<Value>,
}

#[derive(Clone, PartialEq, prost::Oneof)]
enum Value {
    #[prost(float, tag = "2")]
    Scalar(f32),
    #[prost(message, tag = "4")]
    Image(Image),
}

#[derive(Clone, PartialEq, Message)]
struct Image {
    #[prost(int32, tag = "1")]
    height: i32,
    #[prost(int32, tag = "2")]
    width: i32,
    #[prost(int32, tag = "3")]
    colorspace: i32,
    #[prost(bytes = "vec", tag = "4")]
    encoded: Vec<u8>,
}

/// An event file of this process.
pub struct Board {
    file: File,
    path: PathBuf,
    folder: PathBuf,
}

impl Board {
    /// Creates a file in the run's folder.
    ///
    /// # Errors
    /// The folder is missing or full.
    pub fn create(folder: &Path) -> Result<Self> {
        let seconds = now() as u64;
        let name = format!("events.out.tfevents.{seconds:010}.subsplat.{}", std::process::id());
        let path = folder.join(name);
        let file = File::create(&path).with_context(|| path.display().to_string())?;
        let mut board = Self { file, path, folder: folder.to_owned() };
        board.write(0, Content::FileVersion(FILE_VERSION.to_owned()))?;
        Ok(board)
    }

    /// Writes the figures of `event`.
    ///
    /// # Errors
    /// The disk is full.
    pub fn record(&mut self, event: &Event) -> Result<()> {
        match event {
            Event::Step(report) => self.step(report),
            Event::Validated { step, rooms, photos } => {
                self.validation(*step, "rooms", rooms.as_ref())?;
                self.validation(*step, "photos", photos.as_ref())
            }
            Event::Begin { .. } | Event::Skipped { .. } | Event::Saved(_) => Ok(()),
        }
    }

    fn step(&mut self, report: &StepReport) -> Result<()> {
        let t = &report.terms;
        let all = [
            ("loss/total", t.loss),
            ("loss/dssim", t.dssim),
            ("loss/lpips", t.lpips),
            ("loss/cross_entropy", t.cross_entropy),
            ("loss/disparity", t.disparity),
            ("loss/confidence", t.confidence),
            ("train/psnr", t.psnr()),
            ("train/gradient_norm", report.norm),
            ("train/rate", report.rate),
        ];
        self.scalars(report.step, all.map(|(tag, v)| (tag.to_owned(), v)))
    }

    fn validation(&mut self, step: u64, set: &str, found: Option<&Found>) -> Result<()> {
        let Some(found) = found else { return Ok(()) };
        let all = [
            ("psnr", found.psnr),
            ("ssim", found.ssim),
            ("disparity", found.disparity),
            ("within_one", found.within_one),
        ];
        self.scalars(step, all.map(|(tag, v)| (format!("{set}/{tag}"), v)))?;
        let sheet = self.folder.join(format!("sheet-{step:08}-{set}.png"));
        let Ok(encoded) = std::fs::read(&sheet) else { return Ok(()) };
        // IHDR: width and height are the big-endian words at 16 and 20 (PNG, 11.2.2).
        let word = |at: usize| {
            let bytes = encoded.get(at..at + 4).and_then(|b| b.try_into().ok());
            bytes.map_or(0, i32::from_be_bytes)
        };
        let (width, height) = (word(16), word(20));
        let image = Image { height, width, colorspace: RGB, encoded };
        let tagged = Tagged { tag: format!("{set}/sheet"), value: Some(Value::Image(image)) };
        self.write(step, Content::Summary(Summary { value: vec![tagged] }))
    }

    fn scalars(&mut self, step: u64, all: impl IntoIterator<Item = (String, f64)>) -> Result<()> {
        let finite = all.into_iter().filter(|(_, v)| v.is_finite());
        let tagged = |(tag, v)| Tagged { tag, value: Some(Value::Scalar(v as f32)) };
        let value = finite.map(tagged).collect();
        self.write(step, Content::Summary(Summary { value }))
    }

    fn write(&mut self, step: u64, content: Content) -> Result<()> {
        let step = i64::try_from(step).unwrap_or(i64::MAX);
        let message = Record { wall_time: now(), step, content: Some(content) }.encode_to_vec();
        let length = (message.len() as u64).to_le_bytes();
        let mut bytes = Vec::with_capacity(message.len() + 16);
        bytes.extend(length);
        bytes.extend(masked(&length).to_le_bytes());
        bytes.extend(&message);
        bytes.extend(masked(&message).to_le_bytes());
        // One call per record, so that the file holds complete records.
        self.file.write_all(&bytes).with_context(|| self.path.display().to_string())
    }
}

fn masked(bytes: &[u8]) -> u32 {
    crc32c::crc32c(bytes).rotate_right(15).wrapping_add(MASK)
}

/// Seconds since 1970.
fn now() -> f64 {
    SystemTime::now().duration_since(UNIX_EPOCH).map_or(0.0, |d| d.as_secs_f64())
}
