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
/** Time in which the browser should begin to play or go on, and between two looks where it does not tell its pictures,
 * milliseconds. */
const PATIENCE = 15000, WAIT = 100;
/** Time that playing the whole video should take, seconds, and how many times faster than normal browsers play. */
const PLAYED_IN = 15, FASTEST = 16;

const isVideo = (file) => file.type.startsWith("video/") || /\.(mp4|m4v|mov|webm|mkv)$/i.test(file.name);

const cannotPlay = (name) => new Error(
  `${name}: this browser cannot play it; choose photographs, or a video as .mp4 (H.264) or .webm`);

/** Resolves at the next `event` of `video`; an error of it rejects. */
function next(video, event, name) {
  return new Promise((done, fail) => {
    const cannot = () => fail(cannotPlay(name));
    const timer = setTimeout(cannot, PATIENCE);
    const end = (what) => () => { clearTimeout(timer); what(); };
    video.addEventListener(event, end(done), { once: true });
    video.addEventListener("error", end(cannot), { once: true });
  });
}

/** Resolves when a video that plays has another picture, or after a while. */
const picture = (video) => Promise.race([
  new Promise((done) => video.requestVideoFrameCallback?.(done)), new Promise((done) => setTimeout(done, WAIT)),
]);

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
 * receives the part that is done; `signal` ends the work. The video is played: browsers draw black or the frame before
 * after a seek in some files.
 *
 * Throws where the browser cannot play the video, or where it shows one view alone. */
async function videoFrames(file, most, report, signal) {
  const video = document.createElement("video");
  video.muted = video.playsInline = true;
  video.preload = "auto";
  video.src = URL.createObjectURL(file);
  try {
    await next(video, "loadeddata", file.name);
    if (!Number.isFinite(video.duration)) await soughtEnd(video, file.name);
    const length = video.duration, title = file.name.replace(/\.[^.]*$/, "");
    const frames = [];
    let best = null, looked = -Infinity, before = null;
    const take = () => {
      if (best && !(before && difference(best.grey, before) < SAME_VIEW)) {
        const { time, canvas } = best;
        const blob = new Promise((done) => canvas.toBlob(done, "image/jpeg", 0.95));
        frames.push({ blob, name: `${title} ${time.toFixed(2)} s.jpg` });
        before = best.grey;
      }
      best = null;
    };
    const played = next(video, "playing", file.name);
    video.playbackRate = Math.min(Math.max(length / PLAYED_IN, 1), FASTEST);
    video.play().catch(() => {});
    await played;
    let part = 0, moved = performance.now();
    while (!video.ended) {
      signal.throwIfAborted();
      const time = video.currentTime;
      if (time >= looked + length / (most * LOOKS)) {
        [looked, moved] = [time, performance.now()];
        if (Math.floor(time / length * most) > part) {
          take();
          part = Math.floor(time / length * most);
        }
        const seen = look(video);
        if (!best || seen.sharpness > best.sharpness) best = { ...seen, time, canvas: drawn(video, FRAME_SIDE) };
        report(time / length);
      }
      // A tab that is not seen may wait.
      if (document.hidden) moved = performance.now();
      if (performance.now() > moved + PATIENCE) throw cannotPlay(file.name);
      await picture(video);
    }
    take();
    if (frames.length < 2) throw new Error(`${file.name}: expected a video in which the camera moves, got one view`);
    return await Promise.all(
      frames.map(async ({ blob, name }) => new File([await blob], name, { type: "image/jpeg" })));
  } finally {
    video.pause();
    URL.revokeObjectURL(video.src);
  }
}

/** Seeks the end of a recording that does not state its length, and returns to its begin. */
async function soughtEnd(video, name) {
  for (const time of [1e9, 0]) {
    const sought = next(video, "seeked", name);
    video.currentTime = time;
    await sought;
  }
}
