# make demo: install, learn a cost on the iiwa, plan with it.   make test: install, lint, type-check, test.
# make study: the paper's simulation study, both tasks.         make benchmark: timings.
PYTHON ?= $(firstword $(shell command -v python3.11 python3.10 python3))
BIN := .venv/bin
export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1

.PHONY: demo test study benchmark clean

demo: .venv/installed
	$(BIN)/python scripts/learn_cost.py --task placing --method implicit --out out/demo

study: .venv/installed
	$(BIN)/python scripts/simulation_study.py --out out/study

benchmark: .venv/installed
	$(BIN)/python scripts/benchmark.py --out out/benchmark

test: .venv/installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest -n 2

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable .
	touch $@

.venv/installed-test: .venv/installed
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[test]"
	touch $@

clean:
	rm -rf .venv out
