# Everything that a fresh clone needs Python 3.11, git and make for. Each target installs into .venv by itself.
PYTHON ?= python3.11
RUN := .venv/bin
OUTPUTS ?= outputs
# Of the longer training: rounded where the processor multiplies such numbers faster (docs/speed.md).
PRECISION ?= $(shell grep -qs amx_bf16 /proc/cpuinfo && echo bfloat16 || echo float32)
export MLFLOW_DISABLE_TELEMETRY := true
# Else every process compiles all that it loads, which takes it longer than loading: packages come without their bytecode.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help install report lqr_quick obstacles_quick test slow lint bench mutants clean

help:
	@echo "make report   quick comparisons on both tasks, and their reports"
	@echo "make test     the default test suite"
	@echo "make slow     the tests that take long"
	@echo "make lint     ruff and mypy"
	@echo "make bench    speed, beside peers and floors from the same run"
	@echo "make mutants  faults put into the core, which the tests must find; a quarter of an hour"

install: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(RUN)/python tools/install.py .
	@touch $@

.venv/checks: .venv/installed
	$(RUN)/python tools/install.py '.[test,lint,ipopt,mujoco]'
	@touch $@

.venv/servers: .venv/checks
	$(RUN)/python tools/install.py '.[slurm,ray,postgresql]'
	@touch $@

# Two sweeps at once, each with half of the cores: two small trainings side by side beat one on two cores after the other.
report: install
	@mkdir -p $(OUTPUTS)
	@echo "both comparisons at once; that among obstacles writes to $(OUTPUTS)/obstacles_quick.log"
	@$(MAKE) --no-print-directory -j 2 lqr_quick obstacles_quick
	@cat $(OUTPUTS)/obstacles_quick.log
	@echo
	@echo "reports: $(OUTPUTS)/reports/lqr_quick/index.html  $(OUTPUTS)/reports/obstacles_quick/index.html"
	@echo "runs:    $(RUN)/mlflow ui --backend-store-uri sqlite:///$(abspath $(OUTPUTS))/mlflow.db"

HALF = $(shell $(RUN)/python -c 'from dadiff.threads import cores; print(max(1, cores() // 2))')

lqr_quick:
	$(RUN)/dadiff +sweeps=$@ output_dir=$(OUTPUTS) hydra.launcher.workers=$(HALF)
	$(RUN)/dadiff-report $@ --log --output-dir $(OUTPUTS)

obstacles_quick:
	@{ $(RUN)/dadiff +sweeps=$@ output_dir=$(OUTPUTS) hydra.launcher.workers=$(HALF) training.precision=$(PRECISION) && \
	$(RUN)/dadiff-report $@ --log --output-dir $(OUTPUTS); } > $(OUTPUTS)/$@.log 2>&1 || { cat $(OUTPUTS)/$@.log; exit 1; }

test: .venv/checks
	OMP_NUM_THREADS=1 $(RUN)/pytest -n 2 --dist loadfile

slow: .venv/servers
	OMP_NUM_THREADS=1 $(RUN)/pytest -m slow

lint: .venv/checks
	$(RUN)/ruff check .
	$(RUN)/ruff format --check .
	$(RUN)/mypy

bench: .venv/checks
	$(RUN)/python -m bench --out $(OUTPUTS)

mutants: .venv/checks
	$(RUN)/python tools/mutants.py

clean:
	rm -rf .venv
