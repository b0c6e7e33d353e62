# `make help` lists what can be done. Everything is installed into .venv.

PYTHON ?= python3
HOST ?= 127.0.0.1
PORT ?= 8000
SCENE ?= apartment
RUNS ?= runs/$(SCENE)
MINUTES ?= 4
# Tests that watch the clock, and so have the machine to themselves.
TIMED := tests/integration tests/bench tests/test_audio_engine.py tests/test_streaming.py tests/test_priority.py

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help serve test lint format bundle scenes table container-test clean

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-16s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

serve: $(VENV)/installed-server ## install the server and open a scene at http://127.0.0.1:8000 (HOST=, PORT=)
	$(BIN)/nafir serve --host $(HOST) --port $(PORT)

test: lint ## install what tests need, then lint, check types and run every test
	$(BIN)/pytest --numprocesses auto --dist loadfile $(TIMED:%=--ignore %)
	$(BIN)/pytest $(TIMED)

lint: $(VENV)/installed-dev ## lint and check types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/installed-dev ## format the code and apply safe lint fixes
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bundle: $(VENV)/installed-training ## simulate, train, export and measure a scene (SCENE=apartment); resumes where it stopped
	$(BIN)/nafir-train simulate training/scenes/$(SCENE).toml -o $(RUNS)/data
	$(BIN)/nafir-train train $(RUNS)/data -o $(RUNS)/run
	$(BIN)/nafir-train export $(RUNS)/run -o $(RUNS)/bundle --ranks 32,16,8,4,2
	$(BIN)/nafir-train frontier $(RUNS)/bundle $(RUNS)/data -o $(RUNS)/frontier --phases-of factorised --record
	$(BIN)/nafir-train evaluate $(RUNS)/bundle $(RUNS)/data --record --figure $(RUNS)/errors.png

scenes: ## all of that for the six scenes after the paper
	for scene in large1 large2 medium1 medium2 small1 small2; do $(MAKE) bundle SCENE=$$scene || exit 1; done

table: $(VENV)/installed-training ## the paper's table of a scene (SCENE=small1), with the paper's network trained for MINUTES=4
	$(BIN)/nafir-train train $(RUNS)/data -o $(RUNS)/naf --field naf --minutes $(MINUTES) --points 100
	$(BIN)/nafir-train export $(RUNS)/run $(RUNS)/naf -o $(RUNS)/with-naf
	$(BIN)/nafir-train evaluate $(RUNS)/with-naf $(RUNS)/data --pairs 16 --yaws 2 --markdown \
		--methods nearest,linear,linear-aligned,aac-nearest,aac-linear,opus-nearest,opus-linear,image-sources,helmholtz

container-test: ## build the container image and try it read-only (needs buildah, podman and runc)
	tests/integration/container.sh

clean: ## remove .venv and caches; keeps runs/
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Stamps: one per set of dependencies, each larger one satisfying the smaller.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Nafir needs Python 3.11 or newer: make PYTHON=python3.x")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/installed-server: pyproject.toml | $(BIN)/python
	@echo "Installing the server into $(VENV), once ..."
	$(PIP) --editable .
	@touch $@

# torch first and alone, so that no other requirement chooses a different build of it.
$(VENV)/installed-training: pyproject.toml | $(BIN)/python
	@echo "Installing the training side into $(VENV), once ..."
	$(PIP) torch==2.13.0
	$(PIP) --editable '.[training]'
	@touch $(VENV)/installed-server $@

$(VENV)/installed-dev: pyproject.toml | $(BIN)/python
	@echo "Installing what tests need into $(VENV), once ..."
	$(PIP) torch==2.13.0
	$(PIP) --editable '.[dev]'
	@touch $(VENV)/installed-server $(VENV)/installed-training $@
