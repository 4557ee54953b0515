// The network on every processor that a browser has.
import assert from "node:assert/strict";
import { LIKENESS, PLACE, capture, open, psnr, subsplat } from "./browser.mjs";
import { ROOM, dropFiles, finished, nativeFromPage, serve } from "./site.mjs";

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
export async function testNetwork() {
  const size = 32, out = `${PLACE}/network`;
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
