# Each target sets up all that it needs, in a virtual environment of its own, from nothing but Python 3.11.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: demo test test-slow check bench clean

demo: $(VENV)/.demo-ready
	$(BIN)/maxcon demo

test: $(VENV)/.dev-ready
	$(BIN)/python -m pytest -n 2 --dist loadfile

test-slow: $(VENV)/.dev-ready
	$(BIN)/python -m pytest -m slow

check: $(VENV)/.dev-ready
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy

bench: $(VENV)/.dev-ready
	$(BIN)/python benchmarks/engine.py
	$(BIN)/python benchmarks/agent.py
	$(BIN)/python benchmarks/exact.py

$(VENV)/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "maxcon needs Python 3.11 or later; set PYTHON=")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo-ready: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP) install -q -c constraints.txt -e '.[plot]'
	touch $@

$(VENV)/.dev-ready: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP) install -q -c constraints.txt -e '.[dev]'
	touch $@ $(VENV)/.demo-ready

clean:
	rm -rf $(VENV) build dist src/*.egg-info
	find . -name __pycache__ -prune -exec rm -rf {} +
