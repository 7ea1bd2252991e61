# Verbs. Each makes .venv itself; all that is needed is Python >= 3.11 (with venv and headers), make and, better than what the index has, g++.
#
#   make demo                  survey a simulated warehouse, serve its map, localize the robots of the next day in it
#   make demo RECORDING=PATH   build a map of half of a recording, serve it, localize the other half in it
#   make test                  all tests but the long ones
#   make test-all              every test: with browser walks, fault sweeps, real recordings, nights and drills
#   make test-ci               make test, and those of the long tests that CI runs (tests/tiers.toml)
#   make ros2-env              install ROS 2 for the tests with it, into .ros2 (Python 3.11; 190 MB, a minute)
#   make sanitize              what computes, with a core that ends at a read beside an array or an undefined result (needs g++)
#   make check                 format, lint, types, import contracts
#   make docs                  write the tables of docs/command_line.md and docs/settings.md anew
#   make core                  build what changed of the compiled core, shared/core, beside the sources; the other verbs do it first
#   make bench                 all figures of tests/acceptance.toml; many hours (NAMES="joining fleet" for some)
#   make acceptance            those that no change may make worse; an hour
#   make record                write docs/record.md: acceptance, unseen seeds, hashes of inputs and outputs; an hour (NAMES= for some)
#   make record-check          repeat a part of it on this machine and compare: equal, or how far apart; minutes
#   make profile               where the CPU time of a build and of a robot's frame goes, into docs/performance.md (RECORDING=PATH: of its build)
#   make study NAME=warehouse  an experiment of docs/studies once more (FRESH=1: from its beginning)
#   make clean                 remove everything that the other verbs made

PYTHON ?= python3
RECORDING ?=
TESTS ?= tests
PYTEST_ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
# pip compiles libraries, COMPILE the sources here, also where PYTHONDONTWRITEBYTECODE forbids programs to do it as they go.
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
COMPILE := $(BIN)/python -m compileall -q shared mapserver locclient
# What the compiled core is built with, beside a C++ compiler.
CORE_TOOLS := cmake ninja nanobind scikit-build-core
BUILD_CORE := shared/core/build.sh $(VENV)
# Stamps: the time of the last install. Installing for development covers what the demo runs, and takes a core while another compiles.
CORE_STAMP := $(VENV)/.installed-core
RUN_STAMP := $(VENV)/.installed-run
DEV_STAMP := $(VENV)/.installed-dev
INPUTS := pyproject.toml constraints.txt

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help core compiled demo demo-recording test test-ci test-all ros2-env sanitizers sanitize check docs bench acceptance record record-check profile study clean

help:
	@sed -n '1,/^$$/s/^# \{0,1\}//p' Makefile

core: $(DEV_STAMP) compiled

compiled: $(CORE_STAMP)
	@$(BUILD_CORE)

demo: demo-recording $(RUN_STAMP)
	@$(BUILD_CORE)
	@$(COMPILE)
	@BIN=$(BIN) deploy/demo.sh "$(RECORDING)"

# Before the minute of installing.
demo-recording:
	@deploy/demo.sh --check "$(RECORDING)"

# Tests write to folders of their own; of one file they run in one process, so that they share what it made.
RUN_TESTS = $(BIN)/python -m pytest $(TESTS) --numprocesses=auto --dist=loadfile --no-loadscope-reorder $(PYTEST_ARGS)

test: core
	@$(COMPILE) tests/support
	$(RUN_TESTS) -m "not long"

test-ci: core
	@$(COMPILE) tests/support
	$(RUN_TESTS) -m "not long or ci"

test-all: core
	@$(COMPILE) tests/support
	$(RUN_TESTS)

# ROS itself, for tests of what speaks with it; they are skipped without.
ROS2 := tests/support/ros2
ros2-env: .ros2/.complete

.ros2/.complete: $(ROS2)/environment.sh $(ROS2)/requirements.txt $(wildcard $(ROS2)/interfaces/* $(ROS2)/interfaces/*/*/*) | $(DEV_STAMP)
	@$(ROS2)/environment.sh

check: $(DEV_STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/clang-format --dry-run -Werror $$(git ls-files 'shared/core/*.h' 'shared/core/*.cpp')
	$(BIN)/mypy
	$(BIN)/lint-imports

# The core once more, with sanitizers, and what calls it: a read beside an array, or an overflow, ends the test.
SANITIZED := $(VENV)/core-sanitize
TESTS_OF_CORE := $(addprefix tests/,fleetmap fleetsim mapserver/survey mapserver/calibration mapserver/surfels mapserver/grid mapserver/tiles \
	locclient/localization locclient/replay/test_failure_replay.py)
# What bounds the memory of its own process, or counts what it freed: a sanitizer has 20 TB of addresses and its own allocator.
NOT_SANITIZED := locclient/replay/test_failure_replay.py::test_the_server_replays_it_in_a_process_with_limits fleetmap/test_free_memory.py
GXX := $${CXX:-c++}
sanitize: sanitizers core
	@$(BUILD_CORE) sanitize
	LD_PRELOAD="$$($(GXX) -print-file-name=libasan.so) $$($(GXX) -print-file-name=libubsan.so) $$($(GXX) -print-file-name=libstdc++.so)" \
		ASAN_OPTIONS=detect_leaks=0:max_allocation_size_mb=1536:allocator_may_return_null=1 FLEETMAP_CORE="$$(echo $(CURDIR)/$(SANITIZED)/_core.*.so)" \
		FLEETMAP_HOSTILE_EXAMPLES=1000 PYTHONPATH=shared/core/sanitize \
		$(BIN)/python -m pytest $(TESTS_OF_CORE) $(addprefix --deselect=tests/,$(NOT_SANITIZED)) --numprocesses=auto --dist=loadfile --no-loadscope-reorder $(PYTEST_ARGS)

# Python, which is not built with them, loads the libraries of g++ first; clang's cannot be had so.
sanitizers:
	@for library in libasan libubsan libstdc++; do \
	  test -f "$$($(GXX) -print-file-name=$$library.so 2>/dev/null)" && ! $(GXX) --version | grep -q clang || { \
	  echo "fleetmap: make sanitize needs g++ and its $$library.so (g++ on Debian and Ubuntu), which $(GXX) is not" >&2; exit 1; }; \
	done

docs: core
	$(BIN)/python docs/generate.py

bench: core
	PYTHONPATH=tests $(BIN)/python tests/acceptance.py --all $(NAMES)

acceptance: core
	PYTHONPATH=tests $(BIN)/python tests/acceptance.py $(NAMES)

record: core
	PYTHONPATH=tests $(BIN)/python -m studies.record $(NAMES)

record-check: core
	PYTHONPATH=tests $(BIN)/python -m studies.record --check

profile: core
	PYTHONPATH=tests $(BIN)/python -m benchmarks.profiled $(RECORDING)

study: core
	@test -f "tests/studies/$(NAME).py" || { echo "NAME=one of docs/studies, such as make study NAME=warehouse"; exit 2; }
	PYTHONPATH=tests $(BIN)/python -m studies.$(NAME)

clean:
	rm -rf $(VENV) .ros2 shared/fleetmap/_core.*.so out dist build .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@command -v "$(PYTHON)" >/dev/null || { \
	  echo "fleetmap: no $(PYTHON) found; install Python 3.11 or newer, or name one: make PYTHON=/path/to/python3" >&2; exit 1; }
	@"$(PYTHON)" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "fleetmap: $$("$(PYTHON)" --version 2>&1) is too old; Python 3.11 or newer is needed: make PYTHON=/path/to/python3.11" >&2; exit 1; }
	@"$(PYTHON)" -m venv $(VENV) || { \
	  rm -rf $(VENV); echo "fleetmap: $(PYTHON) cannot make virtual environments; install its venv module (python3-venv on Debian)" >&2; exit 1; }

$(CORE_STAMP): $(INPUTS) | $(BIN)/python
	@$(INSTALL) $(CORE_TOOLS)
	@touch $(CORE_STAMP)

$(DEV_STAMP): $(CORE_STAMP) | $(BIN)/python
	@echo "installing fleetmap with everything that tests need into $(VENV)"
	@$(INSTALL) -e ".[dev]"
	@$(COMPILE)
	@touch $(RUN_STAMP) $(DEV_STAMP)

$(RUN_STAMP): $(CORE_STAMP) | $(BIN)/python
	@echo "installing fleetmap, server, client and simulator, into $(VENV)"
	@$(INSTALL) -e ".[server,client,sim]"
	@$(COMPILE)
	@touch $(RUN_STAMP)
