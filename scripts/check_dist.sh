#!/usr/bin/env bash
# Runs the archive of `make dist` in a Debian 11 (glibc 2.31, GCC 10) that debootstrap makes, where it finds nothing else:
# doctor, and a synthetic scene reconstructed with the bundled weights, refined, converted and rendered, as another user than root.
# Needs root and debootstrap (Debian: apt install debootstrap). The Debian stays in target/bullseye; DEBIAN_MIRROR names another mirror.
set -euo pipefail
cd "$(dirname "$0")/.."
target="${CARGO_TARGET_DIR:-target}"
archives=("$target"/dist/globalsplat-*-linux-"$(uname -m)".tar.gz)
[ -e "${archives[0]}" ] || {
    echo "check_dist: there is no $target/dist/*.tar.gz, which \`make dist\` makes" >&2
    exit 2
}
root="$target/bullseye"
if [ ! -e "$root/etc/debian_version" ]; then
    rm -rf "$root" "$root.part"
    debootstrap --variant=minbase bullseye "$root.part" "${DEBIAN_MIRROR:-http://deb.debian.org/debian}" >/dev/null
    mv "$root.part" "$root"
fi
trap 'rm -rf "$root/srv/a folder"' EXIT
rm -rf "$root/srv/a folder"
mkdir -p "$root/srv/a folder/work"
tar -xf "${archives[0]}" -C "$root/srv/a folder"
chown 65534:65534 "$root/srv/a folder/work"

# Runs the program with the files and environment of that Debian alone. $ORIGIN of an rpath needs /proc.
run() {
    echo "check_dist: globalsplat $*"
    # shellcheck disable=SC2016 # expanded by the inner shell
    unshare --fork --pid --mount-proc="$root/proc" chroot --userspec=65534:65534 "$root" /usr/bin/env -i PATH=/usr/bin:/bin \
        /bin/sh -c 'cd "/srv/a folder/work" && exec ../globalsplat-*/bin/globalsplat "$@"' sh "$@"
}
run doctor
run synth --out scenes --scenes 1 --frames 9 --size 64
scene="scenes/000000.torch#0_000000"
run reconstruct --scene "$scene" --out room.ply
run refine --scene "$scene" --out refined.ply --seconds 5
run convert room.ply room.spz
run inspect room.spz
run render --splat refined.ply --scene "$scene" --out rendered
run render --splat refined.ply --scene "$scene" --html room.html
