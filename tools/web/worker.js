// Runs the library (subsplat.wasm) off the page's thread, for one reconstruction: WebAssembly
// returns no memory, so the page starts a new worker for the next one.
//
// Messages in: { id, task: "reconstruct", module, files: [{ name, bytes }], options } and
// { id, task: "save", format }. Messages out: { id, stage, fraction }, { id, scene, spz } of a scene
// that is being refined, then { id, answer } or { id, error }. `options` is the input of the library's function `reconstruct`.
"use strict";

/** Whether the library can wait for a GPU (JavaScript Promise Integration). */
const CAN_WAIT = typeof WebAssembly.Suspending === "function";

let library = null;
let current = 0;

/** The least time between two scenes so far, ms, and the least multiple of what the last one took. */
const SHOWN_EVERY = 2000, SHOWN_SHARE = 8;
/** When the library began the last scene so far, and when it may begin the next one, ms. */
let shown = 0, next = 0;

/** The import `suspend`, which returns after a call of `resume`. */
const wait = {
  resumed: false,
  end: null,
  suspend() {
    return new Promise((end) => {
      this.end = end;
      if (this.resumed) this.resume();
    });
  },
  resume() {
    this.resumed = this.end === null;
    this.end?.();
    this.end = null;
  },
};

async function open(module) {
  const text = new TextDecoder();
  const env = {
    progress(stage, length, fraction) {
      const name = text.decode(new Uint8Array(library.memory.buffer, stage, length));
      postMessage({ id: current, stage: name, fraction });
    },
    wants_scene() {
      shown = performance.now();
      return shown >= next ? 1 : 0;
    },
    scene(...at) {
      const copy = (from, length) => new Uint8Array(library.memory.buffer, from, length).slice();
      const spz = copy(at[2], at[3]);
      postMessage({ id: current, scene: JSON.parse(text.decode(copy(at[0], at[1]))), spz }, [spz.buffer]);
      const end = performance.now();
      next = end + Math.max(SHOWN_EVERY, SHOWN_SHARE * (end - shown));
    },
    suspend: CAN_WAIT ? new WebAssembly.Suspending(() => wait.suspend()) : () => {},
    resume: () => wait.resume(),
  };
  const bindings = await import("./subsplat_bg.js");
  const imports = { env, "./subsplat_bg.js": bindings };
  library = (await WebAssembly.instantiate(module, imports)).exports;
  bindings.__wbg_set_wasm(library);
  library.__wbindgen_start();
}

/** Calls `work`, a function of the library, with `input`, and returns a copy of its answer. */
async function call(work, input, ...numbers) {
  if (input) {
    const at = library.input(input.length);
    new Uint8Array(library.memory.buffer, at, input.length).set(input);
  }
  let success;
  try {
    success = await work(...numbers);
  } catch (error) {
    // A trap: the library is in no usable state.
    library = null;
    throw new Error(`The reconstruction stopped: ${error.message}. The photographs may need more
      memory than the browser gives; try ×1 or ×2.`.replace(/\s+/g, " "));
  }
  const from = library.output();
  const answer = new Uint8Array(library.memory.buffer, from, library.output_length()).slice();
  if (!success) throw new Error(new TextDecoder().decode(answer));
  return answer;
}

/** The device for the library, and the reason where it is not the one that the page asks for. */
function device(network) {
  if (network === "cpu" || CAN_WAIT) return [network, null];
  const reason = "this browser has no WebAssembly.Suspending, which the wait for WebGPU needs";
  return ["cpu", navigator.gpu || network === "gpu" ? reason : null];
}

async function reconstruct({ module, files, options }) {
  await open(module);
  const bytesOf = (text) => new TextEncoder().encode(text);
  for (const [i, { name, bytes }] of files.entries()) {
    postMessage({ id: current, stage: `reading ${name}`, fraction: i / files.length });
    const title = bytesOf(name);
    const input = new Uint8Array(title.length + bytes.byteLength);
    input.set(title);
    input.set(new Uint8Array(bytes), title.length);
    await call(library.add_photograph, input, title.length);
  }
  const [network, reason] = device(options.network);
  const work = CAN_WAIT ? WebAssembly.promising(library.reconstruct) : library.reconstruct;
  const answer = await call(work, bytesOf(JSON.stringify({ ...options, network })));
  const scene = JSON.parse(new TextDecoder().decode(answer));
  scene.network.reason ??= reason;
  postMessage({ id: current, stage: "packing", fraction: 1 });
  return { scene, spz: await save({ format: "spz" }) };
}

async function save({ format }) {
  if (!library) throw new Error("There is no scene to save.");
  return call(library.save, new TextEncoder().encode(format));
}

async function run({ id, task, ...message }) {
  current = id;
  try {
    postMessage({ id, answer: await { reconstruct, save }[task](message) });
  } catch (error) {
    postMessage({ id, error: error.message });
  }
}

// One task at a time: the library takes no other call while it is suspended.
let tasks = Promise.resolve();
onmessage = ({ data }) => {
  tasks = tasks.then(() => run(data));
};
