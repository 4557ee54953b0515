// The page on a server of its own, and what people do with it.
import fs from "node:fs";
import http from "node:http";
import path from "node:path";
import { PLACE, native } from "./browser.mjs";

const SITE = `${PLACE}/site`;
export const ROOM = ["examples/room/images/input_0.png", "examples/room/images/input_1.png"];

/** Serves the page's folder. `before` is JavaScript in front of the worker's own; `sizes` has the bytes
 * of each file that was asked for. */
export function serve() {
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
export async function chooseFiles(page, files) {
  const chooser = page.waitForEvent("filechooser");
  await page.click("text=Choose photographs");
  await (await chooser).setFiles(files);
}

/** Drops files onto the page. */
export async function dropFiles(page, files) {
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
export async function nativeFromPage(page, scene, name) {
  const camera = await page.evaluate(() => ({ ...viewer.cameras[0] }));
  // The viewer's world is y-up: back to the program's.
  camera.world_from_camera = [0, 1, 2].flatMap((r) => {
    const sign = r === 0 ? 1 : -1;
    return [...camera.rotation.slice(3 * r, 3 * r + 3), camera.eye[r]].map((v) => sign * v);
  });
  return native(scene, name, { cameras: [camera] });
}

export const finished = (page) => page.waitForFunction(
  () => !document.getElementById("error").hidden || /^Done/.test(document.getElementById("news").textContent));

export async function download(page, button) {
  const event = page.waitForEvent("download");
  await page.click(button);
  const file = `${PLACE}/page-${(await event).suggestedFilename()}`;
  await (await event).saveAs(file);
  return file;
}
