# What a person runs: `make demo` and `make test`. Both set everything up first.

SHELL := /bin/bash
PYTHON ?= python3
CARGO ?= cargo
VENV := .venv
BIN := target/release/globalsplat

.PHONY: all setup build demo test parity docker clean
.DEFAULT_GOAL := all

all: build

# Finds what is missing and says so; makes .venv with libtorch unless LIBTORCH names another.
setup:
	@scripts/setup.sh

build: setup
	@$(CARGO) build --release --locked

# Trains a small model, makes a splat and pictures of it, and says where they are.
demo: build
	@scripts/demo.sh

test: setup
	$(CARGO) fmt --check
	$(CARGO) clippy --release --locked --all-targets -- -D warnings
	$(CARGO) test --release --locked
	$(VENV)/bin/python -m pytest -q parity

parity: setup
	$(VENV)/bin/python -m pytest -q parity

docker:
	docker build -f docker/cpu.Dockerfile -t globalsplat:cpu .
	docker build -f docker/cuda.Dockerfile -t globalsplat:cuda .

clean:
	$(CARGO) clean
	rm -rf runs
