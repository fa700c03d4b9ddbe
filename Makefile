# Everything runs from a virtual environment in .venv that the targets make themselves: Python 3.11+ and make suffice.
PYTHON ?= python3
PYTEST_WORKERS ?= 2
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt

SIMULATION := $(wildcard posegraph_slam/datasets/simulation/*.py)

.DEFAULT_GOAL := help
.PHONY: help demo test lint benchmark lock presets wheel clean distclean

help:
	@echo 'make demo       install, simulate a small indoor log, optimise it, show the comparison and the pictures'
	@echo 'make test       install with the development tools, lint, type-check, run the tests'
	@echo '                (PSG_DATA=folder of the real logs adds the tests marked "data")'
	@echo 'make lint       format check, lint and type check only'
	@echo 'make benchmark  run benchmarks/*.py on the logs in PSG_DATA'
	@echo 'make lock       write constraints.txt from what .venv holds'
	@echo 'make presets    write configs/default.toml from the defaults in the code'
	@echo 'make wheel      build the wheel, install it into a fresh environment and run it there (2 minutes)'
	@echo 'make clean      remove caches, the demo and build output; distclean removes .venv too'

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo 'Python 3.11 or newer is needed; choose one with: make PYTHON=python3.12 ...' >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) \
		|| { echo 'no virtual environment could be made: is the venv module of $(PYTHON) installed?' >&2; exit 1; }

$(VENV)/.installed: pyproject.toml constraints.txt | $(BIN)/python
	@echo 'installing into $(VENV) ...'
	@$(PIP) --editable .
	@touch $@

$(VENV)/.installed-dev: pyproject.toml constraints.txt | $(BIN)/python
	@echo 'installing into $(VENV) with the development tools ...'
	@$(PIP) --editable '.[dev]'
	@touch $(VENV)/.installed $@

demo/log/world.json: $(SIMULATION) | $(VENV)/.installed
	@$(BIN)/psg simulate --out demo/log --overwrite

demo: $(VENV)/.installed demo/log/world.json
	@$(BIN)/psg optimize demo/log --out demo/run --overwrite

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint
	$(BIN)/python -m pytest -n $(PYTEST_WORKERS) --dist loadfile

benchmark: $(VENV)/.installed-dev
	@for script in $(wildcard benchmarks/*.py); do echo "== $$script"; $(BIN)/python "$$script" || exit 1; done

lock: $(VENV)/.installed-dev
	@$(BIN)/python tools/lock.py > constraints.txt.new && mv constraints.txt.new constraints.txt

presets: $(VENV)/.installed
	@$(BIN)/psg config show > default.toml.new && mv default.toml.new configs/default.toml

wheel: $(VENV)/.installed
	@$(BIN)/python tools/check_wheel.py

clean:
	rm -rf demo build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find posegraph_slam tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean
	rm -rf $(VENV)
