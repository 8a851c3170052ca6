# Everything runs in .venv, which `make setup` makes with the standard library's venv and pip.
PYTHON ?= python3
TORCH ?= torch==2.13.0
WORKERS ?= 1
BIN := .venv/bin
READY := .venv/.sgns-ready

.DEFAULT_GOAL := help
.PHONY: help setup demo frontier test stability lint clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-9s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo "  settings: PYTHON=python3.12 (3.10 to 3.13), TORCH='torch==2.13.0' (what pip installs first),"
	@echo "            WORKERS=4 (processes of make stability)"

setup: $(READY) ## make .venv and install the package with what tests and lint need

# torch comes first and alone, so that its version is ours and not what another package's bounds lead to
$(READY): pyproject.toml
	@test -x $(BIN)/python || $(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] < (3, 14))' || \
		{ echo "$(PYTHON) is missing or is not Python 3.10 to 3.13; name one that is: make setup PYTHON=python3.12" >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
		{ echo "$(PYTHON) has no venv module (Debian, Ubuntu: apt install python3-venv); install it or name another: make setup PYTHON=python3.12" >&2; exit 1; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear .venv
	$(BIN)/python -m pip install --quiet $(TORCH)
	$(BIN)/python -m pip install --quiet --editable '.[test,lint]'
	@touch $@

demo: setup ## from scenes to a report with pictures: simulate, train, roll out, evaluate
	$(BIN)/python -m sgns.demo

# The solver's points on one core, reductions and surrogates on another; the last command gathers.
frontier: setup ## what accuracy costs in time: the quick study, 9 minutes on two cores
	$(BIN)/sgns simulate dataset=quick
	$(BIN)/sgns frontier study=quick axis=solver & solver=$$!; \
	$(BIN)/sgns frontier study=quick axis=reduction && $(BIN)/sgns frontier study=quick axis=surrogate; \
	learned=$$?; wait $$solver && exit $$learned
	$(BIN)/sgns frontier study=quick axis=none

test: setup ## run the tests
	$(BIN)/python -m pytest

stability: setup ## measure the hard cases (about half an hour of one core; goes on where it stopped)
	$(BIN)/python experiments/stability/run.py --workers $(WORKERS)

lint: setup ## check the code's style and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

clean: ## remove caches and build results; .venv, data and outputs stay
	rm -rf build dist .pytest_cache .ruff_cache .hypothesis *.egg-info
	find . -path ./.venv -prune -o -name __pycache__ -type d -exec rm -rf {} +
