# `make help` lists what can be asked for. The plain commands behind reports and test stand in docs/running.md.
PYTHON ?= python3
MISSING ?= 0
KILLS ?= 100
SCALE ?= paper
CORES ?= 2
VENV := .venv
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
# One thread a process: stages run side by side, and results must not depend on how many.
export OMP_NUM_THREADS := 1
export MKL_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1
PYTEST = $(BIN)/python -m pytest --numprocesses $(CORES) --dist loadfile --no-loadscope-reorder --nbval
SNAKEMAKE = $(BIN)/python -m snakemake --profile profiles/local --cores
EVIDENCE = evidence=1 seeds=$(SEEDS) scale=$(SCALE) missing=$(MISSING) $(if $(filter smoke,$(SCALE)),reports=results/smoke/report)

# Tests of numbers: what another processor may round otherwise.
NUMERICAL := tests/plant tests/learning tests/evidence tests/own_plant tests/runs/test_study.py

.PHONY: help setup reports evidence search smoke test portable lock lab browser bench torture plants cluster publish notebooks clean

help:  ## show this list
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "make %-10s %s\n", $$1, $$2}'
	@echo "Settings: SEEDS=20 CORES=2 PYTHON=python3.12, and for evidence SCALE=smoke"

# Unless the command line or the environment says how many; with a default for all, the second of these would do nothing.
reports: SEEDS ?= 1
evidence: SEEDS ?= 20

setup: $(VENV)/installed  ## create .venv and install environment.txt

$(VENV)/installed: environment.txt pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --requirement environment.txt
	$(BIN)/python -m pip install --quiet --no-deps --editable .
	touch $@

$(VENV)/alternatives: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --constraint environment.txt --editable ".[alternatives]"
	touch $@

reports: setup  ## run everything at paper scale and write reports/latest/report.html
	$(SNAKEMAKE) $(CORES) --config seeds=$(SEEDS) scale=paper missing=$(MISSING)
	@echo "The report: $(CURDIR)/reports/latest/report.html"

evidence: setup $(VENV)/alternatives  ## twenty seeds of it, the claims, the limits, the trials and the inferred settings; resumable
	seq 0 $$(($(SEEDS) - 1)) | xargs -n 1 -P $(CORES) sh -c '$(SNAKEMAKE) 1 --config $(EVIDENCE) only=$$0 -- one_seed || true'
	$(SNAKEMAKE) $(CORES) --config $(EVIDENCE)

search: setup  ## the best settings of the printed algorithms, and a sample of weights; hours, resumable; writes reports/reference/search
	printf '1\n2\n' | xargs -n 1 -P $(CORES) $(BIN)/python -m helpers search --scale $(SCALE)
	$(BIN)/python -m helpers search --scale $(SCALE)

smoke: setup  ## everything at a tiny scale, in a minute or two, its numbers mean nothing; the report goes to results/smoke/report/
	$(SNAKEMAKE) $(CORES) --config seeds=1 scale=smoke reports=results/smoke/report
	@echo "The report of the smoke run: $(CURDIR)/results/smoke/report/report.html"

test: setup  ## style, types, layers, tests and the notebooks against their stored outputs
	$(BIN)/python -m ruff check .
	$(BIN)/python -m ruff format --check .
	$(BIN)/python -m mypy
	$(BIN)/lint-imports
	$(PYTEST) notebooks tests

portable: setup  ## the notebooks and the numerical tests as on an older processor, and with AVX2 where this one has AVX-512
	$(BIN)/python -m torture.processors older -- $(PYTEST) notebooks $(NUMERICAL)
	$(BIN)/python -m torture.processors avx2 -- $(PYTEST) notebooks $(NUMERICAL)

lock: setup  ## write pylock.toml from environment.txt: every package of every system with its hash
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/python -m uv pip compile environment.txt --quiet --universal --python-version 3.11.5 --generate-hashes --no-header \
		--format pylock.toml --output-file pylock.toml

lab: setup  ## open JupyterLab on the notebooks, with the code and the parameters beside them
	$(BIN)/python -m jupyter lab --ServerApp.root_dir=. --LabApp.default_url=/lab/tree/notebooks/01_demonstrations.ipynb

browser: setup  ## run every notebook in JupyterLab in Chromium (on Debian: apt-get install chromium); pictures go to results/browser
	$(BIN)/python -m pip install --quiet --constraint environment.txt --editable ".[browser]"
	$(BIN)/python -m pytest -rs -m browser tests/notebooks/test_browser.py

bench: setup  ## measure speed against the machine's bound and other ways; writes reports/reference/benchmarks
	$(BIN)/python -m pip install --quiet --constraint environment.txt --editable ".[bench]"
	$(BIN)/python -m benchmarks.benchmark --whole --cores $(CORES)

torture: setup  ## the slow tests; kill a run KILLS times, crowd notebooks, feed nonsense; writes reports/reference/reliability.md
	$(BIN)/python -m pytest --numprocesses $(CORES) --dist loadfile -m torture
	$(BIN)/python -m torture.torture --kills $(KILLS)

plants: setup  ## judge what is learned from the records of eight plants on the plants themselves; half an hour of processor time; writes reports/reference/plants.md
	$(BIN)/python -m torture.plants --cores $(CORES)

cluster: setup  ## as root on Debian: install SLURM, run the smoke scale through it, compare, stop it (ACCOUNTING=1: with a database)
	$(BIN)/python -m pip install --quiet --constraint environment.txt --editable ".[slurm]"
	$(BIN)/python -m torture.cluster $(if $(ACCOUNTING),--accounting)

publish: setup  ## copy reports/latest to reports/reference
	$(BIN)/python -m helpers publish

notebooks: setup  ## run the notebooks at their defaults and store the outputs in them
	$(BIN)/python -m helpers refresh

clean:  ## remove results and the last report
	rm -rf results reports/latest .snakemake
