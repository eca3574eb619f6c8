# `make demo` flies a simulated drone and judges it. `make check` is what every change must pass. All set-up happens by itself.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.kiteline-installed
OLDEST := $(VENV)/oldest
ROOMS := core codec hw agent basestation lab bench cli

# Compiled kernels are kept with the environment, so that tests and demo compile once.
export NUMBA_CACHE_DIR ?= $(CURDIR)/$(VENV)/numba-cache
export OMP_NUM_THREADS ?= 1
# Compiled modules are kept, also where the shell (of many containers) says not to: the processes of the tests would
# compile them anew, 15 s of CPU in each of the four and 1 s at each start of an agent or a base.
export PYTHONDONTWRITEBYTECODE :=
export PYTHONUNBUFFERED := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.DEFAULT_GOAL := help
.PHONY: help install demo test oldest check format lint types contracts kernels refs docs bench clean

help: ## say what can be made
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

install: $(STAMP) ## set up .venv (every other target does this by itself)

$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { echo "kiteline: no $(PYTHON) found. On Debian or Ubuntu: sudo apt install python3 python3-venv" >&2; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "kiteline: $$($(PYTHON) --version) found, 3.11 or newer is needed. Name another with: make PYTHON=python3.12" >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null || { echo "kiteline: python's venv module is missing. On Debian or Ubuntu: sudo apt install python3-venv" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(STAMP): pyproject.toml | $(BIN)/python
	@echo "installing kiteline and what it needs into $(VENV) (once; about a minute, 1.2 GB of disk)"
	$(BIN)/python -m pip install --quiet -e '.[base,lab,dev]'
	@touch $@

demo: $(STAMP) ## simulate a flight, fly it over a real link, judge the result
	@$(BIN)/python -m kiteline_lab.demo

test: $(STAMP) ## run the tests: four at a time, as some only wait, then those that need the machine to themselves
	@$(BIN)/kiteline doctor --warm >/dev/null
	$(BIN)/python -m pytest -q -n 4 --dist loadfile --no-loadscope-reorder -m "not alone"
	$(BIN)/python -m pytest -q -m alone

oldest: ## run the tests with the oldest versions that pyproject.toml allows, in an environment of their own
	@$(MAKE) --no-print-directory VENV=$(OLDEST) $(OLDEST)/bin/python
	$(OLDEST)/bin/python -m pip install --quiet uv
	$(OLDEST)/bin/uv pip install --quiet --python $(OLDEST)/bin/python --resolution lowest-direct -e '.[base,lab,dev]'
	@touch $(OLDEST)/$(notdir $(STAMP))
	@$(MAKE) --no-print-directory VENV=$(OLDEST) NUMBA_CACHE_DIR=$(CURDIR)/$(OLDEST)/numba-cache test

check: lint types contracts test ## everything that a change must pass

format: $(STAMP) ## format and mend what can be mended
	$(BIN)/ruff check -q --fix .
	$(BIN)/ruff format -q .

lint: $(STAMP) ## style and likely bugs
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP) ## mypy, strict
	$(BIN)/mypy

contracts: $(STAMP) ## who may import whom
	$(BIN)/lint-imports

kernels: $(STAMP) ## list anew what a first start compiles (after a change to the arguments of a kernel)
	$(BIN)/python -m kiteline_hw.system.kernel_compilation --list kiteline_codec.warm kiteline_agent.runtime.warm kiteline_basestation.runtime.warm

refs: $(STAMP) ## renew what replays of the kept logs are expected to compute (LOGS=new: fly them anew, too)
	$(BIN)/python -m kiteline_lab.references --logs $(or $(LOGS),kept) $(NAMES)

docs: $(STAMP) ## build the documentation site in site/, links checked
	@$(BIN)/python -c 'import mkdocs, material, mkdocstrings' 2>/dev/null || $(BIN)/python -m pip install --quiet -e '.[docs]'
	COLUMNS=100 NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict
	@echo "open site/index.html"

bench: $(STAMP) ## measure, and write docs/results.md
	$(BIN)/kiteline bench

clean: ## remove what tools left behind, keep .venv
	rm -rf build dist site .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache *.egg-info
	find $(ROOMS) tests -name __pycache__ -type d -prune -exec rm -rf {} +
