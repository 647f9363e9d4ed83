# Everything a fresh clone needs; only Python 3.11 or newer must be there.

# The first interpreter that is new enough; another: make install PYTHON=/path/to/python3
PYTHON ?= $(shell for p in python3 python3.11 python3.12 python3.13; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)

# Named in the same pip command as the package: an open range ends in gigabytes of CUDA packages.
TORCH := torch==2.13.0

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
# One thread a test worker: two workers share two cores.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest
WORKERS ?= 2
# Of make fuzz.
CASES ?= 2400
SEED ?= 0

.PHONY: help install quickstart test test-browser fuzz test-slow test-gpu gpu-references test-slurm test-all lint mirrors readme check-reports docs clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

install: $(INSTALLED)  ## .venv with the package and what it needs

$(INSTALLED): pyproject.toml
	@'$(PYTHON)' -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
		{ echo 'Python 3.11 or newer is needed; name one: make install PYTHON=/path/to/python3.11' >&2; exit 1; }
	'$(PYTHON)' -m venv $(VENV)
	$(BIN)/python -m pip install $(TORCH) -e '.[dev]'
	@touch $@

quickstart: install  ## the sand column at small scale, from simulation to report, by two engines
	$(BIN)/nsf run -m scene=sand scale=small engine=auto,operators

test: install  ## the tests, without those marked slow or slurm
	$(PYTEST) -m 'not slow and not slurm' -n $(WORKERS) --dist worksteal

test-browser: install  ## the pages in Chromium, their modules under node and tsc; apt install chromium nodejs npm
	@for p in chromium node npx; do command -v $$p >/dev/null || echo "$$p is missing; its tests are skipped: apt install chromium nodejs npm"; done
	! command -v npx >/dev/null || npx --yes -p typescript@5 tsc -p tests/unit/web/tsconfig.json
	$(PYTEST) -rs tests/unit/live tests/unit/export/test_export_page.py

test-slow: install  ## the tests marked slow
	$(PYTEST) -m slow

test-gpu: install  ## the tests marked gpu, on a machine with a GPU
	$(PYTEST) -m gpu -rs

gpu-references: install  ## what tests on a GPU compare with, from a CPU, in tests/references/
	OMP_NUM_THREADS=1 $(BIN)/python tests/gpu_references.py

fuzz: install  ## malformed inputs by the thousand, drawn from SEED: none runs code, hangs or is believed
	OMP_NUM_THREADS=1 $(BIN)/python tests/fuzz/fuzz.py --cases $(CASES) --seed $(SEED)

test-slurm: install  ## sweeps through a Slurm of one node; on Debian after apt install slurm-wlm munge
	$(PYTEST) -m slurm

test-all: test test-slow test-slurm  ## every test

lint: install  ## ruff and the layers of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

mirrors: install  ## the text of the reference that the modal engine mirrors; once its kernels follow an edit
	$(BIN)/python -c 'from nsf.engines.modal import mirrors; mirrors.write()'

readme: install  ## the figures in README.md, from a report, and the list of reports
	$(BIN)/python -m nsf.reporting.committed README.md
	$(BIN)/nsf reports folder=reports

check-reports: install  ## whether reports/ is as it was generated
	$(BIN)/nsf reports folder=reports check=true

docs: install  ## the documentation, in site/
	OMP_NUM_THREADS=1 $(BIN)/python -m mkdocs build --strict

clean:  ## remove the environment, caches and builds; runs and reports stay
	rm -rf $(VENV) build dist site .pytest_cache .ruff_cache .mypy_cache .import_linter_cache .hypothesis *.egg-info
	find nsf tests -name __pycache__ -type d -prune -exec rm -rf {} +
