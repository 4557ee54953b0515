// An exported scene, against the program's own pictures.
import assert from "node:assert/strict";
import fs from "node:fs";
import path from "node:path";
import { pathToFileURL } from "node:url";
import {
  LIKENESS, PLACE, box, capture, drag, drags, excess, idle, moves, native, open, picture, pictures, psnr, subsplat,
} from "./browser.mjs";

/** A far camera draws fewer Gaussians, and nearly the picture of all of them. */
async function levelOfDetail(page, way) {
  await page.waitForFunction(() => viewer.levels);
  const all = await page.evaluate(() => viewer.scene.count);
  await capture(page);
  const near = await page.evaluate(() => viewer.drawn);
  // 16 times the distance, out of the range of views, where the picture would fade.
  await page.evaluate(() => {
    window.held = viewer.range;
    viewer.range = null;
    viewer.wheel(Math.log(16) / Math.log(0.9));
  });
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
  await off.page.evaluate(() => {
    viewer.range = null;
    viewer.wheel(Math.log(16) / Math.log(0.9));
  });
  await capture(off.page);
  assert.equal(await off.page.evaluate(() => viewer.drawn), all, "levels=off");
  await off.page.close();
  await page.evaluate(() => {
    viewer.range = held;
    viewer.reset();
  });
  await idle(page);
}

/** Views stay where the photographs support them, softly, except when flying. */
async function rangeOfViews(url) {
  const { page, errors } = await open(url);
  await page.waitForFunction(() => viewer?.levels);
  assert.ok(await excess(page) < 1e-3, "a photograph's place");
  const reach = await page.evaluate(() => viewer.range.sites.map((site) => site.reach.map((r) => r * 180 / Math.PI)));
  assert.ok(reach.flat().every((r) => r >= 4 && r <= 25) && reach.flat().some((r) => r > 4.1), `${reach}`);
  await drag(page, 100, 0);
  const once = await excess(page);
  assert.ok(once > 0.1 && once < 0.95, `a drag of 100 px: ${once}`);
  await drags(page, 8, 200, -150);
  const limit = await excess(page);
  assert.ok(limit > 0.9 && limit < 1.05, `many drags: ${limit}`);
  for (const [steps, what] of [[-12, "farther"], [12, "nearer"]]) {
    await page.click("text=Reset");
    await page.evaluate((steps) => viewer.wheel(steps), steps);
    const end = await excess(page);
    assert.ok(end > 0.5 && end < 1.05, `${what}: ${end}`);
  }
  // The way back is free: after the limit one drag of 100 px comes nearer to the photograph.
  await page.click("text=Reset");
  await drags(page, 8, -200, 0);
  await drags(page, 1, 100, 0);
  assert.ok(await excess(page) < 0.7, "the way back");
  // Flying leaves the range, and the picture fades to the background there.
  await page.click("text=Reset");
  await page.click("text=Fly");
  await drags(page, 1, 80, 0);
  assert.ok(await excess(page) > 1.5, "flying is free");
  const faded = await capture(page);
  const plain = await page.evaluate(() => {
    window.held = viewer.range;
    viewer.range = null;
  }).then(() => capture(page));
  const fade = psnr(faded, plain);
  assert.ok(fade < 30, `views outside the range fade: ${fade} dB`);
  assert.equal(errors.length, 0, errors.join());
  await page.close();
  // Without the range the same drags lead far out of it.
  const off = await open(url.replace("#", "?range=off#"));
  await off.page.waitForFunction(() => viewer?.levels);
  assert.equal(await off.page.evaluate(() => viewer.range), null);
  await drags(off.page, 8, 200, -150);
  assert.ok(await excess(off.page) > 2, "range=off");
  await off.page.close();
}

/** The picture at the limit of views, where holes are filled. */
async function atLimit(url, way) {
  const { page } = await open(url);
  await page.waitForFunction(() => viewer?.levels);
  await drags(page, 8, 200, -150);
  const shot = await capture(page);
  await idle(page);
  await page.screenshot({ path: `${PLACE}/export-limit-${way}.png` });
  await page.close();
  return shot;
}

/** The view swings until somebody touches it, and not for people who ask for less motion. */
async function swings(url) {
  const touches = {
    click: (page) => drag(page, 0, 0), wheel: (page) => page.mouse.wheel(0, 10),
    key: (page) => page.locator("canvas").press("x"), button: (page) => page.click("text=Keys"),
  };
  const small = { width: 400, height: 400, reducedMotion: "no-preference" };
  const asked = url.replace("#", "?swing=on#");
  for (const [name, touch] of Object.entries(touches)) {
    const { page, errors } = await open(asked, small);
    await page.waitForFunction(() => viewer?.swinging);
    assert.ok(await pictures(page, 1000) > 1, "the view swings");
    assert.ok(await excess(page) < 1, "the swing stays in the range");
    const { x, y } = await box(page);
    await page.mouse.move(x + 20, y + 20);
    await touch(page);
    await idle(page);
    assert.equal(await pictures(page, 700), 0, `the swing ends with a touch: ${name}`);
    assert.equal(errors.length, 0, errors.join());
    await page.close();
  }
  // Untouched, the view comes back and rests. Unasked, it swings where pictures are quick.
  const { page } = await open(asked, small);
  await page.waitForFunction(() => viewer?.swinging);
  await page.evaluate(() => { viewer.swinging.seconds = 1; });
  await page.waitForFunction(() => !viewer.swinging);
  for (const cost of [1, 1000]) {
    assert.equal(await page.evaluate((cost) => {
      Object.assign(viewer, { cost, swings: "auto" }).swing();
      return Boolean(viewer.swinging);
    }, cost), cost < 40, `a picture of ${cost} ms`);
    await page.evaluate(() => viewer.reset());
    await page.evaluate(() => { viewer.swinging = null; });
  }
  assert.ok(await excess(page) < 1e-3, "the swing ends where it began");
  await idle(page);
  assert.equal(await pictures(page, 700), 0, "no pictures at rest");
  await page.close();
  for (const [address, reducedMotion] of [[asked, "reduce"], [url.replace("#", "?swing=off#"), "no-preference"]]) {
    const { page } = await open(address, { ...small, reducedMotion });
    await page.waitForFunction(() => viewer?.levels);
    await idle(page);
    assert.equal(await pictures(page, 700), 0, `no swing: ${address}, ${reducedMotion}`);
    await page.close();
  }
}

/** The keys' list closes with Escape, from the canvas and from its button. */
async function escapes(page) {
  for (const [open, from] of [["KeyH", "canvas"], ["Enter", "[data-do=help]"]]) {
    await page.locator(from).press(open);
    assert.ok(await page.isVisible(".splat-keys"));
    assert.equal(await page.getAttribute("[data-do=help]", "aria-expanded"), "true");
    await page.locator(from).press("Escape");
    assert.ok(await page.isHidden(".splat-keys"), `Escape closes the keys, from ${from}`);
    assert.equal(await page.getAttribute("[data-do=help]", "aria-expanded"), "false");
  }
}

/** The saved picture is what the screen frames, at twice its size. */
async function savesPicture(page) {
  await idle(page);
  const event = page.waitForEvent("download");
  await page.click("text=Save picture");
  assert.equal((await event).suggestedFilename(), "view.png");
  await (await event).saveAs(`${PLACE}/view.png`);
  const saved = await picture(`${PLACE}/view.png`);
  const sides = await page.evaluate(() => [viewer.canvas.clientWidth, viewer.canvas.clientHeight]);
  assert.deepEqual([saved.width, saved.height], sides.map((side) => 2 * side));
  // Means of four pixels, against the picture on the screen.
  await idle(page);
  const shot = await page.evaluate(() => {
    viewer.paint();
    return viewer.canvas.toDataURL("image/png");
  });
  fs.writeFileSync(`${PLACE}/screen.png`, Buffer.from(shot.split(",")[1], "base64"));
  const screen = await picture(`${PLACE}/screen.png`);
  const half = Buffer.alloc(screen.rgba.length);
  for (let at = 0; at < half.length; at++) {
    const x = (at >> 2) % screen.width, y = Math.floor((at >> 2) / screen.width);
    const from = (i, j) => saved.rgba[4 * ((2 * y + j) * saved.width + 2 * x + i) + at % 4];
    half[at] = (from(0, 0) + from(1, 0) + from(0, 1) + from(1, 1)) / 4;
  }
  const likeness = psnr({ ...screen, rgba: half }, screen);
  console.log(`export: saved picture ${likeness.toFixed(1)} dB against the screen`);
  assert.ok(likeness > 28);
}

/** Keys and buttons move the view. */
async function keysAndButtons(page) {
  await moves(page, () => page.locator("canvas").press("ArrowRight"), "an arrow key");
  await moves(page, () => page.click("text=Next photo"), "Next photo");
  assert.equal(await page.textContent(".splat-status"), "Photograph 2 of 2: input_1");
  await escapes(page);
  await page.click("text=Fly");
  assert.equal(await page.getAttribute("text=Fly", "aria-pressed"), "true");
  await moves(page, async () => {
    await page.locator("canvas").focus();
    await page.keyboard.down("KeyW");
    await page.waitForTimeout(300);
    await page.keyboard.up("KeyW");
  }, "W");
  await page.click("text=Fly");
}

export async function testExport() {
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
  // The photographs' own places, not those of cameras.json beside the scene, which is of rendered views.
  const names = ["input_0", "input_1"];
  assert.deepEqual(await page.evaluate(() => viewer.cameras.map((c) => c.name)), names);
  assert.equal(asked.length, 1, `asked for ${asked.join()}`);
  await page.close();
  subsplat("export", `${out}/${title}.ply`, "--cameras", `${out}/cameras.json`, "-o", `${out}/views.html`);
  const views = await open(pathToFileURL(path.resolve(`${out}/views.html`)).href);
  await views.page.click("text=Next view");
  assert.match(await views.page.textContent(".splat-status"), /^View 2 of 3/);
  // WebGL is software in this browser.
  assert.equal(await views.page.evaluate(() => viewer.painter.name), "the processor");
  await views.page.close();

  const shown = pathToFileURL(path.resolve(`${out}/scene.html`)).href;
  // Few Gaussians, which a processor draws in time.
  subsplat("export", `${out}/scene.ply`, "--gaussians", "2000", "-o", `${out}/few.html`);
  const few = pathToFileURL(path.resolve(`${out}/few.html`)).href;
  await swings(`${few}#cpu`);
  await rangeOfViews(`${shown}#cpu`);
  const limits = {};
  for (const way of ["webgl", "cpu"]) limits[way] = await atLimit(`${shown}#${way}`, way);
  const alike = psnr(limits.webgl, limits.cpu);
  console.log(`export: at the limit, with filled holes, ${alike.toFixed(1)} dB between WebGL2 and the processor`);
  assert.ok(alike > LIKENESS, "both ways fill holes alike");

  for (const way of ["webgl", "cpu"]) {
    // Small, where the processor runs WebGL2.
    const { page, errors } = await open(`${shown}#${way}`, { width: 360, height: 420 });
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
    // Keys and buttons are the same for both ways.
    if (way === "cpu") await keysAndButtons(page);
    assert.equal(errors.length, 0, errors.join());
    await page.close();
    const small = await open(`${few}#${way}`, { width: 360, height: 640 });
    await small.page.waitForFunction(() => viewer?.levels);
    await savesPicture(small.page);
    const wide = await small.page.evaluate(() => document.documentElement.scrollWidth);
    assert.ok(wide <= 360, `a page ${wide} px wide on a phone`);
    await small.page.screenshot({ path: `${PLACE}/export-phone.png` });
    assert.equal(small.errors.length, 0, small.errors.join());
    await small.page.close();
  }
}
