# One command from a clone to a judged run, one to a tested checkout.
PYTHON ?= python3
VENV ?= .venv
RUNNABLE = $(VENV)/.runnable
READY = $(VENV)/.ready
MEASURED = tests/protocol tests/timing
# Options of pytest's that choose some of those tests: `make test CHOSEN=--first-of-each-file` asks whether a machine has what they need.
CHOSEN ?=
QUICK = not process and not root and not browser and not nightly and not slow
PIP = $(VENV)/bin/python -m pip install --quiet

# One setting of Python's in an environment would let every process of a test compile all anew.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: demo test linted tested lint measured unmeasured check clean

demo: $(RUNNABLE)  ## Run ten real Iridium satellites on ten loopback agents.
	$(VENV)/bin/cosmos run scenarios/iridium10.yaml

# Lint keeps one processor for a minute: the tests begin beside it, and what it says comes in one piece.
test: $(READY)  ## Lint, types, import contracts and every test but those of `.ci/nightly`.
	@$(MAKE) --no-print-directory --jobs=2 --keep-going linted tested

linted: $(READY)
	@$(MAKE) --no-print-directory --output-sync=target lint

# A line with $(MAKE) runs under `make -n`, too: pytest has one of its own. Tests call make, and this one's flags are not theirs.
tested: $(READY)
	@# Bytecode of the tests is written once here, and not by each of six workers.
	@$(VENV)/bin/python -m pytest --collect-only -qq > $(VENV)/.collected 2>&1 || cat $(VENV)/.collected
	@$(MAKE) --no-print-directory measured
	@$(MAKE) --no-print-directory unmeasured
	MAKEFLAGS= $(VENV)/bin/python -m pytest --numprocesses 6 --dist loadfile --no-loadscope-reorder --durations=25 $(addprefix --ignore=,$(MEASURED)) $(CHOSEN)

lint: $(READY)
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports

# Coverage quadruples what these tests compute and adds half to all others, which it needs none of.
measured: $(READY)
	$(VENV)/bin/python -m pytest --numprocesses 2 --dist worksteal $(MEASURED) -m "not nightly and not slow" --cov=madns_runtime.protocol --cov=madns_runtime.timing --cov-branch --cov-fail-under=95

# Chance of many seeds reaches no line that the others do not: what computes for long is worth its time alone.
unmeasured: $(READY)
	$(VENV)/bin/python -m pytest --numprocesses 2 --dist worksteal $(MEASURED) -m "slow and not nightly"

check: $(READY)  ## Lint, types, import contracts and the tests that start nothing and compute little.
	@$(VENV)/bin/ruff check --quiet .
	@$(VENV)/bin/ruff format --quiet --check .
	@$(VENV)/bin/mypy >$(VENV)/types.txt 2>&1 & types=$$!; \
	$(VENV)/bin/lint-imports >$(VENV)/contracts.txt 2>&1 & contracts=$$!; \
	$(VENV)/bin/python -m pytest --quiet --numprocesses 2 --dist worksteal -m "$(QUICK)"; failed=$$?; \
	wait $$types || { failed=1; cat $(VENV)/types.txt; }; \
	wait $$contracts || { failed=1; cat $(VENV)/contracts.txt; }; \
	exit $$failed

# What running needs. Compiled Python is left to the first start: four fifths of it would never be read.
$(RUNNABLE): pyproject.toml
	@MAKECMDGOALS="$(MAKECMDGOALS)" .ci/prerequisites $(PYTHON)
	$(PYTHON) -m venv $(VENV)
	$(PIP) --upgrade pip
	$(PIP) --no-compile --editable '.[host]'
	touch $@

# What its development needs, beside it.
$(READY): $(RUNNABLE)
	$(PIP) --no-compile --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
