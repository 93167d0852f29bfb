# Everything sets itself up: `make demo` or `make test` is all that a fresh checkout needs.

PYTHON ?= $(shell command -v python3.11 || command -v python3 || echo python3)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

# One BLAS thread a process: catstream's processes are the parallelism.
export OPENBLAS_NUM_THREADS ?= 1
export OMP_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.PHONY: help setup demo test test-slow lint format docs settings bench lock clean fuzz audit

help:  ## say what there is
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1|\2/p' Makefile | column -t -s '|' 2>/dev/null \
		|| sed -n 's/^\([a-z-]*\):.*## /make \1  /p' Makefile

setup: $(READY)  ## make the environment in .venv, from requirements.lock

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
		echo "catstream needs Python 3.11 or newer, '$(PYTHON)' is $$($(PYTHON) --version 2>/dev/null || echo missing):" \
			"install one, or say where it is: make PYTHON=/path/to/python3.11 ..." >&2; exit 1; }
	test -x $(BIN)/pip || $(PYTHON) -m venv --clear $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	$(BIN)/python -c 'import catstream.detection.detector'  # compiles the kernels: the first start need not
	@touch $@

demo: $(READY)  ## render a video, follow the object in it, say how well that went
	$(BIN)/catstream demo

test: $(READY)  ## all tests but the slow ones, doctests too
	$(BIN)/pytest -n auto --dist worksteal

test-slow: $(READY)  ## the slow ones: long real sequences, soaks
	$(BIN)/pytest -m slow --timeout 3600 -o faulthandler_timeout=0

lint: $(READY)  ## style, types, and what is unsafe
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/bandit --quiet --configfile pyproject.toml --recursive catstream services

format: $(READY)  ## put style right where that needs no thought
	$(BIN)/ruff check --fix-only --quiet .
	$(BIN)/ruff format .

docs: $(READY)  ## the documentation, into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

settings: $(READY)  ## write the table of docs/settings.md anew
	$(BIN)/python tests/test_docs.py

bench: $(READY)  ## speed, memory and growth: a quarter of an hour
	for name in startup throughput kernels wire endurance speed; do $(BIN)/python benchmarks/$$name.py || exit 1; done

audit: $(READY)  ## known holes in what requirements.lock installs; asks PyPI
	$(BIN)/python .ci/audit

fuzz: $(READY)  ## a million hostile inputs for each decoder: half an hour
	$(BIN)/python benchmarks/fuzz.py

lock:  ## pin the newest versions of everything in requirements.lock, with their hashes
	$(PYTHON) -m venv --clear build/lock
	build/lock/bin/pip install --quiet --disable-pip-version-check pip-tools
	printf 'setuptools>=77\nwheel\n' > build/lock/build.in
	CUSTOM_COMPILE_COMMAND="make lock" build/lock/bin/pip-compile --quiet --upgrade --extra dev --generate-hashes \
		--strip-extras --allow-unsafe --no-emit-index-url --no-emit-find-links --no-annotate \
		--output-file requirements.lock pyproject.toml build/lock/build.in

clean:  ## remove the environment and all that was made
	rm -rf $(VENV) build dist site demo *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
