# Two commands on a fresh machine: `make demo` and `make test`. Both work in an environment of their own, .venv.
PYTHON ?= python3
VENV ?= .venv
DEMO ?= demo
BIN := $(VENV)/bin
TYPESCRIPT := $(VENV)/typescript
TYPESCRIPT_VERSION := 5.9.3
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

# Tests run in processes of one thread each, which on small work get further than one process of several threads.
# A file's tests share what they start, and so a process. The folders' order has the long files first.
TEST_PROCESSES ?= 2
PYTEST := OMP_NUM_THREADS=1 $(BIN)/pytest --numprocesses $(TEST_PROCESSES) --dist loadfile --no-loadscope-reorder

SPELLED := api benchmarks deploy docs service sgsst_core tests worker *.md Makefile mkdocs.yml pyproject.toml

.PHONY: demo test test-all test-slow lint lint-page docs clean

# Stylize the built-in scene and say where the results are.
demo: $(VENV)/installed
	$(BIN)/sgsst weights fetch vgg16
	$(BIN)/sgsst demo --out $(DEMO)

# Layout, lint, types, and the tests that are not slow by nature.
test: lint
	$(BIN)/sgsst weights fetch vgg16
	$(PYTEST) -m "not slow"

# What `test` leaves out: kills, chains of requests, whole runs, the wheel.
test-slow: $(VENV)/installed-dev
	$(BIN)/sgsst weights fetch vgg16
	$(PYTEST) -m slow

test-all: test
	$(MAKE) test-slow

# Layout, lint, spelling, types, and the directions of imports.
lint: $(VENV)/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/codespell $(SPELLED)
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	$(BIN)/pre-commit validate-config
	@$(MAKE) --no-print-directory lint-page

# The types that the page's scripts say in their comments. Only this check needs node and npm; the page does not.
lint-page: $(VENV)/created
	@if ! command -v npm > /dev/null; then echo "npm is not on this machine: the page's types are not checked"; \
	elif ! $(MAKE) --silent $(TYPESCRIPT)/$(TYPESCRIPT_VERSION); then \
	  echo "npm could not fetch TypeScript: the page's types are not checked"; \
	else $(TYPESCRIPT)/node_modules/.bin/tsc --project .ci/tsconfig.json; fi

$(TYPESCRIPT)/$(TYPESCRIPT_VERSION): $(VENV)/created
	npm install --silent --no-save --prefix $(TYPESCRIPT) typescript@$(TYPESCRIPT_VERSION)
	@touch $@

# The documentation as a site in site/; a link that leads nowhere is an error.
docs: $(VENV)/installed-docs
	$(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) build site *.egg-info .import_linter_cache .mypy_cache .pytest_cache .ruff_cache .hypothesis

# A file stands for each finished step: a step that was interrupted runs again, one that is up to date does not.
$(VENV)/created:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || \
	  { echo "Python 3.11, 3.12 or 3.13 is needed; $(PYTHON) is not one. Try: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	$(PYTHON) -m venv --clear $(VENV)
	@touch $@

$(VENV)/installed: $(VENV)/created pyproject.toml constraints.txt
	@echo "Installing into $(VENV): some minutes the first time"
	$(PIP_INSTALL) --editable .
	@touch $@

$(VENV)/installed-dev: $(VENV)/created pyproject.toml constraints.txt
	@echo "Installing into $(VENV): some minutes the first time"
	$(PIP_INSTALL) --editable ".[dev]"
	@touch $@ $(VENV)/installed

$(VENV)/installed-docs: $(VENV)/created pyproject.toml constraints.txt
	@echo "Installing into $(VENV)"
	$(PIP_INSTALL) --editable ".[docs]"
	@touch $@
