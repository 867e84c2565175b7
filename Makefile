# `make demo`, `make test` and `make check` set up everything they need in .venv first.
PYTHON ?= python3
VENV ?= .venv
# Further requirements of an environment, such as PINS="jax<0.12"; one environment for each, named by VENV.
PINS ?=
# Processes that run tests, which together take up to 0.7 of the memory.
WORKERS ?= 2
RUN = $(VENV)/bin/python
export MUJOCO_GL ?= $(if $(DISPLAY),glfw,egl)

.PHONY: demo test test-fast check docs format benchmark clean

$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install --quiet --disable-pip-version-check --upgrade pip
	$(RUN) -m pip install --quiet --disable-pip-version-check -e ".[dev]" $(foreach pin,$(PINS),"$(pin)")
	touch $@

demo: $(VENV)/installed
	$(RUN) -m crazysim demo

test: $(VENV)/installed
	$(RUN) -m pytest -n $(WORKERS) --dist loadgroup --no-loadscope-reorder $(TESTS)

# Physics, control, geometry, data, and the engine on its interpreter: what compiles little.
FAST = $(addprefix tests/control/test_,allocation.py attitude.py flat_state.py flatness.py setpoint.py state.py) \
  tests/dynamics tests/drones $(addprefix tests/geometry/test_,heightfield.py manifold.py rays.py shapes.py) \
  $(addprefix tests/core/test_,data.py pipeline.py random.py functional.py) $(addprefix tests/engine/test_,ir.py \
  simplify.py passes.py interpret.py rules.py symbolic.py plan.py) tests/envs/test_task.py tests/envs/test_actions.py \
  tests/laws/test_law_03_functional_core.py tests/laws/test_law_09_wrong_input.py tests/test_jaxcompat.py \
  tests/test_pytree.py tests/test_rotation.py tests/test_prose.py tests/test_package.py

test-fast: $(VENV)/installed
	$(RUN) -m pytest -n $(WORKERS) --dist loadgroup --no-loadscope-reorder $(FAST)

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
	$(RUN) benchmarks/step.py
	$(RUN) benchmarks/compile.py
	$(RUN) benchmarks/limits.py
	$(RUN) benchmarks/versus_crazyflow.py

clean:
	rm -rf .venv .venv-* .cache out dist build
