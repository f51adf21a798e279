# `make help` lists the targets. Every target makes .venv first and installs what it needs into it.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
export PYTHONSAFEPATH := 1
SEED ?= 0
REPEAT ?= 50
JOBS ?= 2
PROFILE ?= small

.PHONY: help setup setup-robots system demo demo-robots serve test test-slow test-robots audit lint types imports format bench-acquire \
	bench-score bench-import bench-simulators bench-labels bench-robot-projects bench-policies bench-world-model \
	bench-paper-minigrid bench-paper-minigrid-full bench-paper-robots clean
.DEFAULT_GOAL := help

help: ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-26s %s\n", $$1, $$2}'

setup: $(VENV)/.installed ## .venv with everything that demo and test need

$(VENV)/.installed: pyproject.toml constraints.txt scripts/system-packages
	scripts/system-packages python
	test -x $(BIN)/python || $$(command -v $(PYTHON) || command -v python3) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev]'
	touch $@

setup-robots: $(VENV)/.robots ## what the robot simulators need besides

# The simulators themselves come without their dependencies: what they import for our tasks is in the two groups.
$(VENV)/.robots: $(VENV)/.installed
	scripts/system-packages robots
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[robosuite,maniskill]'
	$(BIN)/python -m pip install --quiet --no-deps -c constraints.txt robosuite mani-skill sapien
	touch $@

system: ## Debian packages for everything, tests included (as root; otherwise prints the command)
	scripts/system-packages all

demo: setup ## the whole loop on MiniGrid, the default strategy beside random, no server needed (SEED=n for another seed)
	$(BIN)/asim demo --seed $(SEED)

demo-robots: setup-robots ## the same loop on robot arms seen by two cameras, Lift and then PullCube (SEED=n)
	$(BIN)/asim demo --simulator robosuite --seed $(SEED)
	$(BIN)/asim demo --simulator maniskill --seed $(SEED)

serve: setup ## the service on ./asim-data at http://127.0.0.1:8000
	$(BIN)/asim serve

test: setup-robots lint types imports ## what CI runs: lint, types, import contracts, tests
	scripts/system-packages all
	$(BIN)/python -m pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder

test-slow: setup ## the long tests: kills at random moments, scale (REPEAT=5 shortens the kills; ASIM_TEST_SEED=n repeats)
	scripts/system-packages all
	REPEAT=$(REPEAT) $(BIN)/python -m pytest -m slow

audit: setup-robots ## known vulnerabilities of everything installed (asks PyPI; says so and fails where it cannot)
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[audit]'
	$(BIN)/python scripts/audit.py

test-robots: setup-robots ## the long tests of the robot simulators: whole episodes replayed, kills at random moments
	$(BIN)/python -m pytest -m robots

lint: setup ## ruff
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup ## mypy, strict
	$(BIN)/mypy

imports: setup ## the arrows between packages
	$(BIN)/lint-imports

format: setup ## let ruff put the code in form
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench-acquire: setup ## latency of POST /acquire with a ready queue
	$(BIN)/python -m benchmarks.service.acquire

bench-score: setup ## the scoring job beside the networks' bare forward pass
	$(BIN)/python -m benchmarks.service.score

bench-import: setup-robots ## import of image trajectories beside the store's own codec, and memory over 5,000 of them
	$(BIN)/python -m benchmarks.service.imports

bench-simulators: setup-robots ## steps a second of every robot task, and a picture of an episode of each
	$(BIN)/python -m benchmarks.simulators

bench-labels: setup-robots ## labels of robot tasks by replay and by search: right ones, errors, cost
	$(BIN)/python -m benchmarks.simulators.labels

bench-policies: setup-robots ## diffusion policies of Lift and PullCube: success over their stages, time of training
	$(BIN)/python -m benchmarks.simulators.policies

bench-robot-projects: setup-robots ## every robot task through the service: collected, acquired, labeled, compared (an hour)
	$(BIN)/python -m benchmarks.simulators.projects

bench-world-model: setup ## a training step of the robots' world model beside its bare products (ARGS="--device cuda --compile")
	$(BIN)/python -m benchmarks.world_model $(ARGS)

bench-paper-minigrid: setup ## the paper's MiniGrid figures, resumable (QUICK=1: 4a and 4d with four arms)
	$(BIN)/python -m benchmarks.paper.minigrid $(if $(QUICK),--quick)

bench-paper-minigrid-full: setup ## the same with every strategy under every batch rule: hours, resumable
	$(BIN)/python -m benchmarks.paper.minigrid --full

bench-paper-robots: setup-robots ## the paper's figure on manipulation, resumable (PROFILE=quick, small or paper; ARGS="--task Lift --device cuda")
	$(BIN)/python -m benchmarks.paper.robots --profile $(PROFILE) $(ARGS)

clean: ## remove .venv and caches
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache .import_linter_cache *.egg-info
