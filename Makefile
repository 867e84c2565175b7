# `make demo`, `make test` and `make check` set up everything they need in .venv first.
PYTHON ?= python3
VENV ?= .venv
# Further requirements of an environment, such as PINS="jax<0.12"; one environment for each, named by VENV.
PINS ?=
# Processes that run tests, which together take up to 0.7 of the memory.
WORKERS ?= 2
RUN = $(VENV)/bin/python
# One worker runs all tests of a file, which share simulations.
PYTEST = $(RUN) -m pytest -n $(WORKERS) --dist loadfile
export MUJOCO_GL ?= $(if $(DISPLAY),glfw,egl)

.PHONY: demo test test-fast test-all test-gpu check docs format benchmark clean

$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install --quiet --disable-pip-version-check --upgrade pip
	$(RUN) -m pip install --quiet --disable-pip-version-check -e ".[dev]" $(foreach pin,$(PINS),"$(pin)")
	touch $@

demo: $(VENV)/installed
	$(RUN) -m crazysim demo

# All tests that are not marked slow; TESTS=tests/control for a part.
test: $(VENV)/installed
	$(PYTEST) -m "not slow" $(TESTS)

test-fast: $(VENV)/installed
	$(PYTEST) -m fast $(TESTS)

# The slow ones too, and new examples for the tests of properties.
test-all: $(VENV)/installed
	CRAZYSIM_HYPOTHESIS=explore $(PYTEST) $(TESTS)

# On a machine with an NVIDIA GPU, which the workers share; PINS="jax[cuda12]" installs JAX for it.
test-gpu: $(VENV)/installed
	XLA_FLAGS=--xla_backend_optimization_level=3 $(PYTEST) --dist worksteal tests/gpu

check: $(VENV)/installed
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/pyright
	$(VENV)/bin/lint-imports --no-cache

docs: $(VENV)/installed
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict  # --quiet would hide its warnings from --strict
	@echo "wrote out/site/index.html"

format: $(VENV)/installed
	$(VENV)/bin/ruff format .
	$(VENV)/bin/ruff check --fix .

benchmark: $(VENV)/installed
	$(RUN) benchmarks/loop.py
	$(RUN) benchmarks/step.py
	$(RUN) benchmarks/compile.py
	$(RUN) benchmarks/limits.py
	$(RUN) benchmarks/versus_crazyflow.py

clean:
	rm -rf .venv .venv-* .cache out dist build
