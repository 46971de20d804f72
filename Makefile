# Two commands do everything: `make demo` (sets up, runs the main job) and `make test` (sets up, runs the tests).
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test validation check lint benchmark clean

demo: $(VENV)/.ready
	$(BIN)/vstent demo --out demo

test: $(VENV)/.ready-dev
	$(BIN)/python -m pytest -m "not validation"

validation: $(VENV)/.ready-dev
	$(BIN)/python -m pytest -m validation -rP

check: lint test

lint: $(VENV)/.ready-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

benchmark: $(VENV)/.ready-dev
	for script in benchmarks/*.py; do $(BIN)/python $$script; done

clean:
	rm -rf $(VENV) demo

$(VENV)/.ready: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "vstent needs Python 3.11 or newer: install it, then give PYTHON=/path/to/python3"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' || \
	  { echo "Python's venv module is missing: install the package python3-venv (Debian, Ubuntu)"; exit 1; }
	test -d $(VENV) || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable ".[app]"
	$(BIN)/python -m vstent.kernels.warm
	@touch $@

$(VENV)/.ready-dev: $(VENV)/.ready
	$(BIN)/python -m pip install --quiet --group dev
	@touch $@
