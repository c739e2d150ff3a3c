.DEFAULT_GOAL := help
.PHONY: help install install-launchers install-trackers install-browser constraints demo demo-lego-complete demo-hypernerf demo-nhr test test-slow \
	test-floors fuzz \
	conformance test-stability bench bench-gpu effects accuracy-time price-list reproduce-tables ablations docs docs-serve \
	lint format clean
SHELL := bash
.SHELLFLAGS := -o pipefail -c
unexport PYTHONDONTWRITEBYTECODE # what pytest rewrites is compiled once
PYTHON ?= python3
BIN := .venv/bin
# Install forewarp with the extras that follow, from where pip is told to look.
LINKS = links="$$($(BIN)/pip config get global.find-links 2>/dev/null || echo "$$PIP_FIND_LINKS")"; \
	if [ -n "$$links" ]; then export UV_FIND_LINKS="$$links"; fi
ADD = $(LINKS); VIRTUAL_ENV="$$PWD/.venv" $(BIN)/uv pip install --compile-bytecode -c constraints.txt -e
KEYS := DATA SCENES METHODS MODEL PRESET MINUTES STEPS SEEDS SWEEPS CHANGES VIEWS OUT JOBS THREADS LAUNCHER DEVICE MORE SMALL PLAN_ONLY
REPRODUCE = $(BIN)/forewarp-reproduce $(1) $(foreach key,$(KEYS),$(if $(findstring command,$(origin $(key))),$(key)='$($(key))'))

help: ## show this list
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 20

install: ## create .venv with forewarp and all extras except the launchers of sweeps
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet uv
	$(ADD) '.[cpu,synth,plots,viewer,export,usd,capture,dev]'
install-launchers: ## add joblib, Ray and submitit for sweeps (launcher=...), and Optuna (sweeps=search)
	$(ADD) '.[sweeps]'
install-trackers: ## add Weights & Biases and MLflow (logger=wandb, logger=mlflow)
	$(ADD) '.[trackers]'
install-browser: ## add a headless Chromium and playwright, which test the viewer's page; as root, on Debian
	command -v chromium >/dev/null || { apt-get update -qq && \
		apt-get install -y -qq --no-install-recommends chromium fonts-dejavu-core >/dev/null; }
	$(ADD) '.[browser]'
constraints: ## write constraints.txt anew: the versions installed here, once .ci/run has passed with them
	@$(LINKS); $(BIN)/uv pip freeze -q --exclude-editable | sed -n 's/^\([^ @]*==[^+ ]*\)\(+.*\)\?$$/\1/p' > constraints.new
	@$(LINKS); $(BIN)/uv pip compile -q --universal --python-version 3.10 --no-header --no-annotate pyproject.toml \
		$(foreach extra,cpu synth plots viewer export usd capture dev trackers browser docs,--extra $(extra)) -o constraints.new
	@{ sed -n '/^#/p' constraints.txt; grep -vE '^($(UNPINNED))' constraints.new; } > constraints.both && rm constraints.new
	@mv constraints.both constraints.txt && wc -l constraints.txt
# Chosen by platform, or wanted in other versions by launchers of sweeps and by MLflow.
UNPINNED = nvidia-|cuda-|triton=|pywin32=|waitress=|colorama=|setuptools=|sqlalchemy=|cloudpickle=|joblib=|alembic=

demo: ## fit the procedural vehicle by three methods, two at once, compare, make a video and a page (about three minutes of two cores) [MINUTES=]
	$(BIN)/forewarp-reproduce demo $(if $(MINUTES),minutes=$(MINUTES))
demo-lego-complete: ## build a small counterpart of Lego Complete, fit a scene, evaluate, make a video
demo-hypernerf: ## the same for a two-phone rig in a textured room, with a static background
demo-nhr: ## the same for a dome of cameras with masks
demo-lego-complete demo-hypernerf demo-nhr:
	$(BIN)/forewarp-train experiment=$(subst -,_,$@) run=runs/$@
	$(BIN)/forewarp-render run=runs/$@ path=both

WORKERS ?= logical
PYTEST = pytest --no-cov -n $(WORKERS) --maxprocesses 4 --dist loadfile
test: ## run the tests except the slow ones, on every core up to four [WORKERS=0: in one process]
	$(BIN)/$(PYTEST) -m "not slow"
test-slow: ## run the slow tests: the page in a browser, killed runs, every method, every sweep's jobs, the wheel
	$(BIN)/$(PYTEST) -m slow
test-stability: ## run the numerical hard cases and killed runs, slow ones too
	$(BIN)/pytest --no-cov -m stability tests/stability
FLOORS := .venv-floors
test-floors: ## run the same tests with the lowest versions that pyproject.toml admits, in .venv-floors
	test -x $(FLOORS)/bin/python || $(PYTHON) -m venv $(FLOORS)
	$(FLOORS)/bin/pip install --quiet uv
	$(LINKS); VIRTUAL_ENV="$$PWD/$(FLOORS)" $(FLOORS)/bin/uv pip install --resolution lowest-direct \
		-e '.[cpu,synth,plots,viewer,export,usd,capture,dev]'
	$(FLOORS)/bin/$(PYTEST) -W default -m "not slow" # they warn of what came later
fuzz: ## read 5,000 harmed files of every format, the same each time: none may take 10 s of the processor, a gigabyte, or a traceback
	OMP_NUM_THREADS=1 $(BIN)/pytest --no-cov -q -s tests/stability/test_fuzzing.py --hypothesis-profile=fuzz
conformance: ## test every method against the contract, slow cases too, and write docs/results/conformance.md
	OMP_NUM_THREADS=1 $(BIN)/pytest --no-cov -q tests/contract/test_contract.py --conformance=docs/results/conformance.md
bench: ## time every operator, a step and a frame, into docs/results/performance.md (a quarter of an hour)
	$(BIN)/python -m tests.bench.performance

accuracy-time: ## accuracy of each choice against training time [MODEL=forward DATA= SCENES= MINUTES= CHANGES= SEEDS=3]
price-list: ## what each choice costs and brings, on the vehicle and real scenes [MODEL=forward DATA= SCENES="a b" MINUTES= CHANGES=]
ablations: ## what each part of the paper's method brings, at equal minutes and at equal steps, or at rest [PRESET=compact DATA= MINUTES= STEPS= SEEDS=3 OUT= SMALL=1]
effects: ## what scenes call for, beside the preset, every effect and none [MODEL=forward DATA= SCENES="a b" MINUTES= SEEDS=]
accuracy-time price-list ablations effects:
	$(call REPRODUCE,$@)
reproduce-tables: ## the paper's tables, measured beside published [DATA= METHODS="dnerf ndvg", or all; PRESET= SCENES= MINUTES= SEEDS=3 SWEEPS=all]
	$(call REPRODUCE,tables)
bench-gpu: ## seconds of steps and frames, and PSNR against seconds, of model=forward on a GPU [DATA= SCENES= MINUTES= DEVICE=cpu SMALL=1]
	$(call REPRODUCE,gpu)

docs: ## build the docs site into site/, from which it opens without a network; warnings are errors
	@$(MKDOCS) build --strict --quiet
	@echo "written: site/index.html"
docs-serve: ## show the docs site on 127.0.0.1:8000, and anew after each change
	@$(MKDOCS) serve
MKDOCS = { $(BIN)/python -c 'import material, mkdocstrings_handlers.python' 2>/dev/null || { $(ADD) '.[docs]'; }; } && \
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs
lint: ## check code and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
format: ## fix what can be fixed, and format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
clean: ## remove caches and builds; runs/ and data/ stay
	rm -rf .pytest_cache .ruff_cache .hypothesis .coverage build dist site
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +
