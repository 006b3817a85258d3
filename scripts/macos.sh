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

. scripts/skip.sh
refuse() { skip macos "link for macOS" "$*"; }
[ -d "$(rustc --print target-libdir --target $target)" ] || rustup target add $target ||
    refuse "no standard library of Rust for macOS, and rustup can't install it"

# Tools, and PyTorch for macOS.
tools="$out/tools"
site="$out/site-packages"
install() { "$python" -m pip install --quiet --disable-pip-version-check --no-deps --only-binary=:all: "$@"; }
torch="$(grep -oE '^torch==[^ ;]+' requirements.txt)"
if [ "$(cat "$site/complete" 2>/dev/null)" != "$torch" ]; then
    rm -rf "$tools" "$site"
    install --target "$tools" cargo-zigbuild==0.24.1 ziglang==0.17.1 macholib==1.16.4 altgraph==0.17.5 ||
        refuse "the tools can't be installed; see pip's message above"
    install --target "$site" --python-version 3.11 --platform macosx_11_0_arm64 "$torch" || refuse "PyTorch for macOS can't be installed"
    echo "$torch" >"$site/complete"
fi

# Zig leaves an empty file where a flag of the compiler was tried.
trap 'rm -f csrc/a.o' EXIT
# The rpath is that of the wheel, in which the program is globalsplat/bin/globalsplat beside torch/.
env -u LD_LIBRARY_PATH LIBTORCH="$site/torch" MACOSX_DEPLOYMENT_TARGET=11.0 GLOBALSPLAT_RPATH=@loader_path/../../torch/lib \
    PATH="$tools/bin:$PATH" PYTHONPATH="$tools" CARGO_ZIGBUILD_ZIG_PATH="$PWD/$python -m ziglang" \
    "$tools/bin/cargo-zigbuild" zigbuild --quiet --release --locked --workspace --target $target --target-dir "$out/build"
release="$out/build/$target/release"

PYTHONPATH="$tools" "$python" - "$release/globalsplat" "$release/lib_native.dylib" "$site/torch/lib" <<'PYTHON'
"""Checks the processor, the oldest system, the libraries and the search path of Mach-O files."""
import sys
from pathlib import Path

from macholib import mach_o
from macholib.MachO import MachO

*files, libtorch = sys.argv[1:]
mistakes = []
for file in files:
    (header,) = MachO(file).headers
    name = Path(file).name
    processor = mach_o.CPU_TYPE_NAMES[header.header.cputype]

    def texts(*kinds):
        return [data.rstrip(b"\0").decode() for load, _, data in header.commands if load.cmd in kinds]

    libraries = texts(mach_o.LC_LOAD_DYLIB, mach_o.LC_LOAD_WEAK_DYLIB, mach_o.LC_REEXPORT_DYLIB, mach_o.LC_LOAD_UPWARD_DYLIB)
    rpaths, own_names = texts(mach_o.LC_RPATH), texts(mach_o.LC_ID_DYLIB)
    (version,) = [command.minos for load, command, _ in header.commands if load.cmd == mach_o.LC_BUILD_VERSION]
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
    mistakes += [f"{name} calls itself {own}" for own in own_names if own.startswith("/")]
    for library in libraries:
        in_torch = library.startswith("@rpath/") and (Path(libtorch) / library.removeprefix("@rpath/")).exists()
        if not in_torch and not library.startswith(("/usr/lib/", "/System/Library/Frameworks/")):
            mistakes.append(f"{name} needs {library}, which is neither the system's nor PyTorch's")
for mistake in mistakes:
    print(f"macos: {mistake}", file=sys.stderr)
sys.exit(bool(mistakes))
PYTHON
