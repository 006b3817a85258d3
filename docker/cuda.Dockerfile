# globalsplat for NVIDIA GPUs.  docker build -f docker/cuda.Dockerfile -t globalsplat:cuda .
#   docker run --rm --gpus all globalsplat:cuda doctor
# No CUDA toolkit is needed: libtorch comes with the libraries it uses, and the container runtime provides the driver.
FROM node:20-bookworm-slim AS page
WORKDIR /web
COPY web .
RUN npm ci --ignore-scripts --no-audit --no-fund && npm run build

FROM rust:1-bookworm
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility
RUN apt-get update && apt-get install -y --no-install-recommends make g++ libgloo-dev python3 python3-venv ffmpeg libheif-examples && rm -rf /var/lib/apt/lists/*
RUN rustup component add clippy rustfmt
WORKDIR /opt/globalsplat
COPY . .
COPY --from=page /web/dist web/dist
RUN make build
# `make demo` and `make test` work in the image:  docker run --rm --gpus all --entrypoint make globalsplat:cuda demo   (or test)
ENTRYPOINT ["/opt/globalsplat/target/release/globalsplat"]
CMD ["--help"]
