# `make help` lists what can be done. Everything is installed into .venv.

PYTHON ?= python3
HOST ?= 127.0.0.1
PORT ?= 8000
SCENE ?= apartment
SCENES ?= small1 small2 medium1 medium2 large1 large2
RUNS ?= runs/$(SCENE)
OFFICE ?= runs/office
# What the paper's table compares with, and on how many held-out pairs: naf takes seconds for each of their responses.
METHODS ?= nearest,linear,linear-aligned,mean-spectrogram,mean-spectrogram-whole,aac-nearest,aac-linear,opus-nearest,opus-linear,image-sources,helmholtz
PAIRS ?= 120
# Of how many simulations of each pair the medians are what its parameters are compared with.
DRAWS ?= 9
# The scene of which fractions are trained on, and how; and how a naf is trained on the measured office.
FRACTIONS_SCENE ?= large1
FRACTIONS ?=
OFFICE_NAF ?= --epochs 200 --points 100
# How the probe of walls is tested: "--spacing-m 0.2 --points 64", say.
PROBE ?=
# How long the paper's network is trained for the table.
NAF ?= --as-long-as $(RUNS)/ears
RANKS ?= 32,16
# How the field of directions and that of ears are trained, where not as usual: "--epochs 24", say; of runs that are
# finished, remove $(RUNS)/trained.
TRAINING ?=
EARS ?=
# How much of the frontier is measured: all ranks with frozen phase, and one of them with responses reused.
SWEEP ?= --phases-of none --reuse-of factorised-r16
# Which of the held-out pairs errors are of: those that the frontier did not choose levels by.
MEASURE ?= --half report
# How long each fuzzer runs, in seconds.
FUZZ_SECONDS ?= 60
# Files with tests that watch the clock: collecting all others takes as long as many a test.
TIMED := $(shell grep -rl --include='test_*.py' 'mark\.timed' tests) \
	$(shell grep -rL --include='test_*.py' '^pytestmark.*\.untimed' tests/integration)
# What kernels, NumPy, OpenBLAS and torch are told, so that they compute as on a processor without AVX-512, and tests of
# what they compute. ONNX Runtime asks the processor itself.
AVX2 := NUMBA_CPU_NAME=znver2 NUMBA_CPU_FEATURES=+sse4.2,+avx,+avx2,+fma,+f16c,+bmi,+bmi2,+popcnt \
	NPY_DISABLE_CPU_FEATURES="X86_V4 AVX512_ICL AVX512_SPR" OPENBLAS_CORETYPE=Zen ATEN_CPU_CAPABILITY=avx2
COMPUTING := $(addprefix tests/,acoustics field kernels rendering responses)
# Pages of /docs and /redoc, kept in server/web/vendor.
SWAGGER_UI := 5.35.0
REDOC := 2.5.4
VENV := .venv
# The Python package for clients, with a project file of its own.
CLIENT := client_examples/python
BIN := $(VENV)/bin
# The server alone is installed by uv, in a quarter of the time, or by pip where uv or its packages cannot be
# had. Its bytecode is compiled by the first start, which needs a third of the modules.
UV := $(BIN)/python -m uv pip install --quiet --python $(BIN)/python
# Elsewhere bytecode is compiled afterwards, on all cores; pip would use one. Some packages ship templates that do not
# compile.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
BYTECODE := $(BIN)/python -m compileall -q -j 0 $(VENV)/lib >/dev/null || true

# Where the environment forbids bytecode, each of the some hundred processes that tests start would compile the server's
# and the tests' sources again, half a second to fifteen.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help serve test test-untimed test-avx2 lint format bundle scenes table tables office own-scenes meshes predictions container-test clean hard-cases fuzz
.PHONY: cluster-test long mutants attacks docs docs-serve results lock vendor audit deploy-check
.PHONY: $(SCENES:%=bundle-%) $(SCENES:%=table-%) paper paper-scene paper-fractions paper-office $(SCENES:%=paper-of-%)

help: ## show this list
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "  make %-16s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

serve: $(VENV)/installed-server ## install the server and open a scene at http://127.0.0.1:8000 (HOST=, PORT=)
	$(BIN)/nafir serve --host $(HOST) --port $(PORT)

test: $(VENV)/installed-dev ## install what tests need, then lint, check types and run all tests but the long
	$(MAKE) --jobs=2 lint test-untimed
	$(BIN)/pytest $(TIMED) -m 'timed and not attack and not long and not cluster'

# What watches no clock runs beside others, and beside mypy, which uses one core.
test-untimed: $(VENV)/installed-dev
	$(BIN)/pytest --numprocesses auto --dist loadfile --no-loadscope-reorder -m 'not timed and not long and not cluster'

test-avx2: $(VENV)/installed-dev ## tests of what is computed, on a processor with AVX-512 as if it had AVX2 alone
	$(AVX2) $(BIN)/pytest --numprocesses auto --dist loadfile --no-loadscope-reorder \
		-m 'not timed and not long and not cluster' $(COMPUTING)

lint: $(VENV)/installed-dev ## lint, check what imports what, and check types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache --no-logo
	$(BIN)/mypy

format: $(VENV)/installed-dev ## format the code and apply safe lint fixes
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(VENV)/installed-dev ## build the documentation into site/; a broken link fails
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

docs-serve: $(VENV)/installed-dev ## show the documentation at http://127.0.0.1:8001 while it is written
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs serve --dev-addr 127.0.0.1:8001

bundle: $(RUNS)/measured ## simulate, train, export and measure a scene (SCENE=apartment); goes on where it stopped

table: $(RUNS)/table.md ## a table like the paper's of a scene (SCENE=): its bundle beside naf, trained for as long, codecs and more
	@cat $<

scenes: $(SCENES:%=bundle-%) ## bundles of the six scenes after the paper (SCENES=); -j2: two at a time

tables: $(SCENES:%=table-%) ## such tables of all six, and one over them; goes on where it stopped; -j2: two at a time
	$(BIN)/nafir-train tabulate --json $(SCENES:%=runs/%/table.json) > runs/tables.json
	$(BIN)/nafir-train tabulate $(SCENES:%=runs/%/table.json) --figure runs/tables.png | tee runs/tables.md

office: | $(VENV)/installed-training ## a bundle of responses measured elsewhere (DATA=folder in MeshRIR's layout), and its table
	@test -f "$(DATA)/pos_mic.npy" || { echo "make office: DATA= names no folder with pos_mic.npy, pos_src.npy, ir_<number>.npy"; exit 2; }
	$(BIN)/nafir-train import meshrir "$(DATA)" -o $(OFFICE)/data
	$(BIN)/nafir-train export $(OFFICE)/data -o $(OFFICE)/bundle
	$(BIN)/nafir-train evaluate $(OFFICE)/bundle $(OFFICE)/data --record --markdown \
		--methods nearest,linear,linear-aligned,mean-spectrogram,aac-nearest,aac-linear,opus-nearest,opus-linear > $(OFFICE)/table.md
	@cat $(OFFICE)/table.md

paper: $(SCENES:%=paper-of-%) paper-fractions $(if $(DATA),paper-office) ## the paper's tables and figures on our scenes, to docs/results/paper.md (DATA= as in office); days; goes on where it stopped
	$(BIN)/python -m benchmarks.paper runs
	$(BIN)/python -m benchmarks.pages

own-scenes: | $(VENV)/installed-training ## bundles of eleven scenes of many kinds, and how long they ring beside other simulations: runs/own-scenes.md
	$(BIN)/python -m training.trials.own_scenes runs/own-scenes

long: $(VENV)/installed-dev ## tests that take very long for what they may find: recipes followed to the end, a longer soak
	$(BIN)/pytest --numprocesses auto --dist worksteal -m 'long and not timed'
	$(BIN)/pytest $(TIMED) -m 'long and timed'

attacks: $(VENV)/installed-dev ## attack a server in every way we know while somebody listens: none of it may be heard
	$(BIN)/pytest -m attack

cluster-test: $(VENV)/installed-cluster ## install Ray, start two nodes of it here and end one of them: scenes, training and streams
	$(BIN)/pytest -m cluster

hard-cases: $(VENV)/installed-dev ## what could break numerically: every case's bound and measured margin, to hard-cases.md
	$(BIN)/pytest --numprocesses auto --dist loadfile tests/hard_cases --hard-cases-table hard-cases.md

fuzz: $(VENV)/installed-dev ## drive message parsing and bundle loading with atheris, then a server with uploads; FUZZ_SECONDS=60 each
	$(BIN)/python tests/hard_cases/fuzz.py messages --seconds $(FUZZ_SECONDS)
	$(BIN)/python tests/hard_cases/fuzz.py bundles --seconds $(FUZZ_SECONDS)
	FUZZ_SECONDS=$(FUZZ_SECONDS) $(BIN)/pytest -m attack -s tests/integration/attacks/test_fuzzing.py

mutants: $(VENV)/installed-dev ## remove each guard in a copy of the tree and show which tests notice
	$(BIN)/python tests/hard_cases/mutants.py

container-test: ## build the container image and try it read-only (needs buildah, podman and runc)
	tests/integration/container.sh

meshes: $(VENV)/installed-training ## whether simulation in meshes is right, beside plans, pyroomacoustics and laws, to docs/results/meshes.md: five to ten minutes
	$(BIN)/python -m benchmarks.meshes
	$(BIN)/python -m benchmarks.pages

predictions: $(VENV)/installed-training ## what plans predict of effects beside what simulation finds, in ten rooms of extremes: some minutes
	$(BIN)/python -m training.trials.rooms_tried

# Of this machine's Python, and without naming where packages come from.
lock: $(VENV)/installed-dev ## take newer versions into requirements.lock, what the image installs: minutes
	CUSTOM_COMPILE_COMMAND="make lock" $(BIN)/pip-compile --quiet --upgrade --extra jwt --generate-hashes --strip-extras \
		--no-emit-index-url --no-emit-trusted-host --no-emit-find-links --no-emit-options \
		--output-file requirements.lock pyproject.toml

audit: $(VENV)/installed-deploy ## look for known vulnerabilities in requirements.lock (asks the network), and write sbom.json (CycloneDX)
	$(BIN)/cyclonedx-py requirements requirements.lock --pyproject pyproject.toml --output-reproducible --of JSON -o sbom.json
	$(BIN)/pip-audit --require-hashes --disable-pip --strict --requirement requirements.lock

deploy-check: $(VENV)/installed-deploy ## check deploy/ with the programs that read it, of those that are installed: prometheus, promtool, caddy, systemd-analyze
	$(BIN)/pytest tests/deploy -rs

vendor: ## fetch Swagger UI and Redoc, of the versions in this file, into server/web/vendor (needs npm)
	rm -rf build/vendor && mkdir -p build/vendor
	cd build/vendor && npm pack --silent swagger-ui-dist@$(SWAGGER_UI) redoc@$(REDOC)
	cd build/vendor && for each in *.tgz; do tar -xzf $$each --one-top-level; done
	.ci/pack-vendor.sh build/vendor/swagger-ui-dist-$(SWAGGER_UI)/package build/vendor/redoc-$(REDOC)/package

results: $(VENV)/installed-dev ## write the tables and plots of docs/results anew from benchmarks/*/*.json
	$(BIN)/python -m benchmarks.pages

clean: ## remove .venv and caches; keeps runs/
	rm -rf $(VENV) build dist site *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(SCENES:%=bundle-%): bundle-%: | $(VENV)/installed-training
	$(MAKE) bundle SCENE=$*

$(SCENES:%=table-%): table-%: | $(VENV)/installed-training
	$(MAKE) table SCENE=$*

$(SCENES:%=paper-of-%): paper-of-%: | $(VENV)/installed-training
	$(MAKE) paper-scene SCENE=$*

paper-scene: $(RUNS)/paper-table.json $(RUNS)/probe.json $(RUNS)/maps.png $(RUNS)/spectrograms.png

paper-fractions: runs/fractions/fractions.done

paper-office: $(OFFICE)/table.json $(OFFICE)/maps.png

# Of one scene one step at a time: trainings that are compared have as much of the machine.
ifneq ($(filter bundle table paper-scene,$(MAKECMDGOALS)),)
.NOTPARALLEL:
endif

# Steps of one scene, a stamp for each that is finished; what an interrupted one has done is kept and gone on with. What
# each takes is written to times.jsonl.
STEP = $(BIN)/python -m training.cli.stopwatch $(RUNS)/times.jsonl
TRAIN = $(BIN)/nafir-train

$(RUNS)/simulated: | $(VENV)/installed-training
	$(STEP) simulate $(TRAIN) simulate training/scenes/$(SCENE).toml -o $(RUNS)/data
	@touch $@

$(RUNS)/trained: $(RUNS)/simulated
	$(STEP) train $(TRAIN) train $(RUNS)/data -o $(RUNS)/run --field directional $(TRAINING)
	$(STEP) train-ears $(TRAIN) train $(RUNS)/data -o $(RUNS)/ears --field factorised $(EARS)
	@touch $@

$(RUNS)/measured: $(RUNS)/trained
	$(STEP) export $(TRAIN) export $(RUNS)/run $(RUNS)/ears -o $(RUNS)/bundle --ranks $(RANKS)
	$(STEP) frontier $(TRAIN) frontier $(RUNS)/bundle $(RUNS)/data -o $(RUNS)/frontier $(SWEEP) --record
	$(STEP) evaluate $(TRAIN) evaluate $(RUNS)/bundle $(RUNS)/data $(MEASURE) --record \
		--figure $(RUNS)/errors.png
	@touch $@

# The paper's network: `naf` of draws of the sound that our field learns too, `naf-expected` of the expected values that our
# field learns, some gigabytes of them, and `naf-whole` of draws of whole responses, as in the paper.
$(RUNS)/%-exported: $(RUNS)/trained
	$(STEP) $* $(TRAIN) train $(RUNS)/data -o $(RUNS)/$* --field $* $(NAF) --points 100
	$(STEP) export-$* $(TRAIN) export $(RUNS)/$* -o $(RUNS)/$*-bundle
	@touch $@

$(RUNS)/table.md: $(RUNS)/measured $(RUNS)/naf-exported $(RUNS)/naf-expected-exported $(RUNS)/naf-whole-exported
	$(STEP) table $(TRAIN) evaluate $(RUNS)/bundle $(RUNS)/naf-bundle $(RUNS)/naf-expected-bundle \
		$(RUNS)/naf-whole-bundle $(RUNS)/data \
		--methods $(METHODS) \
		$(MEASURE) --pairs $(PAIRS) --yaws 1 --draws $(DRAWS) --output $(RUNS)/table.json --markdown > $@

# The paper's tables and figures of a scene, from the same bundles and runs.
$(RUNS)/paper-table.json: $(RUNS)/measured $(RUNS)/naf-exported $(RUNS)/naf-whole-exported
	$(STEP) paper-table $(TRAIN) evaluate $(RUNS)/bundle $(RUNS)/naf-bundle $(RUNS)/naf-whole-bundle $(RUNS)/data \
		--methods $(METHODS),helmholtz-lowpass --pairs $(PAIRS) --yaws 1 --output $@ > /dev/null

$(RUNS)/probe.json: $(RUNS)/naf-exported
	$(STEP) probe $(TRAIN) probe-emitters $(RUNS)/naf $(RUNS)/data $(PROBE) --figure $(RUNS)/probe.png --json > $@

$(RUNS)/maps.png: $(RUNS)/measured
	$(STEP) maps $(TRAIN) maps $(RUNS)/bundle $(RUNS)/data -o $@ --coded aac,opus

$(RUNS)/spectrograms.png: $(RUNS)/measured $(RUNS)/naf-exported
	$(STEP) spectrograms $(TRAIN) spectrograms $(RUNS)/bundle $(RUNS)/naf-bundle $(RUNS)/data -o $@

runs/fractions/fractions.done: | $(VENV)/installed-training
	$(MAKE) runs/$(FRACTIONS_SCENE)/simulated SCENE=$(FRACTIONS_SCENE)
	$(TRAIN) fractions runs/$(FRACTIONS_SCENE)/data -o runs/fractions $(FRACTIONS)
	@touch $@

$(OFFICE)/trained: | $(VENV)/installed-training
	@test -f "$(DATA)/pos_mic.npy" || { echo "DATA= names no folder with pos_mic.npy, pos_src.npy, ir_<number>.npy"; exit 2; }
	$(TRAIN) import meshrir "$(DATA)" -o $(OFFICE)/data
	$(TRAIN) export $(OFFICE)/data -o $(OFFICE)/bundle
	$(TRAIN) train $(OFFICE)/data -o $(OFFICE)/naf --field naf $(OFFICE_NAF)
	@touch $@

$(OFFICE)/table.json: $(OFFICE)/trained
	$(TRAIN) evaluate $(OFFICE)/bundle $(OFFICE)/naf $(OFFICE)/data --output $@ \
		--methods nearest,linear,linear-aligned,aac-nearest,aac-linear,opus-nearest,opus-linear,helmholtz,helmholtz-lowpass

$(OFFICE)/maps.png: $(OFFICE)/trained
	$(TRAIN) maps $(OFFICE)/naf $(OFFICE)/data -o $@

# Stamps: one per set of dependencies, each larger one satisfying the smaller.
$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Nafir needs Python 3.11 or newer: make PYTHON=python3.x")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/installed-server: pyproject.toml $(CLIENT)/pyproject.toml | $(BIN)/python
	@echo "Installing the server into $(VENV), once ..."
	@{ $(PIP) uv && $(UV) --editable . --editable $(CLIENT); } 2>/dev/null || $(PIP) --editable . --editable $(CLIENT)
	@touch $@

# torch first and alone, so that no other requirement chooses a different build of it.
$(VENV)/installed-training: pyproject.toml | $(BIN)/python
	@echo "Installing the training side into $(VENV), once ..."
	$(PIP) torch==2.13.0
	$(PIP) --editable '.[training]' --editable $(CLIENT)
	@$(BYTECODE)
	@touch $(VENV)/installed-server $@

$(VENV)/installed-dev: pyproject.toml $(CLIENT)/pyproject.toml | $(BIN)/python
	@echo "Installing what tests need into $(VENV), once ..."
	$(PIP) torch==2.13.0
	$(PIP) --editable '.[dev]' --editable '$(CLIENT)[clips,play,record]'
	@$(BYTECODE)
	@touch $(VENV)/installed-server $(VENV)/installed-training $@

$(VENV)/installed-deploy: pyproject.toml | $(VENV)/installed-dev
	@echo "Installing what checks a deployment into $(VENV), once ..."
	$(PIP) --editable '.[dev,deploy]'
	@touch $@

$(VENV)/installed-cluster: pyproject.toml | $(VENV)/installed-dev
	@echo "Installing Ray into $(VENV), once ..."
	$(PIP) --editable '.[dev,cluster]'
	@touch $@
