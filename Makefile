# Two commands do everything: `make demo` (sets up, runs the main job) and `make test` (sets up, runs the tests).
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test validation check lint benchmark docs licences wheel-check clean

demo: $(VENV)/.ready
	$(BIN)/vstent demo --out demo

test: $(VENV)/.ready-dev
	$(BIN)/python -m pytest -m "not validation" -n auto --dist loadfile

validation: $(VENV)/.ready-dev
	$(BIN)/python tools/record.py validation

check: lint test

lint: $(VENV)/.ready-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

benchmark: $(VENV)/.ready-dev
	$(BIN)/python tools/record.py benchmark

docs: $(VENV)/.ready-docs
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "open docs/_build/html/index.html"

licences: $(VENV)/.ready-dev
	$(BIN)/python tools/licences.py

# In brief; with PYTHONS="python3.11 python3.12 python3.13", in an empty environment of each that there is.
wheel-check: $(VENV)/.ready
	$(BIN)/python tools/wheel_check.py $(PYTHONS)

clean:
	rm -rf $(VENV) demo docs/_build docs/examples docs/generated

# Kernels that a test process compiles itself are other machine code than those kept, so changed ones are compiled before.
$(VENV)/.ready: pyproject.toml $(wildcard src/vstent/kernels/*.py src/vstent/flow/lattice/kernels/*.py)
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "vstent needs Python 3.11 or newer: install it, then give PYTHON=/path/to/python3"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' || \
	  { echo "Python's venv module is missing: install the package python3-venv (Debian, Ubuntu)"; exit 1; }
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable ".[app]"
	$(BIN)/python -m vstent.cli.warm
	@touch $@

$(VENV)/.ready-dev: $(VENV)/.ready
	$(BIN)/python -m pip install --quiet --group dev
	@touch $@

$(VENV)/.ready-docs: $(VENV)/.ready-dev
	$(BIN)/python -m pip install --quiet --group docs
	@touch $@
