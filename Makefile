# Installs the pinned packages, once, and runs the everyday commands. `make help` lists them.

# Any Python that is new enough: make run PYTHON=python3.12
PYTHON ?= python3
# Passed on to kedro or pytest: make run ARGS=--env=smoke
ARGS ?=

.DEFAULT_GOAL := help
.PHONY: run test test-fast check docs help

run: .venv/.package  ## install, then train and evaluate the augmentation study
	.venv/bin/kedro run --pipeline=augmentation $(ARGS)

# Each core runs a file at a time; files with slow tests come first, as tests/conftest.py sorts them.
PYTEST = .venv/bin/python -m pytest --numprocesses=auto --dist=loadfile --no-loadscope-reorder

test: .venv/.package  ## run all tests
	$(PYTEST) $(ARGS)

test-fast: .venv/.package  ## run all tests but the slow ones
	$(PYTEST) -m "not slow" $(ARGS)

check: .venv/.package  ## lint, formatting and types
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy src

docs: .venv/.package  ## build the documentation, build/site/index.html
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --quiet

help:  ## list the commands
	@sed -n 's/^\([a-z-]*\):.*## /  make \1\t/p' Makefile | expand -t 52
	@echo "After installation and '. .venv/bin/activate':"
	@sed -n 's/^#> /  /p' Makefile

#> kedro run                                         train and evaluate the main studies, report
#> kedro run --pipeline=augmentation                 a study; others: real2real, input_channels,
#>                                                   estimators, unseen_devices, first_windows,
#>                                                   networks, leakage
#> kedro run --pipeline=sweep --params=sweep.learning_rate=1e-4/1e-3
#>                                                   a network with a grid of settings
#> kedro run --pipeline=ground_truth                 biases and noise figures, no training
#> kedro run --pipeline=virtual_gyros                the same, and the virtual gyroscopes
#> kedro run --pipeline=reporting                    tables, figures and report of stored runs
#> kedro run --env=smoke                             a small study for a first try; others are in conf/
#> kedro run --pipeline=ground_truth --env=logs --params=logs=FOLDER
#>                                                   biases of your own log files
#> kedro registry list                               the pipelines
#> kedro viz                                         a view of the pipelines: http://127.0.0.1:4141/?types=task
#> mlflow ui                                         the runs in the browser
#> gyro-calibrate log FILE                           the bias from a log of a gyroscope at rest

# The stamps are written last: an interrupted installation has none, and starts again.
.venv/.requirements: requirements.lock
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("Python 3.11 or newer is \
	needed, and $(PYTHON) is " + sys.version.split()[0] + ". Name another: PYTHON=python3.12")'
	@echo "Installing the pinned requirements into .venv; this takes some minutes, once."
	$(PYTHON) -m venv --clear .venv
	.venv/bin/python -m pip install --disable-pip-version-check -r requirements.lock
	@touch $@

# The build backend comes from the lock as well, so that nothing else is fetched.
.venv/.package: .venv/.requirements pyproject.toml
	.venv/bin/python -m pip install --disable-pip-version-check --quiet \
	    --no-deps --no-build-isolation --editable .
	@touch $@
