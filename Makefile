# Needs python3 (3.11 or later) with venv, and a C compiler. Debian: apt install make gcc libc6-dev python3-venv
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PYTEST_ARGS ?=
# One more than there are processors: many tests wait for a device or a process.
WORKERS ?= $(shell expr $$(nproc) + 1)

.PHONY: help setup demo test soak lint check docs manual lock dist deb audit clean

help:  ## Show the targets.
	@grep -E '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/'

setup: $(VENV)/dev.stamp  ## Set up .venv with the program and the tools that develop it.

demo: $(VENV)/run.stamp  ## Set up and run the station on recorded frames; Ctrl-C stops it.
	$(BIN)/inspector run --config config/demo.yaml

test: setup  ## Set up and pass the tests.
	$(BIN)/pytest -n $(WORKERS) --dist loadgroup $(PYTEST_ARGS)

lint: setup  ## Style, types and import rules.
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

soak: setup  ## Pass the tests that take minutes: long runs, with devices that come and go; random examples, and more.
	$(BIN)/pytest -m long $(PYTEST_ARGS)
	$(BIN)/pytest -n $(WORKERS) --dist loadgroup --hypothesis-profile search
	FAULT_SEQUENCES=10000 RANDOM_STREAMS=200000 $(BIN)/pytest tests/bridge/test_fault_sequences.py \
	  tests/line/test_capture_path.py tests/bridge/test_random_streams.py tests/bridge/test_random_camera_streams.py
	CROWD_REQUESTS=100000 FUZZ_BYTES=10000000 $(BIN)/pytest tests/publish/test_plc_foreign_crowd.py \
	  tests/publish/test_plc_clients.py
	KILLS=200 CUTS=50 SOAK_FRAMES=100000 $(BIN)/pytest -m "long or not long" tests/line/test_archive_kills.py \
	  tests/line/test_archive_power.py tests/line/test_archive_disk.py tests/line/test_archive_soak.py
	HANDSHAKE_EXAMPLES=1000 $(BIN)/pytest --timeout 3600 tests/line/test_handshake_random.py

check: lint test  ## All that CI runs.

docs: $(VENV)/run.stamp  ## Write again what is generated from the code.
	$(BIN)/inspector plc-package --output deploy/plc
	$(BIN)/inspector config schema > config/schema.json
	$(BIN)/inspector io profiles --format markdown > docs/modules.md
	$(BIN)/inspector faults --format markdown > docs/faults.md
	$(BIN)/inspector reinspect-columns > docs/reinspect.md
	$(BIN)/inspector export-columns > docs/export.md
	$(BIN)/python -m inspector.metrics.dashboard dashboard > deploy/prometheus/dashboard.json
	$(BIN)/python -m inspector.metrics.dashboard markdown > docs/metrics.md

manual: $(VENV)/run.stamp  ## Build the manual, docs/README.md and what it leads to, as HTML: build/manual/index.html
	$(BIN)/python deploy/build_manual.py

dist: $(VENV)/run.stamp  ## Build source distribution and wheel into dist/; ARCH=arm64 for another machine than this.
	$(BIN)/python deploy/build_wheel.py $(ARCH:%=--arch %)

deb: $(VENV)/run.stamp  ## Build the Debian package into dist/; ARCH=arm64 for another machine than this.
	$(BIN)/python deploy/build_deb.py $(ARCH:%=--arch %)

audit: $(BIN)/python  ## Ask what is known against the locked dependencies, where advisories are in reach.
	test -x build/audit/bin/pip-audit || { $(PYTHON) -m venv build/audit && build/audit/bin/pip install --quiet pip-audit; }
	build/audit/bin/pip-audit --require-hashes --disable-pip --progress-spinner off --format json \
	  -r requirements.txt 2>build/audit/log | $(BIN)/python deploy/audit.py

lock: $(BIN)/python  ## Choose new releases of the dependencies, with their hashes.
	$(PYTHON) -m venv build/lock && build/lock/bin/pip install --quiet uv
	echo 'setuptools>=77' | build/lock/bin/$(COMPILE) -o requirements.txt pyproject.toml -
	echo 'setuptools>=77' | build/lock/bin/$(COMPILE) -o requirements-dev.txt -c requirements.txt --group dev pyproject.toml -
COMPILE = uv pip compile --quiet --upgrade --universal --python-version 3.11 --generate-hashes \
	--no-header --no-annotate --no-emit-index-url --no-emit-find-links

clean:  ## Remove what the other targets made.
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .import_linter_cache .hypothesis

$(BIN)/python:
	@$(PYTHON) -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "$(PYTHON) is missing, older than 3.11, or has no venv: apt install python3-venv (or: make PYTHON=...)" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

# The package itself is installed in place and without its dependencies: those come from the hashed list alone.
INSTALL = $(BIN)/pip install --quiet --disable-pip-version-check

$(VENV)/run.stamp: requirements.txt pyproject.toml $(wildcard inspector/_*.[ch] inspector/*/_*.[ch] firmware_bridge/*/_*.c) | $(BIN)/python
	@command -v $(CC) >/dev/null || { echo "no C compiler: apt install gcc libc6-dev (or: make CC=...)" >&2; exit 1; }
	$(INSTALL) --require-hashes -r requirements.txt
	rm -f inspector/*.so inspector/*/*.so firmware_bridge/*/*.so
	$(INSTALL) --no-deps --no-build-isolation --editable .
	@touch $@

$(VENV)/dev.stamp: requirements-dev.txt $(VENV)/run.stamp
	$(INSTALL) --require-hashes -r requirements-dev.txt
	@touch $@
