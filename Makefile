# make demo     sets up what is missing, then localizes a simulated swarm through the live graph
# make test     lint, types, unit tests without ROS, node tests over DDS
# make bench-NAME [ARGS="..."]   prints a table, writes out/bench/NAME.json
# make setup | lint | clean

PYTHON ?= python3
export PYTHON

.PHONY: demo test lint setup clean

demo: setup
	./run swarm_loc_estimator demo $(ARGS)

test: setup
	./run -- workspace/check all

lint: setup
	./run -- workspace/check lint

setup:
	@$(PYTHON) setup_workspace.py

bench-%:
	@$(PYTHON) setup_workspace.py --bench
	./run -- python swarm_loc_estimator/bench/$*.py $(ARGS)

clean:
	rm -rf .venv .workspace out
	rm -rf .mypy_cache .pytest_cache .ruff_cache .hypothesis
