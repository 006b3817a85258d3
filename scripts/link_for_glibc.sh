#!/usr/bin/env bash
# Links a program or a shared library for every system with glibc 2.28 and the libstdc++ of GCC 8, although this system's are newer.
#   cargo rustc --release --bin globalsplat -- -C linker="$PWD/scripts/link_for_glibc.sh"    takes the arguments of cc
#   scripts/link_for_glibc.sh --check FILE…    fails if a file needs a newer symbol
# The linker sees copies of this system's libraries without code, which only have the symbols up to these versions. It takes newer symbols of
# libstdc++ from libstdc++.a, and those of glibc from glibc_compat.c. libstdc++ as a whole stays shared: libtorch exchanges its
# objects with us. Needs GNU binutils and GCC. The copies are made once, in target/stubs. CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_LINKER=PATH
# applies the script to everything that cargo links, such as the shared library of a wheel.
set -euo pipefail
# The newest version of each name that a file may need. libtorch 2.11 needs GLIBC 2.28, GLIBCXX 3.4.22 and CXXABI 1.3.11.
limits="GLIBC 2.28 GLIBCXX 3.4.25 CXXABI 1.3.11 GCC 7.0.0"
here="$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)"

# awk: whether the version `v`, such as GLIBC_2.28, is at most its limit. Names without a limit are those of other libraries.
is_old='
BEGIN { n = split(limits, part, " "); for (i = 1; i < n; i += 2) limit[part[i]] = part[i + 1] }
function key(v, number, i, sum) { split(v, number, "."); for (i = 1; i <= 3; i++) sum = sum * 1000 + number[i]; return sum }
function is_old(v, at) {
    at = index(v, "_")
    return !(substr(v, 1, at - 1) in limit) || key(substr(v, at + 1)) <= key(limit[substr(v, 1, at - 1)])
}'

if [ "${1:-}" = --check ]; then
    shift
    for file; do
        readelf -W --dyn-syms "$file" | awk -v limits="$limits" -v file="$file" "$is_old"'
            $7 == "UND" && split($8, name, /@+/) == 2 && !is_old(name[2]) { print "link_for_glibc: " file " needs " $8; bad = 1 }
            END { exit bad }' >&2 || failed=1
    done
    exit "${failed:-0}"
fi

cc="${CC:-cc}"
# Writes a copy of the library $1 without code, as $2.
make_stub() {
    local work
    work="$(mktemp -d)"
    readelf -W --dyn-syms "$1" | awk -v limits="$limits" -v map="$work/map" "$is_old"'
        $7 == "UND" || split($8, name, /@+/) != 2 || name[2] ~ /PRIVATE/ || !is_old(name[2]) { next }
        !(name[1] in version) || key(substr(name[2], index(name[2], "_") + 1)) > key(substr(version[name[1]], index(version[name[1]], "_") + 1)) {
            version[name[1]] = name[2]; type[name[1]] = $4; size[name[1]] = $3
        }
        END {
            for (s in version) {
                n++
                kind = type[s] == "OBJECT" ? "object" : type[s] == "TLS" ? "tls_object" : "function"
                print kind == "object" ? ".bss" : kind == "function" ? ".text" : ".section .tbss,\"awT\",@nobits"
                printf ".balign 32\n.globl s%d\n.type s%d, %%%s\n.size s%d, %s\ns%d: .space %s\n", n, n, kind, n, size[s], n, kind == "function" ? 1 : size[s]
                printf ".symver s%d, %s@@%s, remove\n", n, s, version[s]
                versions[version[s]]
            }
            for (v in versions) print v " {};" >map
        }' >"$work/stub.s"
    "$cc" -shared -nostdlib -Wl,--version-script="$work/map" -Wl,-soname,"$(basename "$1")" -o "$2" "$work/stub.s"
    rm -r "$work"
}

stubs="${CARGO_TARGET_DIR:-$here/../target}/stubs"
if [ ! -e "$stubs/done" ] || [ "$here/link_for_glibc.sh" -nt "$stubs/done" ]; then
    rm -rf "$stubs"
    made="$(mkdir -p "$(dirname "$stubs")" && mktemp -d "$stubs.XXXX")"
    for library in libc.so.6 libm.so.6 libstdc++.so.6; do
        make_stub "$("$cc" -print-file-name="$library")" "$made/$library"
    done
    ln -s libm.so.6 "$made/libm.so"
    echo "INPUT($stubs/libc.so.6 $("$cc" -print-file-name=libc_nonshared.a) AS_NEEDED($(grep -oE '/[^ ]*/ld-linux[^ ]*' "$("$cc" -print-file-name=libc.so)")))" >"$made/libc.so"
    echo "INPUT($stubs/libstdc++.so.6 $("$cc" -print-file-name=libstdc++.a))" >"$made/libstdc++.so"
    touch "$made/done"
    mv -T "$made" "$stubs" 2>/dev/null || rm -r "$made"
fi

compat=("$here/glibc_compat.c" -O2 -fPIC -ffunction-sections)
[[ " $* " == *" -shared "* ]] || compat=(-DPROGRAM "-Wl,--wrap=__libc_start_main" "${compat[@]}")
# glibc 2.34 moved the functions of libpthread and libdl to libc.
exec "$cc" -L"$stubs" -Wl,--allow-shlib-undefined -Wl,--exclude-libs,libstdc++.a \
    -Wl,--push-state,--no-as-needed -l:libpthread.so.0 -l:libdl.so.2 -Wl,--pop-state "${compat[@]}" "$@" -lstdc++
