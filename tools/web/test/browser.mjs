// Headless Chromium, pictures of the viewer and of the program, and movements.
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import fs from "node:fs";
import { chromium } from "playwright-core";

export const PLACE = "out/web-test";
const SUBSPLAT = process.env.SUBSPLAT;
/** Least likeness to the program's picture, dB. */
export const LIKENESS = 35;
const FLAGS = [
  "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
  "--disable-background-networking", "--disable-component-update", "--disable-sync",
  "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
  "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader",
];
const MINUTES = 60_000;

export const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args: FLAGS,
});
export const subsplat = (...args) => execFileSync(SUBSPLAT, args, { stdio: ["ignore", "pipe", "inherit"] });

/** A page whose errors fail the test, and which reports the addresses that it asks for. */
export async function open(url, { width = 480, height = 560, reducedMotion = "reduce" } = {}) {
  const page = await browser.newPage({ viewport: { width, height }, reducedMotion });
  page.setDefaultTimeout(5 * MINUTES);
  const errors = [], asked = [];
  page.on("pageerror", (error) => errors.push(error.message));
  page.on("console", (line) => line.type() === "error" && errors.push(line.text()));
  page.on("request", (request) => asked.push(request.url()));
  await page.goto(url);
  return { page, errors, asked };
}

/** The viewer's picture at the photographs' size, as { width, height, rgba }. */
export async function capture(page) {
  const [width, height, text] = await page.evaluate(() => {
    const shot = viewer.capture();
    let out = "";
    for (let at = 0; at < shot.data.length; at += 8192) {
      out += String.fromCharCode(...shot.data.subarray(at, at + 8192));
    }
    return [shot.width, shot.height, btoa(out)];
  });
  return { width, height, rgba: Buffer.from(text, "base64") };
}

/** Decodes a PNG in the browser. */
export async function picture(file) {
  const page = await browser.newPage();
  const source = `data:image/png;base64,${fs.readFileSync(file).toString("base64")}`;
  const [width, height, text] = await page.evaluate(async (url) => {
    const image = new Image();
    image.src = url;
    await image.decode();
    const canvas = new OffscreenCanvas(image.width, image.height);
    const context = canvas.getContext("2d");
    context.drawImage(image, 0, 0);
    const { data } = context.getImageData(0, 0, image.width, image.height);
    let out = "";
    for (let at = 0; at < data.length; at += 8192) out += String.fromCharCode(...data.subarray(at, at + 8192));
    return [image.width, image.height, btoa(out)];
  }, source);
  await page.close();
  return { width, height, rgba: Buffer.from(text, "base64") };
}

/** PSNR of the colours, dB. */
export function psnr(a, b) {
  assert.deepEqual([a.width, a.height], [b.width, b.height]);
  let sum = 0, count = 0;
  for (let i = 0; i < a.rgba.length; i++) {
    if (i % 4 === 3) continue;
    sum += (a.rgba[i] - b.rgba[i]) ** 2;
    count++;
  }
  return 10 * Math.log10(255 ** 2 / Math.max(sum / count, 1e-9));
}

/** The program's picture of a scene from the viewer's first camera. */
export async function native(scene, name, settings) {
  const [c] = settings.cameras;
  const rows = [0, 4, 8].map((at) => c.world_from_camera.slice(at, at + 4));
  const frame = {
    file: `${name}.png`, width: c.width, height: c.height, fx: c.fx, fy: c.fy, cx: c.cx, cy: c.cy,
    c2w: [...rows, [0, 0, 0, 1]],
  };
  const cameras = `${PLACE}/${name}-cameras.json`;
  fs.writeFileSync(cameras, JSON.stringify({ frames: [frame] }));
  subsplat("render", scene, "--cameras", cameras, "-o", `${PLACE}/${name}`);
  return picture(`${PLACE}/${name}/${name}.png`);
}

export const box = (page) => page.locator("canvas").boundingBox();
/** Waits for the picture of a view that rests. */
export const idle = async (page) => {
  await page.evaluate(() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done))));
  await page.waitForFunction(() => viewer.atRest);
};
/** How far the view is out of the photographs' range, also where it is not held there. */
export const excess = (page) => page.evaluate(
  () => (viewer.range ?? ViewRange.of(viewer.scene, viewer.cameras)).excess(viewer.eye, viewer.forward()));
/** Pictures that the viewer draws in a time, ms. */
export const pictures = (page, time) => page.evaluate(async (time) => {
  let count = 0;
  const draw = viewer.painter.draw;
  viewer.painter.draw = function (...of) {
    count++;
    return draw.apply(this, of);
  };
  await new Promise((done) => setTimeout(done, time));
  viewer.painter.draw = draw;
  return count;
}, time);
/** Drags of so many px to the right and down, without the mouse and without a picture after each. */
export const drags = (page, times, right, down) => page.evaluate(
  ([times, right, down]) => { for (let k = 0; k < times; k++) viewer.rotate(right, down); }, [times, right, down]);
/** A drag from the middle of the picture. */
export async function drag(page, right, down) {
  const { x, y, width, height } = await box(page);
  await page.mouse.move(x + width / 2, y + height / 2);
  await page.mouse.down();
  await page.mouse.move(x + width / 2 + right, y + height / 2 + down, { steps: 3 });
  await page.mouse.up();
  await idle(page);
}

/** Drags in the scene; the picture must change. */
export async function moves(page, action, what) {
  const before = await capture(page);
  await action();
  await idle(page);
  const after = await capture(page);
  assert.ok(psnr(before, after) < 45, `${what} did not change the picture`);
}
