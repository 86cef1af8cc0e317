# make demo     sets up what is missing, then localizes a simulated swarm through the live graph
# make test     lint, types, unit tests without ROS, node tests over DDS
# make bench-NAME [ARGS="..."]   prints a table, draws it under out/, writes out/bench/NAME.json
# make test-lowest   unit tests with the oldest versions that requirements/workspace.txt allows
# make lock      writes the versions and hashes of the wheels that the set-up installs
# make compiled  compiles all inner loops into a wheel for other machines: out/wheels
# make house     prints the figures of the layout, writes out/bench/house.json
# make docs      builds the documentation site: out/docs/index.html
# make setup | lint | types | unit | node | clean

PYTHON ?= python3
PACKAGES := swarm_loc_estimator swarm_loc_vision swarm_loc_drivers
MYPY := ./run -- mypy --num-workers 2
# Only the plug-ins named here: what else is installed on a machine must not change how tests run.
PYTEST := ./run -- env PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 pytest \
    -p xdist.plugin -p pytest_timeout -p _hypothesis_pytestplugin --numprocesses 2 --dist worksteal

.PHONY: demo test lint types unit node test-lowest lock compiled house docs setup clean

demo: setup
	@./run swarm_loc_estimator demo $(ARGS)

test: setup lint unit node

lint:
	./run -- ruff check
	./run -- ruff format --check
	@$(MAKE) --no-print-directory types

# Tests are a call of their own, since two files named conftest.py cannot be of one.
types:
	$(MYPY) conftest.py bench docs tools $(join $(PACKAGES:=/),$(PACKAGES)) $(wildcard $(PACKAGES:=/examples))
	$(MYPY) $(wildcard $(PACKAGES:=/launch) $(PACKAGES:=/test))

unit: setup
	@$(PYTEST) $(wildcard $(PACKAGES:=/test/unit)) bench/test tools/test $(ARGS)

node: setup
	@$(PYTEST) $(wildcard $(PACKAGES:=/test/node)) $(ARGS)

# The oldest numba supports Python 3.11 at most.
LOWEST := .workspace/lowest
test-lowest: setup
	@./run -- uv venv --quiet --allow-existing --python 3.11 $(LOWEST)
	@./run -- uv pip install --quiet --python $(LOWEST) --resolution lowest-direct --requirement requirements/workspace.txt
	@env PYTHONPATH="$(CURDIR)/swarm_loc_estimator:$(CURDIR)/swarm_loc_vision:$(CURDIR)/swarm_loc_drivers" \
	    PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 $(LOWEST)/bin/python -m pytest \
	    -p xdist.plugin -p pytest_timeout -p _hypothesis_pytestplugin --numprocesses 2 --dist worksteal --timeout 600 \
	    -W ignore::DeprecationWarning $(wildcard $(PACKAGES:=/test/unit)) $(ARGS)

setup:
	@$(PYTHON) tools/setup_workspace.py

# The same versions as before where they still fit; UPGRADE=--upgrade takes the newest.
LOCK := ./run -- uv pip compile --quiet --generate-hashes --no-annotate --no-header $(UPGRADE)
lock: setup
	@$(LOCK) --universal --python-version 3.10 --override requirements/overrides.txt \
	    --output-file requirements/workspace.lock requirements/ros.txt requirements/workspace.txt
	@echo 'uv>=0.5,<1' | $(LOCK) --universal --python-version 3.10 --output-file requirements/uv.lock -

compiled: setup
	@./run -- python tools/compiled_wheel.py $(ARGS)

house: setup
	@./run -- python tools/house.py $(ARGS)

# Draws diagrams in the browser: one file of the package, without what it depends on.
.workspace/mermaid/mermaid.min.js: Makefile
	@mkdir -p $(@D)
	@npm pack --silent --pack-destination $(@D) mermaid@11.17.2 >/dev/null
	@tar --extract --touch --file $(@D)/mermaid-11.17.2.tgz --directory $(@D) --strip-components 2 package/dist/mermaid.min.js
	@rm $(@D)/mermaid-11.17.2.tgz

# The README is the start page, under its own name for links and as the index.
docs: .workspace/mermaid/mermaid.min.js
	@$(PYTHON) tools/setup_workspace.py --extra docs
	@./run -- sphinx-build --quiet --fail-on-warning --keep-going -c docs --doctree-dir .workspace/doctrees . out/docs
	@cp out/docs/README.html out/docs/index.html
	@echo "Written: out/docs/index.html"

bench-%:
	@$(PYTHON) tools/setup_workspace.py --extra bench
	@./run -- python -m bench $* $(ARGS)

clean:
	rm -rf .venv .workspace out .mypy_cache .pytest_cache .ruff_cache .hypothesis
