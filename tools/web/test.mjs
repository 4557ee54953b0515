// The page and an exported scene in headless Chromium, against the program's own pictures.
// test.sh copies this file and its folder beside their modules and runs it at the root of the repository:
// `test.mjs [export] [page] [network]`, all three without a name.
import { browser } from "./test/browser.mjs";
import { testExport } from "./test/export.mjs";
import { testNetwork } from "./test/network.mjs";
import { testPage } from "./test/page.mjs";

const chosen = process.argv.slice(2);
try {
  if (chosen.length === 0 || chosen.includes("export")) await testExport();
  if (chosen.length === 0 || chosen.includes("page")) await testPage();
  if (chosen.length === 0 || chosen.includes("network")) await testNetwork();
} finally {
  await browser.close();
}
