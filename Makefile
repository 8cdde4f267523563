# One command from a clone to a judged run, one to a tested checkout.
PYTHON ?= python3
VENV ?= .venv
READY = $(VENV)/.ready

.PHONY: demo test check clean

demo: $(READY)  ## Run ten real Iridium satellites on ten loopback agents.
	$(VENV)/bin/cosmos run scenarios/iridium10.yaml

test: $(READY)  ## Lint, types, import contracts and every test.
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/lint-imports
	$(VENV)/bin/python -m pytest --numprocesses 3 --dist loadfile --no-loadscope-reorder --durations=25 --cov=madns_runtime.protocol --cov=madns_runtime.timing --cov-branch --cov-fail-under=95

$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install --quiet --upgrade pip
	$(VENV)/bin/python -m pip install --quiet --editable '.[dev]'
	touch $(READY)

clean:
	rm -rf $(VENV) build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
