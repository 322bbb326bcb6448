# Everything starts from Python ≥ 3.11 and make; the rest is installed into .venv from the lock files.

PORT ?= 8000
PYTHON ?= python3
# The index for CPU builds of torch, where the default index would bring a CUDA build. See README.md.
TORCH_INDEX_URL ?=
# Further arguments for pytest, the audit, the benchmarks or the lock's resolver: make test ARGS="-k geometry".
ARGS ?=
# How long a soak lasts.
MINUTES ?= 10

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
# One more than cores: a third of the tests' time is waiting, for services and the browser.
WORKERS ?= $$(($$($(BIN)/python -c 'import os; print(os.cpu_count())') + 1))
PYTEST := $(BIN)/python -m pytest --numprocesses $(WORKERS) --dist loadscope --no-loadscope-reorder
INDEX := $(if $(TORCH_INDEX_URL),--extra-index-url $(TORCH_INDEX_URL))

# A stamp says that the environment holds what its lock file asks for; it is made anew when the lock
# or pyproject.toml is newer. Both are subsets of one resolution, so they share one environment.
SERVICE := $(VENV)/.installed-service
EVERYTHING := $(VENV)/.installed-everything

.DEFAULT_GOAL := help
.PHONY: checks help run test test-fast test-slow docs chaos soak audit setup format bench lock clean
.DELETE_ON_ERROR:

help:  ## show this help
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 20

run: $(SERVICE)  ## serve the shipped models on 127.0.0.1 (PORT=8000)
	SCENE_HOST=127.0.0.1 SCENE_PORT=$(PORT) exec $(BIN)/python -m app

test: checks  ## lint, format, types, import rules, then all tests but the slow ones
	$(PYTEST) -m "not slow" $(ARGS)

test-slow: $(EVERYTHING)  ## the slow tests: training runs, the site, further parameters (minutes)
	$(BIN)/python -m app.compile
	$(PYTEST) -m slow $(ARGS)

test-fast: checks  ## the same checks, then tests without processes, browser and training (a minute)
	$(PYTEST) -m "not slow and not system" $(addprefix tests/,machines enumeration http registry scene serving) \
		--ignore tests/enumeration/test_scene_chains.py $(ARGS)

checks: $(EVERYTHING)
	@# Compiled once, beside the checks, and not by every process of the tests.
	@set -e; $(BIN)/python -m app.compile & compiling=$$!; trap 'kill $$compiling 2>/dev/null || :' EXIT; set -x; \
	$(BIN)/python -m ruff check --quiet .; \
	$(BIN)/python -m ruff format --quiet --check .; \
	$(BIN)/python -m mypy --no-error-summary; \
	$(BIN)/lint-imports --no-logo; \
	wait $$compiling

docs: $(EVERYTHING)  ## the documentation as a site that works without internet (build/site)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

audit: $(EVERYTHING)  ## known vulnerabilities, risky code, bills of materials (build/)
	$(BIN)/python scripts/audit.py $(ARGS)

chaos: $(EVERYTHING)  ## attack a live service: hostile requests, overload, swaps (minutes)
	$(BIN)/python -m app.compile
	$(BIN)/python -m pytest tests/chaos $(ARGS)

soak: $(EVERYTHING)  ## ten minutes of mixed use: nothing may grow (MINUTES=10)
	@# The compiler's memory is no part of the service's.
	$(BIN)/python -m app.compile
	CHAOS_SOAK_MINUTES=$(MINUTES) $(BIN)/python -m pytest tests/chaos/test_soak.py $(ARGS)

setup: $(EVERYTHING)  ## install everything that training, tests and benchmarks need

format: $(EVERYTHING)  ## rewrite the sources in the house format, the blocking client too
	$(BIN)/python -m ruff check --fix-only --quiet .
	$(BIN)/python -m ruff format .
	$(BIN)/python scripts/sync_client.py

bench: $(EVERYTHING)  ## run the benchmarks, then the service under load beside a plain FastAPI app, then a stream
	$(BIN)/python -m benchmarks $(ARGS)
	$(if $(ARGS),,$(BIN)/python -m benchmarks.load)
	$(if $(ARGS),,$(BIN)/python -m benchmarks.stream)

lock: $(BIN)/python  ## resolve pyproject.toml anew into requirements*.lock
	$(BIN)/python scripts/lock.py $(INDEX) $(ARGS)

clean:  ## remove the environment and every cache
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache .numba_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(SERVICE): requirements.lock pyproject.toml clients/python/pyproject.toml | $(BIN)/python
	@echo "Installing the service's packages into $(VENV) ..."
	@$(PIP) install -qq -r requirements.lock
	@$(PIP) install -qq --no-deps --editable clients/python --editable .
	@echo "Compiling loops for this machine ..."
	@$(BIN)/python -m app.compile
	@touch $@

$(EVERYTHING): requirements-dev.lock pyproject.toml clients/python/pyproject.toml | $(BIN)/python
	@echo "Installing every package into $(VENV) ..."
	@$(PIP) install -qq $(INDEX) -r requirements-dev.lock
	@$(PIP) install -qq --no-deps --editable clients/python --editable .
	@touch $(SERVICE) $@

# Order-only above: an environment is made once and then kept, whatever its own time stamp says.
$(BIN)/python:
	@set -eu; for candidate in $(PYTHON) python3.13 python3.12 python3.11; do \
	    if $$candidate -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	        found=$$candidate; break; fi; done; \
	if [ -z "$${found:-}" ]; then \
	    echo "error: no Python 3.11 or newer found; name one: make PYTHON=/path/to/python3" >&2; exit 1; fi; \
	if ! $$found -c 'import ensurepip, venv' 2>/dev/null; then \
	    echo "error: $$found cannot create virtual environments: its venv or ensurepip module is missing" \
	         "(on Debian and Ubuntu: apt-get install python3-venv)" >&2; exit 1; fi; \
	$$found -m venv --clear $(VENV) || { rm -rf $(VENV); exit 1; }
