// The page: photographs to the worker, its scene to the viewer.
"use strict";

const find = (id) => document.getElementById(id);
/** Most photographs at once: poses and memory grow with them. */
const PHOTOGRAPHS_MAX = 12;
const STAGES = {
  cameras: "finding the cameras", crop: "cropping", check: "checking the cameras",
  "depth range": "estimating the depth range", backbone: "estimating depth",
  primaries: "placing Gaussians", matching: "correcting depth", parents: "adjusting Gaussians",
  subsplat: "dividing Gaussians", detail: "adding detail",
  fit: "fitting to the photographs", refine: "refining",
};

/** `?network=cpu` and `?network=gpu` choose the processor of the network, `?draw=cpu` and
 * `?draw=webgl` that of the pictures. `?size=N` sets the network's input to about N×N pixels. */
const ADDRESS = new URLSearchParams(location.search);

/** The program: loaded while the photographs are chosen, compiled once. */
const compiled = (async () => {
  const answer = await fetch("subsplat.wasm.gz");
  if (!answer.ok) throw new Error(`The program could not be loaded (${answer.status}).`);
  const plain = answer.body.pipeThrough(new DecompressionStream("gzip"));
  return WebAssembly.compile(await new Response(plain).arrayBuffer());
})();
compiled.catch(() => {});

let worker = null;
/** Ends the reconstruction that runs. */
let running = null;
let task = 0;
const waiting = new Map();
let viewer = null;
let photographs = [];

function stopWorker(reason) {
  worker?.terminate();
  for (const { reject } of waiting.values()) reject(new Error(reason));
  waiting.clear();
}

function startWorker() {
  stopWorker("Another reconstruction began.");
  worker = new Worker("worker.js");
  worker.onmessage = ({ data: { id, stage, fraction, answer, error } }) => {
    const promise = waiting.get(id);
    if (!promise) return;
    if (stage !== undefined) {
      find("stage").textContent = `${STAGES[stage] ?? stage} …`;
      find("progress").value = fraction;
      return;
    }
    waiting.delete(id);
    error === undefined ? promise.resolve(answer) : promise.reject(new Error(error));
  };
  worker.onerror = (event) => stopWorker(event.message ?? "no worker");
}

function ask(message, transfer = []) {
  const id = ++task;
  return new Promise((resolve, reject) => {
    waiting.set(id, { resolve, reject });
    worker.postMessage({ id, ...message }, transfer);
  });
}

function showError(text) {
  find("error").hidden = !text;
  find("error").textContent = text ?? "";
}

/** Names the processor of the network, and the reason where it is not the first choice. */
function networkText({ processor, reason }) {
  if (processor === "gpu") {
    return reason ? `The network began on WebGPU. ${reason}.` : "The network ran on WebGPU.";
  }
  return `The network ran on the processor${reason ? `: ${reason}` : ""}.`;
}

function choose(list) {
  const files = [...list];
  if (files.length === 0) return;
  // A single file is added to the one before, so that a phone can give them one by one.
  const together = files.length === 1 && photographs.length === 1 ? [...photographs, ...files] : files;
  photographs = together.slice(0, PHOTOGRAPHS_MAX);
  const rows = photographs.map((file) => {
    const row = document.createElement("li"), picture = document.createElement("img");
    picture.alt = "";
    picture.src = URL.createObjectURL(file);
    picture.onload = picture.onerror = () => URL.revokeObjectURL(picture.src);
    row.append(picture, file.name);
    return row;
  });
  find("chosen").replaceChildren(...rows);
  find("start").disabled = photographs.length < 2;
  const cut = together.length > PHOTOGRAPHS_MAX
    ? `Only the first ${PHOTOGRAPHS_MAX} of ${together.length} photographs are used.` : null;
  showError(cut);
  if (photographs.length < 2) find("news").textContent = "One photograph chosen; choose another.";
  else reconstruct();
}

function busy(state) {
  find("working").hidden = !state;
  find("cancel").hidden = !state;
  find("start").disabled = state || photographs.length < 2;
  find("files").disabled = state;
}

/** Reads the photographs and returns the worker's answer. */
async function send(signal) {
  const module = await compiled;
  const files = await Promise.all(
    photographs.map(async (file) => ({ name: file.name, bytes: await file.arrayBuffer() })));
  signal.throwIfAborted();
  startWorker();
  return ask({
    task: "reconstruct", module, files,
    options: {
      upscale: find("upscale").value, effort: find("effort").value,
      size: ADDRESS.get("size") ?? "256", network: ADDRESS.get("network") ?? "auto",
    },
  }, files.map((f) => f.bytes));
}

async function reconstruct() {
  showError(null);
  busy(true);
  find("news").textContent = "";
  find("result").hidden = true;
  const begin = performance.now();
  try {
    find("stage").textContent = "loading the program …";
    find("progress").value = 0;
    running = new AbortController();
    const { signal } = running;
    const cancelled = new Promise((_, reject) => {
      signal.addEventListener("abort", () => reject(signal.reason));
    });
    const { scene, spz } = await Promise.race([cancelled, send(signal)]);
    find("result").hidden = false;
    viewer ??= new SplatViewer(find("viewer"), {
      draw: ADDRESS.get("draw") ?? "auto", levels: ADDRESS.get("levels") !== "off",
    });
    await viewer.load(spz, scene);
    const notes = scene.warnings.map((text) => {
      const row = document.createElement("li");
      row.textContent = text;
      return row;
    });
    find("notes").hidden = notes.length === 0;
    find("notes").querySelector("ul").replaceChildren(...notes);
    const seconds = ((performance.now() - begin) / 1000).toFixed(1);
    find("news").textContent = `Done in ${seconds} seconds. ${networkText(scene.network)}`;
    viewer.canvas.focus({ preventScroll: false });
  } catch (error) {
    showError(error.message);
  } finally {
    busy(false);
  }
}

find("form").addEventListener("submit", (event) => {
  event.preventDefault();
  reconstruct();
});
find("files").addEventListener("change", () => {
  choose(find("files").files);
  // The same files can be chosen again.
  find("files").value = "";
});
find("cancel").addEventListener("click", () => {
  running.abort(new Error("Cancelled."));
  stopWorker("Cancelled.");
});
for (const button of document.querySelectorAll("[data-save]")) {
  button.addEventListener("click", async () => {
    const format = button.dataset.save;
    try {
      saveBlob(new Blob([await ask({ task: "save", format })]), `scene.${format}`);
    } catch (error) {
      showError(error.message);
    }
  });
}
find("picture").addEventListener("click", () => viewer.savePicture());
const drop = find("drop");
document.addEventListener("dragover", (event) => {
  event.preventDefault();
  drop.classList.add("over");
});
document.addEventListener("dragleave", (event) => {
  if (!event.relatedTarget) drop.classList.remove("over");
});
document.addEventListener("drop", (event) => {
  event.preventDefault();
  drop.classList.remove("over");
  if (!find("files").disabled) choose(event.dataTransfer.files);
});
