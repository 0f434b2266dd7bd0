# `make demo` and `make test` need nothing but Python 3.10 .. 3.13 with venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

.PHONY: demo ablation results pages test lint budgets kernels wheel install clean

# One thread: the demo's tensors are small, and a second thread gains nothing but waits where the machine is shared.
demo: export OMP_NUM_THREADS := 1
demo: demo/capture
	rm -rf demo/run
	$(BIN)/turbogs train demo/capture --out demo/run --config demo
	$(BIN)/turbogs render demo/run

# The paper's table of components on the demo capture: six short runs and their report, within five minutes.
ablation: export OMP_NUM_THREADS := 1
ablation: demo/capture
	rm -rf demo/components
	timeout 300 $(BIN)/turbogs ablate configs/ablations/components.yaml --scene $< --steps 40 --out demo/components

demo/capture: | $(INSTALLED)
	$(BIN)/turbogs demo $@

# What README and docs/lab show of TurboGS, measured anew on a GPU machine, into results/COMMIT and docs/lab:
# make results SCENES="PATH/fox PATH/caliterra PATH/snowmiku PATH/bonsai PATH/train". The same call goes on after a stop.
results: $(INSTALLED)
	PATH="$(CURDIR)/$(BIN):$$PATH" docs/lab/measure.sh results $(SCENES)
	$(MAKE) pages

# The tables of README and docs/, and README's plot, from the files in docs/lab; a second run changes nothing.
pages: $(INSTALLED)
	$(BIN)/python docs/lab/make_pages.py

# A process a core, each with one thread and a run of files, whose tests share captures and runs. One that is done
# takes half of what another has left: no large file keeps a core waiting. Bytecode is kept, also where the environment
# says otherwise: the tests start Python some dozens of times.
test: export OMP_NUM_THREADS := 1
test: export PYTHONDONTWRITEBYTECODE :=
test: $(INSTALLED)
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 8 --dist worksteal

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Lines of every room beside their budgets, and the files of docs/.
budgets: $(INSTALLED)
	$(BIN)/python tests/test_rooms.py

# The CUDA library, for development; wants nvcc but no GPU.
kernels: $(INSTALLED)
	TURBOGS_CUDA=require TURBOGS_CUDA_ARCH=$${TURBOGS_CUDA_ARCH:-90} $(BIN)/python setup.py build_ext --inplace

# One wheel in dist/, for Python 3.10 and later, torch 2.10 and later, and every GPU from 8.0; wants nvcc but no GPU.
# What an earlier build left in build/ would land in it.
WHEEL_ARCHITECTURES := 80 86 89 90 100 120
wheel: $(INSTALLED)
	rm -rf build/lib* build/bdist* dist
	TURBOGS_CUDA=require TURBOGS_CUDA_ARCH="$(WHEEL_ARCHITECTURES)" \
		$(BIN)/python -m pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist .
	$(BIN)/python .ci/check_wheel.py dist/*.whl $(WHEEL_ARCHITECTURES)

install: $(INSTALLED)

# torch first and by its exact version, so that nothing below picks another build of it. No build isolation: the
# kernels' binding is compiled against this very torch.
$(INSTALLED): pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet "setuptools>=77" wheel
	$(BIN)/python -m pip install --quiet torch==2.13.0
	$(BIN)/python -m pip install --quiet --no-build-isolation --editable ".[dev]"
	touch $@

clean:
	rm -rf build dist *.egg-info demo .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path "./$(VENV)/*" -prune -exec rm -rf {} +
