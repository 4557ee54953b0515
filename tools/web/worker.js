// Runs the library (subsplat.wasm) off the page's thread.
//
// Messages in: { id, task: "reconstruct", files: [{ name, bytes }], upscale, effort } and
// { id, task: "save", format }. Messages out: { id, stage, fraction }, then { id, answer } or
// { id, error }.
"use strict";

/** Compiled once; each reconstruction gets a new instance, since WebAssembly returns no memory. */
const compiled = (async () => {
  const answer = await fetch("subsplat.wasm.gz");
  if (!answer.ok) throw new Error(`The program could not be loaded (${answer.status}).`);
  const plain = answer.body.pipeThrough(new DecompressionStream("gzip"));
  return WebAssembly.compile(await new Response(plain).arrayBuffer());
})();
compiled.catch(() => {});

let library = null;
let current = 0;

async function open() {
  const text = new TextDecoder();
  const progress = (stage, length, fraction) => {
    const name = text.decode(new Uint8Array(library.memory.buffer, stage, length));
    postMessage({ id: current, stage: name, fraction });
  };
  library = null;
  library = (await WebAssembly.instantiate(await compiled, { env: { progress } })).exports;
}

/** Calls a function of the library with `input`, and returns a copy of its answer. */
function call(name, input, ...numbers) {
  if (input) {
    const at = library.input(input.length);
    new Uint8Array(library.memory.buffer, at, input.length).set(input);
  }
  let success;
  try {
    success = library[name](...numbers);
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

async function reconstruct({ files, upscale, effort }) {
  postMessage({ id: current, stage: "loading the program", fraction: 0 });
  await open();
  for (const [i, { name, bytes }] of files.entries()) {
    postMessage({ id: current, stage: `reading ${name}`, fraction: i / files.length });
    const title = new TextEncoder().encode(name);
    const input = new Uint8Array(title.length + bytes.byteLength);
    input.set(title);
    input.set(new Uint8Array(bytes), title.length);
    call("add_photograph", input, title.length);
  }
  const scene = JSON.parse(new TextDecoder().decode(call("reconstruct", null, upscale, effort)));
  postMessage({ id: current, stage: "packing", fraction: 1 });
  return { scene, spz: save({ format: "spz" }) };
}

function save({ format }) {
  if (!library) throw new Error("There is no scene to save.");
  return call("save", new TextEncoder().encode(format));
}

onmessage = async ({ data }) => {
  current = data.id;
  try {
    const answer = await { reconstruct, save }[data.task](data);
    postMessage({ id: data.id, answer });
  } catch (error) {
    postMessage({ id: data.id, error: error.message });
  }
};
