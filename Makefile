# Every target does its own set-up: a fresh clone and one of these commands is all it takes.
VENV ?= .venv
BIN  := $(VENV)/bin
OUT  ?= demo-out
JOBS ?= $(shell nproc 2>/dev/null || sysctl -n hw.ncpu 2>/dev/null || echo 2)

# Numba keys a compiled kernel on its own file, so a change in what it calls from another file goes unnoticed:
# the kernels of other sources than these are not used.
SOURCES := $(shell find ocnf_data ocnf_model -name '*.py' | LC_ALL=C sort)
export NUMBA_CACHE_DIR := $(CURDIR)/.numba/$(shell cat $(SOURCES) | cksum | cut -d ' ' -f 1)

.PHONY: help setup demo test lint docs bench clean
help:
	@echo "make demo [MESHES=DIR] [OUT=demo-out]   generate a small data set, verify it, reconstruct it, draw"
	@echo "                                        pictures (UP=y: their vertical axis, where it is not z)"
	@echo "make demo TRAIN=1 [SEED=0]              train a small network from scratch, compare it on unseen shapes"
	@echo "make test                               run the tests (OCNF_DATA=DIR adds those on real data)"
	@echo "make lint                               ruff and mypy"
	@echo "make docs                               write the tables of fields, build the site in site/"
	@echo "make bench                              print the speed and size tables"
	@echo "make setup                              only create $(VENV)"

setup: $(VENV)/.ready
$(VENV)/.ready: pyproject.toml constraints.txt tools/setup_venv.sh
	@bash tools/setup_venv.sh $(VENV)
	@touch $@

demo: setup
ifdef TRAIN
	@$(BIN)/python tools/demo_train.py --out "$(OUT)" --jobs $(JOBS) $(if $(SEED),--seed $(SEED))
else
	@$(BIN)/python tools/demo.py --out "$(OUT)" --jobs $(JOBS) $(if $(MESHES),--meshes "$(MESHES)") $(if $(UP),--up $(UP))
endif

test: setup stale
	@$(BIN)/python -m pytest -n $(JOBS) --dist worksteal $(PYTEST_ARGS)

lint: setup
	@$(BIN)/ruff check .
	@$(BIN)/mypy

# The tables of fields come from the models; the site is built without a network, and a warning is an error.
docs: setup
	@$(BIN)/python tools/reference.py
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "docs: site/index.html"

# On procedural shapes, or on real meshes laid out as ModelNet with MESHES=DIR.
bench: setup
	@for of in octree codec fusion loader catalogue plan conv tvl1; do echo; $(BIN)/python tools/bench/$$of.py || exit 1; done
	@$(BIN)/python tools/bench/render.py $(if $(MESHES),"$(MESHES)")
	@$(BIN)/python tools/bench/generate.py $(if $(MESHES),--meshes "$(MESHES)")

# Kernels of older sources, which nothing uses any more.
.PHONY: stale
stale:
	@find .numba -mindepth 1 -maxdepth 1 -not -path "$(NUMBA_CACHE_DIR:$(CURDIR)/%=%)" -exec rm -rf {} + 2>/dev/null || true

clean:
	rm -rf .numba "$(OUT)" site build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
