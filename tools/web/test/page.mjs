// The page, against the program's own pictures.
import assert from "node:assert/strict";
import fs from "node:fs";
import path from "node:path";
import { pathToFileURL } from "node:url";
import { LIKENESS, PLACE, capture, open, picture, psnr, subsplat } from "./browser.mjs";
import { ROOM, chooseFiles, download, finished, nativeFromPage, serve } from "./site.mjs";

/** The .html that the page offers shows the scene by itself. */
async function pageOfItsOwn(page) {
  const file = await download(page, "#page");
  const own = await open(`${pathToFileURL(path.resolve(file)).href}#cpu`);
  await own.page.waitForFunction(() => document.querySelector(".splat-status").textContent);
  const likeness = psnr(await capture(own.page), await capture(page));
  assert.ok(likeness > 60, `the downloaded page: ${likeness} dB`);
  assert.equal(await own.page.evaluate(() => viewer.place), "Photograph");
  assert.deepEqual([own.errors.length, own.asked.length], [0, 1], own.errors.join());
  await own.page.close();
}

/** The clip that the page records plays, has several pictures, and is small enough to send. */
async function clip(page) {
  const file = await download(page, "#clip");
  const bytes = fs.readFileSync(file);
  assert.ok(bytes.length > 10_000 && bytes.length <= 2e6, `${file}: ${bytes.length} bytes`);
  const kind = path.extname(file).slice(1);
  const seen = await page.evaluate(async (source) => {
    const video = document.createElement("video");
    video.muted = true;
    video.src = source;
    await video.play();
    await new Promise((done) => { video.onended = done; });
    return [video.currentTime, video.videoWidth];
  }, `data:video/${kind};base64,${bytes.toString("base64")}`);
  console.log(`page: a clip of ${seen[0].toFixed(1)} s, ${bytes.length} bytes (.${kind})`);
  assert.ok(seen[0] > 3 && seen[0] < 12 && seen[1] > 100, `${seen}`);
  return { file, width: seen[1] };
}

/** A video gives frames, which are photographs like others; one that the browser cannot play is refused. */
async function video(page, { file, width }) {
  const broken = `${PLACE}/broken.mp4`;
  fs.writeFileSync(broken, "no video");
  await chooseFiles(page, [broken]);
  await page.waitForSelector("#error:not([hidden])");
  assert.match(await page.textContent("#error"), /broken\.mp4: this browser cannot play it/);
  await page.click("#clear");
  await chooseFiles(page, [file]);
  await page.waitForFunction(() => photographs.length > 0);
  const frames = await page.evaluate(() => Promise.all(photographs.map(async (photograph) => {
    const picture = await createImageBitmap(photograph);
    return { name: photograph.name, bytes: photograph.size, width: picture.width };
  })));
  assert.ok(frames.length >= 6 && frames.length <= 12, JSON.stringify(frames));
  assert.ok(frames.every((frame) => frame.width === width && / \d+\.\d\d s\.jpg$/.test(frame.name)), JSON.stringify(frames));
  // The clip goes there and back: frames of different times differ but for its ends.
  assert.ok(new Set(frames.map((frame) => frame.bytes)).size > frames.length / 2, JSON.stringify(frames));
  console.log(`page: ${frames.length} frames of the clip`);
  await page.waitForSelector("#working:not([hidden])");
  await page.click("#cancel");
  await page.waitForFunction(() => document.getElementById("working").hidden);
  assert.equal(await page.textContent("#error"), "Cancelled.");
}

/** A focal length reaches the library, which refuses one that no lens has. */
async function focalLength(page) {
  await page.fill("#focal", "9999");
  await page.click("#start");
  assert.ok(await page.evaluate(() => !document.getElementById("form").checkValidity()));
  await chooseFiles(page, ROOM);
  await page.waitForSelector("#error:not([hidden])");
  assert.equal(await page.textContent("#error"), 'Focal length: expected 8 to 400 mm, got "9999"');
  await page.fill("#focal", "");
}

/** A phone's camera gives photographs one by one, until a person begins. */
async function camera(page) {
  assert.equal(await page.getAttribute("#camera", "capture"), "environment");
  await page.click("#clear");
  assert.ok(await page.isDisabled("#start"));
  for (const [k, says] of [[0, /^One photograph/], [1, /^2 photographs: take another/]]) {
    await page.setInputFiles("#camera", ROOM[k]);
    assert.match(await page.textContent("#news"), says);
  }
  assert.ok(await page.isEnabled("#start"));
  assert.equal(await page.locator("#chosen li").count(), 2);
}

/** Where a browser shares files, the scene goes to other programs as a page. */
async function shares(page) {
  await page.click("#share");
  await page.waitForFunction(() => window.shared);
  const [name, size] = await page.evaluate(() => [shared.name, shared.size]);
  assert.ok(name === "scene.html" && size > 1e6, `${name}, ${size} bytes`);
}

/** No message of the library names a flag of the program. */
async function advice(page) {
  const skipped = /photos\/(programs|video)|tests?\.rs|verdict\.rs.*poses/;
  const files = fs.readdirSync("src", { recursive: true }).filter((f) => f.endsWith(".rs") && !skipped.test(f));
  const texts = files.flatMap((file) => {
    const code = fs.readFileSync(`src/${file}`, "utf8").split("mod tests {")[0].replace(/^\s*\/\/.*$/gm, "");
    return [...code.matchAll(/"((?:[^"\\]|\\[^])*)"/g)].map(([, text]) => text.replace(/\\\n\s*/g, ""));
  }).filter((text) => /\s--[a-z]/.test(text));
  assert.ok(texts.length >= 6, `${texts.length} messages with flags`);
  for (const text of texts) {
    const said = await page.evaluate((text) => advised(text), text);
    assert.ok(!/--[a-z]/.test(said) && said.length > 5, `${text}\n${said}`);
  }
}

export async function testPage() {
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
    // The scene is shown while it is refined, and the view stays where a person moved it.
    await page.selectOption("#effort", way === "webgl" ? "2" : "0");
    await page.evaluate(() => {
      window.shown = [];
      const load = SplatViewer.prototype.load;
      SplatViewer.prototype.load = async function (spz, settings, state) {
        await load.call(this, spz, settings, state);
        shown.push({ ...state, downloads: !document.getElementById("downloads").hidden });
        if (shown.length > 1 || state.final) return;
        this.touch();
        this.turn(0.05, 0);
        window.turned = [...this.rotation];
      };
    });
    await page.evaluate(() => {
      window.fractions = {};
      new MutationObserver(() => {
        const stage = document.getElementById("stage").textContent;
        (fractions[stage] ??= new Set()).add(document.getElementById("progress").value);
      }).observe(document.getElementById("progress"), { attributes: true });
    });
    // Chromium shares nothing on Linux.
    if (way === "cpu") {
      await page.evaluate(() => {
        navigator.canShare = ({ files }) => files.length > 0;
        navigator.share = async ({ files }) => { window.shared = files[0]; };
      });
    }
    const begin = Date.now();
    await chooseFiles(page, ROOM);
    await page.waitForSelector("#working:not([hidden])");
    await finished(page);
    assert.ok(await page.isHidden("#error"), await page.textContent("#error"));
    const states = await page.evaluate(() => shown);
    const expectedStates = states.map((_, i) => {
      const final = i === states.length - 1;
      return { keep: i > 0, final, downloads: final };
    });
    assert.deepEqual(states, expectedStates);
    assert.ok(way === "webgl" ? states.length > 1 : states.length === 1, JSON.stringify(states));
    if (way === "webgl") {
      assert.deepEqual(await page.evaluate(() => viewer.rotation), await page.evaluate(() => turned));
      await page.evaluate(() => viewer.reset());
    }
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
    assert.match(await page.textContent("#verdict"), /^(Good|Usable near the photographs|Wrong): .*[a-z]\.$/);
    assert.deepEqual(await page.evaluate(() => viewer.cameras.map((c) => c.name)), ["input_0", "input_1"]);
    assert.match(fs.readFileSync(ply, "latin1").slice(0, 4000), /subsplat photograph: .* name=input_1\n/);
    for (const format of ["spz", "glb"]) {
      const file = await download(page, `[data-save=${format}]`);
      const info = JSON.parse(subsplat("--json", "info", file).toString());
      const count = info.count ?? info.splats?.count ?? info.gaussians;
      // Some lie beyond the edges of the photographs, of a scene that is the network's alone none.
      const most = way === "webgl" ? 1.03 : 1;
      assert.ok(count >= 2 * 256 * 256 && count <= most * 2 * 256 * 256, JSON.stringify(info));
    }
    if (way === "cpu") {
      await pageOfItsOwn(page);
      const recorded = await clip(page);
      await shares(page);
      await focalLength(page);
      await camera(page);
      await advice(page);
      await video(page, recorded);
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
