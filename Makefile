# Everything sets itself up: `make demo` or `make test` is all that a fresh checkout needs.

PYTHON ?= $(shell command -v python3.11 || command -v python3 || echo python3)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/pip install --quiet --quiet --disable-pip-version-check
READY := $(VENV)/.ready
TOOLS := $(VENV)/.tools

.DEFAULT_GOAL := help
.PHONY: help setup develop demo test test-slow lint format docs pythons picture settings protocol bench results lock clean fuzz audit

help:  ## say what there is
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1|\2/p' Makefile | column -t -s '|' 2>/dev/null \
		|| sed -n 's/^\([a-z-]*\):.*## /make \1  /p' Makefile

setup: $(READY)  ## make the environment in .venv, from requirements.lock

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
		echo "catstream needs Python 3.11 or newer, '$(PYTHON)' is $$($(PYTHON) --version 2>/dev/null || echo missing):" \
			"install one, or say where it is: make PYTHON=/path/to/python3.11 ..." >&2; exit 1; }
	@test -x $(BIN)/pip || .ci/step "making $(VENV) with $$($(PYTHON) --version)" $(PYTHON) -m venv --clear $(VENV)
	@.ci/step "installing $$(grep -c '==' requirements.lock) packages, 900 MB on disk: a minute or more" \
		$(PIP) --require-hashes -r requirements.lock
	@.ci/step "installing catstream itself" $(PIP) --no-deps --no-build-isolation --editable .
	@.ci/step "compiling kernels, once" $(BIN)/python -P -c 'import logging; logging.disable(); import catstream.detection.detector'
	@touch $@

develop: $(TOOLS)  ## add what tests and checks need, from requirements-dev.lock

$(TOOLS): $(READY) requirements-dev.lock
	@.ci/step "installing $$(grep -c '==' requirements-dev.lock) packages for tests, 600 MB on disk: a minute or more" \
		$(PIP) --require-hashes -r requirements-dev.lock -r requirements.lock
	@touch $@

demo: $(READY)  ## render a video, follow the object in it, say how well that went
	@$(BIN)/catstream demo

test: $(TOOLS)  ## all tests but the slow ones, doctests too
	@$(BIN)/pytest -n auto --dist worksteal

test-slow: $(TOOLS)  ## the slow ones: long real sequences, soaks
	@$(BIN)/pytest -m slow --timeout 3600 -o faulthandler_timeout=0

lint: $(TOOLS)  ## style, types, and what is unsafe
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/bandit --quiet --configfile pyproject.toml --recursive catstream services

format: $(TOOLS)  ## put style right where that needs no thought
	$(BIN)/ruff check --fix-only --quiet .
	$(BIN)/ruff format .

docs: $(TOOLS)  ## the documentation, into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

pythons:  ## follow the demo on each Python of this machine that catstream supports
	@.ci/pythons

picture: $(READY)  ## make the animated picture of README.md anew
	@$(BIN)/python .ci/picture

settings: $(TOOLS)  ## write the table of docs/settings.md anew
	$(BIN)/python tests/test_docs.py

protocol: $(TOOLS)  ## write the tables of docs/protocol.md anew
	$(BIN)/python tests/wire/test_protocol_page.py

bench: $(TOOLS)  ## measure speed, memory and growth on a quiet machine, into benchmarks/results: 20 minutes
	PYTHON=$${PYTHON_OF_PEERS:-$(BIN)/python} benchmarks/measure.sh

results: $(TOOLS)  ## write docs/results.md, and the figures of README, from benchmarks/results
	$(BIN)/python benchmarks/page.py

audit: $(TOOLS)  ## known holes in what the lock files install; asks PyPI
	$(BIN)/python .ci/audit

fuzz: $(TOOLS)  ## a million hostile inputs for each decoder: half an hour
	$(BIN)/python benchmarks/fuzz.py

lock:  ## pin the newest versions of everything in both lock files, with their hashes
	@PYTHON=$(PYTHON) .ci/lock

clean:  ## remove the environment and all that was made
	rm -rf $(VENV) build dist site demo *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
