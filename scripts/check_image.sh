#!/usr/bin/env bash
# Executes the steps of docker/cpu.Dockerfile without Docker, in a Debian that debootstrap makes, then runs the image's entry point as its
# user: doctor, and a reconstruction of a synthetic capture.
#   scripts/check_image.sh         about half an hour on two cores, most of it for compilation; needs 25 GB of disk
# Needs root, debootstrap and buildah (Debian: apt install debootstrap buildah). Its files are in target/image, and all but the Debian are
# deleted at the end.
set -euo pipefail
cd "$(dirname "$0")/.."
folder="$(realpath -m "${CARGO_TARGET_DIR:-target}")/image"
mkdir -p "$folder"
run_buildah() {
    TMPDIR="$folder" buildah --root "$folder/storage" --runroot "$folder/run" --storage-driver vfs "$@"
}
end() {
    run_buildah rm --all >/dev/null 2>&1 || true
    run_buildah rmi --all --force >/dev/null 2>&1 || true
    rm -rf "$folder/storage" "$folder/run"
}
trap end EXIT

# Stands in for debian:bookworm-slim, from any mirror that DEBIAN_MIRROR names.
debian="$folder/bookworm.tar"
if [ ! -e "$debian" ]; then
    debootstrap --variant=minbase bookworm "$folder/bookworm" "${DEBIAN_MIRROR:-http://deb.debian.org/debian}"
    tar -C "$folder/bookworm" -cf "$debian.part" .
    mv "$debian.part" "$debian"
    rm -rf "$folder/bookworm"
fi
mkdir -p "$folder/context/certificates"
ln -f "$debian" "$folder/context/bookworm.tar"
# Behind a proxy with a certificate of its own, the base image has to know it, as an organization's base images do.
find /usr/local/share/ca-certificates -name '*.crt' -exec cp -t "$folder/context/certificates" {} +
certificates=/etc/ssl/certs/ca-certificates.crt
run_buildah bud --quiet --tag debian:bookworm-slim --file - "$folder/context" <<END
FROM scratch
ADD bookworm.tar /
ADD certificates /usr/local/share/ca-certificates
ENV PIP_CERT=$certificates NODE_EXTRA_CA_CERTS=$certificates
END

# A build uses the files that Git tracks, as a fresh clone.
rm -rf "$folder/clone"
mkdir "$folder/clone"
git ls-files -z | xargs -0 cp --parents -t "$folder/clone"
began=$SECONDS
run_buildah bud --isolation chroot --pull-never --format docker --tag globalsplat:cpu --file docker/cpu.Dockerfile "$folder/clone"
rm -rf "$folder/clone" "$folder/context"
echo "check_image: built in $((SECONDS - began)) s"

container="$(run_buildah from --pull-never globalsplat:cpu)"
# The entry point, with its arguments instead of the image's command.
run_in() {
    run_buildah run --isolation chroot "$container" -- globalsplat "$@"
}
[ "$(run_buildah inspect --format '{{.OCIv1.Config.Entrypoint}} {{.OCIv1.Config.User}}' globalsplat:cpu)" = "[globalsplat] globalsplat" ]
[ "$(run_buildah run --isolation chroot "$container" -- id -un)" = globalsplat ]
run_in doctor
run_in synth --out scenes --scenes 1 --frames 9 --size 64
run_in reconstruct --scene "scenes/000000.torch#0_000000" --out room.ply
run_in convert room.ply room.spz
root="$(run_buildah mount "$container")"
echo "check_image: $(du -sxh "$root" | cut -f1), of which globalsplat $(du -sch "$root"/usr/local/{bin,lib,share} | tail -1 | cut -f1)"
