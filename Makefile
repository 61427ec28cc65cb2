# make run    set up and run the default configuration (synthetic scenes, to tables and figures)
# make test   set up and run lint and all tests
# make bench  set up and time what must be fast; tables go to results/benchmarks (docs/benchmarks.md)
PYTHON ?= python3
CORES ?= 2
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
export PATH := $(CURDIR)/$(BIN):$(PATH)

.PHONY: run test lint bench report setup

run: $(STAMP)
	snakemake --cores $(CORES) --workflow-profile workflow/profiles/default

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,export-tests]'
	touch $(STAMP)

lint: $(STAMP)
	ruff check hilsplat tests benchmarks
	ruff format --check hilsplat tests benchmarks
	lint-imports
	snakefmt --check Snakefile rules
	snakemake --lint --configfile config/ci.yaml

test: lint
	python -m pytest --numprocesses $(CORES) --dist loadgroup

bench: $(STAMP)
	OMP_NUM_THREADS=1 python -m pytest -c benchmarks/pytest.ini benchmarks

report: $(STAMP)
	snakemake --cores $(CORES) --workflow-profile workflow/profiles/default
	snakemake --report results/report.html
