# Everything runs from .venv, which the first target that needs it builds.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEMO_STAMP := $(VENV)/.installed-demo
OUT ?= out
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --no-compile -c constraints.txt
UV := $(shell command -v uv 2>/dev/null)
GOAL := $(or $(firstword $(MAKECMDGOALS)),demo)

# The demo and the tests start many processes; without compiled files each of them compiles all that it imports.
unexport PYTHONDONTWRITEBYTECODE

# Each trainer has its own environment, because their packages conflict. So do the environments that benchmarks/env.py
# compares with.
PINNED := $(sort $(basename $(notdir $(wildcard constraints/*.txt))))
ADAPTERS := $(filter-out bench,$(PINNED))
ADAPTER_TESTS := $(ADAPTERS:%=test-adapter-%)

.PHONY: demo leaderboard test test-slow test-ci-slow test-adapter test-adapters $(ADAPTER_TESTS) coverage lint bench bench-env chaos mesh simulate soak \
	fuzz docs pictures clean install

demo: $(DEMO_STAMP)
	@$(BIN)/thermofleet demo --out $(OUT)/demo

# How well policies do on the test split of the suite, from the stored results.
leaderboard: $(STAMP)
	@$(BIN)/thermofleet leaderboard

# Of each of two workers; more threads would wait for each other on two cores.
test test-ci-slow coverage: export OMP_NUM_THREADS := 1

test: $(STAMP)
	@$(BIN)/python -m pytest -n 2 --dist worksteal

# Tests that take minutes, and properties with all their examples.
test-slow: $(STAMP)
	@HYPOTHESIS_PROFILE=full $(BIN)/python -m pytest -m '(slow or ci_slow or hypothesis) and not adapter'

# The slow tests that CI runs: whole demos, notebooks, tutorials, builds.
test-ci-slow: $(STAMP)
	@$(BIN)/python -m pytest -n 2 --dist worksteal -m 'ci_slow and not slow'

ifneq ($(filter $(ADAPTER),$(ADAPTERS)),)
test-adapter: test-adapter-$(ADAPTER)
else
test-adapter:
	@echo "Name a trainer: make test-adapter ADAPTER=NAME. There are: $(ADAPTERS)."; exit 1
endif

test-adapters: $(ADAPTER_TESTS)

$(ADAPTER_TESTS): test-adapter-%: .venv-adapters/%/.installed
	@.venv-adapters/$*/bin/python -m pytest -m adapter tests/adapters/test_$*.py

# Share of product lines that tests run, without compiled functions and the processes of live fleets.
coverage: $(STAMP)
	@$(BIN)/python -m pytest -n 2 --dist worksteal --cov --cov-report=term:skip-covered --cov-report=html:$(OUT)/coverage

lint: $(STAMP)
	@$(BIN)/ruff format --check .
	@$(BIN)/ruff check .
	@$(BIN)/pyright

chaos: $(STAMP)
	@$(BIN)/python -m benchmarks.chaos

# 256 arms behind two linked routers: kill either, cut the link.
mesh: $(STAMP)
	@$(BIN)/python -m benchmarks.chaos.mesh --speed 20

# Whole fleets in one process under faults, seed after seed until one breaks a rule or Ctrl-C. SEEDS=n or HOURS=n
# bounds it, FIRST=n is the first seed, SEED=n prints the trace of one, MUTATIONS=all breaks rules on purpose.
simulate: $(STAMP)
	@$(BIN)/python -m benchmarks.simulation $(if $(SEED),--seed $(SEED)) $(if $(SEEDS),--seeds $(SEEDS)) \
	  $(if $(HOURS),--hours $(HOURS)) $(if $(FIRST),--first $(FIRST)) $(if $(MUTATIONS),--mutations $(MUTATIONS))

# A week of work, a million jobs, through one auctioneer: about 20 minutes.
soak: $(STAMP)
	@$(BIN)/python -m benchmarks.soak --jobs 1000000

# Coverage-guided fuzzing of every parser. `make fuzz INPUTS=10000000` takes longer, `TARGETS=journal` one parser.
INPUTS ?= 1000000
fuzz: $(VENV)/.atheris
	@$(BIN)/python -m benchmarks.fuzz --inputs $(INPUTS) $(TARGETS)

$(VENV)/.atheris: $(STAMP)
	@$(PIP) atheris==3.0.0
	@touch $@

# The documentation as a site, with its links and anchors checked.
docs: $(STAMP)
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet --strict --site-dir $(abspath $(OUT))/site
	@echo "Open $(OUT)/site/index.html in a browser."

# Every picture of README and docs, and the outputs of the notebooks, made anew. Needs OpenGL (EGL) and Chromium.
pictures: $(STAMP)
	@$(BIN)/python docs/make_pictures.py
	@$(BIN)/python docs/notebooks.py

bench: $(STAMP)
	@for b in benchmarks/bench_*.py; do echo "== $$b"; $(BIN)/python -m benchmarks.$$(basename $$b .py) || exit 1; done

EXTRA := [cli]
.venv-adapters/bench/.installed: EXTRA := [cli,learn]
.venv-adapters/ray/.installed: EXTRA := [cli,ray]
.venv-adapters/ros2/.installed: EXTRA := [bus,ros2]
BENCH := $(abspath .venv-adapters/bench)
bench-env: $(BENCH)/ocean_rware/binding.so
	@PYTHONPATH=$(BENCH) $(BENCH)/bin/python -m benchmarks.env $(if $(JSON),--out $(JSON))

# PufferLib's warehouse in C, one file of its source package. Building the whole package needs libraries from elsewhere
# and a GPU compiler, so pip only unpacks the source, and --no-clean keeps it when pip gives up on the rest.
$(BENCH)/ocean_rware/binding.so: .venv-adapters/bench/.installed
	@rm -rf $(@D) && mkdir -p $(@D)/source
	@{ NO_OCEAN=1 NO_TRAIN=1 TMPDIR=$(@D)/source $(BENCH)/bin/python -m pip --disable-pip-version-check download \
	    --no-clean --no-deps --no-build-isolation --no-binary pufferlib --dest $(@D) pufferlib==3.0.0; \
	  cd $(@D)/source/pip-download-*/pufferlib_*/ && \
	  cc -O2 -shared -fPIC -w -DPLATFORM_DESKTOP -Iraylib-5.5_linux_amd64/include \
	    -I$$($(BENCH)/bin/python -c 'import numpy; print(numpy.get_include())') \
	    -I$$($(BENCH)/bin/python -c 'import sysconfig; print(sysconfig.get_path("include"))') \
	    pufferlib/ocean/rware/binding.c raylib-5.5_linux_amd64/lib/libraylib.a -lm -lpthread -ldl -o $@; \
	} >$(@D)/build.log 2>&1 || echo "PufferLib's warehouse was not built and has no row; see $(@D)/build.log."

install: $(STAMP)

# A broken environment is removed, so that the next call builds a new one. setuptools is installed first, so that its
# pinned version builds the package. torch, which the demo does not need, comes by pip, which also looks on this disk, as
# it may be set up to: uv would fetch the build for NVIDIA's GPUs, of gigabytes. uv installs the rest if it is there and
# can.
$(STAMP): WANTED := dev
$(STAMP): FIRST := setuptools torch
$(STAMP): LASTS := a few minutes
$(DEMO_STAMP): WANTED := demo
$(DEMO_STAMP): FIRST := setuptools
$(DEMO_STAMP): LASTS := about a minute
$(STAMP) $(DEMO_STAMP): pyproject.toml constraints.txt
	@command -v "$(PYTHON)" >/dev/null 2>&1 || { \
	  echo "thermofleet needs Python 3.11 or newer, and there is no '$(PYTHON)' here. Install it, or name one: make $(GOAL) PYTHON=/path/to/python3.11"; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null || { \
	  echo "thermofleet needs Python 3.11 or newer, and '$(PYTHON)' is $$("$(PYTHON)" --version 2>&1 | head -1). Name another: make $(GOAL) PYTHON=/path/to/python3.11"; exit 1; }
	@test -x $(BIN)/python || "$(PYTHON)" -m venv $(VENV) >/dev/null 2>&1 || { \
	  rm -rf $(VENV); \
	  echo "'$(PYTHON) -m venv $(VENV)' could not make an environment. On Debian and Ubuntu the package python3-venv is missing then: apt install python3-venv"; exit 1; }
	@echo "Installing thermofleet into $(VENV) (once, $(LASTS); log in $(VENV)/install.log) …"
	@{ $(PIP) $(FIRST) && \
	  { $(if $(UV),VIRTUAL_ENV=$(abspath $(VENV)) $(UV) pip install --quiet -c constraints.txt --no-build-isolation -e '.[$(WANTED)]' ||) \
	    $(PIP) --no-build-isolation -e '.[$(WANTED)]'; }; } >$(VENV)/install.log 2>&1 || { \
	  echo "The packages could not be installed. The usual reason is no network: they are fetched once, later runs need none."; \
	  grep -oE 'ERROR: .*' $(VENV)/install.log | grep -vE 'conflicting dependencies|ResolutionImpossible' | sed 's/^ERROR:/pip said:/;q'; \
	  echo "All that pip said is in $(VENV)/install.log; 'make $(GOAL)' tries again."; exit 1; }
	@touch $@ $(DEMO_STAMP)

# A trainer's own pins override the shared ones. Its packages are installed as pinned, whatever they require.
$(PINNED:%=.venv-adapters/%/.installed): .venv-adapters/%/.installed: constraints/%.txt constraints.txt pyproject.toml | $(STAMP)
	@echo "Installing $* into .venv-adapters/$* (once, a few minutes; log in .venv-adapters/$*/install.log) …"
	@test -x .venv-adapters/$*/bin/python || $(BIN)/python -m venv .venv-adapters/$*
	@awk -F== '!seen[$$1]++' constraints/$*.txt constraints.txt >.venv-adapters/$*/pins.txt
	@pip=".venv-adapters/$*/bin/python -m pip --disable-pip-version-check install --quiet"; \
	{ $$pip -c .venv-adapters/$*/pins.txt setuptools && \
	  $$pip -c .venv-adapters/$*/pins.txt --no-build-isolation -e '.$(EXTRA)' pytest hypothesis && \
	  $$pip --no-deps -r constraints/$*.txt; } >.venv-adapters/$*/install.log 2>&1 || { \
	  echo "$* could not be installed; all that pip said is in .venv-adapters/$*/install.log."; exit 1; }
	@touch $@

clean:
	rm -rf $(VENV) .venv-adapters $(OUT) build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
