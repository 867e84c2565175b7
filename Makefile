# `make demo`, `make test` and `make check` set up everything they need in .venv first.
PYTHON ?= python3
VENV ?= .venv
# Further requirements of an environment, such as PINS="jax<0.12"; one environment for each, named by VENV.
PINS ?=
RUN = $(VENV)/bin/python
export MUJOCO_GL ?= $(if $(DISPLAY),glfw,egl)

.PHONY: demo test check docs format benchmark clean

$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(RUN) -m pip install --quiet --disable-pip-version-check --upgrade pip
	$(RUN) -m pip install --quiet --disable-pip-version-check -e ".[dev]" $(foreach pin,$(PINS),"$(pin)")
	touch $@

demo: $(VENV)/installed
	$(RUN) -m crazysim demo

test: $(VENV)/installed
	$(RUN) -m pytest -n 2 --dist loadgroup $(TESTS)

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
