#!/usr/bin/env bash
# Builds the program and the Python module for Linux on ARM64 by cross-compilation, and checks them under emulation, into target/arm64:
#   scripts/arm64.sh          builds and checks everything
#   scripts/arm64.sh build    builds only
# Needs on Debian 12, for example:
#   dpkg --add-architecture arm64 && apt update
#   apt install g++-aarch64-linux-gnu qemu-user libstdc++6:arm64 libpython3.11:arm64
# Downloads Rust's standard library and Python packages for ARM64 once. The checks compare with the build of this machine.
set -euo pipefail
cd "$(dirname "$0")/.."
target=aarch64-unknown-linux-gnu
out="$PWD/target/arm64"
python=.venv/bin/python
mkdir -p "$out"

. scripts/skip.sh
refuse() { skip arm64 "cross-compilation for ARM64" "$*"; }
for tool in aarch64-linux-gnu-g++ qemu-aarch64; do
    command -v "$tool" >/dev/null || refuse "$tool is missing: apt install g++-aarch64-linux-gnu qemu-user"
done
libpython="$(echo /usr/lib/aarch64-linux-gnu/libpython3.1[0-9].so.1.0)"
[ -e "$libpython" ] || refuse "no Python for ARM64: dpkg --add-architecture arm64 && apt update && apt install libstdc++6:arm64 libpython3.11:arm64"
cargo="${CARGO:-cargo}"
[ -d "$(rustc --print target-libdir --target $target)" ] || rustup target add $target ||
    refuse "no standard library of Rust for ARM64, and rustup can't install it"

# PyTorch and NumPy for ARM64. This PyTorch is built for CUDA, whose libraries are large and of no use here: libraries without code take their
# place, in which functions that modules call while they are loaded return the address of zeros.
site="$out/site-packages"
install_packages() {
    local lib="$site/torch/lib" version="${libpython##*libpython}" library
    pin() { grep -oE "^$1==[^ ;]+" requirements.txt; }
    rm -rf "$site"
    "$python" -m pip install --quiet --disable-pip-version-check --no-deps --only-binary=:all: --target "$site" \
        --python-version "${version%.so*}" --platform manylinux_2_28_aarch64 --platform manylinux_2_27_aarch64 \
        --platform manylinux_2_25_aarch64 --platform manylinux2014_aarch64 "$(pin torch)" "$(pin numpy)" "$(pin pytest)" \
        "$(pin safetensors)" "nvidia-cuda-cupti<14" "nvidia-cuda-runtime<14" typing-extensions iniconfig packaging pluggy pygments filelock \
        sympy mpmath networkx jinja2 markupsafe fsspec
    replace() { aarch64-linux-gnu-gcc -shared -nostdlib -Wl,-soname,"$1" -o "$lib/$1" -x assembler "$2"; }
    local names="aarch64-linux-gnu-nm -D"
    for library in "$lib"/lib{torch_cpu,c10,c10_cuda,shm}.so "$site"/nvidia/*/lib/libcudart.so.* "$libpython" \
        /usr/lib/aarch64-linux-gnu/libstdc++.so.6 /lib/aarch64-linux-gnu/{libc,libm,libgcc_s}.so.*; do
        $names --defined-only "$library"
    done | awk '{sub(/@.*/, "", $NF); print $NF}' | sort -u >"$out/defined"
    $names --undefined-only "$lib/libtorch_python.so" | awk '{sub(/@.*/, "", $NF); print $NF}' | sort -u | comm -23 - "$out/defined" |
        awk '!/^(_ZT[IVS]|__|_ITM)/ {code = code ".globl " $1 "\n" $1 ":\n"}
            # Type information needs a name.
            /^_ZT[IVS]/ {data = data ".globl " $1 "\n" $1 ": .quad 0, name_" NR ", 0, 0, 0, 0, 0, 0\nname_" NR ": .asciz \"" $1 "\"\n.balign 16\n"}
            END {print ".text\n" code "adrp x0, zeros\nadd x0, x0, :lo12:zeros\nret\n.section .data.rel,\"aw\"\n.balign 16\nzeros: .zero 4096\n" data}' \
            >"$out/libtorch_cuda.s"
    replace libtorch_cuda.so "$out/libtorch_cuda.s"
    replace libcudnn.so.9 /dev/null
    replace libcufile.so.0 /dev/null
    touch "$site/complete"
}
[ -e "$site/complete" ] || install_packages

build() {
    env -u LD_LIBRARY_PATH LIBTORCH="$site/torch" \
        CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-g++ CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER=qemu-aarch64 \
        "$cargo" "$1" --quiet --release --locked --target $target --target-dir "$out/build" "${@:2}"
}
build build --workspace
program="$out/globalsplat"
printf '#!/bin/sh\nexec qemu-aarch64 "%s" "$@"\n' "$out/build/$target/release/globalsplat" >"$program"
chmod +x "$program"
[ "${1:-}" != build ] || exit 0

native="$PWD/target/release/globalsplat"
[ -x "$native" ] || { echo "arm64: $native is missing: run make build" >&2; exit 2; }
step() { echo "arm64: $SECONDS s: $*" >&2; }
fail() { echo "arm64: $*" >&2; exit 1; }
same() { cmp "$1" "$2" || fail "$1 and $2 differ"; }

step "tests of the crates that need no libtorch"
# Not those for which COLMAP, ffmpeg and libheif run, which are programs of this machine.
build test --tests --package=globalsplat-{files,torch-file,splat-file,capture,synth} -- --skip heic_and_avif

step "kernels, layers, losses and optimizers against PyTorch"
"$python" -m parity --program "$program" \
    --only 'linear*,attention,attention_bf16,quaternion,rasterizer*,ssim,photometric,depth_*,semi_global*,adamw,muon,resample'

step "splat files, byte for byte"
work="$(mktemp -d)"
trap 'rm -rf "$work"' EXIT
# Runs a command, and prints what it said if it fails.
quietly() { "$@" >"$work/log" 2>&1 || { cat "$work/log" >&2; fail "failed: $*"; }; }
captures="$work/captures"
mkdir "$work"/{native,arm64}
quietly "$native" synth --out "$captures" --seed 3 --scenes 1 --frames 6 --off-path 2 --size 64
capture="$(echo "$captures"/3_*)"
refine=(refine --scene "$capture" --steps 20 --gaussians 2000 --seed 1)
quietly "$native" "${refine[@]}" --out "$work/native.ply"
for file in a.compressed.ply a.sog a.spz a.splat a.glb; do
    quietly "$native" convert "$work/native.ply" "$work/native/$file"
    quietly "$program" convert "$work/native.ply" "$work/arm64/$file"
    same "$work/native/$file" "$work/arm64/$file"
    quietly "$native" convert "$work/native/$file" "$work/native/back.ply"
    quietly "$program" convert "$work/native/$file" "$work/arm64/back.ply"
    same "$work/native/back.ply" "$work/arm64/back.ply"
    rm "$work"/*/back.ply
done

step "refine and reconstruct"
for run in 1 2; do
    quietly "$program" "${refine[@]}" --out "$work/arm64$run.ply"
done
same "$work/arm641.ply" "$work/arm642.ply"
reconstruct=(reconstruct --scene "$capture" --views 4)
quietly "$native" "${reconstruct[@]}" --out "$work/native_model.ply"
quietly "$program" "${reconstruct[@]}" --out "$work/arm64_model.ply"
for pair in native.ply:arm641.ply native_model.ply:arm64_model.ply; do
    for splat in ${pair/:/ }; do
        GLOBALSPLAT_WEIGHTS=/nonexistent "$native" eval --scene "$capture" --splat "$work/$splat" --json 2>/dev/null |
            "$python" -c 'import json, sys; print(json.load(sys.stdin)["psnr"])'
    done | "$python" -c "
import sys
native, arm64 = map(float, sys.stdin)
print(f'${pair}: {native:.3f} and {arm64:.3f} dB')
sys.exit(abs(native - arm64) > 0.05)" || fail "the splats of $pair differ in PSNR"
done

step "the wheel, installed for the Python of ARM64"
# CMake packs what is built already.
"$python" -m pip install --quiet --disable-pip-version-check -r requirements-dist.txt
installed="$out/installed"
rm -rf "$out/wheels" "$installed"
CARGO="$(command -v true)" CARGO_TARGET_DIR="$out/build/$target" LIBTORCH="$site/torch" \
    quietly "$python" -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir "$out/wheels" \
    --config-settings=wheel.tags=cp310-abi3-linux_aarch64 --config-settings=build-dir="$out/wheel" \
    --config-settings=cmake.define.STRIP="$(command -v aarch64-linux-gnu-strip)" ./python
"$python" -m pip install --quiet --disable-pip-version-check --no-deps --no-index --target "$installed" --only-binary=:all: \
    --platform linux_aarch64 "$out"/wheels/*.whl
message="$(PYTHONPATH="$installed" "$python" -P -m globalsplat doctor 2>&1)" && fail "the program of ARM64 runs here"
[[ $message == "globalsplat: globalsplat was compiled for linux_aarch64, and this is linux on "* ]] ||
    fail "another processor is refused with: $message"
aarch64-linux-gnu-gcc -o "$out/python3" -x c - -x none "$libpython" <<'C'
int Py_BytesMain(int, char **);
int main(int count, char **arguments) { return Py_BytesMain(count, arguments); }
C
PYTHONHOME=/usr PYTHONPATH="$installed:$site" GLOBALSPLAT_PACKAGE="$installed" qemu-aarch64 "$out/python3" -P -m pytest -q \
    -p no:cacheprovider python/tests/test_rasterization.py
step "done"
