# Start with `make demo` or `make test`. Both install what they need into the virtual environment .venv.
PYTHON ?= python3
VENV ?= .venv
DEMO ?= demo
BIN := $(VENV)/bin
TYPESCRIPT := $(VENV)/typescript
TYPESCRIPT_VERSION := 5.9.3
PIP_INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt

# Tests are small, so several processes of one thread each are faster than one process of several threads. The tests of
# a file share fixtures and therefore a process. The order of the folders starts long files first.
# Bytecode is cached, because the tests start many processes.
TEST_PROCESSES ?= 2
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 \
  $(BIN)/pytest --numprocesses $(TEST_PROCESSES) --dist loadfile --no-loadscope-reorder

SPELLED := api benchmarks deploy docs service sgsst_core tests worker *.md Makefile mkdocs.yml pyproject.toml

.PHONY: benchmarks demo test test-all test-slow stability coverage lint lint-page docs clean

# Stylize the built-in scene and print where the results are.
demo: $(VENV)/installed
	$(BIN)/sgsst weights fetch vgg16
	$(BIN)/sgsst demo --out $(DEMO)

# Run all checks of `lint`, and the tests that are not marked as slow; with FILES=..., only the fast tests of these paths.
test: $(if $(FILES),$(VENV)/installed-dev,lint)
ifdef FILES
	OMP_NUM_THREADS=1 $(BIN)/pytest -m "not slow" $(FILES)
else
	$(BIN)/sgsst weights fetch vgg16
	$(BIN)/python -m sgsst_core.bench.device_checks
	$(PYTEST) -m "not slow"
endif

# Run the slow tests: kills, whole runs, the wheel.
test-slow: $(VENV)/installed-dev
	$(BIN)/sgsst weights fetch vgg16
	$(PYTEST) -m slow

# Measure the hard cases against their float64 references at full size, and store them in benchmarks/results.
stability: $(VENV)/installed
	$(BIN)/sgsst weights fetch vgg16
	$(BIN)/python -m benchmarks.stability

# Run the benchmarks that need no GPU on a quiet machine, given a folder with scenes/ and styles/; a second call goes on.
benchmarks: $(VENV)/installed-dev
	$(BIN)/sgsst weights fetch vgg16
	$(BIN)/python -m benchmarks $(DATA)

# Run the fast tests, and list the lines that none of them executes, in any process.
coverage: $(VENV)/installed-dev
	$(BIN)/sgsst weights fetch vgg16
	$(BIN)/coverage erase
	-OMP_NUM_THREADS=1 $(BIN)/coverage run -m pytest --numprocesses $(TEST_PROCESSES) --dist loadfile -m "not slow"
	$(BIN)/coverage combine --quiet
	$(BIN)/coverage report --show-missing --skip-covered

test-all: test
	$(MAKE) test-slow

# Check formatting, lint, spelling, types and the directions of imports.
lint: $(VENV)/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/codespell $(SPELLED)
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	$(BIN)/pre-commit validate-config
	@$(MAKE) --no-print-directory lint-page

# Check the types in the JSDoc comments of the page's scripts. Only this check needs Node.js and npm; the page does not.
lint-page: $(VENV)/created
	@if ! command -v npm > /dev/null; then echo "npm is not on this machine: the page's types are not checked"; \
	elif ! $(MAKE) --silent $(TYPESCRIPT)/$(TYPESCRIPT_VERSION); then \
	  echo "npm could not fetch TypeScript: the page's types are not checked"; \
	else $(TYPESCRIPT)/node_modules/.bin/tsc --project .ci/tsconfig.json; fi

$(TYPESCRIPT)/$(TYPESCRIPT_VERSION): $(VENV)/created
	npm install --silent --no-save --prefix $(TYPESCRIPT) typescript@$(TYPESCRIPT_VERSION)
	@touch $@

# Build the documentation as a website in site/. Broken links are errors.
docs: $(VENV)/installed-docs
	$(BIN)/zensical build --clean --strict

clean:
	rm -rf $(VENV) build site *.egg-info .import_linter_cache .mypy_cache .pytest_cache .ruff_cache .hypothesis

# Each finished step touches a file, so an interrupted step runs again and an up-to-date one does not.
$(VENV)/created:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || \
	  { echo "Python 3.11, 3.12 or 3.13 is needed; $(PYTHON) is not one. Try: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	$(PYTHON) -m venv --clear $(VENV)
	@touch $@

$(VENV)/installed: $(VENV)/created pyproject.toml constraints.txt
	@echo "Installing into $(VENV): some minutes the first time"
	$(PIP_INSTALL) --editable ".[service,video,heif]"
	$(BIN)/python -m sgsst_core.bench.device_checks
	@touch $@

$(VENV)/installed-dev: $(VENV)/created pyproject.toml constraints.txt
	@echo "Installing into $(VENV): some minutes the first time"
	$(PIP_INSTALL) --editable ".[dev,service]"
	@touch $@ $(VENV)/installed

$(VENV)/installed-docs: $(VENV)/created pyproject.toml constraints.txt
	@echo "Installing into $(VENV)"
	$(PIP_INSTALL) --editable ".[docs]"
	@touch $@
