# make demo   the main job, on embedded defaults      make test       the tests
# make check  style, types, layers                    make test-slow  those that take long: many kills, many images
# make setup  what the demo needs, in .venv         make docs       the documentation as a site, in build/site
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.ready
DEV := $(VENV)/.dev-ready
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt

.PHONY: setup demo test test-slow test-compose test-slurm test-kubernetes check docs stability lock clean
.DELETE_ON_ERROR:

setup: $(STAMP)

$(STAMP): constraints.txt scripts/setup.sh pyproject.toml
	PYTHON="$(PYTHON)" ./scripts/setup.sh "$(VENV)"
	@touch $@

$(DEV): constraints.txt scripts/setup.sh pyproject.toml
	PYTHON="$(PYTHON)" ./scripts/setup.sh "$(VENV)" dev
	@touch $@ $(STAMP)

demo: $(STAMP)
	env -u PYTHONDONTWRITEBYTECODE $(BIN)/photonfarm up room --modifications 128 --views 2 --shard-rows 8 --workers 2 --train-steps 1000 --reference-views 6 --set filter_direct=true --also guided_denoise 120 --store demo/store --run demo/run --out demo

# Three at a time on two cores, as many tests wait; a file's tests together, as they share servers and scenes; in order,
# as the longest files come early; a process that crashes ends it, as xdist never ends with another one in its place.
# Bytecode is kept whatever the environment says: hundreds of processes start, and each would compile photonfarm anew.
PYTEST := env -u PYTHONDONTWRITEBYTECODE $(BIN)/python -m pytest \
	-n 3 --dist loadfile --no-loadscope-reorder --max-worker-restart 0

test: $(DEV)
	$(PYTEST) -m 'not slow'

test-slow: $(DEV)
	$(PYTEST) -m slow

# The compose file, run for real; needs a Docker engine.
test-compose: $(DEV)
	PHOTONFARM_TEST_COMPOSE=1 $(BIN)/python -m pytest -s tests/end_to_end/test_compose.py

# photonfarm slurm on a SLURM of two nodes, which the test starts: as root, with Debian's slurmctld, slurmd, slurm-client
# and munge installed. A quarter of an hour, as SLURM lets requeued jobs wait.
test-slurm: $(DEV)
	PHOTONFARM_TEST_SLURM=1 $(BIN)/python -m pytest -s tests/end_to_end/test_slurm.py

# The chart, rendered by helm and held against the schemas of Kubernetes (docs/kubernetes.md); skipped without helm.
test-kubernetes: $(VENV)/.kubernetes-ready
	$(BIN)/python -m pytest -v tests/end_to_end/test_kubernetes.py tests/end_to_end/test_kubernetes_files.py

$(VENV)/.kubernetes-ready: $(DEV)
	$(PIP) --group kubernetes
	@touch $@

check: $(DEV)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The documentation as a site; a link to nothing is an error.
docs: $(VENV)/.docs-ready
	$(BIN)/python scripts/cli_page.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

$(VENV)/.docs-ready: $(DEV)
	$(PIP) --group docs
	@touch $@

# What only this benchmark needs: the peers it is about, and plots.
$(VENV)/.bench-ready: $(DEV)
	$(PIP) --group bench
	@touch $@

bench-render: $(VENV)/.bench-ready

# What this machine's card gives, most telling first: make bench-card ARGS="--minutes 8".
bench-card: $(DEV)
	$(BIN)/python -m bench.card $(ARGS)

# bench-train-step is the module bench.trainer.train_step: whichever room of bench/ has it.
bench-%: $(DEV)
	$(BIN)/python -m $(or $(subst /,.,$(basename $(wildcard bench/*/$(subst -,_,$*).py))),$(error bench/ has no $*))

# The integrator on 36 rows of hard scenes, each against its truth: make stability ARGS="--quick --only 13".
stability: $(DEV)
	$(BIN)/python -m tests.stability $(ARGS)

# Every experiment of experiments/, from nothing to its report; goes on where it was interrupted.
experiments-%: $(DEV)
	$(BIN)/python experiments/run.py --size $*

# The exact versions in constraints.txt, made from a fresh environment.
lock:
	PYTHON="$(PYTHON)" ./scripts/lock.sh

clean:
	rm -rf $(VENV) demo
