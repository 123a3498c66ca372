# Two commands do everything on a fresh machine: `make run` and `make test`. `make help`
# lists the rest.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: help run colonies test quick lint types docs bench clean

run: $(STAMP)  ## search for a circuit that draws a stripe (a minute or two)
	$(BIN)/python experiments/boundary_stripe.py --colonies 500 --out runs/stripe

colonies: $(STAMP)  ## grow 16 colonies of 500 cells in one batch (half a minute)
	$(BIN)/torchfilm run microcolony --colonies 16 --cells 500 --out runs/colonies.h5 --overwrite

test: $(STAMP)  ## all tests
	$(BIN)/python -m pytest -n 2

quick: $(STAMP)  ## the tests that take under a second each
	$(BIN)/python -m pytest -n 2 -m "not slow"

lint: $(STAMP)  ## ruff: style and errors
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)  ## mypy
	$(BIN)/mypy

docs: $(STAMP)  ## build the documentation into site/
	$(BIN)/python -m pip install -q -c constraints.txt -e ".[docs]"
	$(BIN)/mkdocs build --strict -q

bench: $(STAMP)  ## the benchmarks of growth and of design, small sizes
	$(BIN)/python experiments/benchmarks/growth.py --quick --out runs/growth.json
	$(BIN)/python experiments/benchmarks/search.py rate --cells 100 --designs 16 --out runs/rate.json

clean:  ## remove what was built
	rm -rf $(VENV) runs site

help:  ## this list
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):[^#]*## /  make \1\t/' | expand -t 16

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q -c constraints.txt -e ".[app,design,bayes,pareto,infer,cluster,images,tables,notebook,sbml,dev]"
	touch $@
