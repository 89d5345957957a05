# Every target does its own set-up: a fresh clone and one of these commands is all it takes.
VENV ?= .venv
BIN  := $(VENV)/bin
OUT  ?= demo-out
JOBS ?= $(shell nproc 2>/dev/null || sysctl -n hw.ncpu 2>/dev/null || echo 2)

.PHONY: help setup demo test lint bench clean
help:
	@echo "make demo [MESHES=DIR] [OUT=demo-out]   generate a small data set, verify it, draw pictures"
	@echo "make test                               run the tests (OCNF_DATA=DIR adds those on real data)"
	@echo "make lint                               ruff and mypy"
	@echo "make bench                              print the speed and size tables"
	@echo "make setup                              only create $(VENV)"

setup: $(VENV)/.ready
$(VENV)/.ready: pyproject.toml constraints.txt tools/setup_venv.sh
	@bash tools/setup_venv.sh $(VENV)
	@touch $@

demo: setup
	@$(BIN)/python tools/demo.py --out "$(OUT)" --jobs $(JOBS) $(if $(MESHES),--meshes "$(MESHES)")

test: setup
	@$(BIN)/python -m pytest -n $(JOBS) --dist worksteal $(PYTEST_ARGS)

lint: setup
	@$(BIN)/ruff check .
	@$(BIN)/mypy

bench: setup
	@$(BIN)/python tools/bench.py

clean:
	rm -rf "$(OUT)" build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
