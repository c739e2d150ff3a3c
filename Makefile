.DEFAULT_GOAL := help
.PHONY: help install install-launchers install-browser demo demo-particles demo-forward demo-backward tables-vehicle tables-captures demo-lego-complete demo-hypernerf demo-nhr test conformance test-slow test-stability bench bench-gpu effects accuracy-time price-list reproduce-tables ablations docs docs-serve lint format clean

PYTHON ?= python3
BIN := .venv/bin
DEMO := runs/demo
# For accuracy-time and price-list: a folder that holds dnerf/ (none: the procedural vehicle), a scene of it, minutes of
# training a run, how many seeds, MODEL=forward for the paper's method instead of particles, and, to compare less than
# sweeps/price_list_<model>.yaml does, CHANGES="stage.fine.density=45,180".
DATA ?=
SCENE ?= jumpingjacks
SCENES ?= jumpingjacks hook
MINUTES ?= 3
MODEL ?=
DEVICE ?= gpu
SHELL := bash
.SHELLFLAGS := -o pipefail -c
MORE = budget.minutes=$(MINUTES) $(SEED) $(if $(THREADS),threads=$(THREADS))
comma := ,
# SEEDS=3: run each job with seeds 0, 1 and 2; SEEDS=4,7: with these.
SEED = $(if $(SEEDS),$(if $(findstring $(comma),$(SEEDS)),seed,seeds)=$(SEEDS))
# Begin each line of jobs that run side by side with the job's name; leave Ctrl-C to the job itself.
SAYS = 2>&1 | { trap '' INT; sed -u 's/^/$@ | /'; }
# All changes of the method's price list; with CHANGES the reference, then these.
OF_MODEL = $(if $(MODEL),model=$(MODEL))
KNOWN_LIST = $(if $(filter-out particles forward,$(MODEL)),$(error MODEL: expected particles or forward, but got $(MODEL)))
SWEEP = sweep() { $(BIN)/forewarp-train --multirun "$$@" $(MORE); }; \
	compare() { $(if $(CHANGES),sweep sweeps=accuracy_time $(OF_MODEL) "$$@" $(GO_ON); sweep sweeps=accuracy_time $(OF_MODEL) "$$@" $(CHANGES),$(KNOWN_LIST)sweep sweeps=price_list_$(or $(MODEL),particles) "$$@"); }
space := $(subst ,, )
# A failed job has printed its error and stops no other job; make ends with its status. Only Ctrl-C ends everything.
GO_ON = || { status=$$?; [ $$status -lt 128 ] || exit $$status; }

# Install forewarp with the extras that follow, from where pip is told to look.
ADD = links="$$($(BIN)/pip config get global.find-links 2>/dev/null || echo "$$PIP_FIND_LINKS")"; \
	if [ -n "$$links" ]; then export UV_FIND_LINKS="$$links"; fi; \
	VIRTUAL_ENV="$$PWD/.venv" $(BIN)/uv pip install --compile-bytecode -c constraints.txt -e

help: ## show this list
	@grep -E '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 20

install: ## create .venv with forewarp and all extras except the launchers of sweeps
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet uv
	$(ADD) '.[cpu,synth,plots,viewer,export,capture,dev]'

install-launchers: ## add joblib, Ray and submitit for sweeps (launcher=...), and Optuna (sweeps=search)
	$(ADD) '.[sweeps]'

install-browser: ## add a headless Chromium and playwright, which test the viewer's page; as root, on Debian
	command -v chromium >/dev/null || { apt-get update -qq && \
		apt-get install -y -qq --no-install-recommends chromium fonts-dejavu-core >/dev/null; }
	$(ADD) '.[browser]'

demo: ## fit the procedural vehicle by three methods, two at once, compare, make a video (about three minutes)
	@$(MAKE) --no-print-directory -j2 demo-particles demo-forward demo-backward
	$(BIN)/forewarp-report kind=compare runs=[$(DEMO)/particles,$(DEMO)/forward,$(DEMO)/backward] out=$(DEMO)
	$(BIN)/forewarp-render run=$(DEMO)/particles path=both

# Kernels of particles compile for half a minute the first time, beside the others' training.
DEMO_MINUTES := 0.3
demo-particles demo-forward demo-backward: demo-%:
	$(BIN)/forewarp-train experiment=demo model=$* threads=1 budget.minutes=$(DEMO_MINUTES) run=$(DEMO)/$* $(SAYS)

demo-lego-complete: ## build a small counterpart of Lego Complete, fit a scene, evaluate, make a video
demo-hypernerf: ## the same for a two-phone rig in a textured room, with a static background
demo-nhr: ## the same for a dome of cameras with masks
demo-lego-complete demo-hypernerf demo-nhr:
	$(BIN)/forewarp-train experiment=$(subst -,_,$@) run=runs/$@
	$(BIN)/forewarp-render run=runs/$@ path=both

test: ## run the tests except the slow ones
	$(BIN)/pytest --no-cov -m "not slow"

test-slow: ## run the slow tests: the page in a browser, killed runs, every method on every dataset, every sweep's jobs, the wheel
	$(BIN)/pytest --no-cov -m slow

conformance: ## test every method against the contract, slow cases too, and write docs/conformance.md
	OMP_NUM_THREADS=1 $(BIN)/pytest --no-cov -q tests/contract/test_contract.py --conformance=docs/conformance.md

test-stability: ## run the numerical hard cases and killed runs, slow ones too
	$(BIN)/pytest --no-cov -m stability tests/stability

bench: ## time every operator, a step and a frame, into docs/performance.md (a quarter of an hour)
	$(BIN)/python -m tests.bench.performance

TINY = data.scene=tiny paths.data=runs/bench-gpu data.synthesis.size=32 data.synthesis.frames=8 \
	data.synthesis.test_views=[1,1,1] preset.rays=64 preset.inpainter_width=16 data.held_out=2 budget.iterations=12 \
	stage.coarse.num_voxels=[[0,1000]] stage.fine.num_voxels=[[0,1500]]
bench-gpu: MINUTES := $(if $(filter command line,$(origin MINUTES)),$(MINUTES),10)
bench-gpu: ## seconds of steps and frames, and PSNR against seconds, of model=forward on a GPU [DATA= SCENES="a b" MINUTES= DEVICE=cpu SMALL=1]
	status=0; for scene in $(if $(DATA),$(SCENES),vehicle); do \
		bench() { $(BIN)/forewarp-train model=forward trainer=$(DEVICE) $(if $(DATA),paths.scenes=$(DATA) dataset=dnerf data.scene=$$scene,data.scene=$$scene) \
			+variant.name=base "$$@" $(if $(SMALL),$(TINY)) $(GO_ON); }; \
		bench preset=fast data.held_out=8 budget.minutes=$(MINUTES) run=runs/bench-gpu/$$scene-fast; \
		bench preset=faithful budget.minutes=null budget.iterations=240 run=runs/bench-gpu/$$scene-faithful; \
	done; \
	for kind in accuracy_time price_list; do \
		$(BIN)/forewarp-report kind=$$kind runs=runs/bench-gpu out=runs/bench-gpu/results $(GO_ON); \
	done; exit $$status

RENAMED = $(if $(VARIANTS),$(error VARIANTS: expected MODEL=forward CHANGES="preset.rays=1024$(comma)2048"; variants are gone since 0.3))
accuracy-time: ## accuracy of each choice against training time [MODEL=forward DATA= SCENE= MINUTES= CHANGES= SEEDS=3]
	@$(RENAMED)
	status=0; $(SWEEP); compare $(if $(DATA),paths.scenes=$(DATA) dataset=dnerf data.scene=$(SCENE)) $(GO_ON); \
	$(BIN)/forewarp-report kind=accuracy_time && exit $$status

price-list: SEEDS ?= 2
price-list: LISTED := runs/price-list/$(or $(MODEL),particles)
price-list: ## what each choice costs and brings, on the vehicle and real scenes [MODEL=forward DATA= SCENES="a b" MINUTES= CHANGES=]
	@$(RENAMED)
	@test -n "$(DATA)" || { echo "price-list: expected DATA=<folder that holds dnerf/>"; exit 2; }
	status=0; $(SWEEP); compare paths.runs=$(LISTED) $(GO_ON); \
	for scene in $(SCENES); do \
		compare paths.runs=$(LISTED) paths.scenes=$(DATA) dataset=dnerf data.scene=$$scene $(GO_ON); \
	done; \
	$(BIN)/forewarp-report kind=price_list runs=$(LISTED) out=docs/results && exit $$status

COMPARE = $(BIN)/forewarp-train --multirun sweeps=effects $(if $(THREADS),threads=$(THREADS))
effects: MINUTES := $(if $(filter command line,$(origin MINUTES)),$(MINUTES),$(if $(filter particles,$(MODEL)),0.5,2))
effects: SEEDS ?= 2
# Three specimens are made for effects that particles alone have; they have no fixed set to compare a plan with.
SPECIMENS := still,rigid,band,glossy,room,quick,daylight,blocks,spin
effects: ## planned effects of model=forward against all effects, on procedural or real scenes [DATA= SCENES="a b" MINUTES= SEEDS=]; plans of MODEL=particles
ifneq ($(filter-out particles forward,$(MODEL)),)
	$(error MODEL: expected forward or particles, which can be planned, but got $(MODEL))
else ifeq ($(MODEL),particles)
	@status=0; $(COMPARE) $(SEED) model=particles ablation=auto budget.minutes=$(MINUTES) $(if $(DATA),paths.scenes=$(DATA)) \
		$(if $(DATA),dataset=dnerf data.scene=$(subst $(space),$(comma),$(SCENES)),scene=specimen_$(subst $(comma),$(comma)specimen_,$(SPECIMENS))) $(GO_ON); \
	$(BIN)/forewarp-report kind=effects && exit $$status
else ifeq ($(DATA),)
	@status=0; $(COMPARE) $(SEED) ablation=auto $(GO_ON); \
	$(COMPARE) $(SEED) ablation=all_effects budget.minutes=$(MINUTES) $(GO_ON); \
	$(BIN)/forewarp-report kind=effects && exit $$status
else
	@status=0; \
	for choice in ablation=auto ablation=all_effects ablation=full ablation=base; do \
		$(COMPARE) $(SEED) $$choice paths.scenes=$(DATA) dataset=dnerf data.scene=$(subst $(space),$(comma),$(SCENES)) \
			budget.minutes=$(MINUTES) plan.minutes=$(MINUTES) plan.seconds=40 plan.trial_seconds=40 $(GO_ON); \
	done; \
	$(BIN)/forewarp-report kind=effects && exit $$status
endif

# METHODS="dnerf tineuvox_b", or all: these in place of a sweep's own; ablations and the resolution are of model=forward.
EVERY = $(subst $(comma),$(space),$(shell sed -n 's/^ *model: //p' sweeps/methods.yaml))
OF_METHODS = $(if $(METHODS),model=$(subst $(space),$(comma),$(strip $(METHODS:all=$(EVERY)))))
UNTIL = $(if $(STEPS),budget.minutes=null budget.iterations=$(STEPS),$(if $(MINUTES),budget.minutes=$(MINUTES)))
REPRODUCE = table() { \
	case $$1 in sweeps=ablation_*|sweeps=resolution) of=;; *) of=$(OF_METHODS);; esac; \
	$(BIN)/forewarp-train --multirun preset=$(PRESET) $(UNTIL) $(SEED) $(if $(VIEWS),views=$(VIEWS)) score=null \
		$(if $(THREADS),threads=$(THREADS)) $(if $(LAUNCHER),launcher=$(LAUNCHER)) $(ALSO) "$$@" $$of; }
# Without DATA: a counterpart of each dataset; on two of them all methods. Half of the runs on each of two cores.
JOBS ?= 2
LANES = $(MAKE) --no-print-directory -j$(JOBS) tables-vehicle tables-captures PRESET=$(PRESET) SEEDS=$(SEEDS)
reproduce-tables: PRESET ?= $(if $(DATA),fast,demo)
reproduce-tables: MINUTES := $(if $(filter command line,$(origin MINUTES)),$(MINUTES),$(if $(filter faithful,$(PRESET)),null,$(if $(DATA),5,1)))
reproduce-tables: SWEEPS_TYPED := $(if $(filter command line,$(origin SWEEPS)),$(SWEEPS))
reproduce-tables: SCENES_TYPED := $(if $(filter command line,$(origin SCENES)),$(SCENES))
reproduce-tables: SWEEPS ?= $(if $(SCENES_TYPED),dnerf,dnerf hypernerf nhr lego_complete)
reproduce-tables: override SWEEPS := $(if $(filter all,$(SWEEPS)),dnerf hypernerf nhr lego_complete ablation_modules ablation_losses resolution,$(SWEEPS))
reproduce-tables: SEEDS ?= 1
reproduce-tables: OUT ?= runs/paper/results
reproduce-tables: ## the paper's tables and figures, measured beside published [DATA=<folder that holds dnerf/ ...> METHODS="dnerf ndvg", or all; PRESET= SCENES="hook lego" MINUTES= SEEDS=3 VIEWS= SWEEPS=all OUT=]
ifeq ($(DATA),)
	@$(if $(SCENES_TYPED),$(error SCENES: expected DATA=<folder that holds dnerf/> beside it))
	@$(if $(filter-out all ablations,$(SWEEPS_TYPED)),$(error SWEEPS: expected all or ablations without DATA, but got $(SWEEPS_TYPED)))
	@status=0; $(LANES) MINUTES=$(MINUTES) $(GO_ON); \
	$(BIN)/forewarp-report kind=paper out=$(OUT) curves=docs/results && exit $$status
else
	@$(if $(filter methods,$(SWEEPS)),$(if $(SCENES_TYPED),,$(error SCENES: expected SCENES="hook ..." beside SWEEPS=methods with DATA; \
		all scenes by all methods: METHODS=all)))
	@status=0; $(REPRODUCE); for sweep in $(SWEEPS:ablations=ablation_modules ablation_losses); do \
		table sweeps=$$sweep paths.scenes=$(DATA) \
			$(if $(SCENES_TYPED),absent=refuse dataset=dnerf data.scene=$(subst $(space),$(comma),$(SCENES_TYPED))) $(GO_ON); \
	done; \
	$(BIN)/forewarp-report kind=paper out=$(OUT) curves=docs/results && exit $$status
endif

# Apart from the runs of tables, from which a page could not tell those of another share.
ABLATIONS := paths.runs=runs/ablations
ablations: PRESET ?= demo
ablations: MINUTES := $(if $(filter command line,$(origin MINUTES)),$(MINUTES),2.5)
ablations: STEPS ?= 600
ablations: VIEWS ?= 9
ablations: SEEDS ?= 2
ablations: OUT ?= docs/results
# The voxel networks come with the fine stage, which the demo's numbers give too little of the training to tell; on fewer
# rays and voxels it makes enough steps within minutes.
ablations: ALSO ?= stage.fine.share=2 preset.rays=512 modules.num_voxels=[[0,4096]] \
	callbacks.accuracy.rays=2000 callbacks.pictures=null logger=none
# And in HyperNeRF's room.
ablations: ROOM ?= stage.coarse.background_num_voxels=[[0,27000]] stage.fine.background_num_voxels=[[0,110592]]
ablations: ## what each part of the paper's method brings, on three counterparts, at equal minutes and at equal steps [MINUTES= STEPS= SEEDS=3 OUT=]
	@$(if $(DATA)$(METHODS),$(error DATA, METHODS: not for ablations; they are of model=forward on counterparts. \
		Real scenes: make reproduce-tables DATA=$(or $(DATA),<folder>) SWEEPS="ablation_modules ablation_losses"))
	@status=0; \
	$(LANES) SWEEPS=ablations VIEWS=$(VIEWS) ALSO="$(ALSO) $(ABLATIONS)" ROOM="$(ROOM)" MINUTES=$(MINUTES) STEPS= $(GO_ON); \
	$(LANES) SWEEPS=ablations VIEWS=$(VIEWS) ALSO="$(ALSO) $(ABLATIONS)" ROOM="$(ROOM)" STEPS=$(STEPS) $(GO_ON); \
	$(BIN)/forewarp-report kind=ablation out=$(OUT) && exit $$status

ONLY_ABLATIONS = $(filter ablations,$(SWEEPS))
WITH_ABLATIONS = $(filter ablations all,$(SWEEPS))
tables-vehicle: PAIRS := $(if $(ONLY_ABLATIONS),,methods:dnerf nhr:nhr) $(if $(WITH_ABLATIONS),ablation_losses:dnerf ablation_modules:dnerf)
tables-captures: PAIRS := $(if $(ONLY_ABLATIONS),,methods:hypernerf lego_complete:lego_complete) \
	$(if $(WITH_ABLATIONS),ablation_modules:hypernerf ablation_modules:lego_complete) $(if $(filter all,$(SWEEPS)),resolution:hypernerf)
tables-vehicle tables-captures: THREADS ?= 1
tables-vehicle tables-captures:
	@{ status=0; $(REPRODUCE); for pair in $(PAIRS); do \
		case $$pair in ablation_*:hypernerf) room="$(ROOM)";; *) room=;; esac; \
		table sweeps=$${pair%:*} scene=counterpart_$${pair#*:} budget.clock=processor $$room $(GO_ON); \
	done; exit $$status; } $(SAYS)

MKDOCS = { $(BIN)/python -c 'import material, mkdocstrings_handlers.python' 2>/dev/null || { $(ADD) '.[docs]'; }; } && \
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs
docs: ## build the docs site into site/, from which it opens without a network; warnings are errors
	@$(MKDOCS) build --strict --quiet
	@echo "written: site/index.html"

docs-serve: ## show the docs site on 127.0.0.1:8000, and anew after each change
	@$(MKDOCS) serve

lint: ## check code and format
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: ## fix what can be fixed, and format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean: ## remove caches and builds; runs/ and data/ stay
	rm -rf .pytest_cache .ruff_cache .hypothesis .coverage build dist site
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +
