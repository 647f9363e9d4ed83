# Everything a fresh clone needs; only Python 3.11 or newer must be there.

# The first interpreter that is new enough; another: make install PYTHON=/path/to/python3
PYTHON ?= $(shell for p in python3 python3.11 python3.12 python3.13; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)

# Named in the same pip command as the package: an open range ends in gigabytes of CUDA packages.
TORCH := torch==2.13.0

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
# With what tests, lint and the documentation need on top, most of it to read what was exported.
DEVELOPED := $(VENV)/.developed
# Without a GPU, and where pip has not been told where to look: PyTorch's builds without CUDA, 2 GB less.
CPU_TORCH = $$( [ "$$(uname -s)" = Linux ] && [ ! -e /proc/driver/nvidia/version ] && [ ! -e /dev/dxg ] && \
	! $(BIN)/python -m pip config list | grep -q index-url && \
	echo --extra-index-url https://download.pytorch.org/whl/cpu )
# Of what was installed, the parts that only tests and builds of those packages use: 200 MB, most of them torch's.
UNUSED = $(VENV)/lib/python*/site-packages -mindepth 2 \( -type d -name tests -o -path '*/torch/test' \
	-o -path '*/torch/bin/*[tT]est*' -o -path '*/torch/bin/protoc*' \)
# One thread a test worker: two workers share two cores.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest
WORKERS ?= 2
# What Python compiles of torch and the rest is kept: it takes six seconds of every process that imports them.
unexport PYTHONDONTWRITEBYTECODE
# Of make fuzz.
CASES ?= 2400
SEED ?= 0

.PHONY: help install develop quickstart test test-browser fuzz test-slow test-gpu gpu-references test-slurm test-all lint mirrors readme check-reports reproduce calibration models docs clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

install: $(INSTALLED)  ## .venv with the package, and what the chain needs

$(INSTALLED): pyproject.toml
	@'$(PYTHON)' -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || \
		{ echo 'Python 3.11 or newer is needed; name one: make install PYTHON=/path/to/python3.11' >&2; exit 1; }
	'$(PYTHON)' -m venv $(VENV)
	$(BIN)/python -m pip install --no-compile $(CPU_TORCH) $(TORCH) -e .
	find $(UNUSED) -prune -exec rm -rf {} +
	@touch $@

develop: $(DEVELOPED)  ## the same, with every extra, and what tests, lint and docs need

$(DEVELOPED): $(INSTALLED)
	$(BIN)/python -m pip install $(CPU_TORCH) $(TORCH) -e '.[dev]'
	@touch $@

quickstart: install  ## a column of sand in a minute, from simulation to report, by two models
	$(BIN)/nsf run +experiment=quickstart
	@echo
	@echo 'Next, the page above in a browser, and'
	@echo '  $(BIN)/nsf runs stage=evaluate sort=delta    the runs behind it'
	@echo '  $(BIN)/nsf plan scene=cake                   what another scene would take'
	@echo '  $(BIN)/nsf run scene=sand                    a finer column, with two held-out cases'
	@echo '  docs/tutorial.md                                what was done, and how to go on'

test: develop  ## the tests, without those marked slow or slurm: see test-slow
	$(PYTEST) -m 'not slow and not slurm' -n $(WORKERS) --dist worksteal

test-browser: develop  ## the pages in Chromium, their modules under node and tsc; apt install chromium nodejs npm
	@for p in chromium node npx; do command -v $$p >/dev/null || echo "$$p is missing; its tests are skipped: apt install chromium nodejs npm"; done
	! command -v npx >/dev/null || npx --yes -p typescript@5 tsc -p tests/unit/web/tsconfig.json
	$(PYTEST) -rs tests/unit/live tests/unit/export/test_export_page.py

test-slow: develop  ## the tests marked slow: the pages' commands, a job of every kind, the wheel
	$(PYTEST) -m slow -n $(WORKERS) --dist worksteal

test-gpu: develop  ## the tests marked gpu, on a machine with a GPU
	$(PYTEST) -m gpu -rs

gpu-references: develop  ## what tests on a GPU compare with, from a CPU, in tests/references/
	OMP_NUM_THREADS=1 $(BIN)/python tests/gpu_references.py

fuzz: develop  ## malformed inputs by the thousand, drawn from SEED: none runs code, hangs or is believed
	OMP_NUM_THREADS=1 $(BIN)/python tests/fuzz/fuzz.py --cases $(CASES) --seed $(SEED)

test-slurm: develop  ## sweeps through a Slurm of one node; on Debian after apt install slurm-wlm munge
	$(PYTEST) -m slurm

test-all: test test-slow test-slurm  ## every test

lint: develop  ## ruff and the layers of imports
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

mirrors: install  ## the text of the reference that the modal engine mirrors; once its kernels follow an edit
	$(BIN)/python -c 'from nsf.engines.modal import mirrors; mirrors.write()'

readme: install  ## the figures in README.md, from a report, and the list of reports
	$(BIN)/python -m nsf.results.readme README.md
	$(BIN)/nsf reports folder=reports

check-reports: install  ## whether reports/ is as it was generated
	$(BIN)/nsf reports folder=reports check=true

# Every experiment, those of the paper's size first; calibration makes `inverse`.
REPRODUCED := table1 noise sampling latent_dim training timestep generalise super_resolution forcing trust teaching training_runs taylor2d large

reproduce: install  ## every report, from nothing, on one GPU; the same command goes on where it was stopped
	@echo 'first the jelly cube at the paper'\''s size, whose rates tell how long the others take at most'
	$(BIN)/nsf run scene=jelly_cube scale=paper model=recurrence
	@for e in $(REPRODUCED); do $(BIN)/nsf plan +experiment=$$e | sed -n "s/^in all/in all, $$e:/p"; done
	@failed=; for e in $(REPRODUCED); do $(BIN)/nsf run +experiment=$$e || failed="$$failed $$e"; done; \
		[ -z "$$failed" ] || { echo "not whole:$$failed; make reproduce goes on" >&2; exit 1; }
	NSF_RUNS=$${NSF_RUNS:-runs}-calibration $(MAKE) calibration
	$(BIN)/nsf bench
	$(BIN)/nsf validate
	$(BIN)/nsf reports folder=reports
	$(BIN)/nsf validate scenes=bread,cake,sand,metal,toothpaste,jelly_cube,squishy_ball
	$(BIN)/nsf reports folder=reports
	$(BIN)/nsf reports folder=reports check=true

# Two moduli of a pressed frame, as docs/howto/inverse.md has them.
FRAME := scene=metal scale=small model=recurrence device=cpu latent_dim=8 \
	'+scene.parameters.E={key:material.E,unit:Pa,range:[1.2,1.8]}' '+scene.parameters.hardening.range=[0.0,0.2]' \
	'scene.design={_target_:nsf.scenes.Grid,train:[4,4],validation:16,test:2}'

# How validation runs are weighed was chosen on trials of the seeds 0 and 1; the trials reported are of another.
calibration: install  ## the reports of calibration, sensitivities and design, on a CPU, in an empty NSF_RUNS
	for s in simulate train deploy; do $(BIN)/nsf $$s +experiment=inverse || exit; done
	$(BIN)/nsf calibrate +experiment=inverse/models trials=20 seed=2 device=cpu folder=reports/calibration
	for s in simulate train deploy; do $(BIN)/nsf $$s $(FRAME) || exit; done
	$(BIN)/nsf calibrate trials=20 seed=2 device=cpu folder=reports/calibration_frame
	$(BIN)/nsf sample run=jelly_cube of=height,run_out,x@0.44:0.5:0.45 sensitivities=1024 full_order=32 \
		device=cpu folder=reports/sensitivities
	$(BIN)/nsf design +experiment=inverse/tilt x@0.5:0.5:0.24=0.52 tilt=10 knots=3 friction_angle=30 device=cpu \
		folder=reports/design
	for s in simulate train deploy; do $(BIN)/nsf $$s scene=block model=recurrence device=cpu || exit; done
	$(BIN)/nsf design run=block x@0.4:0.4:0.26=0.42 tilt=30 knots=4 E=6000 density=100 device=cpu \
		folder=reports/design_block

# Runs by recurrence at small scale, as forcing (seed 0) and table1/small have them.
models: install  ## write the models of nsf demo: make models block=DEPLOY_ID tray=DEPLOY_ID metal=DEPLOY_ID
	@[ -n "$(block)$(tray)$(metal)" ] || { echo 'name a run: make models block=ID' >&2; exit 2; }
	for m in block=$(block) tray=$(tray) metal=$(metal); do [ -z "$${m#*=}" ] || $(BIN)/python -c "from pathlib import Path; \
		from nsf.live.publish import ship; from nsf.runs import Run; \
		ship(Run.named('$${m#*=}', 'deploy'), Path('nsf/live/models/$${m%=*}.bin'))" || exit; done

docs: develop  ## the documentation, in site/
	OMP_NUM_THREADS=1 $(BIN)/python -m mkdocs build --strict

clean:  ## remove the environment, caches and builds; runs and reports stay
	rm -rf $(VENV) build dist site .pytest_cache .ruff_cache .mypy_cache .import_linter_cache .hypothesis *.egg-info
	find nsf tests -name __pycache__ -type d -prune -exec rm -rf {} +
