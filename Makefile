# make demo     sets up what is missing, then localizes a simulated swarm through the live graph
# make test     lint, types, unit tests without ROS, node tests over DDS
# make bench-NAME [ARGS="..."]   prints a table, draws it under out/, writes out/bench/NAME.json
# make setup | lint | unit | node | clean

PYTHON ?= python3
PACKAGES := swarm_loc_estimator swarm_loc_vision swarm_loc_drivers
# Only the plug-ins named here: what else is installed on a machine must not change how tests run.
PYTEST := ./run -- env PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 pytest \
    -p xdist.plugin -p pytest_timeout -p _hypothesis_pytestplugin --numprocesses 2

.PHONY: demo test lint unit node setup clean

demo: setup
	@./run swarm_loc_estimator demo $(ARGS)

test: lint unit node

lint:
	./run -- ruff check
	./run -- ruff format --check
	./run -- mypy conftest.py setup_workspace.py
	@set -e; for package in $(PACKAGES); do \
	    for part in $$package launch test bench workspace; do \
	        if [ -n "$$(find $$package/$$part -name '*.py' 2>/dev/null)" ]; then \
	            echo "./run -- mypy $$package/$$part"; ./run -- mypy $$package/$$part; \
	        fi; \
	    done; \
	done

unit: setup
	@$(PYTEST) $(wildcard $(PACKAGES:=/test/unit)) $(ARGS)

node: setup
	@$(PYTEST) $(wildcard $(PACKAGES:=/test/node)) $(ARGS)

setup:
	@$(PYTHON) setup_workspace.py

bench-%:
	@$(PYTHON) setup_workspace.py --bench
	@PYTHONPATH=swarm_loc_estimator:swarm_loc_vision/bench ./run -- python -m bench.$* $(ARGS)

clean:
	rm -rf .venv .workspace out .mypy_cache .pytest_cache .ruff_cache .hypothesis
