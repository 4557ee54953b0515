// Checks .glb files with the Khronos glTF validator, and what the validator does not
// know yet: KHR_gaussian_splatting.
//
//     node tools/check_glb.mjs a.glb b.glb
//
// The validator comes from the npm registry into a temporary folder, unless
// GLTF_VALIDATOR names a folder that holds node_modules/gltf-validator.
// Exit code: 0 nothing wrong, 1 an error in a file, 2 no validator or no file.
//
// Version 2.0.0-dev.3.10 knows neither the extension nor attribute names that carry an
// extension's prefix (glTF-Validator issue 252). Exactly two of its messages are set
// aside for that: UNSUPPORTED_EXTENSION for this name, and MESH_PRIMITIVE_INVALID_ATTRIBUTE
// for names with this prefix. Their accessors are checked here, by the extension's tables.

import { execFileSync } from "node:child_process";
import { mkdtempSync, readFileSync, rmSync } from "node:fs";
import { createRequire } from "node:module";
import { tmpdir } from "node:os";
import { join } from "node:path";

const VERSION = "2.0.0-dev.3.10";
const NAME = "KHR_gaussian_splatting";
const FLOAT = 5126;

function loadValidator() {
  const given = process.env.GLTF_VALIDATOR;
  const folder = given ?? mkdtempSync(join(tmpdir(), "gltf-validator-"));
  try {
    if (!given) {
      const options = { cwd: folder, stdio: ["ignore", "ignore", "inherit"] };
      const wanted = `gltf-validator@${VERSION}`;
      execFileSync("npm", ["install", "--prefix", folder, "--no-audit", "--no-fund", wanted], options);
    }
    return createRequire(join(folder, "package.json"))("gltf-validator");
  } finally {
    if (!given) rmSync(folder, { recursive: true, force: true });
  }
}

function parse(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const length = view.getUint32(12, true);
  const json = JSON.parse(new TextDecoder().decode(bytes.subarray(20, 20 + length)));
  return { json, binary: 20 + length + 8, view };
}

// The numbers of an accessor of floats, element by element.
function* elements({ json, binary, view }, accessor, lanes) {
  const bufferView = json.bufferViews[accessor.bufferView];
  const start = binary + (bufferView.byteOffset ?? 0) + (accessor.byteOffset ?? 0);
  const stride = bufferView.byteStride ?? 4 * lanes;
  for (let i = 0; i < accessor.count; i++) {
    yield Array.from({ length: lanes }, (_, l) => view.getFloat32(start + i * stride + 4 * l, true));
  }
}

function checkPrimitive(file, primitive, say) {
  const { json } = file;
  const extension = primitive.extensions[NAME];
  if ((primitive.mode ?? 4) !== 0) say(`mode is ${primitive.mode}, not POINTS`);
  if (typeof extension.kernel !== "string") say("no kernel");
  if (!["srgb_rec709_display", "lin_rec709_display"].includes(extension.colorSpace)) {
    say(`colorSpace is ${extension.colorSpace}`);
  }
  const lanesOf = { SCALAR: 1, VEC3: 3, VEC4: 4 };
  const count = json.accessors[primitive.attributes.POSITION]?.count;
  const check = (attribute, type, valid) => {
    const index = primitive.attributes[`${NAME}:${attribute}`];
    const accessor = json.accessors[index];
    if (!accessor) return say(`no ${attribute}`);
    if (accessor.type !== type) say(`${attribute} is ${accessor.type}, not ${type}`);
    if (accessor.count !== count) say(`${attribute} has ${accessor.count} elements, not ${count}`);
    if (accessor.componentType !== FLOAT) return;
    for (const v of elements(file, accessor, lanesOf[type])) {
      if (!v.every(Number.isFinite) || !valid(v)) return say(`${attribute} holds ${v}`);
    }
  };
  check("ROTATION", "VEC4", (q) => Math.abs(Math.hypot(...q) - 1) < 1e-3);
  check("SCALE", "VEC3", (s) => s.every((x) => x >= 0));
  check("OPACITY", "SCALAR", ([a]) => a >= 0 && a <= 1);
  const has = (l) => Object.keys(primitive.attributes).some((a) => a.startsWith(`${NAME}:SH_DEGREE_${l}_`));
  const degree = [3, 2, 1].find(has) ?? 0;
  const known = new Set(["ROTATION", "SCALE", "OPACITY"]);
  for (let l = 0; l <= degree; l++) {
    for (let n = 0; n <= 2 * l; n++) {
      known.add(`SH_DEGREE_${l}_COEF_${n}`);
      check(`SH_DEGREE_${l}_COEF_${n}`, "VEC3", () => true);
    }
  }
  for (const attribute of Object.keys(primitive.attributes)) {
    const [prefix, own] = attribute.split(":");
    if (prefix === NAME && !known.has(own)) say(`unknown attribute ${attribute}`);
  }
  return { count, degree };
}

function checkExtension(bytes, say) {
  const file = parse(bytes);
  const { json } = file;
  if (!json.extensionsUsed?.includes(NAME)) say("not in extensionsUsed");
  const found = [];
  for (const mesh of json.meshes ?? []) {
    for (const primitive of mesh.primitives) {
      if (primitive.extensions?.[NAME]) found.push(checkPrimitive(file, primitive, say));
    }
  }
  if (found.length === 0) say("no primitive of splats");
  return found;
}

// One of the two messages that only say "I do not know this extension".
function setAside(message) {
  const text = `${message.pointer} ${message.message}`;
  return (
    (message.code === "UNSUPPORTED_EXTENSION" && text.includes(NAME)) ||
    (message.code === "MESH_PRIMITIVE_INVALID_ATTRIBUTE" && text.includes(`${NAME}:`))
  );
}

const files = process.argv.slice(2);
if (files.length === 0) {
  console.error("usage: node tools/check_glb.mjs FILE.glb ...");
  process.exit(2);
}
let validator;
try {
  validator = loadValidator();
} catch (error) {
  console.error(`no gltf-validator: ${error.message}`);
  process.exit(2);
}
let wrong = 0;
for (const name of files) {
  const bytes = new Uint8Array(readFileSync(name));
  const problems = [];
  let aside = 0;
  try {
    const report = await validator.validateBytes(bytes, { uri: name, maxIssues: 0 });
    for (const message of report.issues.messages) {
      if (setAside(message)) aside += 1;
      // 0 error, 1 warning, 2 information, 3 hint.
      else if (message.severity <= 1) problems.push(`${message.code} ${message.pointer}: ${message.message}`);
      else console.log(`${name}: (${message.code}) ${message.pointer}: ${message.message}`);
    }
    const found = checkExtension(bytes, (what) => problems.push(`${NAME}: ${what}`));
    const summary = found.map(({ count, degree }) => `${count} splats of degree ${degree}`).join(", ");
    console.log(`${name}: ${summary}; validator ${validator.version()}, ${aside} messages about ${NAME} set aside`);
  } catch (error) {
    problems.push(String(error));
  }
  for (const problem of problems) console.error(`${name}: ${problem}`);
  wrong += problems.length;
}
process.exit(wrong === 0 ? 0 : 1);
