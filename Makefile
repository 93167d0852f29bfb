# Each command installs what it needs: run `make demo` or `make test` in a fresh checkout.

PYTHON ?= $(shell command -v python3.11 || command -v python3 || echo python3)
VENV := .venv
BIN := $(VENV)/bin
# Python compiles what it imports, a small part of what is installed.
PIP := $(BIN)/pip install --quiet --quiet --disable-pip-version-check --no-compile
INSTALLED := $(VENV)/.installed
READY := $(VENV)/.ready
TOOLS := $(VENV)/.tools

# Tests start hundreds of processes, which would all compile the sources again.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help setup develop demo test test-system test-slow lint format docs wheel picture protocol bench results lock clean fuzz audit

help:  ## list all commands
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1|\2/p' Makefile | column -t -s '|' 2>/dev/null \
		|| sed -n 's/^\([a-z-]*\):.*## /make \1  /p' Makefile

setup: $(READY)  ## create the environment in .venv, from requirements.lock

$(INSTALLED): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
		echo "catstream needs Python 3.11 or newer, '$(PYTHON)' is $$($(PYTHON) --version 2>/dev/null || echo missing):" \
			"install one, or give its path: make PYTHON=/path/to/python3.11 ..." >&2; exit 1; }
	@test -x $(BIN)/pip || .ci/step "making $(VENV) with $$($(PYTHON) --version)" $(PYTHON) -m venv --clear $(VENV)
	@.ci/step "installing $$(grep -c '==' requirements.lock) packages, 900 MB on disk: a minute or more" \
		$(PIP) --require-hashes -r requirements.lock
	@.ci/step "installing catstream itself" $(PIP) --no-deps --no-build-isolation --editable .
	@touch $@

$(READY): $(INSTALLED)
	@.ci/step "compiling kernels, once" $(BIN)/python -P -c 'import logging; logging.disable(); import catstream.detection.detector, catstream.detection.scm'
	@touch $@

develop: $(READY) $(TOOLS)  ## add the packages for tests and checks, from requirements-dev.lock

$(TOOLS): $(INSTALLED) requirements-dev.lock
	@.ci/step "installing $$(grep -c '==' requirements-dev.lock) packages for tests, 600 MB on disk: a minute or more" \
		$(PIP) --require-hashes -r requirements-dev.lock -r requirements.lock
	@touch $@

demo: $(READY)  ## render a video, track the object in it, print the accuracy
	@$(BIN)/catstream demo

test: $(READY) $(TOOLS)  ## all tests but those of test-system and test-slow, with doctests
	@$(BIN)/pytest -n auto --dist worksteal

test-system: $(READY) $(TOOLS)  ## those with Ray, a browser, Node.js, or a whole benchmark
	@$(BIN)/pytest -n 3 --dist worksteal -m 'system and not slow'

test-slow: $(READY) $(TOOLS)  ## the slow ones: many faults, a load test (4 minutes)
	@$(BIN)/pytest -m slow --timeout 3600 -o faulthandler_timeout=0

lint: $(TOOLS)  ## style, types, and unsafe code
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/bandit --quiet --configfile pyproject.toml --recursive catstream services

format: $(TOOLS)  ## fix the style automatically
	$(BIN)/ruff check --fix-only --quiet .
	$(BIN)/ruff format .

docs: $(TOOLS)  ## the documentation, into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

wheel:  ## build sdist and wheel in dist/, and try them on each supported Python of this machine: some minutes
	@PYTHON=$(PYTHON) .ci/wheel

picture: $(READY)  ## render the animated picture of the tutorial
	@$(BIN)/python .ci/picture

protocol: $(TOOLS)  ## update the fields in docs/protocol.md
	$(BIN)/python docs/fields.py

bench: $(TOOLS)  ## measure speed, memory and growth on an idle machine, into benchmarks/results: 20 minutes
	PYTHON=$${PYTHON_OF_PEERS:-$(BIN)/python} benchmarks/measure.sh

results: $(TOOLS)  ## write the pages of results, and the figures of README, from benchmarks/results
	$(BIN)/python benchmarks/page.py

audit: $(TOOLS)  ## known vulnerabilities of the packages in the lock files, from PyPI
	$(BIN)/python .ci/audit

fuzz: $(TOOLS)  ## a million hostile inputs for each decoder: half an hour
	$(BIN)/python benchmarks/fuzz.py

lock:  ## pin the newest versions of everything in both lock files, with their hashes
	@PYTHON=$(PYTHON) .ci/lock

clean:  ## remove the environment and all generated files
	rm -rf $(VENV) build dist site demo *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
