# make demo   tracks the person of a bag in bags/      make lint   ruff, mypy and clang-format
# make test   all tests                                make bench  the benchmarks
# make setup  the workspace, with MediaPipe Pose       make soak   nodes under load and faults
# make clean  restores the state of a clone            make detector  MediaPipe Pose alone
# make core   compiles the core of the sources         make sanitize  its tests, with sanitizers
# make learn  learns everything again from DATA=...   make figures  those of the papers, in docs/
# make camera VIDEO=/dev/video0 FOV=65 PEOPLE=1: tracks who is there, and shows it in RViz
#
# Each works as the first command after a clone: it installs its requirements into .venv and builds
# the packages once. See CONTRIBUTING.md.

SHELL := /bin/bash
.SHELLFLAGS := -e -o pipefail -c
.DEFAULT_GOAL := help
.PHONY: help setup core detector demo camera test lint sanitize bench soak learn figures clean lock

# Small matrices: a second BLAS thread costs more than it saves.
export OMP_NUM_THREADS := 1
export OPENBLAS_NUM_THREADS := 1

WORKSPACE := tools/workspace.sh
# Without network a line says so, with the exit code 78, and the rest goes on.
WITH_DETECTOR := $(WORKSPACE) detector || [ $$? -eq 78 ]
PYTHON_IN_VENV := .venv/bin/python
SOURCED := source tools/environment.bash &&
TEST_PROCESSES ?= 2
SOAK_MINUTES ?= 10
CORE := hmt_ros/core
DATA ?= $(or $(HMT_SHARED),../shared)
VIDEO ?= /dev/video0
FOV ?=
PEOPLE ?= 1
DEMO_BAG ?= $(patsubst %/metadata.yaml,%,$(firstword $(wildcard bags/*/metadata.yaml)))

help:
	@sed -n 's/^# \{0,1\}//p; /^$$/q' Makefile

setup:
	@$(WORKSPACE) ros test lint core build
	@$(WITH_DETECTOR)

core:
	@$(WORKSPACE) ros core

detector:
	@$(WORKSPACE) ros core detector

demo:
	@$(WORKSPACE) ros core build
	@$(WITH_DETECTOR)
	@rm -rf build/demo && mkdir -p build/demo
	@echo 'starting the demonstration'
	@$(SOURCED) python tools/demonstration/demo.py $(DEMO_BAG) -o build/demo --live

camera:
	@$(WORKSPACE) ros core build
	@$(WITH_DETECTOR)
	@tools/camera.sh $(VIDEO) "$(FOV)" $(PEOPLE)

test:
	@$(WORKSPACE) ros test core build
	@$(WORKSPACE) detector || echo 'hmt_ros: the tests of MediaPipe Pose are skipped' >&2
	@$(SOURCED) python -m pytest -n $(TEST_PROCESSES) --dist loadfile --no-loadscope-reorder $(ARGS)

lint:
	@$(WORKSPACE) ros lint
	@$(PYTHON_IN_VENV) -m ruff check .
	@$(PYTHON_IN_VENV) -m ruff format --check .
	@$(PYTHON_IN_VENV) -m mypy
	@$(PYTHON_IN_VENV) tools/english.py
	@find $(CORE) -name '*.h' -o -name '*.cpp' | xargs .venv/bin/clang-format --dry-run -Werror

# AddressSanitizer and UndefinedBehaviorSanitizer of g++. What Python itself leaks is not told.
sanitize:
	@$(WORKSPACE) ros test sanitize
	@ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 PYTHONMALLOC=malloc \
	  LD_PRELOAD="$$(g++ -print-file-name=libasan.so) $$(g++ -print-file-name=libstdc++.so)" \
	  $(PYTHON_IN_VENV) -m pytest -o pythonpath='build/sanitize/lib .' $(or $(ARGS),test/core)

bench:
	@$(WORKSPACE) ros test core build
	@$(SOURCED) python -m benchmarks $(ARGS)

soak:
	@$(WORKSPACE) ros test core build
	@$(SOURCED) python -m benchmarks soak --minutes $(SOAK_MINUTES) $(ARGS)

figures: demo
	@$(WORKSPACE) test
	@$(SOURCED) for papers in sampling smoothing experts demonstration; do python docs/figures_$$papers.py; done

learn:
	@$(WORKSPACE) ros test core build
	@$(SOURCED) tools/learn.sh $(DATA) build/learned

clean:
	rm -rf .venv build install log .coverage .coverage.* .hypothesis .mypy_cache .pytest_cache .ruff_cache *.egg-info $(CORE)/*.so
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The newest versions that fit together on every supported Python. Only this target changes them.
lock:
	@$(WORKSPACE) ros
	@$(PYTHON_IN_VENV) -m pip install -qq uv
	@: >requirements/lock.txt
	@.venv/bin/uv pip compile --quiet --universal --python-version 3.10 --annotation-style line \
	  --custom-compile-command 'make lock' requirements/{runtime,ros,test,lint,detector}.txt -o requirements/lock.txt
	@sed -i "/sys_platform == 'win32'/d" requirements/lock.txt
