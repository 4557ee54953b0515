// The page and an exported scene in headless Chromium, against the program's own pictures.
// test.sh copies this file beside its modules and runs it at the root of the repository.
import assert from "node:assert/strict";
import { execFileSync } from "node:child_process";
import fs from "node:fs";
import http from "node:http";
import path from "node:path";
import { pathToFileURL } from "node:url";
import { chromium } from "playwright-core";

const PLACE = "out/web-test";
const SITE = `${PLACE}/site`;
const SUBSPLAT = process.env.SUBSPLAT;
const ROOM = ["examples/room/images/input_0.png", "examples/room/images/input_1.png"];
/** Least likeness to the program's picture, dB. */
const LIKENESS = 35;
const FLAGS = [
  "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
  "--disable-background-networking", "--disable-component-update", "--disable-sync",
  "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
  "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader",
];
const MINUTES = 60_000;

const browser = await chromium.launch({
  executablePath: process.env.CHROMIUM ?? "/usr/bin/chromium", args: FLAGS,
});
const subsplat = (...args) => execFileSync(SUBSPLAT, args, { stdio: ["ignore", "pipe", "inherit"] });

/** A page whose errors fail the test, and which reports the addresses that it asks for. */
async function open(url, { width = 480, height = 560 } = {}) {
  const page = await browser.newPage({ viewport: { width, height } });
  page.setDefaultTimeout(5 * MINUTES);
  const errors = [], asked = [];
  page.on("pageerror", (error) => errors.push(error.message));
  page.on("console", (line) => line.type() === "error" && errors.push(line.text()));
  page.on("request", (request) => asked.push(request.url()));
  await page.goto(url);
  return { page, errors, asked };
}

/** The viewer's picture at the photographs' size, as { width, height, rgba }. */
async function capture(page) {
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
async function picture(file) {
  const page = await browser.newPage();
  const source = `data:image/png;base64,${fs.readFileSync(file).toString("base64")}`;
  const [width, height, data] = await page.evaluate(async (url) => {
    const image = new Image();
    image.src = url;
    await image.decode();
    const canvas = new OffscreenCanvas(image.width, image.height);
    const context = canvas.getContext("2d");
    context.drawImage(image, 0, 0);
    const { data } = context.getImageData(0, 0, image.width, image.height);
    return [image.width, image.height, Array.from(data)];
  }, source);
  await page.close();
  return { width, height, rgba: Buffer.from(data) };
}

/** PSNR of the colours, dB. */
function psnr(a, b) {
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
async function native(scene, name, settings) {
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

const box = (page) => page.locator("canvas").boundingBox();
const idle = (page) => page.evaluate(
  () => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done))));

/** Drags in the scene; the picture must change. */
async function moves(page, action, what) {
  const before = await capture(page);
  await action();
  await idle(page);
  const after = await capture(page);
  assert.ok(psnr(before, after) < 45, `${what} did not change the picture`);
}

/** A far camera draws fewer Gaussians, and nearly the picture of all of them. */
async function levelOfDetail(page, way) {
  await page.waitForFunction(() => viewer.levels);
  const all = await page.evaluate(() => viewer.scene.count);
  await capture(page);
  const near = await page.evaluate(() => viewer.drawn);
  // 16 times the distance.
  await page.evaluate(() => viewer.wheel(Math.log(16) / Math.log(0.9)));
  const fewer = await capture(page);
  // The page's canvas has another size than the captured picture, so its number is another one.
  await idle(page);
  const far = await page.evaluate(() => viewer.drawn);
  await page.waitForFunction(
    (far) => document.querySelector(".splat-status").textContent.startsWith(far.toLocaleString("en")
      + " of "), far);
  await page.locator("canvas").press("l");
  const whole = await capture(page);
  assert.equal(await page.evaluate(() => viewer.drawn), all, "L draws all Gaussians");
  await page.locator("canvas").press("l");
  const likeness = psnr(fewer, whole);
  console.log(`export, ${way}: ${near} of ${all} Gaussians at the first camera, ${far} at 16 times the`
    + ` distance, ${likeness.toFixed(1)} dB against all`);
  assert.equal(near, all, "the first camera draws all Gaussians");
  assert.ok(2 * far < all, "a far camera draws fewer Gaussians");
  assert.ok(likeness >= LIKENESS && likeness < 90, "the picture of fewer Gaussians");
  // Without levels the far camera draws all.
  const off = await open(`${page.url().split("#")[0]}?levels=off#${way}`);
  await off.page.waitForFunction(() => viewer?.levels);
  await off.page.evaluate(() => viewer.wheel(Math.log(16) / Math.log(0.9)));
  await capture(off.page);
  assert.equal(await off.page.evaluate(() => viewer.drawn), all, "levels=off");
  await off.page.close();
  await page.evaluate(() => viewer.reset());
  await idle(page);
}

async function testExport() {
  const out = `${PLACE}/export`;
  subsplat("run", "examples/room", "--input-size", "64", "--fit", "0", "--refine", "off",
    "--save", "ply,html", "-o", out);
  // A name that would break a page that does not escape it.
  const title = "a <b> & c";
  fs.copyFileSync(`${out}/scene.ply`, `${out}/${title}.ply`);
  subsplat("export", `${out}/${title}.ply`, "-o", `${out}/export.html`);
  const { page, errors, asked } = await open(pathToFileURL(path.resolve(`${out}/export.html`)).href);
  await page.waitForFunction(() => document.querySelector(".splat-status").textContent);
  assert.equal(await page.title(), title);
  assert.equal(errors.length, 0, errors.join());
  assert.equal(await page.evaluate(() => viewer.cameras.length), 3, "cameras.json beside the scene");
  assert.equal(asked.length, 1, `asked for ${asked.join()}`);
  await page.close();

  for (const way of ["webgl", "cpu"]) {
    const url = `${pathToFileURL(path.resolve(`${out}/scene.html`)).href}#${way}`;
    const { page, errors } = await open(url);
    await page.waitForFunction(() => document.querySelector(".splat-status").textContent);
    const status = await page.textContent(".splat-status");
    assert.match(status, way === "cpu" ? /the processor/ : /WebGL2/);
    const settings = JSON.parse(await page.textContent("#settings"));
    const expected = await native(`${out}/scene.ply`, `export-${way}`, settings);
    const got = await capture(page);
    const likeness = psnr(got, expected);
    console.log(`export, ${way}: ${likeness.toFixed(1)} dB against the program's picture`);
    assert.ok(likeness >= LIKENESS);
    // The comparison sees an exchange of colours and a turned picture.
    const swapped = { ...got, rgba: Buffer.from(got.rgba) };
    for (let i = 0; i < swapped.rgba.length; i += 4) {
      [swapped.rgba[i], swapped.rgba[i + 2]] = [got.rgba[i + 2], got.rgba[i]];
    }
    assert.ok(psnr(swapped, expected) < LIKENESS && psnr(
      { ...got, rgba: Buffer.from(new Uint32Array(new Uint8Array(got.rgba).buffer).reverse().buffer) },
      expected) < LIKENESS);

    await levelOfDetail(page, way);
    assert.ok(psnr(await capture(page), expected) >= LIKENESS, "levels leave the first picture");

    const { x, y, width, height } = await box(page);
    const middle = [x + width / 2, y + height / 2];
    await moves(page, async () => {
      await page.mouse.move(...middle);
      await page.mouse.down();
      await page.mouse.move(middle[0] + 90, middle[1] + 30, { steps: 3 });
      await page.mouse.up();
    }, "a drag");
    await page.click("text=Reset");
    await idle(page);
    assert.ok(psnr(await capture(page), expected) >= LIKENESS, "Reset returns to the start");
    await page.mouse.move(...middle);
    await moves(page, () => page.mouse.wheel(0, -300), "the wheel");
    await moves(page, () => page.locator("canvas").press("ArrowRight"), "an arrow key");
    await moves(page, () => page.click("text=Next view"), "Next view");
    await page.click("text=Fly");
    assert.equal(await page.getAttribute("text=Fly", "aria-pressed"), "true");
    await moves(page, async () => {
      await page.locator("canvas").focus();
      await page.keyboard.down("KeyW");
      await page.waitForTimeout(300);
      await page.keyboard.up("KeyW");
    }, "W");
    const saved = page.waitForEvent("download");
    await page.click("text=Save picture");
    assert.equal((await saved).suggestedFilename(), "view.png");
    assert.equal(errors.length, 0, errors.join());
    if (way === "webgl") {
      await page.setViewportSize({ width: 360, height: 640 });
      await idle(page);
      const wide = await page.evaluate(() => document.documentElement.scrollWidth);
      assert.ok(wide <= 360, `a page ${wide} px wide on a phone`);
      await page.screenshot({ path: `${PLACE}/export-phone.png` });
    }
    await page.close();
  }
}

/** Serves the page's folder. `before` is JavaScript in front of the worker's own; `sizes` has the bytes
 * of each file that was asked for. */
function serve() {
  const kinds = { html: "text/html", js: "text/javascript", css: "text/css" };
  const server = http.createServer((request, answer) => {
    const name = new URL(request.url, "http://localhost").pathname.slice(1) || "index.html";
    const file = path.join(SITE, path.basename(name));
    if (!fs.existsSync(file)) return answer.writeHead(404).end();
    const body = fs.readFileSync(file);
    server.sizes.set(name, body.length);
    answer.writeHead(200, { "content-type": kinds[name.split(".").pop()] ?? "application/octet-stream" });
    answer.end(name === "worker.js" ? server.before + body : body);
  });
  server.sizes = new Map();
  server.before = "";
  return new Promise((done) => server.listen(0, "127.0.0.1", () => done(server)));
}

/** Chooses files by a click on the button. */
async function chooseFiles(page, files) {
  const chooser = page.waitForEvent("filechooser");
  await page.click("text=Choose photographs");
  await (await chooser).setFiles(files);
}

/** Drops files onto the page. */
async function dropFiles(page, files) {
  const list = files.map((file) => ({
    name: path.basename(file), text: fs.readFileSync(file).toString("base64"),
  }));
  const dataTransfer = await page.evaluateHandle((list) => {
    const data = new DataTransfer();
    for (const { name, text } of list) {
      data.items.add(new File([Uint8Array.from(atob(text), (c) => c.charCodeAt(0))], name));
    }
    return data;
  }, list);
  await page.dispatchEvent("#drop", "drop", { dataTransfer });
}

/** The program's picture of a scene file from the first camera of the page's viewer. */
async function nativeFromPage(page, scene, name) {
  const camera = await page.evaluate(() => ({ ...viewer.cameras[0] }));
  // The viewer's world is y-up: back to the program's.
  camera.world_from_camera = [0, 1, 2].flatMap((r) => {
    const sign = r === 0 ? 1 : -1;
    return [...camera.rotation.slice(3 * r, 3 * r + 3), camera.eye[r]].map((v) => sign * v);
  });
  return native(scene, name, { cameras: [camera] });
}

const finished = (page) => page.waitForFunction(
  () => !document.getElementById("error").hidden || /^Done/.test(document.getElementById("news").textContent));

async function download(page, button) {
  const event = page.waitForEvent("download");
  await page.click(button);
  const file = `${PLACE}/page-${(await event).suggestedFilename()}`;
  await (await event).saveAs(file);
  return file;
}

async function testPage() {
  const server = await serve();
  const address = `http://127.0.0.1:${server.address().port}/`;
  const broken = `${PLACE}/broken.jpg`;
  fs.writeFileSync(broken, fs.readFileSync("examples/room/images/heldout_0_512.jpg").subarray(0, 20000));
  for (const way of ["webgl", "cpu"]) {
    const { page, errors, asked } = await open(`${address}?draw=${way}`);
    // Refusals: a truncated photograph, then the same view twice.
    await chooseFiles(page, [ROOM[0], broken]);
    await finished(page);
    assert.match(await page.textContent("#error"), /broken\.jpg.*(truncated|end|EOI)/i);
    if (way === "webgl") {
      await chooseFiles(page, [ROOM[0], ROOM[0]]);
      await finished(page);
      assert.match(await page.textContent("#error"), /show the same view/);
      assert.ok(await page.isHidden("#result"));
    }

    await page.selectOption("#upscale", "1");
    await page.selectOption("#effort", way === "webgl" ? "1" : "0");
    await page.evaluate(() => {
      window.fractions = {};
      new MutationObserver(() => {
        const stage = document.getElementById("stage").textContent;
        (fractions[stage] ??= new Set()).add(document.getElementById("progress").value);
      }).observe(document.getElementById("progress"), { attributes: true });
    });
    const begin = Date.now();
    await chooseFiles(page, ROOM);
    await page.waitForSelector("#working:not([hidden])");
    await finished(page);
    assert.ok(await page.isHidden("#error"), await page.textContent("#error"));
    const reports = await page.evaluate(
      () => Object.entries(fractions).map(([stage, set]) => [stage, set.size]));
    const [, within] = reports.find(([stage]) => stage.startsWith("estimating depth ")) ?? [];
    assert.ok(within >= 3, `progress within the network: ${JSON.stringify(reports)}`);
    console.log(`page, ${way}: ${((Date.now() - begin) / 1000).toFixed(1)} s from choice to scene`);
    assert.match(await page.textContent(".splat-status"), way === "cpu" ? /the processor/ : /WebGL2/);
    // The one adapter here is a software one, which is not chosen unasked.
    assert.match(await page.textContent("#news"), /The network ran on the processor\.$/);
    const ply = await download(page, "[data-save=ply]");
    const expected = await nativeFromPage(page, ply, `page-${way}`);
    const likeness = psnr(await capture(page), expected);
    console.log(`page, ${way}: ${likeness.toFixed(1)} dB against the program's picture of its .ply`);
    assert.ok(likeness >= LIKENESS);
    const photograph = await picture(ROOM[0]);
    const own = psnr(expected, photograph);
    console.log(`page, ${way}: ${own.toFixed(1)} dB against the first photograph`);
    assert.ok(own > 24, "the scene shows the photograph from its own place");
    for (const format of ["spz", "glb"]) {
      const file = await download(page, `[data-save=${format}]`);
      const info = JSON.parse(subsplat("--json", "info", file).toString());
      assert.equal(info.count ?? info.splats?.count ?? info.gaussians, 2 * 256 * 256, JSON.stringify(info));
    }
    if (way === "webgl") {
      await page.screenshot({ path: `${PLACE}/page.png`, fullPage: true });
      // A second pair after the first, in the other order.
      await page.selectOption("#effort", "0");
      await chooseFiles(page, [...ROOM].reverse());
      await page.waitForFunction(() => document.getElementById("news").textContent === "");
      await finished(page);
      assert.ok(await page.isHidden("#error"), await page.textContent("#error"));
      const second = await capture(page);
      const own = psnr(second, await picture(ROOM[1]));
      assert.ok(own > 20 && psnr(second, expected) < 30, "the second scene replaces the first");
      await page.setViewportSize({ width: 360, height: 740 });
      const wide = await page.evaluate(() => document.documentElement.scrollWidth);
      assert.ok(wide <= 360, `a page ${wide} px wide on a phone`);
      await page.screenshot({ path: `${PLACE}/page-phone.png` });
      const bytes = [...server.sizes.values()].reduce((a, b) => a + b, 0);
      console.log(`page: ${bytes} bytes over the wire`);
      assert.ok(bytes <= 6e6);
    }
    assert.ok(asked.every((url) => /^(blob|data):/.test(url) || url.startsWith(address)), asked.join());
    assert.equal(errors.length, 0, errors.join());
    await page.close();
  }
  server.close();
}

/** What the page says of the network's processor, by address and by JavaScript that precedes the
 * worker's. */
const NETWORKS = [
  { name: "WebGPU", network: "gpu", says: /Done in .*The network ran on WebGPU\.$/ },
  {
    name: "WebGPU unasked, of an adapter that calls itself hardware", network: "auto",
    before: `Object.defineProperty(GPUAdapterInfo.prototype, "isFallbackAdapter", { get: () => false });`,
    says: /Done in .*The network ran on WebGPU\.$/,
  },
  { name: "CPU", network: "cpu", says: /Done in .*The network ran on the processor\.$/ },
  {
    name: "no adapter", network: "gpu",
    before: "GPU.prototype.requestAdapter = async () => null;",
    says: /The network ran on the processor: no GPU: .*no adapter/,
  },
  {
    name: "no device", network: "gpu",
    before: "GPUAdapter.prototype.requestDevice = async () => { throw new Error('none left'); };",
    says: /The network ran on the processor: GPU .*: no device: .*none left/,
  },
  {
    name: "no Suspending", network: "auto", before: "delete WebAssembly.Suspending;",
    says: /The network ran on the processor: .*WebAssembly\.Suspending/,
  },
  {
    name: "a kernel refused", network: "gpu",
    before: `const make = GPUDevice.prototype.createShaderModule;
      GPUDevice.prototype.createShaderModule = function (of) {
        return make.call(this, { ...of, code: of.code + " nonsense" });
      };`,
    says: /The network began on WebGPU\. GPU refused .*nonsense.*; the CPU does this instead\.$/,
  },
  {
    name: "a device lost", network: "gpu",
    before: `let device = null, submits = 0;
      const { requestDevice } = GPUAdapter.prototype, { submit } = GPUQueue.prototype;
      GPUAdapter.prototype.requestDevice = async function (...of) {
        return (device = await requestDevice.apply(this, of));
      };
      GPUQueue.prototype.submit = function (...of) {
        if (++submits === 3) device.destroy();
        return submit.apply(this, of);
      };`,
    says: /The network began on WebGPU\. GPU lost: .*; the CPU does this instead\.$/,
  },
];

/** The network on every processor, against the program's own scene of the same photographs. */
async function testNetwork() {
  const size = 64, out = `${PLACE}/network`;
  subsplat("run", ...ROOM, "--input-size", `${size}`, "--upscale", "2", "--fit", "0", "--refine", "off",
    "--device", "cpu", "--save", "ply", "-o", out);
  const server = await serve();
  for (const { name, network, before, says } of NETWORKS) {
    server.before = `{ ${before ?? ""} }\n`;
    const address = `http://127.0.0.1:${server.address().port}/?network=${network}&size=${size}`;
    const { page, errors } = await open(address);
    await page.selectOption("#upscale", "2");
    await page.selectOption("#effort", "0");
    const begin = Date.now();
    await dropFiles(page, ROOM);
    await finished(page);
    const seconds = ((Date.now() - begin) / 1000).toFixed(1);
    assert.ok(await page.isHidden("#error"), await page.textContent("#error"));
    assert.match(await page.textContent("#news"), says);
    const got = await capture(page);
    const expected = await nativeFromPage(page, `${out}/scene.ply`, `network-${network}`);
    const likeness = psnr(got, expected);
    console.log(`network, ${name}: ${likeness.toFixed(1)} dB against the program's scene, ${seconds} s`);
    assert.ok(likeness >= LIKENESS);
    assert.equal(errors.length, 0, errors.join());
    await page.close();
  }
  // A size out of range is refused.
  const { page } = await open(`http://127.0.0.1:${server.address().port}/?size=9`);
  await dropFiles(page, ROOM);
  await finished(page);
  assert.match(await page.textContent("#error"), /size: expected 32 to 1024, got "9"/);
  await page.close();
  server.close();
}

const chosen = process.argv.slice(2);
try {
  if (chosen.length === 0 || chosen.includes("export")) await testExport();
  if (chosen.length === 0 || chosen.includes("page")) await testPage();
  if (chosen.length === 0 || chosen.includes("network")) await testNetwork();
} finally {
  await browser.close();
}
