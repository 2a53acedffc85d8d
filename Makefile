# make demo: install; watch a person, learn, plan and do it.    make test: install, lint, type-check, test.
# make paper: all experiments of the paper, with a report.      make study: its simulation study alone.
# make docs: the pages as a web site in out/site.
# make stress: try to break it, for hours: certificates and peers, statuses, noisy starts, kills, long lives of one process.
# make benchmark: timings of ours and of peers, a quarter of an hour; --page (see the script) writes the pages that show them.
# make hands: the networks that find hands in films, from the package registry; for kpirl learn-video.
# make models: camera data, keypoint detector and dynamics at the paper's scale (SEED=0, MODELS=out/models).
# With PYTHON=python3.13, .venv is made with another Python than the first of these that runs.
RUNS = for python in python3.11 python3.10 python3.12 python3.13 python3; do $$python -c "" 2>&- && echo $$python; done
PYTHON ?= $(firstword $(shell $(RUNS)))
BIN := .venv/bin
WHICH = $(shell $(1) -c "import sys; print('%d.%d' % sys.version_info[:2])")
ifneq ($(and $(filter-out file,$(origin PYTHON)),$(wildcard $(BIN)/python)),)
ifneq ($(call WHICH,$(PYTHON)),$(call WHICH,$(BIN)/python))
$(error .venv holds Python $(call WHICH,$(BIN)/python), not $(PYTHON): remove .venv first)
endif
endif
export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1

SEED := 0
HELD_OUT := 24
MODELS := out/models
COLLECT = $(BIN)/python scripts/collect_data.py
KEYPOINTS = $(BIN)/python scripts/train_keypoints.py --preset full
ROBUST = $(BIN)/kpirl train-robust
IN_HAND = hand-placing hand-placing-1 hand-placing-2
DYNAMICS = $(BIN)/python scripts/train_dynamics.py --seed $(SEED) --detector $(MODELS)/detector/detector.json

.PHONY: demo paper test study benchmark stress hands models docs clean

demo: .venv/installed-perception
	$(BIN)/python scripts/visual_demo.py --out out/demo

paper: .venv/installed-perception
	$(BIN)/python scripts/reproduce_paper.py --out out/paper

study: .venv/installed
	$(BIN)/python scripts/simulation_study.py --out out/study

# Crocoddyl's wheel asks for an older example-robot-data than ours, and does not need it.
benchmark: .venv/installed-bench
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-deps crocoddyl libcrocoddyl
	$(BIN)/python scripts/benchmark.py --out out/benchmark

stress: .venv-stress/installed
	RUST_LOG=off .venv-stress/bin/python scripts/stress_test.py --out out/stress

hands: .venv/installed-perception
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[hands]"
	$(BIN)/python -m kpirl_ocp.perception.hands.networks

# Training data has the seed 10 SEED, held-out data 10 SEED + 2; 10 SEED + 1 served development.
# One thread, so that the same seed gives the same models.
models: .venv/installed-perception
	for motion in keypoints sines placing hand-wandering; do \
		$(COLLECT) $$motion --seed $(SEED)0 --out $(MODELS)/data/$$motion || exit; done
	for motion in keypoints sines placing hand-placing; do \
		$(COLLECT) $$motion --seed $(SEED)2 --episodes $(HELD_OUT) --out $(MODELS)/test/$$motion || exit; done
	$(COLLECT) sines --rate 1 --steps 10 --seed $(SEED)0 --out $(MODELS)/data/slow-sines
	$(COLLECT) sines --rate 1 --steps 10 --seed $(SEED)2 --episodes $(HELD_OUT) --out $(MODELS)/test/slow-sines
	for level in 1 2; do \
		$(COLLECT) hand-placing --surroundings $$level --seed $(SEED)2 --episodes $(HELD_OUT) \
			--out $(MODELS)/test/hand-placing-$$level || exit; done
	$(KEYPOINTS) --threads 1 --seed $(SEED) --out $(MODELS)/teacher \
		--data $(MODELS)/data/keypoints --videos $(MODELS)/data/hand-wandering \
		--test $(addprefix $(MODELS)/test/,keypoints sines placing hand-placing)
	$(ROBUST) --teacher $(MODELS)/teacher/detector.json --threads 1 --seed $(SEED) \
		--out $(MODELS)/detector --test $(addprefix $(MODELS)/test/,keypoints sines placing $(IN_HAND))
	for activation in relu tanh; do \
		$(DYNAMICS) --activation $$activation --out $(MODELS)/reaching-$$activation \
			--data $(MODELS)/data/sines --test $(MODELS)/test/sines || exit; \
		$(DYNAMICS) --activation $$activation --out $(MODELS)/placing-$$activation \
			--augment --data $(addprefix $(MODELS)/data/,placing slow-sines) \
			--test $(addprefix $(MODELS)/test/,placing slow-sines) || exit; done
	# The layout that reproduce_paper.py --models reads; tanh, so that converged plans can be differentiated.
	for suffix in json safetensors; do \
		cp $(MODELS)/detector/detector.$$suffix $(MODELS)/detector.$$suffix || exit; \
		for task in reaching placing; do \
			cp $(MODELS)/$$task-tanh/dynamics.$$suffix $(MODELS)/$$task.$$suffix || exit; done; done

docs: .venv/installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo "open out/site/index.html"

# Modules are compiled once, not by each of hundreds of processes, even where Python is told to write no bytecode.
# The two processes of the tests have one thread each. Types are checked beside them: what is wrong with types is said last.
test: export PYTHONDONTWRITEBYTECODE =
test: .venv/installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy > .venv/types & $(BIN)/pytest -n 2; tests=$$?; wait $$!; types=$$?; cat .venv/types; exit $$((tests + types))

# The C sources as well: the core is built anew after a pull that changes them.
.venv/installed: pyproject.toml constraints.txt setup.py $(wildcard $(addsuffix /*.[ch],\
		kpirl_ocp/ocp/interior_point/c kpirl_ocp/ocp/interior_point/c/* kpirl_ocp/ocp/sensitivity/c))
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

.venv/installed-perception: .venv/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[perception]"
	touch $@

.venv/installed-bench: .venv/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[bench]"
	touch $@

.venv/installed-docs: .venv/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[docs]"
	touch $@

.venv/installed-test: .venv/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[test]"
	touch $@

# Peers in an environment of their own. mpc.pytorch needs an old setuptools to be built.
.venv-stress/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv-stress
	.venv-stress/bin/python -m pip install --quiet --constraint constraints.txt --editable ".[test,stress]"
	echo "setuptools<66" > .venv-stress/old-setuptools.txt
	PIP_CONSTRAINT=.venv-stress/old-setuptools.txt .venv-stress/bin/python -m pip install --quiet --no-deps mpc==0.0.6
	touch $@

clean:
	rm -rf .venv .venv-stress out
