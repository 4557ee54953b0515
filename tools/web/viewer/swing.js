// The gentle movement of a view that nobody has touched, and clips of it.
"use strict";

/** Seconds of a swing to both sides and back, its part of the least reach, and how much it rises of what it turns. */
const SWING_SECONDS = 10, SWING_REACH = 0.6, SWING_RISE = 0.25;
/** Swings until the view rests, and seconds in which the first one grows to its full size. */
const SWINGS = 2, SWING_GROWS = 3;
/** Least number of frames a second of a swing that nobody asked for. */
const SWING_FRAMES = 10;
/** Seconds of a clip, and its bits a second: 2 MB at most. */
const CLIP_SECONDS = 6, CLIP_BITS = 2.4e6;

/** Moves the view of a viewer about the place where it is. */
class Swing {
  /** `seconds`: of one swing; `swings`: their number, after which the view is back; `grows`: seconds to full size. */
  constructor(viewer, { seconds = SWING_SECONDS, swings = SWINGS, grows = SWING_GROWS } = {}) {
    Object.assign(this, { viewer, seconds, swings, grows });
    const { rotation, eye } = viewer;
    this.start = { rotation, eye };
    this.pivot = viewer.pivot();
    this.size = SWING_REACH * Math.min(...viewer.range.nearest(eye).reach);
  }

  /** Puts the view where it is `seconds` after the start. */
  place(seconds) {
    const { viewer, pivot } = this, turn = 2 * Math.PI * seconds / this.seconds;
    const wide = this.size * Math.min(seconds / Math.max(this.grows, 1e-3), 1);
    const turned = multiply(about(viewer.up, wide * Math.sin(turn)), this.start.rotation);
    const risen = about([1, 0, 0], SWING_RISE * wide * Math.sin(2 * turn));
    viewer.rotation = orthonormal(multiply(turned, risen));
    viewer.eye = add(pivot, viewer.forward(), -viewer.distance);
  }

  /** Puts the view where it was at the start. */
  back() {
    Object.assign(this.viewer, this.start);
  }

  /** Swings until the time is over, or `going` returns false; a `patient` swing has any number of frames a second. */
  async run(going, patient) {
    const next = () => new Promise((done) => requestAnimationFrame(done));
    const begin = await next();
    let frames = 0, since = begin, now = begin;
    while (now - begin < 1000 * this.seconds * this.swings) {
      this.place((now - begin) / 1000);
      this.viewer.paint();
      now = await next();
      if (!going()) return;
      frames++;
      // Frames come unevenly where the graphics card is behind: those of a second count.
      if (now - since < 1000) continue;
      if (!patient && 1000 * frames < SWING_FRAMES * (now - since)) break;
      [frames, since] = [0, now];
    }
    this.back();
  }
}

/** The kind of clip that the browser records of a canvas, or nothing. */
function clipKind(canvas) {
  const kinds = ["video/mp4;codecs=avc1.42E01E", "video/webm;codecs=vp9", "video/webm"];
  const can = window.MediaRecorder && canvas.captureStream;
  return can ? kinds.find((kind) => MediaRecorder.isTypeSupported(kind)) : undefined;
}

/** Records what `canvas` shows while `work` runs. */
async function record(canvas, work) {
  const stream = canvas.captureStream(25), parts = [];
  const recorder = new MediaRecorder(stream, { mimeType: clipKind(canvas), videoBitsPerSecond: CLIP_BITS });
  recorder.ondataavailable = ({ data }) => parts.push(data);
  const stopped = new Promise((done) => { recorder.onstop = done; });
  recorder.start();
  await work();
  recorder.stop();
  await stopped;
  stream.getTracks().forEach((track) => track.stop());
  return new Blob(parts, { type: recorder.mimeType });
}
