# make demo       run the model on samples/street; installs what a user needs; the recording is runs/street/recording.rrd
# make install    what a developer needs
# make test       the fast tests, in two processes of one thread each; make test-all: all tests
# make docs       the site of the documents of this version in build/site/VERSION, and the list of versions in build/site
# make dist       the sdist and the wheel of the last commit in dist
# make fuzz       11,700 broken files and wrong contents of every kind, up to 25 minutes on two cores
# make check      lint, who imports whom, and types; make format: fix what ruff can fix
# make gpu-check  check bevcli on a GPU, and write gpu-report.md to paste into an issue; DEVICE=cuda:1 or DEVICE=mps
# make bench      measure this machine and rewrite the table of docs/speed.md; nothing else should run meanwhile
VENV := .venv
ifeq ($(OS),Windows_NT)
BIN := $(VENV)/Scripts
PYTHON := python
else
BIN := $(VENV)/bin
PYTHON := python3
endif
VERSION := $(shell sed -n 's/^__version__ = "\(.*\)"/\1/p' bevcli/_version.py)
USER := $(VENV)/.user
DEVELOPER := $(VENV)/.developer
WRITER := $(VENV)/.docs
VIEWERS := $(VENV)/.viewers
PACKAGER := $(VENV)/.packager
# Files are compiled when they are first imported: a demo imports few of them.
PIP := $(BIN)/pip install --quiet --no-compile --constraint constraints.txt

# Reference data that is not in this repository (real nuScenes frames, reference numbers). Tests skip without it.
ifneq ($(wildcard ../shared),)
export BEVCLI_SHARED ?= $(abspath ../shared)
endif

.PHONY: install demo test test-all docs dist fuzz check format bench gpu-check clean

install: $(DEVELOPER)

$(USER): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(PIP) --editable .
	touch $@

$(DEVELOPER): $(USER)
	$(PIP) --editable '.[dev,onnx,openvino]'
	touch $@

$(WRITER): $(USER)
	$(PIP) --editable '.[docs]'
	touch $@

$(PACKAGER): $(USER)
	$(PIP) --editable '.[dist]'
	touch $@

$(VIEWERS): $(DEVELOPER)
	$(PIP) --editable '.[dev,dist,docs,notebook,onnx,openvino,triton]' playwright
	.ci/install-viewers
	touch $@

demo: $(USER)
	$(BIN)/bevcli run samples/street --out runs/street --force

# Compiled modules are kept, also where the environment says not to: programs that tests start import in a third of the time.
test test-all: export PYTHONDONTWRITEBYTECODE :=

# A worker that crashes ends the tests: pytest-xdist's scheduler of groups waits for ever when it is replaced.
test: $(DEVELOPER)
	OMP_NUM_THREADS=1 $(BIN)/pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder --max-worker-restart 0 -m "not slow and not gpu"

test-all: $(VIEWERS)
	$(BIN)/pytest

docs: $(WRITER)
	$(BIN)/sphinx-build --fail-on-warning --quiet -c docs/site -d build/doctrees -b html . build/site/$(VERSION)
	$(BIN)/python docs/site/versions.py build/site

dist: $(PACKAGER)
	rm -rf dist
	PATH="$(abspath $(BIN)):$$PATH" .ci/build-dist dist

bench: $(DEVELOPER)
	$(BIN)/python docs/site/speed_table.py docs/speed.md

gpu-check: $(DEVELOPER)
	$(BIN)/python tests/tools/gpu_check.py --device $(or $(DEVICE),auto)

fuzz: $(DEVELOPER)
	OMP_NUM_THREADS=1 BEVCLI_FUZZ_CASES=$${BEVCLI_FUZZ_CASES:-150} BEVCLI_FUZZ_SHARE=$${BEVCLI_FUZZ_SHARE:-1} \
		$(BIN)/pytest --numprocesses 2 --max-worker-restart 0 tests/tools/fuzz

check: $(DEVELOPER)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo
	$(BIN)/mypy

format: $(DEVELOPER)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache
