#!/usr/bin/env bash
# Builds archives of the programs into out/release: `tools/release/build.sh [TARGET…]`.
#
# Without a target: x86_64-unknown-linux-musl. A target may end in a version of glibc
# (x86_64-unknown-linux-gnu.2.31). Zig compiles and links (cargo-zigbuild); both come from PyPI into out/release-tools.
# FEATURES adds features of tools/cli (`FEATURES=mp4,heic`), CARGO_ARGS goes to cargo. PAGE=no leaves the page out,
# PAGE=FOLDER takes one that tools/web/build.sh has built.
set -euo pipefail
cd "$(dirname "$0")/../.."
place=$PWD/out/release tools=$PWD/out/release-tools
targets=("$@")
((${#targets[@]})) || targets=(x86_64-unknown-linux-musl)
version=$(sed -n 's/^version = "\(.*\)"/\1/p' tools/cli/Cargo.toml | head -n 1)
epoch=$(git log -1 --format=%ct 2>/dev/null || echo 0)
say() { printf '%s\n' "$*" >&2; }

if [[ ! -x $tools/bin/cargo-zigbuild ]]; then
    say "installing zig …"
    python3 -m venv "$tools"
    "$tools/bin/pip" install --quiet cargo-zigbuild==0.24.1 ziglang==0.17.1
fi
export PATH="$tools/bin:$PATH" MACOSX_DEPLOYMENT_TARGET=${MACOSX_DEPLOYMENT_TARGET:-11.0}
if ! command -v cargo-about >/dev/null; then
    say "installing cargo-about …"
    cargo install --locked --quiet --root "$tools" --features cli cargo-about@0.9.3
fi

mkdir -p "$place"
licences=$place/LICENSES-of-dependencies.txt
if [[ ! $licences -nt Cargo.lock || ! $licences -nt tools/release/about.hbs ]]; then
    say "licences of the dependencies (some minutes) …"
    cargo about generate --locked --fail -c tools/release/about.toml -m tools/cli/Cargo.toml \
        -o "$licences" tools/release/about.hbs
fi
page=${PAGE:-$place/page}
[[ -n ${PAGE:-} ]] || tools/web/build.sh "$page"

# Programs in a folder of the target's own.
compile() {
    local target=$1 triple=$2
    say "$target, features $features …"
    rustup target list --installed 2>/dev/null | grep -qx "$triple" || rustup target add "$triple"
    # shellcheck disable=SC2086 # several words
    CARGO_PROFILE_RELEASE_STRIP=symbols cargo zigbuild --locked --release --target "$target" -p subsplat-cli --bins \
        --no-default-features --features "$features" ${CARGO_ARGS:-}
}

# Man pages and completions for these features, by the first target's program that runs here.
manual() {
    [[ -d $pages ]] && return
    "$1" "$pages.part" 2>/dev/null || return 0
    mv "$pages.part" "$pages"
}

pack() {
    local triple=$1 ending=$2 built name folder
    built=${CARGO_TARGET_DIR:-target}/$triple/release name=subsplat-$version-$triple
    folder=$place/$name
    rm -rf "$folder" && mkdir -p "$folder/examples"
    cp "$built/subsplat$ending" "$built/subsplat-convert$ending" README.md LICENSE "$folder"
    cp "$licences" "$folder"
    cp -r examples/berlin "$folder/examples"
    [[ ! -d $pages ]] || cp -r "$pages/." "$folder"
    [[ $page == no ]] || cp -r "$page" "$folder/page"
    if [[ $ending == .exe ]]; then
        (cd "$place" && python3 -m zipfile -c "$name.zip" "$name")
    else
        tar -C "$place" --sort=name --owner=0 --group=0 --numeric-owner --mtime="@$epoch" -c "$name" |
            gzip -9 -n >"$place/$name.tar.gz"
    fi
    rm -rf "$folder"
}

rm -rf "$place"/manual*
for target in "${targets[@]}"; do
    triple=${target%%.[0-9]*}
    ending='' features=release${FEATURES:+,$FEATURES} pages=$place/manual
    [[ $triple != *windows* ]] || ending=.exe
    # GPU and window load their libraries at run time, which a static program cannot. For macOS they need the
    # frameworks' link stubs, which are part of Apple's SDK.
    [[ $triple == *musl* || $triple == *apple* ]] || features+=,view pages+=-view
    compile "$target" "$triple"
    manual "${CARGO_TARGET_DIR:-target}/$triple/release/subsplat-manual$ending"
    pack "$triple" "$ending"
done
cd "$place"
sha256sum subsplat-*.tar.gz subsplat-*.zip 2>/dev/null >SHA256SUMS || [[ -s SHA256SUMS ]]
cat SHA256SUMS
