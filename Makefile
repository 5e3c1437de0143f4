# Two commands do everything: `make demo` and `make test`. Both stand on `make setup`, which makes .venv here.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
BENCH_VENV := .venv-bench
BENCH_STAMP := $(BENCH_VENV)/.installed
BENCH_PYTHON = $(if $(wildcard $(BENCH_STAMP)),$(BENCH_VENV),$(VENV))/bin/python

.PHONY: setup demo test test-slow fuzz fuzz-figures check format lock gallery bench bench-compare bench-quick bench-setup accuracy accuracy-world clean

setup: $(STAMP)

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "lidarpose needs Python 3.11 or newer: make PYTHON=python3.12 setup")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	$(BIN)/python -m compileall -q src
	@touch $(STAMP)

demo: setup
	$(BIN)/lidarpose demo demo-output

check: setup
	$(BIN)/ruff check src tests benchmarks
	$(BIN)/ruff format --check src tests benchmarks
	$(BIN)/mypy
	$(BIN)/lint-imports

test: check
	$(BIN)/pytest -n 2 --dist worksteal

test-slow: setup
	$(BIN)/pytest -n 2 --dist worksteal -m slow

# The corner paper's tables again; an hour on two cores.
accuracy-world: setup
	$(BIN)/python benchmarks/accuracy_world.py --output docs/accuracy-world.md

# Damaged files for every reader, guided by coverage, for FUZZ_SECONDS or a little more; FUZZ_SEED=0 draws other
# damage each time. atheris lies in a folder of its own, as it has no wheel for every Python and system; where it has
# none, this says so and does nothing.
FUZZ_SECONDS ?= 75
FUZZ_SEED ?= 1
FUZZ_PACKAGES := $(VENV)/fuzz
fuzz: setup
	-test -d $(FUZZ_PACKAGES)/atheris || $(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes \
	  --only-binary :all: --target $(FUZZ_PACKAGES) --requirement tests/fuzz-requirements.lock
	cd tests && PYTHONPATH=$(abspath $(FUZZ_PACKAGES)) $(abspath $(BIN))/python -m tests_support.atheris_job --seconds $(FUZZ_SECONDS) --seed $(FUZZ_SEED)

# The figures of docs/formats.md again; half an hour.
fuzz-figures: fuzz
	cd tests && $(abspath $(BIN))/python -W ignore -m tests_support.bad_bytes --runs 500 --write ../docs/formats.md
	cd tests && PYTHONPATH=$(abspath $(FUZZ_PACKAGES)) $(abspath $(BIN))/python -m tests_support.atheris_job --seconds 300 \
	  --write ../docs/formats.md

format: setup
	$(BIN)/ruff check --fix src tests benchmarks
	$(BIN)/ruff format src tests benchmarks

# The pictures of docs/gallery.md and the README; needs Chromium.
gallery: setup
	$(BIN)/python docs/make_gallery.py

# Peers to measure against, in an environment of their own (Open3D brings sixty packages). Benchmarks run without them too.
bench-setup: $(BENCH_STAMP)

$(BENCH_STAMP): requirements-bench.lock pyproject.toml
	$(PYTHON) -m venv $(BENCH_VENV)
	$(BENCH_VENV)/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes --requirement requirements-bench.lock
	$(BENCH_VENV)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	@touch $(BENCH_STAMP)

# Accuracy and speed against peers and limits, on an idle machine: docs/benchmarks.md and .json. A quarter of an hour.
bench: setup
	$(BENCH_PYTHON) -m benchmarks.run --write

# The same again, saying which figures differ from the stored ones by more than their tolerance; fails where one is worse.
# SUITES="files plane_search" runs those alone.
bench-compare: setup
	$(BENCH_PYTHON) -m benchmarks.run --compare docs/benchmarks.json $(if $(SUITES),--only $(SUITES))

# The same with small sizes, printed only: minutes, to see that all works.
bench-quick: setup
	$(BENCH_PYTHON) -m benchmarks.run --quick

# The long accuracy studies behind docs/accuracy.md; hours. See also accuracy-world.
accuracy: setup
	$(BIN)/python -m benchmarks.accuracy_turntable --runs 500 --write docs/accuracy.md
	$(BIN)/python -m benchmarks.seed_setup --seeds 10 --write docs/accuracy.md
	$(BIN)/python -m benchmarks.corner_finding

# Needs uv on the path. The lock names versions and hashes, never an index.
lock:
	uv pip compile pyproject.toml --universal --fork-strategy fewest --python-version 3.11 --generate-hashes --extra fast \
	  --group dev --group build --no-emit-index-url --no-emit-find-links --no-annotate --no-header \
	  --output-file requirements.lock
	uv pip compile pyproject.toml --universal --fork-strategy fewest --python-version 3.11 --generate-hashes --extra fast \
	  --group bench --group build --constraints requirements.lock --no-emit-index-url --no-emit-find-links --no-annotate \
	  --no-header --output-file requirements-bench.lock

clean:
	rm -rf $(VENV) $(BENCH_VENV) demo-output .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
