# globalsplat for NVIDIA GPUs.  docker build -f docker/cuda.Dockerfile -t globalsplat:cuda .
#   docker run --rm --gpus all globalsplat:cuda doctor
# No CUDA toolkit is needed: libtorch comes with the libraries it uses, and the container runtime provides the driver.
# The first stage is that of cpu.Dockerfile, except for its last step.
FROM debian:bookworm-slim AS build
RUN apt-get update \
    && apt-get install -y --no-install-recommends ca-certificates curl g++ libgloo-dev make nodejs npm procps python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*
RUN curl --proto =https -fsS https://static.rust-lang.org/rustup/rustup-init.sh | sh -s -- -y --profile minimal
ENV PATH=/root/.cargo/bin:$PATH
WORKDIR /build
COPY . .
RUN make setup && scripts/dist.sh cuda && mv target/dist/globalsplat-*/ /opt/globalsplat

FROM debian:bookworm-slim
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility
RUN apt-get update && apt-get install -y --no-install-recommends ffmpeg libheif-examples libstdc++6 zlib1g && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home globalsplat && mkdir /work && chown globalsplat /work
COPY --from=build /opt/globalsplat /usr/local
USER globalsplat
WORKDIR /work
ENTRYPOINT ["globalsplat"]
CMD ["--help"]
