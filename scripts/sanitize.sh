#!/usr/bin/env bash
# Runs csrc/checks on the rasterizer compiled as in a release, under ThreadSanitizer, and under AddressSanitizer with
# UndefinedBehaviorSanitizer, for every instruction set that this machine supports, and prints how much was checked:
#   scripts/sanitize.sh          every degree of spherical harmonics on 1 to 16 threads
#   scripts/sanitize.sh short    one degree per scene, on few threads; checks that don't depend on the instruction set run only with the
#                                best one
# Fails if a sanitizer or a check reports an error. Needs g++ or the compiler that CXX names.
set -euo pipefail
cd "$(dirname "$0")/.."
form=${1:-long}
out=target/sanitize
rm -rf "$out"
mkdir -p "$out"

# The instruction sets, as in csrc/build.rs.
case $(uname -m) in
x86_64) isas="avx512 avx2 portable" ;;
aarch64) isas="neon" ;;
*) isas="portable" ;;
esac
declare -A flags_of=(
    [avx512]="-mavx512f -mavx512dq -mavx512vl -mavx512bw -mfma"
    [avx2]="-mavx2 -mfma"
    [plain]="-O3"
    [thread]="-O1 -g1 -fsanitize=thread"
    # The disabled checks (null, object-size) take half of the compile time, and AddressSanitizer detects these errors, too.
    [address]="-O1 -g1 -fno-omit-frame-pointer -D_GLIBCXX_ASSERTIONS -fsanitize=address,undefined,float-cast-overflow \
-fno-sanitize=null,object-size -fno-sanitize-recover=all"
)
sanitizers="address thread plain"

compile() { # OBJECT SOURCE FLAG…
    echo "${CXX:-g++} -std=c++17 -fno-math-errno -Wall -Wextra -Wno-maybe-uninitialized -Wno-unknown-warning-option ${*:3} -c csrc/$2 -o $out/$1.o"
}
# The slowest compilations come first.
for sanitizer in $sanitizers; do
    for isa in $isas; do
        compile "$sanitizer-$isa" kernels/kernels_isa.cpp "${flags_of[$sanitizer]}" -ffp-contract=off "-DGS_ISA=$isa" \
            "${flags_of[$isa]:-}"
    done
    for source in kernels/{raster,multi_head_attention,image_losses,depth_search,optim,parallel,kernels}.cpp cuda/frame.cpp \
        checks/{checks,schedules}.cpp; do
        compile "$sanitizer-$(basename "$source" .cpp)" "$source" "${flags_of[$sanitizer]}" -Icsrc/kernels
    done
    compile "$sanitizer-emulated_kernels" cuda/emulated_kernels.cpp "${flags_of[$sanitizer]}" -ffp-contract=off -Icsrc/kernels
    # ThreadSanitizer checks the emulated GPU threads, not the emulator that schedules them.
    case $sanitizer in
    thread) compile thread-emulator cuda/emulator.cpp -O1 -g1 -DGS_UNDER_TSAN -Icsrc/kernels ;;
    *) compile "$sanitizer-emulator" cuda/emulator.cpp "${flags_of[$sanitizer]}" -Icsrc/kernels ;;
    esac
done | xargs -P "$(nproc)" -d '\n' -n 1 bash -c
for sanitizer in $sanitizers; do
    # shellcheck disable=SC2086
    ${CXX:-g++} ${flags_of[$sanitizer]} "$out/$sanitizer"-*.o -pthread -o "$out/$sanitizer"
done

# Newer Linux kernels randomize addresses over a wider range than the sanitizers' shadow memory supports.
unscattered=()
! setarch -R true 2>/dev/null || unscattered=(setarch -R)
export TSAN_OPTIONS="halt_on_error=1" UBSAN_OPTIONS="print_stacktrace=1"
export ASAN_OPTIONS="detect_leaks=1:detect_stack_use_after_return=1"

echo "Renders, forward and backward, that were checked: $form, $("${CXX:-g++}" --version | head -1)"
failed=0
for sanitizer in $sanitizers; do
    checks="bits callers threads orders children"
    # ThreadSanitizer doesn't follow a child that starts threads.
    [ "$sanitizer" != thread ] || checks=${checks% children}
    for isa in $isas; do
        status=0
        # shellcheck disable=SC2086
        GLOBALSPLAT_SIMD=$isa "${unscattered[@]}" "$out/$sanitizer" "$form" $checks >"$out/counts" 2>"$out/log" || status=$?
        [ $status -ne 3 ] || continue # not an instruction set of this machine
        sed "s/^/$sanitizer, $isa, /" "$out/counts"
        if [ $status -ne 0 ]; then
            echo "$sanitizer, $isa: FAILED"
            failed=1
            head -60 "$out/log" >&2
        fi
        [ "$form" != short ] || checks="bits callers"
    done
done
exit $failed
