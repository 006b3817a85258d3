#!/usr/bin/env bash
# Compiles the crates that need no libtorch and their tests for Windows, and runs the tests under Wine, into target/windows:
#   scripts/windows.sh CRATE…    their packages
# Needs on Debian, for example: apt install gcc-mingw-w64-x86-64 wine64
set -euo pipefail
cd "$(dirname "$0")/.."
target=x86_64-pc-windows-gnu
out="$PWD/target/windows"
mkdir -p "$out"

. scripts/skip.sh
refuse() { skip windows "tests for Windows" "$*"; }
[ "$(uname -m)" = x86_64 ] || refuse "Wine runs programs for x86-64 on such a processor alone"
command -v x86_64-w64-mingw32-gcc >/dev/null || refuse "no C compiler for Windows: apt install gcc-mingw-w64-x86-64"
wine="$(PATH="$PATH:/usr/lib/wine" command -v wine64)" || refuse "no Wine: apt install wine64"
[ -d "$(rustc --print target-libdir --target $target)" ] || rustup target add $target ||
    refuse "no standard library of Rust for Windows, and rustup can't install it"

# Before version 9, Wine lacks the library from which Rust takes random numbers.
export WINEPREFIX="$out/wine" WINEDEBUG=-all
mkdir -p "$WINEPREFIX/drive_c/windows/system32"
x86_64-w64-mingw32-gcc -shared -o "$WINEPREFIX/drive_c/windows/system32/bcryptprimitives.dll" -x c - -x none -ladvapi32 <<'C'
unsigned char SystemFunction036(void *buffer, unsigned long size);
__declspec(dllexport) int ProcessPrng(unsigned char *data, unsigned long long size) { return SystemFunction036(data, (unsigned long)size); }
C

# COLMAP and ffmpeg are those of Windows, of which there are none here.
env -u LIBTORCH -u GLOBALSPLAT_NO_SKIPS CARGO_TARGET_X86_64_PC_WINDOWS_GNU_RUNNER="$wine" \
    "${CARGO:-cargo}" test --quiet --locked --no-fail-fast --target $target --target-dir "$out/build" "${@/#/--package=}"
