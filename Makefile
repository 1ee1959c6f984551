# The two commands of the README are `make demo` and `make test`; `make` alone lists the rest.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OLDEST := .venv-oldest
# One worker more than cores, for tests of the node wait; whoever has nothing left to do takes tests
# from another.
PARALLEL := -n $(shell echo $$(($$(nproc 2>/dev/null || echo 2) + 1))) --maxprocesses 8 \
    --dist worksteal

# A ROS installation that is sourced in this shell must not mix with the wheels in .venv.
unexport PYTHONPATH AMENT_PREFIX_PATH LD_LIBRARY_PATH RMW_IMPLEMENTATION
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE
export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: help demo test test-all test-oldest lint docs bench experiments lock clean

help:
	@sed -n 's/^#: //p' Makefile

#: make demo                   aligns a simulated flight: table of errors, picture
#: make demo BAG=path          the same for a recording; ARGS='--lever-arm 1 0 0.5'
demo: $(VENV)/ready
	@mkdir -p build/demo
ifdef BAG
	@$(BIN)/ins_align replay '$(BAG)' $(ARGS) --json build/demo/recording.json \
	    --csv build/demo/recording.csv --plot build/demo/recording.png || [ $$? -eq 1 ]
	@echo 'Picture: build/demo/recording.png (the numbers are beside it: .json, .csv)'
else
	@rm -rf build/demo/flight
	@$(BIN)/ins_align simulate build/demo/flight --scenario flight --imu mems --seed 1 \
	    --lever-arm 1 1 1
	@$(BIN)/ins_align replay build/demo/flight --lever-arm 1 1 1 \
	    --set lever_arm_std=0.02 $(ARGS) \
	    --json build/demo/flight.json --csv build/demo/flight.csv --plot build/demo/flight.png
	@echo 'Picture: build/demo/flight.png (the numbers are beside it: .json, .csv)'
endif

#: make test                   linters, types and tests, four minutes on two cores;
#:                             ARGS='-k node' some of them
test: $(VENV)/ready
	@$(BIN)/python -m pytest -q $(PARALLEL) -m 'not campaign' $(ARGS) \
	    && echo 'make test: passed' || { echo 'make test: FAILED'; exit 1; }

#: make test-all               all tests, the long campaigns too, with their coverage; then test-oldest
test-all: $(VENV)/ready
	@FUZZ_EXAMPLES=$${FUZZ_EXAMPLES:-300} \
	    $(BIN)/python -m pytest -q $(PARALLEL) --cov --cov-report=term $(ARGS) \
	    || { echo 'make test-all: FAILED'; exit 1; }
	@$(MAKE) -s --no-print-directory test-oldest
	@echo 'make test-all: passed'

#: make test-oldest            the tests with numpy 1.26 and scipy 1.11, where Python 3.12 is there
test-oldest:
	@for python in $(PYTHON312) python3.12 \
	        $$(pyenv root 2>/dev/null)/versions/3.12*/bin/python3.12; do \
	    if "$$python" -c '' 2>/dev/null; then \
	        $(MAKE) -s --no-print-directory $(OLDEST)/ready PYTHON="$$python" || exit 1; \
	        $(OLDEST)/bin/python -m pytest -q $(PARALLEL) -m 'not linter and not campaign' $(ARGS) \
	            && echo 'make test-oldest: passed' && exit 0; \
	        echo 'make test-oldest: FAILED'; exit 1; \
	    fi; \
	done; \
	echo 'make test-oldest: skipped, no Python 3.12 found (PYTHON312=path names one)'

#: make lint                   linters and types only
lint: $(VENV)/ready
	@$(BIN)/python -m pytest -q -m linter

#: make docs                   the documentation as HTML, in build/docs
docs: $(VENV)/ready
	@$(BIN)/python -m sphinx -W --keep-going -q -b html docs build/docs
	@echo 'Documentation: build/docs/index.html'

#: make bench                  speed of replay, node, estimator and start, as ratios; QUICK=1: with
#:                             10 minutes of data instead of an hour
bench: $(VENV)/ready
	@$(BIN)/ins_align experiment bench --out docs/experiments $(if $(QUICK),--runs 10)

#: make experiments            renews the figures and tables in docs/experiments; those of real
#:                             recordings with DATA=folder
experiments: demo
	@$(BIN)/python -c "from PIL import Image; Image.open('build/demo/flight.png').convert( \
	    'RGB').quantize(256).save('docs/images/flight.png', optimize=True)"
	@$(BIN)/ins_align experiment all --out docs/experiments $(if $(DATA),--data '$(DATA)')

#: make lock                   renews the pinned versions in requirements/ (needs uv)
lock:
	@cd requirements && set -- uv pip compile -q -U --no-header --annotation-style line && \
	    "$$@" --universal --python-version 3.10 dev.in -o dev.txt && \
	    "$$@" --python-version 3.12 oldest.in -o oldest.txt

#: make clean                  removes what all these made
clean:
	@rm -rf $(VENV) $(OLDEST) build install log .coverage* .mypy_cache .pytest_cache .hypothesis \
	    *.egg-info
	@find . -name __pycache__ -prune -exec rm -rf {} +

# `python -m venv --clear`: what an interrupted run left does not count.
$(VENV)/requirements: REQUIREMENTS := requirements/dev.txt
$(OLDEST)/requirements: REQUIREMENTS := requirements/oldest.txt
$(VENV)/requirements: requirements/dev.txt
$(OLDEST)/requirements: requirements/oldest.txt
$(VENV)/requirements $(OLDEST)/requirements:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { echo \
	    'Python 3.10 or newer is needed; PYTHON=path names one'; exit 1; }
	@echo 'Installing $(REQUIREMENTS) into $(@D), once ...'
	@$(PYTHON) -m venv --clear $(@D)
	@$(@D)/bin/python -m pip install -qq --no-deps -r $(REQUIREMENTS)
	@touch $@

%/ready: %/requirements setup.py setup.cfg
	@$*/bin/python -m pip install -qq --no-deps --no-build-isolation --use-pep517 -e .
	@touch $@
