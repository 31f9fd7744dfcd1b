# One environment for users and developers: .venv. `make demo` and `make test` create it.
PYTHON ?= python3
BIN := .venv/bin
NOW := $(shell date +%Y%m%d-%H%M%S)

.PHONY: demo test test-all test-long check format examples bench bench-gpu docs linkcheck film release-check clean

demo: .venv/installed
	$(BIN)/qfolio train pendulum --no-compare --out runs/demo-$(NOW)/pendulum
	$(BIN)/qfolio backtest --test 4y --seeds 2 --out runs/demo-$(NOW)/portfolio
	@echo
	@echo "The two reports:"
	@echo "  runs/demo-$(NOW)/pendulum/report.html"
	@echo "  runs/demo-$(NOW)/portfolio/report.html"

# Two processes, each with whole files: most of a test's time is compiling, which keeps one core busy.
test: .venv/installed-dev
	$(BIN)/pytest -n 2 --dist loadfile -m "not slow and not optimized"

# Those that learn for long come last, with programs optimized as users have them.
test-all: .venv/installed-dev
	$(BIN)/pytest -n 2 --dist loadfile -m "not optimized and not long"
	QFOLIO_TEST_OPTIMIZED=1 $(BIN)/pytest -n 2 --dist loadfile -m "optimized and not long"

# One more learner, market or environment of a kind that `make test-all` has tested; before a release.
test-long: .venv/installed-dev
	QFOLIO_TEST_OPTIMIZED=1 $(BIN)/pytest -n 2 --dist loadfile -m long

check: .venv/installed-dev
	$(BIN)/ruff format --check
	$(BIN)/ruff check
	$(BIN)/mypy

format: .venv/installed-dev
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

# The first script that fails stops the others.
examples: .venv/installed
	set -e; for script in mandate own_agent own_signal_and_cost pendulum prices_to_orders; do \
		echo "examples/$$script.py"; $(BIN)/python examples/$$script.py; done

# The site, in docs/_build/html. Any warning fails: a broken link, a page that the navigation does not reach.
docs: .venv/installed-docs
	$(BIN)/sphinx-build --fail-on-warning --keep-going --quiet --doctree-dir docs/_build/doctrees docs docs/_build/html

# The links to other sites, which may fail for a day.
linkcheck: .venv/installed-docs
	$(BIN)/sphinx-build --builder linkcheck --doctree-dir docs/_build/doctrees --quiet docs docs/_build/linkcheck

# The wheel and the sdist in dist/, and a first session with the wheel in an environment that holds nothing else.
release-check: .venv/installed-release
	rm -rf dist .venv-wheel
	$(BIN)/python -m build
	$(BIN)/twine check --strict dist/*
	$(PYTHON) -m venv .venv-wheel
	.venv-wheel/bin/python -m pip install --quiet dist/*.whl
	.venv-wheel/bin/python -I .ci/try_wheel.py

# The moving pictures in docs/images. Needs Chromium.
film: .venv/installed-dev
	$(BIN)/python -m pip install --quiet --group film
	$(BIN)/python bench/film.py

bench: .venv/installed-dev
	$(BIN)/python bench/run.py

bench-gpu: .venv/installed
	$(BIN)/python bench/gpu.py

clean:
	rm -rf .venv .venv-bench .venv-wheel dist

.venv/installed: pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --editable ".[watch]"
	touch $@

.venv/installed-dev: .venv/installed
	$(BIN)/python -m pip install --quiet --group dev
	touch $@

.venv/installed-docs: .venv/installed-dev
	$(BIN)/python -m pip install --quiet --editable ".[docs]"
	touch $@

.venv/installed-release: .venv/installed
	$(BIN)/python -m pip install --quiet --group release
	touch $@
