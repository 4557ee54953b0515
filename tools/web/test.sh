#!/usr/bin/env bash
# Tests the page and an exported scene in headless Chromium (software WebGL2), from a release build
# of the programs. `test.sh page` and `test.sh export` run one of the two.
set -euo pipefail
cd "$(dirname "$0")/../.."
command -v node >/dev/null && command -v npm >/dev/null && command -v chromium >/dev/null ||
    { apt-get update && apt-get install -y --no-install-recommends chromium nodejs npm; }
place=out/web-test
mkdir -p "$place"
[[ -d $place/node_modules/playwright-core ]] ||
    npm install --prefix "$place" --no-audit --no-fund --silent playwright-core@1.65.1
cp tools/web/test.mjs "$place/test.mjs"
tools/web/build.sh "$place/site"
export SUBSPLAT="${CARGO_TARGET_DIR:-target}/release/subsplat"
exec node "$place/test.mjs" "$@"
