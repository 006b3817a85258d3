#!/usr/bin/env bash
# Runs the archive of `make dist` in Debian 11 (glibc 2.31, GCC 10), where it finds nothing else: doctor, and a synthetic scene
# reconstructed with the bundled weights, refined, converted and rendered, as another user than root. Needs Docker.
set -euo pipefail
cd "$(dirname "$0")/.."
archives=("${CARGO_TARGET_DIR:-target}"/dist/globalsplat-*-linux-"$(uname -m)".tar.gz)
[ -e "${archives[0]}" ] || {
    echo "check_dist: there is no ${archives[0]}, which \`make dist\` makes" >&2
    exit 2
}
# shellcheck disable=SC2016 # expanded by the inner shell
docker run --rm --volume "$(realpath "${archives[0]}"):/archive.tar.gz:ro" debian:bullseye-slim sh -euxc '
    mkdir -p "/srv/a folder/work"
    tar -xzf /archive.tar.gz -C "/srv/a folder"
    cd "/srv/a folder/work"
    chown 65534:65534 .
    run() { setpriv --reuid=65534 --regid=65534 --clear-groups ../globalsplat-*/bin/globalsplat "$@"; }
    run doctor
    run synth --out scenes --scenes 1 --frames 9 --size 64
    run reconstruct --scene "scenes/000000.torch#0_000000" --out room.ply
    run refine --scene "scenes/000000.torch#0_000000" --out refined.ply --seconds 5
    run convert room.ply room.spz
    run inspect room.spz
    run render --splat refined.ply --scene "scenes/000000.torch#0_000000" --out rendered
    run render --splat refined.ply --scene "scenes/000000.torch#0_000000" --html room.html'
