.DEFAULT_GOAL := help
.PHONY: help install demo test lint format clean

PYTHON ?= python3
BIN := .venv/bin
DEMO := runs/demo

help: ## show this list
	@grep -E '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

install: ## make .venv and put forewarp with all its extras into it
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet uv
	links="$$($(BIN)/pip config get global.find-links 2>/dev/null || echo "$$PIP_FIND_LINKS")"; \
	if [ -n "$$links" ]; then export UV_FIND_LINKS="$$links"; fi; \
	VIRTUAL_ENV="$$PWD/.venv" $(BIN)/uv pip install -c constraints.txt -e '.[cpu,synth,plots,dev]'

demo: ## fit the procedural vehicle forward and backward, compare, make a video (three minutes)
	$(BIN)/forewarp-train experiment=demo run=$(DEMO)/forward
	$(BIN)/forewarp-train experiment=demo model=backward run=$(DEMO)/backward
	$(BIN)/forewarp-render run=$(DEMO)/forward path=both
	$(BIN)/python -m forewarp.cli.compare $(DEMO)/forward $(DEMO)/backward

test: ## run the tests, but for the slow ones
	$(BIN)/pytest --no-cov -m "not slow"

lint: ## look for mistakes and untidy code
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: ## tidy the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean: ## remove what tests and tools leave behind; runs/ and data/ stay
	rm -rf .pytest_cache .ruff_cache .hypothesis .coverage build dist
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +
