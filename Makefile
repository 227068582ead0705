# Needs python3 (3.11 or later) and a package registry; everything else goes into $(VENV).
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

# One thread per maths library: workers are the parallelism here.
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
SOAK_S ?= 1800
.PHONY: help setup demo test check format bench fault-test fuzz soak audit browser container-test clean

help: ## list the targets
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 16

setup: $(READY) ## create $(VENV) with the pinned packages and gpom itself

$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "gpom needs Python 3.11 or later: make PYTHON=/path/to/python3 ..." >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@echo "installing into $(VENV) ..."
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--constraint constraints.txt setuptools
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check \
		--constraint constraints.txt --no-build-isolation --editable '.[dev]'
	@touch $@

demo: setup ## a service, three simulated robots and the live map, on this machine
	@$(BIN)/gpom demo

test: setup ## all tests, two files at a time
	@$(BIN)/python -m pytest --numprocesses 2 --dist loadfile

check: setup ## format, lint, types and the rules about who may import whom
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

format: setup ## write the code in its one format
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

bench: setup ## measure speed and accuracy; name the folder of laser logs in GPOM_DATA for all of it
	@$(BIN)/python -m pytest tests/benchmarks -m benchmark -s

fault-test: setup ## break the real parts while robots drive: kill, stop, cut off, fill the disk
	@$(BIN)/python -m pytest tests/faults -m 'fault or not fault' -s

fuzz: setup ## a million inputs from a coverage-guided fuzzer for the decoder of scans
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check atheris
	@PYTHONPATH=. $(BIN)/python tests/fuzz/seeds.py .fuzz/scans
	@PYTHONPATH=. $(BIN)/python tests/fuzz/scan_decoder.py .fuzz/scans -runs=1000000

soak: setup ## 30 minutes of steady load; SOAK_S=… seconds. Memory, files and threads stay flat
	@PYTHONPATH=. $(BIN)/python -m tests.soak.steady $(SOAK_S)

audit: setup ## what the service runs on and its licences, then known vulnerabilities (needs PyPI itself)
	@$(BIN)/python tests/audit/licences.py
	@test -x .audit/bin/pip-audit || { $(PYTHON) -m venv .audit && \
		.audit/bin/python -m pip install --quiet --disable-pip-version-check pip-audit; }
	@.audit/bin/pip-audit --strict --no-deps --disable-pip --requirement constraints.txt

browser: ## install Chromium for the tests of the live map (Debian, root); else they are skipped
	@apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -qq -y \
		--no-install-recommends chromium fonts-dejavu-core > /dev/null

container-test: ## build the image and run the compose file for real; CONTAINERS_INSTALL=1 gets the tools
	@bash tests/containers/run.sh || { code=$$?; test $$code = 77; }

clean: ## remove caches and build products, but not $(VENV)
	@rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
	@find . -path ./$(VENV) -prune -o -name __pycache__ -type d -print | xargs rm -rf
