# make run     set up, then run the default configuration: synthetic scenes, tables, figures
# make demo    set up, then run one scene with four methods: a panel and tables in a few minutes
# make test    set up, then run lint and all tests
# make lint    set up, then check style, imports and rules
# make docs    set up, then build the site of the documentation in site/; a broken link fails
# make bench   set up, then time the fast paths and a run on photographs; tables go to results/benchmarks (docs/benchmarks.md)
#              with BASE=<commit>: what got slower since then, by runs of both versions in turn
# make gpu     set up, then test and measure what needs an NVIDIA card; with DEVICE=cpu, at tiny sizes (docs/gpu.md)
# make gpu-build  set up, then compile gsplat for a machine with a card; needs nvcc, but no card (docs/gpu.md)
# make published  set up, then run config/paper.yaml over tiny data in the published layouts (docs/workflow.md)
# make chaos   set up, then kill, freeze and starve runs of the ci configuration, and compare tables (docs/workflow.md)
# make report  set up, run, and write results/report.html
# make setup   create .venv with everything that the targets above need
PYTHON ?= python3
CORES ?= 2
DEVICE ?= cuda
KILLS ?= 30
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
export PATH := $(CURDIR)/$(BIN):$(PATH)
# Images of containers often set this variable. Without compiled modules, each of the hundreds of processes that
# a run starts takes a sixth longer to start.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run demo test lint style types docs bench gpu gpu-build chaos published report setup

run: $(STAMP)
	hilsplat run --cores $(CORES)

demo: $(STAMP)
	hilsplat run --config demo --cores $(CORES)

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev,export,browser-tests]'
	touch $(STAMP)

lint: $(STAMP)
	$(MAKE) --jobs=2 --output-sync --no-print-directory style types

style: $(STAMP)
	ruff check cpusplat hilsplat hilsplat_world models snakemake_logger_plugin_hilsplat tests benchmarks docs/*.py
	ruff format --check cpusplat hilsplat hilsplat_world models snakemake_logger_plugin_hilsplat tests benchmarks docs/*.py
	lint-imports
	snakefmt --check Snakefile workflow/Snakefile rules
	snakemake --lint --configfile config/ci.yaml

types: $(STAMP)
	mypy

# One more process than cores, because tests wait for servers and locks; files that take a minute start first.
test: lint
	python -m pytest --numprocesses $$(($(CORES) + 1)) --dist loadfile --no-loadscope-reorder tests/workflow tests/unit/test_benchmarks.py tests/unit/training tests/browser tests/bad_inputs tests/damage tests/published_models tests/imports tests/unit tests/cpusplat

# The variable turns off mkdocs-material's notice about MkDocs 2, which pyproject.toml excludes.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 mkdocs build --strict

gpu: $(STAMP)
	python -m benchmarks.gpu --device $(DEVICE)

gpu-build: $(STAMP)
	python -m benchmarks.gpu_build $(TARGET)

bench: $(STAMP)
ifdef BASE
	python -m benchmarks.compare $(BASE)
else
	OMP_NUM_THREADS=1 python -m pytest -c benchmarks/pytest.ini benchmarks
	rm -rf results/benchmarks/rehearsal
	python -m benchmarks.rehearsal results/benchmarks/rehearsal
endif

published: $(STAMP)
	python -m tests.published --cores $(CORES)

chaos: $(STAMP)
	python -m tests.chaos --kills $(KILLS)
	python -m pytest --hypothesis-profile chaos tests/damage

report: run
	snakemake --report results/report.html
