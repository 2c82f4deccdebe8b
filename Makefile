# What one does with a checkout of Rooftrack. `make` alone lists it.

.DEFAULT_GOAL := help
.SILENT:

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
SAMPLE := workspace/sample
# Two test processes by default: the engine inside a test uses threads of its own, and a browser fills most of two cores.
TEST_PROCESSES ?= 2
TEST_OPTIONS ?=
# A Python to use instead of the one .ci/make-venv finds.
PYTHON ?=

## Using it

.PHONY: run
run: $(VENV)/installed $(VENV)/libraries $(SAMPLE)/project.json ## measure the shipped sample, then serve the browser interface over workspace/
	$(BIN)/rooftrack run $(SAMPLE)
	$(BIN)/rooftrack serve workspace

.PHONY: serve
serve: $(VENV)/installed $(VENV)/libraries ## serve the browser interface over workspace/
	mkdir -p workspace
	$(BIN)/rooftrack serve workspace

## Proving it

.PHONY: test
test: lint $(VENV)/libraries $(VENV)/browser ## lint, types and all tests
	$(BIN)/python -m pytest --ignore=tests/browser -n $(TEST_PROCESSES) $(TEST_OPTIONS)
	$(BIN)/python -m pytest tests/browser -n $(TEST_PROCESSES) --dist worksteal $(TEST_OPTIONS)

.PHONY: lint
lint: $(VENV)/tested ## style, format and types of everything
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	.ci/check-javascript

.PHONY: accuracy
accuracy: $(VENV)/tested $(VENV)/libraries ## render scenes with known truth, measure them, print the errors
	$(BIN)/python -m sample_data.accuracy $(ACCURACY_OPTIONS)

.PHONY: bench
bench: $(VENV)/tested $(VENV)/libraries ## speed and memory of the engine against decoding alone
	$(BIN)/python -m sample_data.bench $(BENCH_OPTIONS)

.PHONY: pictures
pictures: $(VENV)/tested $(VENV)/libraries $(VENV)/browser ## remake the screenshots in this README
	$(BIN)/python -m sample_data.pictures

## Keeping it

.PHONY: format
format: $(VENV)/tested ## put Python files into the one format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

.PHONY: lock
lock: $(VENV)/made ## remake the lock files from pyproject.toml (UPGRADE=1: newest versions)
	.ci/lock $(BIN)/python

.PHONY: clean
clean: ## remove what make made, but never workspace/, where work lies
	rm -rf $(VENV) node_modules build *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find app core sample_data tests -name __pycache__ -type d -prune -exec rm -rf {} +

.PHONY: help
help: ## this list
	awk -F ':.*## ' '/^## /{printf "\n%s\n", substr($$0, 4)} /^[a-z-]+:.*## /{printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

# What the targets above stand on. Each file in $(VENV) says that a step is done;
# a newer lock file makes it be done again.

$(VENV)/made:
	PYTHON="$(PYTHON)" .ci/make-venv $(VENV)
	touch $@

$(VENV)/installed: requirements.lock pyproject.toml | $(VENV)/made
	echo "Installing what Rooftrack needs (first time: a few minutes)"
	$(PIP) install -r requirements.lock
	$(PIP) install --no-deps --no-build-isolation --editable .
	touch $@

$(VENV)/tested: requirements-test.lock $(VENV)/installed
	echo "Installing what the tests need"
	$(PIP) install -r requirements-test.lock
	touch $@

$(VENV)/libraries: $(VENV)/installed
	.ci/system-libraries $(BIN)/python
	touch $@

$(VENV)/browser: $(VENV)/tested
	.ci/browser $(BIN)/python
	touch $@

# A sample somebody has worked on is theirs: only a missing one is copied.
$(SAMPLE)/project.json:
	mkdir -p workspace
	cp -R sample_data/sample workspace/
