# Everything runs in .venv, which `make setup` makes with the standard library's venv and pip.
PYTHON ?= python3
TORCH ?= torch==2.13.0
LOCK ?= requirements.lock
WORKERS ?= 1
BIN := .venv/bin
READY := .venv/.sgns-ready
# torch and what its builds for CUDA bring
NOT_LOCKED := torch triton cuda-bindings cuda-pathfinder cuda-toolkit nvidia-cublas nvidia-cuda-cupti \
	nvidia-cuda-nvrtc nvidia-cuda-runtime nvidia-cudnn-cu13 nvidia-cufft nvidia-cufile nvidia-curand \
	nvidia-cusolver nvidia-cusparse nvidia-cusparselt-cu13 nvidia-nccl-cu13 nvidia-nvjitlink \
	nvidia-nvshmem-cu13 nvidia-nvtx

.DEFAULT_GOAL := help
.PHONY: help setup demo frontier test stability lint docs lock clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-9s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo "  settings: PYTHON=python3.12 (3.10 to 3.13), TORCH='torch==2.13.0' (what pip installs first),"
	@echo "            LOCK= (newest releases that pyproject.toml allows, not those of requirements.lock),"
	@echo "            WORKERS=4 (processes of make stability)"

setup: $(READY) ## make .venv and install the package with what tests and lint need

# torch comes first and alone: its version is ours, and pip chooses the build for this machine (CPU or CUDA).
# The rest has the versions and hashes of the lock file, which names everything but torch and its CUDA libraries.
$(READY): pyproject.toml $(LOCK)
	@test -x $(BIN)/python || $(PYTHON) -c 'import sys; sys.exit(not (3, 10) <= sys.version_info[:2] < (3, 14))' || \
		{ echo "$(PYTHON) is missing or is not Python 3.10 to 3.13; name one that is: make setup PYTHON=python3.12" >&2; exit 1; }
	@test -x $(BIN)/python || $(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
		{ echo "$(PYTHON) has no venv module (Debian, Ubuntu: apt install python3-venv); install it or name another: make setup PYTHON=python3.12" >&2; exit 1; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear .venv
	$(BIN)/python -m pip install --quiet $(TORCH)
	$(if $(LOCK),$(BIN)/python -m pip install --quiet --no-deps --require-hashes --requirement $(LOCK))
	$(BIN)/python -m pip install --quiet --editable '.[test,lint]'
	@touch $@

demo: setup ## from scenes to a report with pictures: simulate, train, roll out, evaluate
	$(BIN)/python examples/demo.py

# The solver's points on one core, reductions and surrogates on another; the last command gathers.
frontier: setup ## what accuracy costs in time: the quick study, 9 minutes on two cores
	$(BIN)/sgns simulate dataset=quick
	$(BIN)/sgns frontier study=quick axis=solver & solver=$$!; \
	$(BIN)/sgns frontier study=quick axis=reduction && $(BIN)/sgns frontier study=quick axis=surrogate; \
	learned=$$?; wait $$solver && exit $$learned
	$(BIN)/sgns frontier study=quick axis=none

test: setup ## run the tests, in two processes: 5 minutes on two cores
	$(BIN)/python -m pytest -n 2 --dist loadfile

stability: setup ## hard cases, kills, full disks and random input (most of an hour of one core; the hard cases go on where they stopped)
	$(BIN)/python experiments/stability/run.py --workers $(WORKERS)
	$(BIN)/python experiments/stability/wrong_inputs.py
	$(BIN)/python -m pytest -m long
	SGNS_FUZZ=20 $(BIN)/python -m pytest -s --timeout 1200 tests/stability/fuzz

lint: setup ## check the code's style, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: setup ## build the documentation's site in build/site
	$(BIN)/python -m pip install --quiet --editable '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict

lock: ## renew requirements.lock: the newest releases that pyproject.toml allows, with hashes, for Python 3.10 to 3.13
	$(PYTHON) -m venv --clear build/lock
	build/lock/bin/python -m pip install --quiet uv
	echo '$(TORCH)' > build/lock/torch.txt
	build/lock/bin/uv pip compile pyproject.toml --extra test --extra lint --constraint build/lock/torch.txt --upgrade \
		--universal --python-version 3.10 --generate-hashes --quiet --custom-compile-command 'make lock' \
		$(foreach package,$(NOT_LOCKED),--no-emit-package $(package)) --output-file requirements.lock

clean: ## remove caches and build results; .venv, data and outputs stay
	rm -rf build dist .pytest_cache .ruff_cache .hypothesis *.egg-info
	find . -path ./.venv -prune -o -name __pycache__ -type d -exec rm -rf {} +
