# Everything runs in .venv; the first target that needs it makes it. PYTHON, PRESET, ARGS, RUN, POLICY, EPISODES, JOBS, SEED, SECONDS, VIEWED may be set.
PYTHON ?= python3
PRESET ?= quick
POLICY ?= learned
EPISODES ?= 50
JOBS ?= 2
RUN ?= $(firstword $(shell ls -1dt runs/*/ 2>/dev/null))
VIEWED ?= shipped
ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps
# Options of the pinned XLA.
COMPILE_LITTLE := --xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1 --xla_llvm_disable_expensive_passes=true --xla_disable_hlo_passes=while-loop-invariant-code-motion

.PHONY: help setup lock train eval test test-slow test-faults lives lint format bench pictures figures docs browser dist doctor clean

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

setup: $(STAMP)  ## make .venv and install everything, pinned by hashes

$(STAMP): pyproject.toml requirements.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(INSTALL) --require-hashes -r requirements.txt
	$(INSTALL) --no-build-isolation -e .
	touch $@

lock:  ## pin what pyproject.toml asks for, with hashes, in requirements.txt; needs uv
	uv pip compile pyproject.toml --extra bench --extra dev --extra dist --python-version 3.11.5 --universal --generate-hashes --no-annotate --custom-compile-command "make lock" --quiet --output-file requirements.txt

train: $(STAMP)  ## train PRESET (quick) into a new folder under runs/
	$(BIN)/csac-jax train $(PRESET) $(ARGS)

eval: $(STAMP)  ## evaluate RUN (the newest) with POLICY (learned) over EPISODES (50)
	@test -n "$(RUN)" || { echo "eval: there is no run under runs/; run 'make train' first or set RUN=DIR" >&2; exit 1; }
	$(BIN)/csac-jax eval $(RUN) --policy $(POLICY) --episodes $(EPISODES) --json $(RUN:/=)/eval-$(POLICY).json $(ARGS)

test: $(STAMP)  ## fast tests, in JOBS (2) processes; they compile much and run little
	XLA_FLAGS="$(XLA_FLAGS) $(COMPILE_LITTLE)" $(BIN)/python -m pytest -m "not slow" -n $(JOBS) --dist loadfile $(ARGS)

test-slow: $(STAMP)  ## slow tests
	$(BIN)/python -m pytest -m slow -n $(JOBS) --dist loadfile $(ARGS)

test-faults: $(STAMP)  ## inject every fault (10 minutes); ARGS=NAME for those of that name, SEED=N for others
	$(BIN)/python -m tests.faults $(if $(SEED),--seed $(SEED)) $(ARGS)

lives: $(STAMP)  ## live whole lives of runs, sweeps and policies for SECONDS (60); SEED=N for others
	$(BIN)/python -m tests.faults.lives --seconds $(or $(SECONDS),60) --jobs $(JOBS) $(if $(SEED),--seed $(SEED)) $(ARGS)

lint: $(STAMP)  ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(STAMP)  ## rewrite the sources in ruff's format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(STAMP)  ## measure this machine by the main benchmarks, into build/bench.md (15 minutes)
	$(BIN)/python -m experiments.bench $(ARGS)

pictures: $(STAMP)  ## draw the pictures of README and docs (4 minutes)
	$(BIN)/python -m experiments.pictures
	$(BIN)/csac-jax play --scene pinwheel --robot ur5 --policy $(VIEWED) --size 960 720 --png docs/pictures/views.png
	$(BIN)/csac-jax play --scene pile --objects procedural:0:200 --policy $(VIEWED) --size 960 720 --png docs/pictures/objects.png

figures: $(STAMP)  ## the tables and figures of docs/ that are made from the recorded results
	$(BIN)/python -m experiments.summary
	$(BIN)/python -m experiments.figures

docs: $(STAMP)  ## build the site of docs/ into build/docs; only the page "In the browser" needs a network
	$(BIN)/csac-jax report experiments/results --markdown build/pages/all-results.md > /dev/null
	$(BIN)/python -m experiments.index
	@rm -f build/browser/app.js
	@if command -v npm > /dev/null; then $(MAKE) --no-print-directory browser; fi || true
	@test -f build/browser/app.js || echo "docs: the page 'In the browser' is left out; it needs node and npm's registry"
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo "read it: $(BIN)/python -m http.server --directory build/docs"

browser: $(STAMP)  ## bundle the script of the page "In the browser" into build/browser; needs node
	mkdir -p build/browser
	cp docs/browser/package.json docs/browser/package-lock.json build/browser
	npm ci --prefix build/browser --silent
	$(BIN)/python -m docs.browser.export build/browser
	node docs/browser/build.mjs build/browser

dist: $(STAMP)  ## build wheel and sdist into dist/, and check them
	rm -rf dist
	$(BIN)/python -m build --no-isolation
	$(BIN)/twine check --strict dist/*

doctor: $(STAMP)  ## versions, devices, numerics self-test
	$(BIN)/csac-jax doctor $(ARGS)

clean:  ## remove .venv and caches; runs/ stays
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
