# make demo   track the packaged clips with the shipped weights     make test   everything CI runs
# Sets itself up in $(VENV) with pip; a second run does not touch the network.

PYTHON ?= python3
VENV ?= .venv
WORKERS ?= 2
DEMO_OUT ?= outputs/demo

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt
BASE := $(VENV)/.installed-base
ALL := $(VENV)/.installed-all
CHECK_RENDERER := $(BIN)/python -c "from quest.render_device import prepare_renderer; prepare_renderer()"

# One thread a worker: two workers with two threads each wait for each other.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup

export PYRIGHT_PYTHON_IGNORE_WARNINGS := 1

.PHONY: demo test lint format types pytest fuzz soak lowest audit render-deps site dist clean help
.DELETE_ON_ERROR:

help:
	@sed -n 's/^# //p' Makefile | head -n 2; echo "also: make lint | format | types | pytest | fuzz | soak | lowest | audit | render-deps | site | dist | clean"

demo: $(BASE)
	$(BIN)/quest demo --out $(DEMO_OUT)

# Two at a time, so that tests begin while types are checked.
test: $(ALL) render-deps
	$(MAKE) --no-print-directory --jobs 2 lint types pytest

lint: $(ALL)
	$(BIN)/ruff check
	$(BIN)/ruff format --check

format: $(ALL)
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

types: $(ALL)
	$(BIN)/pyright --pythonpath $(BIN)/python

# With every annotated shape checked, but in the tests that tests/conftest.py names.
pytest: $(ALL) render-deps
	$(PYTEST) --jaxtyping-packages=quest,beartype.beartype

# Thousands of damaged files of every kind: QUEST_FUZZ of each, then as many seconds of each guided by coverage.
QUEST_FUZZ ?= 2000
GUIDED_S ?= 30
KINDS = $$($(BIN)/python -c "from tests.test_fuzz import KINDS; print(*KINDS)")
fuzz: $(ALL)
	QUEST_FUZZ=$(QUEST_FUZZ) $(PYTEST) --timeout 0 tests/test_fuzz.py
	$(PIP) atheris
	for kind in $(KINDS); do $(BIN)/python -m tests.guided_fuzz $$kind -max_total_time=$(GUIDED_S) || exit 1; done

# A long stream with a camera that fails, queries that come and go, saving and restoring: memory and time must stay flat.
SOAK_FRAMES ?= 100000
soak: $(ALL)
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.endurance --frames $(SOAK_FRAMES) --disturbed --out outputs/soak.json

# The tests of recordings and of tracking with the lowest versions that pyproject.toml allows, but for torch.
LOWEST = $(VENV)-lowest
PINS = import tomllib; own = tomllib.load(open("pyproject.toml", "rb"))["project"]; names = own["dependencies"] + own["optional-dependencies"]["ros"]
lowest:
	$(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/python -c '$(PINS); print(*(n.replace(">=", "==") + ".*" for n in names if "torch" not in n), sep="\n")' > $(LOWEST)/pins.txt
	$(LOWEST)/bin/python -m pip install --quiet --requirement $(LOWEST)/pins.txt "$$(grep ^torch== constraints.txt)" \
	  beartype hypothesis "pandas<3" pytest pytest-timeout pytest-xdist
	$(LOWEST)/bin/python -m pip install --quiet --no-deps --editable .
	$(LOWEST)/bin/python -m pytest -n $(WORKERS) tests/data tests/filter tests/geometry tests/monitor tests/track tests/test_tracks.py

# Known holes in the versions that are tested; asks the databases of PyPI and OSV.
audit: $(BIN)/python
	$(PIP) pip-audit
	$(BIN)/pip-audit --requirement constraints.txt --no-deps --disable-pip

# The documentation as a web site, in site/.
site: $(ALL)
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict
	@echo "open site/index.html; with search: $(BIN)/python -m http.server --directory site"

# What a release is made of, in dist/, by the setuptools that is installed.
dist: $(ALL)
	rm -rf dist build
	$(BIN)/python -c 'from setuptools.build_meta import build_sdist, build_wheel; build_sdist("dist"); build_wheel("dist")'

render-deps: $(BASE)
	@$(CHECK_RENDERER) 2>/dev/null || { \
	  if ! command -v apt-get >/dev/null; then \
	    echo "no Vulkan driver and no apt-get here: install Chromium or Google Chrome (for SwiftShader) and the" >&2; \
	    echo "Vulkan loader with your package manager, then run 'quest doctor'" >&2; exit 1; fi; \
	  sudo=; [ "$$(id -u)" = 0 ] || sudo=sudo; \
	  echo "no Vulkan driver can render here: installing SwiftShader (Debian's chromium) and the Vulkan loader"; \
	  $$sudo apt-get update -qq && \
	  $$sudo env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium libvulkan1 >/dev/null && \
	  $(CHECK_RENDERER); }

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed; name one with: make PYTHON=/path/to/python3" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(BASE): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --no-compile --editable .
	@touch $@

$(ALL): pyproject.toml constraints.txt $(BASE)
	$(PIP) --no-compile --editable ".[sim,train,viz,live,ros,export,scale,text,docs,dev]"
	@touch $@

clean:
	rm -rf build dist site outputs .pytest_cache .ruff_cache .hypothesis src/*.egg-info
	find src tests -name __pycache__ -type d -exec rm -rf {} +
