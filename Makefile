# Two commands stand on their own on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: setup demo test test-all lint studies notebooks job-keys docs lock clean

setup: .venv/ready

.venv/ready: requirements.lock pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "jaximp needs Python 3.11 or newer; set PYTHON=/path/to/python3.11")'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -e .
	touch $@

demo: setup
	$(BIN)/jaximp demo --out out/demo --force

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# One thread of linear algebra for each of two workers: more of them wait for each other.
PYTEST := OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder

# Without the tests that are marked slow.
test: lint
	$(PYTEST) -m "not slow"

test-all: lint
	$(PYTEST)

# The slow studies behind the README's tables; their results stand in experiments/results.
studies: setup
	for study in experiments/*.py experiments/benchmarks/*.py; do $(BIN)/python $$study || exit 1; done

# Runs the notebooks and keeps them with their results.
notebooks: setup
	$(BIN)/jupyter-execute --inplace --NotebookClient.record_timing=False notebooks/*.ipynb

# The reference of all keys of a job file, from the code.
job-keys: setup
	$(BIN)/python docs/make_job_keys.py

# The documentation as a site in out/site, which needs no network. A warning is an error.
docs: setup
	$(BIN)/python docs/site/build.py out/site

# Pinned versions for every supported Python, without any download address.
lock: setup
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 \
		--no-header --no-annotate -o requirements.lock

clean:
	rm -rf .venv out build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
