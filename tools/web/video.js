// Photographs from a video that the browser plays: the sharpest frame of each part of it.
"use strict";

/** Longer side of a frame, pixels: more than the reconstruction reads, less than memory allows of many. */
const FRAME_SIDE = 2048;
/** Longer side of the small grey pictures that are compared, pixels. */
const GREY_SIDE = 320;
/** Frames that are looked at in each part of the video. */
const LOOKS = 4;
/** Mean difference of two small pictures, of 255, below which they show one view. */
const SAME_VIEW = 2;
/** Most time to wait for a frame, milliseconds. */
const PATIENCE = 15000;

const isVideo = (file) => file.type.startsWith("video/") || /\.(mp4|m4v|mov|webm|mkv)$/i.test(file.name);

/** Resolves at the next `event` of `video`; an error of it rejects. */
function next(video, event, name) {
  return new Promise((done, fail) => {
    const cannot = () => fail(new Error(
      `${name}: this browser cannot play it; choose photographs, or a video as .mp4 (H.264) or .webm`));
    const timer = setTimeout(cannot, PATIENCE);
    const end = (what) => () => { clearTimeout(timer); what(); };
    video.addEventListener(event, end(done), { once: true });
    video.addEventListener("error", end(cannot), { once: true });
  });
}

/** A picture of `video` whose longer side is at most `side`. */
function drawn(video, side) {
  const scale = Math.min(1, side / Math.max(video.videoWidth, video.videoHeight));
  const canvas = document.createElement("canvas");
  canvas.width = Math.max(1, Math.round(video.videoWidth * scale));
  canvas.height = Math.max(1, Math.round(video.videoHeight * scale));
  canvas.getContext("2d", { willReadFrequently: true }).drawImage(video, 0, 0, canvas.width, canvas.height);
  return canvas;
}

/** Grey values of a small picture of `video`, and their sharpness: the mean difference from the mean of the neighbours. */
function look(video) {
  const canvas = drawn(video, GREY_SIDE), { width, height } = canvas;
  const { data } = canvas.getContext("2d").getImageData(0, 0, width, height);
  const grey = new Float32Array(width * height);
  for (let i = 0; i < grey.length; i++) grey[i] = 0.3 * data[4 * i] + 0.6 * data[4 * i + 1] + 0.1 * data[4 * i + 2];
  let sum = 0;
  for (let y = 1; y + 1 < height; y++) {
    for (let x = 1; x + 1 < width; x++) {
      const i = y * width + x;
      sum += Math.abs(4 * grey[i] - grey[i - 1] - grey[i + 1] - grey[i - width] - grey[i + width]);
    }
  }
  return { grey, sharpness: sum / grey.length };
}

const difference = (a, b) => a.reduce((sum, v, i) => sum + Math.abs(v - b[i]), 0) / a.length;

/** At most `most` frames of the video `file` as JPEG files. Views that repeat the one before are left out. `report`
 * receives the part that is done; `signal` ends the work.
 *
 * Throws where the browser cannot play the video, or where it shows one view alone. */
async function videoFrames(file, most, report, signal) {
  const video = document.createElement("video");
  video.muted = true;
  video.preload = "auto";
  video.src = URL.createObjectURL(file);
  try {
    await next(video, "loadeddata", file.name);
    // A recording of a browser states no length before its end is sought.
    if (!Number.isFinite(video.duration)) {
      const known = next(video, "durationchange", file.name);
      video.currentTime = 1e9;
      await known;
    }
    const at = async (time) => {
      signal.throwIfAborted();
      const sought = next(video, "seeked", file.name);
      video.currentTime = time;
      await sought;
    };
    const frames = [];
    let before = null;
    for (let part = 0; part < most; part++) {
      let best = null;
      for (let i = 0; i < LOOKS; i++) {
        const time = video.duration * (part + (i + 0.5) / LOOKS) / most;
        await at(time);
        const seen = look(video);
        if (!best || seen.sharpness > best.sharpness) best = { ...seen, time };
        report((part + (i + 1) / LOOKS) / most);
      }
      if (before && difference(best.grey, before) < SAME_VIEW) continue;
      before = best.grey;
      await at(best.time);
      const blob = await new Promise((done) => drawn(video, FRAME_SIDE).toBlob(done, "image/jpeg", 0.95));
      const name = `${file.name.replace(/\.[^.]*$/, "")} ${best.time.toFixed(2)} s.jpg`;
      frames.push(new File([blob], name, { type: "image/jpeg" }));
    }
    if (frames.length < 2) throw new Error(`${file.name}: expected a video in which the camera moves, got one view`);
    return frames;
  } finally {
    URL.revokeObjectURL(video.src);
  }
}
