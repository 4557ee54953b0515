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
  fit: "fitting to the photographs", refine: "refining", verdict: "judging the scene",
};
const TRUST = { good: "Good", near_photographs: "Usable near the photographs", wrong: "Wrong" };

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
/** The scene that is shown: its .spz and the viewer's settings. */
let finished = null;
/** The viewer shows a scene of the reconstruction that runs; the end of its last change. */
let isShown = false, showing = Promise.resolve();

function stopWorker(reason) {
  worker?.terminate();
  for (const { reject } of waiting.values()) reject(new Error(reason));
  waiting.clear();
}

function startWorker() {
  stopWorker("Another reconstruction began.");
  worker = new Worker("worker.js");
  worker.onmessage = ({ data: { id, stage, fraction, scene, spz, answer, error } }) => {
    const promise = waiting.get(id);
    if (!promise) return;
    if (spz !== undefined) {
      showing = showing.then(() => showSoFar(spz, scene, () => waiting.has(id))).catch(() => {});
      return;
    }
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

/** What messages of the library advise by flags of the program, and the page's controls in their place. */
const ADVICE = [
  [/give --fov or --intrinsics/, "fill in the field “Focal length”"],
  [/give --fov/, "fill in the field “Focal length”"],
  [/a folder `masks` leaves such pixels/, "pictures with transparent pixels leave these"],
  [/, and give these with --fov 90/, ", and choose these with a focal length of 18 mm"],
  [/; or build with the feature `heic`/, ""],
  [/; the program estimates them from the photographs alone, without the file of cameras/, "; other photographs may help"],
];

/** A message of the library in the page's terms. Advice that the page has no control for is left out. */
function advised(text) {
  const said = ADVICE.reduce((said, [flag, control]) => said.replace(flag, control), text);
  return said.split(/(?=[;:] )/).filter((part) => !/--[a-z]/.test(part)).join("") || said;
}

function showError(text) {
  find("error").hidden = !text;
  find("error").textContent = advised(text ?? "");
}

/** Names the processor of the network, and the reason where it is not the first choice. */
function networkText({ processor, reason }) {
  if (processor === "gpu") {
    return reason ? `The network began on WebGPU. ${reason}.` : "The network ran on WebGPU.";
  }
  return `The network ran on the processor${reason ? `: ${reason}` : ""}.`;
}

/** Shows the photographs that are chosen. */
function showChosen() {
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
  find("clear").hidden = photographs.length === 0;
}

/** `files` with frames in place of videos. */
async function withFrames(files) {
  running = new AbortController();
  const { signal } = running;
  busy(true);
  try {
    const all = [];
    for (const file of files) {
      find("stage").textContent = `choosing frames of ${file.name} …`;
      const report = (fraction) => { find("progress").value = fraction; };
      all.push(...(isVideo(file) ? await videoFrames(file, PHOTOGRAPHS_MAX, report, signal) : [file]));
    }
    return all;
  } finally {
    busy(false);
  }
}

/** Takes files of a person; `taken`: of the device's camera, where more may follow. */
async function choose(chosen, taken = false) {
  if (chosen.length === 0) return;
  const files = chosen.some(isVideo) ? await withFrames(chosen) : chosen;
  // A single file is added to the one before, so that a phone can give them one by one, its camera any number.
  const one = files.length === 1 && (photographs.length === 1 || taken);
  const together = one ? [...photographs, ...files] : files;
  photographs = together.slice(0, PHOTOGRAPHS_MAX);
  showChosen();
  const cut = together.length > PHOTOGRAPHS_MAX
    ? `Only the first ${PHOTOGRAPHS_MAX} of ${together.length} photographs are used.` : null;
  showError(cut);
  if (photographs.length < 2) find("news").textContent = "One photograph chosen; choose another.";
  else if (!taken) reconstruct();
  else find("news").textContent = `${photographs.length} photographs: take another, or press “Reconstruct”.`;
}

function busy(state) {
  find("working").hidden = !state;
  find("cancel").hidden = !state;
  find("start").disabled = state || photographs.length < 2;
  find("files").disabled = find("camera").disabled = find("clear").disabled = state;
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
      size: ADDRESS.get("size") ?? "256", focal: find("focal").value, network: ADDRESS.get("network") ?? "auto",
    },
  }, files.map((f) => f.bytes));
}

async function attempt(work) {
  try {
    await work();
  } catch (error) {
    showError(error.message);
  }
}

/** The scene as one page with the viewer: what `subsplat export -o scene.html` writes. */
async function scenePage() {
  const part = async (name) => {
    const answer = await fetch(name);
    if (!answer.ok) throw new Error(`${name} could not be loaded (${answer.status}).`);
    return answer.text();
  };
  const [template, css, js] = await Promise.all(["scene.html", "viewer.css", "viewer.js"].map(part));
  const { spz, scene: { cameras, background, photographs } } = finished;
  const url = await new Promise((done) => {
    const reader = new FileReader();
    reader.onload = () => done(reader.result);
    reader.readAsDataURL(new Blob([spz]));
  });
  const parts = {
    title: "scene", css, settings: JSON.stringify({ cameras, background, photographs }).replaceAll("<", "\\u003c"),
    scene: url.slice(url.indexOf(",") + 1), js,
  };
  return new Blob([template.replace(/\{\{(\w+)\}\}/g, (_, name) => parts[name])], { type: "text/html" });
}

/** Shows a scene. The view of an earlier state of the same scene stays. */
async function show(spz, scene, final) {
  find("result").hidden = false;
  viewer ??= new SplatViewer(find("viewer"), {
    draw: ADDRESS.get("draw") ?? "auto", levels: ADDRESS.get("levels") !== "off",
    range: ADDRESS.get("range") !== "off", swing: ADDRESS.get("swing") ?? "auto",
  });
  await viewer.load(spz, scene, { keep: isShown, final });
  isShown = true;
}

/** Shows a scene that is being refined while `runs()`. What is made of a finished one is hidden. */
async function showSoFar(spz, scene, runs) {
  if (!runs()) return;
  for (const id of ["verdict", "downloads", "notes"]) find(id).hidden = true;
  await show(spz, scene, false);
  if (runs()) find("news").textContent = "This is the scene so far; it becomes sharper.";
}

async function reconstruct() {
  showError(null);
  busy(true);
  isShown = false;
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
    await showing;
    for (const id of ["verdict", "downloads"]) find(id).hidden = false;
    await show(spz, scene, true);
    finished = { spz, scene };
    find("clip").hidden = !viewer.canClip();
    find("share").hidden = !canShare(new File([], "scene.html", { type: "text/html" }));
    const { trust, reason } = scene.verdict;
    find("verdict").textContent = `${TRUST[trust]}: ${advised(reason)}.`;
    find("verdict").dataset.trust = trust;
    const notes = scene.warnings.map((text) => {
      const row = document.createElement("li");
      row.textContent = advised(text);
      return row;
    });
    find("notes").hidden = notes.length === 0;
    find("notes").querySelector("ul").replaceChildren(...notes);
    const seconds = ((performance.now() - begin) / 1000).toFixed(1);
    find("news").textContent = `Done in ${seconds} seconds. ${networkText(scene.network)}`;
    viewer.canvas.focus({ preventScroll: false });
  } catch (error) {
    showError(error.message);
    // A scene that is not finished cannot be saved.
    find("result").hidden = true;
  } finally {
    busy(false);
  }
}

find("form").addEventListener("submit", (event) => {
  event.preventDefault();
  reconstruct();
});
for (const id of ["files", "camera"]) {
  find(id).addEventListener("change", () => {
    attempt(() => choose([...find(id).files], id === "camera"));
    // The same files can be chosen again.
    find(id).value = "";
  });
}
find("clear").addEventListener("click", () => {
  photographs = [];
  showChosen();
  showError(null);
  find("news").textContent = "";
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
find("page").addEventListener("click", () => attempt(async () => saveBlob(await scenePage(), "scene.html")));
find("share").addEventListener("click", () => attempt(async () => {
  const file = new File([await scenePage()], "scene.html", { type: "text/html" });
  // Whoever closes the list of receivers shares nothing.
  await navigator.share({ files: [file], title: "scene" }).catch(() => {});
}));
find("clip").addEventListener("click", () => attempt(async () => {
  find("clip").disabled = true;
  try {
    const clip = await viewer.clip();
    saveBlob(clip, `clip.${clip.type.includes("mp4") ? "mp4" : "webm"}`);
  } finally {
    find("clip").disabled = false;
  }
}));
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape" && !event.defaultPrevented) find("notes").open = false;
});
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
  // The list is empty once the event is over.
  const files = [...event.dataTransfer.files];
  if (!find("files").disabled) attempt(() => choose(files));
});
