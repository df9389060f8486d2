# Everything runs in a virtual environment of its own; python3 (3.11 or newer) is all that is needed.
PY ?= python3
BIN := .venv/bin

.PHONY: demo test test-all bench lint clean

.venv/installed: pyproject.toml
	$(PY) -m venv .venv
	$(BIN)/pip install -q -e .
	touch $@

.venv/installed-test: .venv/installed
	$(BIN)/pip install -q -e ".[test]"
	touch $@

.venv/installed-dev: .venv/installed-test
	$(BIN)/pip install -q -e ".[dev]"
	touch $@

demo: .venv/installed
	$(BIN)/gnssbb run demo -o demo/demo.h5 --plots

test: .venv/installed-test
	$(BIN)/python -m pytest -n 2 -m "not slow"

test-all: .venv/installed-test
	$(BIN)/python -m pytest -n 2

bench: .venv/installed
	$(BIN)/gnssbb bench

lint: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean:
	rm -rf .venv build dist demo
