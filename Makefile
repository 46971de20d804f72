# `make demo` sets up and runs the main job; `make test` sets up and runs the tests.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test system validation check lint benchmark docs licences wheel-check bounds-check viewer-check sentences clean

demo: $(VENV)/.ready
	$(BIN)/vstent demo --out demo

test: $(VENV)/.ready-dev
	$(BIN)/python -m pytest -m "not validation and not system" -n auto --dist loadfile

# Commands that are killed at any stage, clusters, the simulator's benchmark, and walks of the page in a browser.
system: $(VENV)/.ready-dev
	$(BIN)/python -m pytest -m system -n auto

validation: $(VENV)/.ready-dev
	$(BIN)/python tools/record.py validation

check: lint test

lint: $(VENV)/.ready-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/codespell README.md CONTRIBUTING.md CHANGELOG.md docs src tests tools benchmarks viewer/app viewer/src

benchmark: $(VENV)/.ready-dev
	$(BIN)/python tools/record.py benchmark

docs: $(VENV)/.ready-docs
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "open docs/_build/html/index.html"

licences: $(VENV)/.ready-dev
	$(BIN)/python tools/licences.py

# Without PYTHONS in brief; with PYTHONS="python3.11 python3.12 python3.13", in an empty environment of each that is installed.
wheel-check: $(VENV)/.ready
	$(BIN)/python tools/wheel_check.py $(PYTHONS)

# Installs the wheel with the lowest and with the newest dependencies, and runs the demo with a coarse flow in both.
bounds-check: $(VENV)/.ready
	$(BIN)/python tools/wheel_check.py --bounds

# Rebuilds the JavaScript bundles where npm is installed and fails where they differ from those in the package.
viewer-check: $(VENV)/.ready
	$(BIN)/python tools/viewer_check.py

sentences: $(VENV)/.ready
	$(BIN)/python tools/sentences.py

clean:
	rm -rf $(VENV) demo docs/_build docs/examples docs/generated

# Kernels are compiled before the tests: a test process that compiles them itself runs slightly different machine code.
$(VENV)/.ready: pyproject.toml $(wildcard src/vstent/kernels/*.py src/vstent/flow/lattice/kernels/*.py)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "vstent needs Python 3.11 or newer: install it, then give PYTHON=/path/to/python3"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' || \
	  { echo "Python's venv module is missing: install the package python3-venv (Debian, Ubuntu)"; exit 1; }
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable ".[app]"
	$(BIN)/python -m vstent.cli.warm study
	@touch $@

$(VENV)/.ready-dev: $(VENV)/.ready
	$(BIN)/python -m pip install --quiet --group dev
	$(BIN)/python -m vstent.cli.warm
	@touch $@

$(VENV)/.ready-docs: $(VENV)/.ready-dev
	$(BIN)/python -m pip install --quiet --group docs
	@touch $@
