# `make demo` and `make test` need nothing but Python 3.11+ and a package index.
PYTHON ?= python3
VENV ?= .venv
TEST_VENV ?= .venv-test
# How many faults of each kind `make faults` tries.
FAULTS ?= 100
# How long `make fuzz` searches each parser, at least, and with which random numbers.
FUZZ_SECONDS ?= 600
FUZZ_EXECUTIONS ?= 100000
FUZZ_SEED ?= 0
BIN = $(VENV)/bin
PIP_FLAGS = --quiet --disable-pip-version-check --constraint constraints.txt

# The commit that `make bits` holds this checkout against.
BASE ?= HEAD~1

# What `make paper` hands on, such as PAPER="--scenes DIR --workers 1".
PAPER ?=

.PHONY: demo install test bits slow browser matrix exposures compat faults fuzz lint bench paper docs clean

demo: install  ## Train the bundled real scene for two minutes at most and print the results
	$(BIN)/crossgrad run

install: $(VENV)/.installed  ## Environment with an editable install

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install $(PIP_FLAGS) --editable .
	touch $@

test:  ## Build the wheel, install it into a fresh environment, run all tests against it
	PYTHON="$(PYTHON)" TEST_VENV="$(abspath $(TEST_VENV))" sh tests/run.sh

bits: install  ## Whether this checkout trains to the bits of its parent commit (BASE=COMMIT)
	PYTHON="$(BIN)/python" BASE="$(BASE)" sh tests/bits.sh

matrix:  ## Train every combination of components for a few steps (CONTRIBUTING.md says how long)
	PYTHON="$(PYTHON)" TEST_VENV="$(abspath $(TEST_VENV))" sh tests/run.sh -m matrix

slow:  ## The tests that take minutes: statistics of many repetitions, gradients entry by entry, Ray
	PYTHON="$(PYTHON)" TEST_VENV="$(abspath $(TEST_VENV))" EXTRAS=test,lint,ray sh tests/run.sh -m slow

browser:  ## The HTML page in Chromium, which must be installed (Debian package: chromium)
	PYTHON="$(PYTHON)" TEST_VENV="$(abspath $(TEST_VENV))" CROSSGRAD_BROWSER=required \
	    sh tests/run.sh -m browser

exposures:  ## Train every exposure x backbone x K for sixty steps, and photos of all extremes
	PYTHON="$(PYTHON)" TEST_VENV="$(abspath $(TEST_VENV))" sh tests/run.sh -m exposures

compat:  ## The tests on Python 3.12, 3.13 and the lowest versions of packages, one worker each
	COMPAT_VENVS="$(abspath .venv-compat)" sh tests/compat.sh

faults:  ## Kill, starve and interrupt runs, a hundred times each, and look at what is left
	PYTHON="$(PYTHON)" TEST_VENV="$(abspath $(TEST_VENV))" EXTRAS=test,lint,ray FAULTS="$(FAULTS)" \
	    sh tests/run.sh -m faults

fuzz: install  ## Ten minutes of mutated files for each parser; findings go to fuzz-findings/
	$(BIN)/pip install $(PIP_FLAGS) --editable ".[test]"
	PYTHONPATH=tests:tests/fuzz $(BIN)/python -m crossgrad_fuzz defects
	PYTHONPATH=tests:tests/fuzz $(BIN)/python -m crossgrad_fuzz run --seconds $(FUZZ_SECONDS) \
	    --executions $(FUZZ_EXECUTIONS) --seed $(FUZZ_SEED) --least 0.95

docs: install  ## The site: build/docs/index.html
	$(BIN)/pip install $(PIP_FLAGS) --editable ".[docs]"
	$(BIN)/sphinx-build -W -n -q -b html docs build/docs

lint: install  ## ruff and mypy
	$(BIN)/pip install $(PIP_FLAGS) --editable ".[lint]"
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: install  ## Loss, optimizer and operators of docs/benchmarks.md, which names the other commands
	$(BIN)/python benchmarks/loss.py
	$(BIN)/python benchmarks/adam.py
	$(BIN)/python benchmarks/operators.py

paper: install  ## The paper's tables and claims on our scenes: tunes, runs what is missing, writes the page
	nice -n 10 $(BIN)/python benchmarks/paper.py run $(PAPER)

clean:  ## Remove environments and caches; keeps runs/
	rm -rf $(VENV) $(TEST_VENV) .venv-compat build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis fuzz-findings
