# Needs Python >= 3.11, pip and make: every target creates .venv and installs its dependencies.
.DEFAULT_GOAL := help
SHELL := /bin/bash
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# An NVIDIA machine: make EXTRAS=render,log,dev,warp,cuda
EXTRAS ?= render,log,dev
# The first Python that is new enough; override with `make PYTHON=/path/to/python3`.
PYTHON ?= $(firstword $(foreach p,python3 python3.12 python3.11 python3.13 python,\
  $(shell $(p) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $(p))))
# Number of parallel test processes.
TEST_JOBS ?= 2
SOURCES := $(wildcard *.py mqe_jax tests examples tools lab)

.PHONY: help install demo test soak docs audit release check fmt clean system browser npm

help: ## List the targets
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 10

install: $(STAMP) ## Create .venv and install the package with its tools

$(STAMP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "make: no Python >= 3.11 found; name one with make PYTHON=/path/to/python3" >&2; exit 2; }
	@# Debian keeps ensurepip in python3-venv; without it the outer pip fills the environment.
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV) 2>/dev/null || $(PYTHON) -m venv --clear --without-pip $(VENV)
	@if $(BIN)/python -m pip --version >/dev/null 2>&1; then pip="$(BIN)/python -m pip"; \
	else pip="$(PYTHON) -m pip --python $(BIN)/python"; fi; \
	echo "$$pip install -c constraints.txt -e .[$(EXTRAS)]"; \
	$$pip install --disable-pip-version-check -q -c constraints.txt -e ".[$(EXTRAS)]"
	@touch $@

system: ## Install the GL libraries for rendering, where possible
	@bash tools/install.sh gl

browser: ## Install Debian's Chromium for the test of `mqe view`, where possible
	@bash tools/install.sh chromium

npm: ## Install Debian's npm for the libraries of `mqe play-site`, where possible
	@bash tools/install.sh npm

demo: $(STAMP) system ## Train Narrow Gate on the CPU, evaluate and render it, in runs/demo
	JAX_PLATFORMS=cpu $(BIN)/mqe train go1gate --config demo --run-dir runs/demo --resume
	JAX_PLATFORMS=cpu $(BIN)/mqe render runs/demo -o runs/demo/video.mp4

test: $(STAMP) ## Run the tests
	$(BIN)/python -m pytest -n $(TEST_JOBS) --dist worksteal

docs: $(STAMP) npm ## Build the documentation site into build/site
	JAX_PLATFORMS=cpu $(BIN)/mqe play-site -o build/play || echo "docs: the page for playing was not built"
	NO_MKDOCS_2_WARNING=1 JAX_PLATFORMS=cpu $(BIN)/mkdocs build --strict --quiet
	@echo "docs: to read with search: python3 -m http.server --bind 127.0.0.1 --directory build/site"

soak: $(STAMP) ## Run the heavy tests too (about an hour)
	MQE_SOAK=1 $(BIN)/python -m pytest -n $(TEST_JOBS) --dist worksteal

audit: $(STAMP) ## Look up known vulnerabilities of the pinned packages
	test -x build/audit/bin/pip-audit || { $(BIN)/python -m venv build/audit && build/audit/bin/pip install -q "pip-audit>=2.9"; }
	build/audit/bin/pip-audit -r constraints.txt --disable-pip --no-deps

release: $(STAMP) ## Wheel and bill of materials into dist/, tried with the README in an empty environment
	$(BIN)/python tools/release.py

check: $(STAMP) ## Lint, formatting, types
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/check-jsonschema --builtin-schema vendor.github-workflows .github/workflows/*.yml
	$(BIN)/check-jsonschema --builtin-schema vendor.citation-file-format CITATION.cff

fmt: $(STAMP) ## Format and apply automatic fixes
	$(BIN)/ruff format $(SOURCES)
	$(BIN)/ruff check --fix $(SOURCES)

clean: ## Remove .venv, caches and build leftovers (runs/ stays)
	rm -rf $(VENV) .cache .pytest_cache .ruff_cache build dist *.egg-info
	find mqe_jax tests lab -name __pycache__ -type d -prune -exec rm -rf {} +
