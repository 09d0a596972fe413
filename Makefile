# make          set everything up and run the demo (no hardware, no data)
# make test     set everything up and run all checks: lint, types, import direction, tests
# make test-all the same with the long tests;  make bench  prints ratios to physical limits
# make docs     write what follows from the code;  make lock  resolve the lock files again

PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
# A venv made without ensurepip (bare Debian) has no pip of its own: the system's pip fills it.
PIP = $$($(BIN)/python -m pip --version >/dev/null 2>&1 && echo $(BIN)/python -m pip || echo $(PYTHON) -m pip --python $(BIN)/python)
INSTALL = --quiet --disable-pip-version-check --require-hashes

.PHONY: demo test test-all lint bench docs lock clean
.DEFAULT_GOAL := demo

demo: $(VENV)/run.stamp
	$(BIN)/turnscan demo --overwrite demo-output

test: lint
	$(BIN)/pytest --benchmark-disable -n 2 --dist worksteal

test-all: lint
	$(BIN)/pytest --benchmark-disable -n 2 --dist worksteal -m "not benchmark"

lint: $(VENV)/dev.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	PYTHONPATH=tests/.src $(BIN)/lint-imports --no-cache

bench: $(VENV)/dev.stamp
	$(BIN)/pytest -m benchmark -s -q --benchmark-columns=min,median,rounds tests/benchmarks

docs: $(VENV)/dev.stamp
	$(BIN)/python docs/generate.py

lock: $(VENV)/dev.stamp
	for target in "run" "dev --extra formats --group test --group lint"; do set -- $$target; name=$$1; shift; \
	  $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
	    --no-emit-find-links --no-header --no-annotate --upgrade $$* pyproject.toml requirements/build.in \
	    -o requirements/$$name.lock || exit 1; done

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "turnscan needs Python 3.11 or newer: install python3" >&2; exit 1; }
	@$(PYTHON) -m venv $(VENV) >/dev/null 2>&1 || { rm -rf $(VENV); $(PYTHON) -m venv --without-pip $(VENV); }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m pip --version >/dev/null 2>&1 || \
	  { rm -rf $(VENV); echo "neither ensurepip nor pip found: install python3-venv or python3-pip" >&2; exit 1; }

$(VENV)/run.stamp: requirements/run.lock pyproject.toml | $(BIN)/python
	@echo "installing what turnscan needs into $(VENV)"
	@$(PIP) install $(INSTALL) -r requirements/run.lock
	@$(PIP) install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

$(VENV)/dev.stamp: requirements/dev.lock $(VENV)/run.stamp
	@echo "installing what its checks need into $(VENV)"
	@$(PIP) install $(INSTALL) -r requirements/dev.lock
	@touch $@

clean:
	rm -rf $(VENV) demo-output build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
