# Two commands: `make run` and `make test`. Both set up .venv first, with what they need, which takes seconds where nothing has changed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUNS := $(VENV)/.runs
READY := $(VENV)/.installed
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
# Bytes of all files in git.
LARGEST := 25000000
STAMP = $(shell date +%Y%m%d-%H%M%S)
# The tests start hundreds of processes: they share what Python has compiled, also where it is told not to keep it.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: run test check results fuzz netns soak chaos simulate slurm-test dask-test compose-test mutants bench gpu gpu-atari docs dist

run: $(RUNS)
	@$(BIN)/coop-local --preset cartpole --method coop --actors 2 --total-steps 20000 --run-dir runs/first-light-$(STAMP)

test: check
	@$(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder

check: $(READY)
	@$(BIN)/ruff check --quiet .
	@$(BIN)/ruff format --check . > $(VENV)/format.log 2>&1 || { cat $(VENV)/format.log; exit 1; }
	@$(BIN)/mypy --no-error-summary
	@$(BIN)/lint-imports --no-logo > $(VENV)/lint-imports.log || { cat $(VENV)/lint-imports.log; exit 1; }
	@test ! -e .git || test $$(git ls-files -z | xargs -0 cat 2>/dev/null | wc -c) -lt $(LARGEST) || \
		{ echo "make check: the files in git hold more than $(LARGEST) bytes; what make results makes need not be there"; exit 1; }

# Every figure and table of results/, from the packed studies there.
results: $(READY)
	@for study in results/*/*.parquet; do $(BIN)/coop-report $$study | tail -n 1 || exit 1; done
	@$(BIN)/python -m results.cartpole.edl.verdict figures
	@$(BIN)/python -m results.cartpole.hold.verdict figures
	@$(BIN)/python -m results.minatar.edl.verdict figures
	@$(BIN)/python results/minatar/registered.py figure results/minatar/study.parquet
	@$(BIN)/coop-report results/pong.parquet --curves results/pong

# Checks that take longer; docs/robustness.md says what each shows.
fuzz: $(READY)
	@$(BIN)/python benchmarks/fuzz.py

netns: $(READY)
	@$(BIN)/python benchmarks/netns.py

chaos: $(READY)
	@$(BIN)/python benchmarks/$(if $(KILLS),storm.py --kills $(KILLS),chaos.py --run-dir runs/chaos-$(STAMP))

soak: $(READY)
	@$(BIN)/python benchmarks/soak.py

# Whole runs in made-up time, with faults from a seed each; FIRST=N begins at another one.
simulate: $(READY)
	@$(BIN)/python -m benchmarks.simulate --seeds $(or $(SEEDS),1000) --first $(or $(FIRST),0)

# A Slurm controller and three nodes on this machine; root installs what is missing.
slurm-test: $(READY)
	@BIN=$(BIN) deploy/slurm/check.sh

# A sweep on a Dask cluster of network namespaces, of whose workers two are killed; needs root.
dask-test: $(READY)
	@$(BIN)/python benchmarks/dask_sweep.py

# The image and the Compose files on a real engine, which is started if none runs; root installs what is missing.
compose-test:
	@deploy/check_containers.sh

mutants: $(READY)
	@$(PIP) --editable '.[dev,mutants]' > $(VENV)/mutants.log 2>&1 || { cat $(VENV)/mutants.log; exit 1; }
	@PATH="$(CURDIR)/$(BIN):$$PATH" $(BIN)/python benchmarks/mutants.py

# coop beside what people would use instead, whose packages get environments of their own. AREAS="table service" is a part of it;
# AGAINST=benchmarks/results.json writes nothing, but names what has moved since.
bench:
	@PYTHON=$(PYTHON) benchmarks/rivals.sh
	@PYTHONPATH=benchmarks .bench/bench/bin/python -m bench $(AREAS) $(if $(AGAINST),--against $(AGAINST))

# What a GPU makes of updates, acting and a whole run, in four minutes. On a machine without network, deploy/gpu_wheels.sh
# has put what is missing into .whl/ before.
gpu:
	@$(if $(wildcard $(BIN)/python),$(BIN)/python,$(PYTHON)) benchmarks/gpu.py --out $(or $(OUT),runs/gpu)

# The four methods learn a game on a GPU for MINUTES, or MINUTES more if OUT has what they had learned before.
gpu-atari:
	@$(if $(wildcard $(BIN)/python),$(BIN)/python,$(PYTHON)) benchmarks/gpu_atari.py --out $(or $(OUT),runs/gpu-atari) \
		--minutes $(or $(MINUTES),8) --game $(or $(GAME),pong)

# The documentation as a site, build/site/index.html; a broken link is an error. Says how many code blocks the tests run.
docs: $(READY)
	@$(PIP) --editable '.[dev,docs]' > $(VENV)/docs.log 2>&1 || { cat $(VENV)/docs.log; exit 1; }
	@$(BIN)/python -m website.assemble build/docs
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build > $(VENV)/docs.log 2>&1 || { cat $(VENV)/docs.log; exit 1; }

# Wheel and sdist in dist/; the wheel is tried in a fresh environment.
dist: $(READY)
	@$(PIP) --editable '.[dev,dist]' > $(VENV)/dist.log 2>&1 || { cat $(VENV)/dist.log; exit 1; }
	@BUILDER="$(CURDIR)/$(BIN)/python" PYTHON="$(PYTHON)" deploy/check_dist.sh

# What runs need; and what checks and tests need as well.
$(RUNS): PACKAGES := .
$(READY): PACKAGES := .[dev]
$(RUNS) $(READY): pyproject.toml constraints.txt
	@echo "setting up $(VENV): some minutes and 2 GB; $(VENV)/install.log has the details"
	@test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	@$(PIP) --editable '$(PACKAGES)' > $(VENV)/install.log 2>&1 || { cat $(VENV)/install.log; exit 1; }
	@touch $(RUNS) $@
