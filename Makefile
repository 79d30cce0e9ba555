# Install what is pinned, once, and run the everyday commands. `make help` lists them.

# Any Python that is new enough: make run PYTHON=python3.12
PYTHON ?= python3
# Passed on to kedro or pytest: make run ARGS=--env=smoke
ARGS ?=

.DEFAULT_GOAL := help
.PHONY: run test test-fast check docs help

run: .venv/.package  ## install, then train and evaluate the augmentation study
	.venv/bin/kedro run --pipeline=augmentation $(ARGS)

# A file at a time on each core; files with slow tests come first, as tests/conftest.py sorts them.
PYTEST = .venv/bin/python -m pytest --numprocesses=auto --dist=loadfile --no-loadscope-reorder

test: .venv/.package  ## run all tests
	$(PYTEST) $(ARGS)

test-fast: .venv/.package  ## run the tests without the slow ones, while at work
	$(PYTEST) -m "not slow" $(ARGS)

check: .venv/.package  ## lint, formatting and types
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/mypy src

docs: .venv/.package  ## build the site of the documentation, build/site/index.html
	NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs build --quiet

help:  ## list the commands
	@sed -n 's/^\([a-z-]*\):.*## /  make \1\t/p' Makefile | expand -t 52
	@echo "After installation and '. .venv/bin/activate':"
	@sed -n 's/^#> /  /p' Makefile

#> kedro run                                         train and evaluate the main studies, report
#> kedro run --pipeline=augmentation                 one study; or: real2real, input_channels,
#>                                                   estimators, unseen_devices, first_windows,
#>                                                   networks, leakage
#> kedro run --pipeline=sweep --params=sweep.learning_rate=1e-4/1e-3
#>                                                   a network with each of some settings
#> kedro run --pipeline=ground_truth                 biases and noise figures, no training
#> kedro run --pipeline=virtual_gyros                the virtual gyroscopes as well
#> kedro run --pipeline=reporting                    tables, figures and report of what was run
#> kedro run --env=smoke                             a small study, to try things; others are in conf/
#> kedro run --pipeline=ground_truth --env=logs --params=logs=FOLDER
#>                                                   biases of log files of your own
#> kedro registry list                               the pipelines
#> kedro viz                                         the pipelines drawn: http://127.0.0.1:4141/?types=task
#> mlflow ui                                         the runs, in the browser
#> gyro-calibrate log FILE                           the bias of one still log

# The stamps are written last: an interrupted installation has none, and is started anew.
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
