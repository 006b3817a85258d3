# globalsplat for any CPU.  docker build -f docker/cpu.Dockerfile -t globalsplat:cpu .
#   docker run --rm -v "$PWD:/work" -w /work globalsplat:cpu reconstruct --weights model.safetensors --scene capture --out scene.ply
FROM node:20-bookworm-slim AS page
WORKDIR /web
COPY web .
RUN npm ci --ignore-scripts --no-audit --no-fund && npm run build

FROM rust:1-bookworm
RUN apt-get update && apt-get install -y --no-install-recommends make g++ libgloo-dev python3 python3-venv ffmpeg libheif-examples && rm -rf /var/lib/apt/lists/*
RUN rustup component add clippy rustfmt
WORKDIR /opt/globalsplat
COPY . .
COPY --from=page /web/dist web/dist
RUN make build
# `make demo` and `make test` work in the image:  docker run --rm --entrypoint make globalsplat:cpu demo   (or test)
ENTRYPOINT ["/opt/globalsplat/target/release/globalsplat"]
CMD ["--help"]
