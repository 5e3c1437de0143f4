# Two commands do everything: `make demo` and `make test`. Both stand on `make setup`, which makes .venv here.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: setup demo test test-slow check format lock gallery bench bench-quick accuracy-world clean

setup: $(STAMP)

$(STAMP): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "lidarpose needs Python 3.11 or newer: make PYTHON=python3.12 setup")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
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

format: setup
	$(BIN)/ruff check --fix src tests benchmarks
	$(BIN)/ruff format src tests benchmarks

# The pictures of docs/gallery.md and the README; needs Chromium.
gallery: setup
	$(BIN)/python docs/make_gallery.py

# Accuracy and speed, by hand: nothing here is a test. An hour or two; bench-quick takes minutes.
bench: setup
	$(BIN)/python benchmarks/accuracy_turntable.py --runs 500 --write docs/accuracy.md
	$(BIN)/python -m benchmarks.seed_setup --seeds 10 --write docs/accuracy.md
	$(BIN)/python benchmarks/accuracy_world.py --output docs/accuracy-world.md
	$(BIN)/python benchmarks/corner_finding.py
	$(BIN)/python -m benchmarks.calibrate
	$(BIN)/python -m benchmarks.detection
	$(BIN)/python -m benchmarks.assemble

bench-quick: setup
	$(BIN)/python benchmarks/accuracy_turntable.py --runs 20 --rendered 0
	$(BIN)/python -m benchmarks.seed_setup --seeds 1 --places 30
	$(BIN)/python -m benchmarks.calibrate
	$(BIN)/python -m benchmarks.detection

# Needs uv on the path. The lock names versions and hashes, never an index.
lock:
	uv pip compile pyproject.toml --universal --fork-strategy fewest --python-version 3.11 --generate-hashes --extra fast \
	  --group dev --group build --no-emit-index-url --no-emit-find-links --no-annotate --no-header \
	  --output-file requirements.lock

clean:
	rm -rf $(VENV) demo-output .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
