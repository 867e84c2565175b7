# Each target sets up what it needs in .venv first: `make demo` what the demonstration needs, `make test` adds what tests
# need, `make docs` what the pages need, and `make check` the checkers. `make .venv/installed-dev` installs all at once.
PYTHON ?= python3
VENV ?= .venv
# Further requirements of an environment, such as PINS="jax<0.12"; one environment for each, named by VENV.
PINS ?=
# Processes that run tests; auto is one for each core and 4 GB of memory (tests/machine.py).
WORKERS ?= auto
RUN = $(VENV)/bin/python
# One worker runs all tests of a file, which share simulations. The durations of all tests are kept in out/tests/.
PYTEST = $(RUN) -m pytest -n $(WORKERS) --dist loadfile --junitxml=out/tests/$@$(VENV:.venv%=%).xml
# What `make test` runs, about five minutes on two quiet cores; TESTS=tests/control for another part.
tests_of = $(patsubst %,tests/$(1)/test_%.py,$(2))
TESTS ?= tests/laws tests/golden tests/core tests/dynamics tests/drones \
  $(patsubst %,tests/test_%.py,eager machine package rotation startup storage utils) \
  $(call tests_of,control,allocation attitude flatness setpoint state wrong_controllers) \
  $(call tests_of,docs,first_pages imports site) \
  $(call tests_of,engine,gradient_kernels interpret jaxcompat passes plan pytree record rules) \
  $(call tests_of,engine,simplify step symbolic) \
  $(call tests_of,envs,actions brax contract pettingzoo task vector wrappers) \
  $(call tests_of,geometry,heightfield rays shapes) tests/lab/bodies/test_manifold.py \
  $(call tests_of,scene,build contact_report contacts sync wrong_scenes) \
  tests/trajectories/test_formation.py
# What a new JAX can break: derivatives, tracing, lowering, devices and the cache of programs.
NEEDS_JAX = $(call tests_of,engine,cache ffi_handlers fuzz gradient_kernels host_call index_map indexing interpret) \
  $(call tests_of,engine,jaxcompat pair_reductions plain plan pytree record rules sharding stage step tables targets) \
  $(call tests_of,laws,gradients law_02_batch_axes law_03_functional_core law_06_no_retrace law_07_no_nan) \
  $(call tests_of,laws,law_10_same_seed law_11_no_buffer_taken transformations) tests/docs/test_first_pages.py
# Tests start processes that import JAX: without bytecode each takes seconds more.
unexport PYTHONDONTWRITEBYTECODE
export MUJOCO_GL ?= $(if $(DISPLAY),glfw,egl)

.PHONY: demo test test-rest test-newest test-all test-gpu check docs format benchmark release clean

# The stamp of an extra of pyproject.toml that is installed, and of those that it includes.
INCLUDED_test = demo
INCLUDED_dev = check docs test demo
$(VENV)/installed-%: pyproject.toml
	$(RUN) -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install --quiet --disable-pip-version-check --no-compile -e ".[$*]" $(foreach pin,$(PINS),"$(pin)")
	touch $@ $(addprefix $(VENV)/installed-,$(INCLUDED_$*))

demo: $(VENV)/installed-demo
	$(RUN) -m crazysim demo

test: $(VENV)/installed-test
	$(PYTEST) -m "not slow" $(TESTS)

# What `make test` leaves out, except for the slow ones: CI runs both.
test-rest: $(VENV)/installed-test
	$(PYTEST) -m "not slow" $(addprefix --ignore=,$(TESTS))

# With all optimisations of XLA and of g++, as users have them; CI runs it on the newest JAX. Two kernels that take g++
# 40 s are left out: they hold what the smaller ones ask of JAX.
test-newest: $(VENV)/installed-test
	XLA_FLAGS=--xla_backend_optimization_level=3 $(PYTEST) -m "not slow" \
	  -k "not gradients_of_contacts and not state-controllers" $(NEEDS_JAX)

# Everything, with new examples for the tests of properties.
test-all: $(VENV)/installed-test
	CRAZYSIM_HYPOTHESIS=explore $(PYTEST)

# On a machine with an NVIDIA GPU, which the workers share; PINS="jax[cuda12]" installs JAX for it.
test-gpu: $(VENV)/installed-test
	XLA_FLAGS=--xla_backend_optimization_level=3 $(PYTEST) --dist worksteal tests/gpu

check: $(VENV)/installed-check
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/pyright
	$(VENV)/bin/lint-imports --no-cache

docs: $(VENV)/installed-docs
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict  # --quiet would hide its warnings from --strict
	@echo "wrote out/site/index.html"

format: $(VENV)/installed-check
	$(VENV)/bin/ruff format .
	$(VENV)/bin/ruff check --fix .

benchmark: $(VENV)/installed-demo
	$(RUN) benchmarks/loop.py
	$(RUN) benchmarks/step.py
	$(RUN) benchmarks/compile.py
	$(RUN) benchmarks/limits.py
	$(RUN) benchmarks/versus_crazyflow.py

# Builds and tries the distribution in empty environments, and uploads it to PyPI; CONTRIBUTING.md says what comes before.
release: $(VENV)/installed-test
	git diff --quiet HEAD
	.ci/dist $(PYTHON) out/dist
	$(RUN) -m pip install --quiet --disable-pip-version-check --no-compile twine
	$(RUN) -m twine upload out/dist/*
	git tag v$$($(RUN) -c "import crazysim; print(crazysim.__version__)")

clean:
	rm -rf .venv .venv-* .cache out dist build
