// The page: photographs to the worker, its scene to the viewer.
"use strict";

const find = (id) => document.getElementById(id);
/** Most photographs at once: poses and memory grow with them. */
const PHOTOGRAPHS_MAX = 12;
const STAGES = {
  cameras: "finding the cameras", crop: "cropping", check: "checking the cameras",
  "depth range": "estimating the depth range", backbone: "estimating depth",
  primaries: "placing Gaussians", subsplat: "dividing Gaussians", detail: "adding detail",
  fit: "fitting to the photographs", refine: "refining",
};

let worker = null;
let task = 0;
const waiting = new Map();
let viewer = null;
let photographs = [];

function startWorker() {
  worker?.terminate();
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
  worker.onerror = (event) => {
    for (const { reject } of waiting.values()) reject(new Error(event.message ?? "no worker"));
    waiting.clear();
  };
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

async function reconstruct() {
  showError(null);
  busy(true);
  find("news").textContent = "";
  find("result").hidden = true;
  const begin = performance.now();
  try {
    const files = await Promise.all(
      photographs.map(async (file) => ({ name: file.name, bytes: await file.arrayBuffer() })));
    const { scene, spz } = await ask({
      task: "reconstruct", files,
      upscale: Number(find("upscale").value), effort: Number(find("effort").value),
    }, files.map((f) => f.bytes));
    find("result").hidden = false;
    // `?draw=cpu` and `?draw=webgl` choose how the scene is drawn, `?levels=off` draws all of it.
    const query = new URLSearchParams(location.search);
    viewer ??= new SplatViewer(find("viewer"), {
      draw: query.get("draw") ?? "auto", levels: query.get("levels") !== "off",
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
    find("news").textContent = `Done in ${seconds} seconds.`;
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
  for (const { reject } of waiting.values()) reject(new Error("Cancelled."));
  waiting.clear();
  startWorker();
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
// The program is loaded while the photographs are chosen.
startWorker();
