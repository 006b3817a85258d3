#!/usr/bin/env bash
# Links the program and the Python module for macOS on Apple silicon from another system, and checks what their load commands name, into
# target/macos. Nothing is run: that needs a Mac.
# Downloads Rust's standard library for macOS, Zig as a linker with Apple's interfaces, and PyTorch's wheel once, 250 MB.
set -euo pipefail
cd "$(dirname "$0")/.."
target=aarch64-apple-darwin
out="$PWD/target/macos"
python=.venv/bin/python
mkdir -p "$out"

# Something is missing: among other tests that may be skipped, this is counted, otherwise it is an error.
refuse() {
    echo "macos: $*" >&2
    [ -n "${GLOBALSPLAT_SKIPPED:-}" ] && [ -z "${GLOBALSPLAT_NO_SKIPS:-}" ] || exit 2
    echo "link for macOS" >>"$GLOBALSPLAT_SKIPPED"
    exit 0
}
[ -d "$(rustc --print target-libdir --target $target)" ] || rustup target add $target ||
    refuse "no standard library of Rust for macOS, and rustup can't install it"

# Tools, and PyTorch for macOS.
tools="$out/tools"
site="$out/site-packages"
install() { "$python" -m pip install --quiet --disable-pip-version-check --no-deps --only-binary=:all: "$@"; }
if [ ! -e "$site/complete" ]; then
    rm -rf "$tools" "$site"
    install --target "$tools" cargo-zigbuild==0.24.1 ziglang==0.17.1 macholib==1.16.4 altgraph==0.17.5 ||
        refuse "the tools can't be installed; see pip's message above"
    install --target "$site" --python-version 3.11 --platform macosx_11_0_arm64 "$(grep -oE '^torch==[^ ;]+' requirements.txt)"
    touch "$site/complete"
fi

# The rpath is that of the wheel, in which the program is globalsplat/bin/globalsplat beside torch/.
env -u LD_LIBRARY_PATH LIBTORCH="$site/torch" MACOSX_DEPLOYMENT_TARGET=11.0 GLOBALSPLAT_RPATH=@loader_path/../../torch/lib PATH="$tools/bin:$PATH" PYTHONPATH="$tools" \
    CARGO_ZIGBUILD_ZIG_PATH="$PWD/$python -m ziglang" \
    "$tools/bin/cargo-zigbuild" zigbuild --quiet --release --locked --workspace --target $target --target-dir "$out/build"
# Zig leaves an empty file where a flag of the compiler was tried.
rm -f csrc/a.o
release="$out/build/$target/release"

PYTHONPATH="$tools" "$python" - "$release/globalsplat" "$release/lib_native.dylib" "$site/torch/lib" <<'PYTHON'
"""Checks the processor, the oldest system, the libraries and the search path of Mach-O files."""
import sys
from pathlib import Path

from macholib.mach_o import LC_BUILD_VERSION, LC_LOAD_DYLIB, LC_RPATH, CPU_TYPE_NAMES
from macholib.MachO import MachO

*files, libtorch = sys.argv[1:]
mistakes = []
for file in files:
    (header,) = MachO(file).headers
    name = Path(file).name
    processor = CPU_TYPE_NAMES[header.header.cputype]
    text = lambda data: data.rstrip(b"\0").decode()
    libraries = [text(data) for load, _, data in header.commands if load.cmd == LC_LOAD_DYLIB]
    rpaths = [text(data) for load, _, data in header.commands if load.cmd == LC_RPATH]
    (version,) = [command.minos for load, command, _ in header.commands if load.cmd == LC_BUILD_VERSION]
    oldest = f"{version >> 16}.{version >> 8 & 255}"
    print(f"{name}: {processor}, macOS {oldest}, rpath {', '.join(rpaths)}, {', '.join(libraries)}")
    if processor != "ARM64":
        mistakes.append(f"{name} is for {processor}")
    # The oldest system for which PyTorch's wheel is tagged.
    if oldest != "11.0":
        mistakes.append(f"{name} needs macOS {oldest}")
    expected = "@loader_path/../../torch/lib" if name == "globalsplat" else "@loader_path/../torch/lib"
    if rpaths != [expected]:
        mistakes.append(f"{name} has the rpaths {rpaths}, expected {expected}")
    for library in libraries:
        in_torch = library.startswith("@rpath/") and (Path(libtorch) / library.removeprefix("@rpath/")).exists()
        if not in_torch and not library.startswith(("/usr/lib/", "/System/Library/Frameworks/")):
            mistakes.append(f"{name} needs {library}, which is neither the system's nor PyTorch's")
for mistake in mistakes:
    print(f"macos: {mistake}", file=sys.stderr)
sys.exit(bool(mistakes))
PYTHON
