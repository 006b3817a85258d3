# globalsplat for any CPU.  docker build -f docker/cpu.Dockerfile -t globalsplat:cpu .
#   docker run --rm -v "$PWD:/work" globalsplat:cpu reconstruct --scene capture --out scene.ply
# scripts/check_image.sh executes these steps where no Docker runs.
FROM debian:bookworm-slim AS build
RUN apt-get update \
    && apt-get install -y --no-install-recommends ca-certificates curl g++ libgloo-dev make nodejs npm procps python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*
RUN curl --proto =https -fsS https://static.rust-lang.org/rustup/rustup-init.sh | sh -s -- -y --profile minimal
ENV PATH=/root/.cargo/bin:$PATH
WORKDIR /build
COPY . .
RUN make dist && mv target/dist/globalsplat-*/ /opt/globalsplat

FROM debian:bookworm-slim
RUN apt-get update && apt-get install -y --no-install-recommends ffmpeg libheif-examples libstdc++6 && rm -rf /var/lib/apt/lists/* \
    && useradd --create-home globalsplat && mkdir /work && chown globalsplat /work
COPY --from=build /opt/globalsplat /usr/local
USER globalsplat
WORKDIR /work
ENTRYPOINT ["globalsplat"]
CMD ["--help"]
