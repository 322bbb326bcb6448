# Every target needs Python ≥ 3.11 and make. The packages of the lock files are installed into .venv.

PORT ?= $(or $(SCENE_PORT),8000)
PYTHON ?= python3
# Package index for torch alone, with CPU builds. On Linux the default index has CUDA builds, which need
# further packages. See README.md.
TORCH_INDEX_URL ?=
# Further arguments of pytest, image, audit, bench or lock, such as make test ARGS="-k geometry".
ARGS ?=

VENV := .venv
# Environment of the service with Ray.
RAY_VENV := .venv-ray
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
# One worker more than cores, because the tests spend a third of their time waiting.
WORKERS ?= $$(($$($(BIN)/python -c 'import os; print(os.cpu_count())') + 1))
PYTEST := $(BIN)/python -m pytest --numprocesses $(WORKERS) --dist loadscope --no-loadscope-reorder
TORCH := $(if $(TORCH_INDEX_URL),--require-hashes -r requirements-torch-cpu.lock --index-url $(TORCH_INDEX_URL),\
	-r requirements-torch.lock)

# Where this is set, every process of the tests compiles all sources again, for up to two seconds.
unexport PYTHONDONTWRITEBYTECODE

# A stamp file marks an environment with the packages of its lock file. A newer lock file or
# pyproject.toml makes the stamp out of date. The lock files have the same versions, so they share
# one environment.
SERVICE := $(VENV)/.installed-service
TRAINING := $(VENV)/.installed-training
EVERYTHING := $(VENV)/.installed-everything
RAY := $(RAY_VENV)/.installed

# Lock the packages of some extras with the hashes of all their files. torch has a file of its own.
define compile
	$(BIN)/python -m piptools compile --quiet --generate-hashes --strip-extras --no-annotate --no-header \
		--no-emit-index-url --no-emit-find-links --unsafe-package torch $(3) \
		$(addprefix --extra ,$(2)) --output-file $(1) $(ARGS) pyproject.toml clients/python/pyproject.toml
endef

# Install torch, the packages of a lock file, and this repository.
define install
	@# torch first and alone, because a package of the lock file needs it. A CUDA build, from the default
	@# index, then gets its companions. Python compiles the modules that it imports; pip would compile
	@# all of them, for a minute.
	@$(PIP) install --no-compile --no-deps $(TORCH)
	@$(PIP) install --no-compile --require-hashes -r $(1)
	@$(if $(TORCH_INDEX_URL),,$(PIP) install -qq $(TORCH))
	@$(PIP) install -qq --no-deps --editable clients/python --editable .
	@echo "Installed."
endef

.DEFAULT_GOAL := help
.PHONY: checks help run ray test test-fast test-slow coverage docs image audit sbom setup training format bench lock clean
.DELETE_ON_ERROR:

help:  ## show this help
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## (.*)/  make \1\t\2/' | expand -t 20

run: $(SERVICE)  ## serve the shipped models on 127.0.0.1 (port: PORT=8000)
	SCENE_HOST=127.0.0.1 SCENE_PORT=$(PORT) exec $(BIN)/python -m app

ray: $(RAY)  ## serve by two replicas with Ray Serve on 127.0.0.1 (port: PORT=8000)
	exec $(RAY_VENV)/bin/python deploy/ray/run.py --port $(PORT) --replicas 2

test: checks  ## check lint, format, types and imports, then run all tests except the slow ones (SLOW=1: all tests)
	$(PYTEST) $(if $(SLOW),,-m "not slow") $(ARGS)

test-slow: $(EVERYTHING)  ## run the slow tests: training runs, the site, further parameters (minutes)
	$(BIN)/python -m app.compile
	$(PYTEST) -m slow $(ARGS)

test-fast: checks  ## run the checks and the tests without processes, browser and training (a minute)
	$(PYTEST) -m "not slow and not system" $(addprefix tests/,machines enumeration http registry scene serving) \
		--ignore tests/enumeration/test_scene_chains.py $(ARGS)

checks: $(EVERYTHING)
	@# Compile the kernels once, in parallel with the checks, instead of in every test process.
	@set -e; $(BIN)/python -m app.compile & compiling=$$!; trap 'kill $$compiling 2>/dev/null || :' EXIT; set -x; \
	$(BIN)/python -m ruff check --quiet .; \
	$(BIN)/python -m ruff format --quiet --check .; \
	$(BIN)/python -m mypy --no-error-summary; \
	$(BIN)/python -m mypy --no-error-summary --python-version 3.10 --follow-imports silent clients/python/scene_client; \
	$(BIN)/lint-imports --no-logo; \
	wait $$compiling

coverage: $(EVERYTHING)  ## measure which lines the tests run, without the slow tests (build/coverage)
	$(BIN)/python -m app.compile
	$(PYTEST) -m "not slow" --cov --cov-report term --cov-report html $(ARGS)

docs: $(EVERYTHING)  ## build the documentation as a site that works without internet (build/site)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet

audit: $(EVERYTHING)  ## report known vulnerabilities and risky code
	$(BIN)/python scripts/audit.py $(ARGS)

sbom: $(EVERYTHING)  ## write bills of materials of the images' Python packages (CycloneDX, build/)
	$(BIN)/python -m scripts.sbom

image: $(BIN)/python  ## build the image, ask its service its questions, remove it (Docker or buildah)
	$(BIN)/python deploy/image.py $(ARGS)

training: $(TRAINING)  ## install the service and training: adapt a home, train on your own scenes

setup: $(EVERYTHING)  ## install everything that training, tests and benchmarks need

format: $(EVERYTHING)  ## format the sources and generate the blocking client
	$(BIN)/python -m ruff check --fix-only --quiet .
	$(BIN)/python -m ruff format .
	$(BIN)/python scripts/sync_client.py

bench: $(EVERYTHING)  ## run the benchmarks, then load tests of the service, a plain FastAPI app and DDS
	$(BIN)/python -m benchmarks $(ARGS)
	$(if $(ARGS),,$(BIN)/python -m benchmarks.load)
	$(if $(ARGS),,$(BIN)/python -m benchmarks.dds)

lock: $(EVERYTHING)  ## resolve the dependencies of pyproject.toml into requirements*.lock (minutes)
	$(call compile,requirements-dev.lock,service training telemetry docs dev)
	$(call compile,requirements-training.lock,service training,--constraint requirements-dev.lock)
	$(call compile,requirements-ray.lock,service ray,--constraint requirements-dev.lock)
	$(call compile,requirements.lock,service,--constraint requirements-dev.lock)

clean:  ## remove the environment and all caches
	rm -rf $(VENV) $(RAY_VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache .numba_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(SERVICE): requirements.lock pyproject.toml clients/python/pyproject.toml | $(BIN)/python
	@echo "Installing the service's packages into $(VENV) ..."
	@$(PIP) install --require-hashes -r requirements.lock
	@$(PIP) install -qq --no-deps --editable clients/python --editable .
	@echo "Installed. Compiling kernels for this machine ..."
	@$(BIN)/python -m app.compile
	@echo "Compiled."
	@touch $@

$(TRAINING): requirements-training.lock requirements-torch.lock requirements-torch-cpu.lock pyproject.toml clients/python/pyproject.toml | $(BIN)/python
	@echo "Installing the packages of the service and of training into $(VENV) ..."
	$(call install,requirements-training.lock)
	@touch $(SERVICE) $@

$(EVERYTHING): requirements-dev.lock requirements-torch.lock requirements-torch-cpu.lock pyproject.toml clients/python/pyproject.toml | $(BIN)/python
	@echo "Installing every package into $(VENV) ..."
	$(call install,requirements-dev.lock)
	@touch $(SERVICE) $(TRAINING) $@

$(RAY): requirements-ray.lock pyproject.toml clients/python/pyproject.toml | $(RAY_VENV)/bin/python
	@echo "Installing the service and Ray into $(RAY_VENV) ..."
	@$(RAY_VENV)/bin/python -m pip --disable-pip-version-check install -qq --require-hashes \
		-r requirements-ray.lock
	@$(RAY_VENV)/bin/python -m pip --disable-pip-version-check install -qq --no-deps --editable clients/python --editable .
	@echo "Installed. Compiling kernels for this machine ..."
	@$(RAY_VENV)/bin/python -m app.compile
	@echo "Compiled."
	@touch $@

# This target is an order-only prerequisite above, so an existing environment is never created again.
$(BIN)/python $(RAY_VENV)/bin/python:
	@set -eu; for candidate in $(PYTHON) python3.13 python3.12 python3.11; do \
	    if $$candidate -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	        found=$$candidate; break; fi; done; \
	if [ -z "$${found:-}" ]; then \
	    echo "error: no Python 3.11 or newer found; select one with make PYTHON=/path/to/python3" >&2; exit 1; fi; \
	if ! $$found -c 'import ensurepip, venv' 2>/dev/null; then \
	    echo "error: $$found cannot create virtual environments: its venv or ensurepip module is missing" \
	         "(on Debian and Ubuntu: apt-get install python3-venv)" >&2; exit 1; fi; \
	$$found -m venv --clear $(@:/bin/python=) || { rm -rf $(@:/bin/python=); exit 1; }
