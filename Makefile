# make demo       run the model on samples/street; the recording is runs/street/recording.rrd
# make test       the fast tests, in two processes of one thread each; make test-all: all tests
# make fuzz       6,450 broken files of every format, up to ten minutes
# make check      lint and types; make format: fix what ruff can fix
# make gpu-check  check bevcli on a GPU, and write gpu-report.md to paste into an issue; DEVICE=cuda:1 or DEVICE=mps
# make bench      measure this machine and rewrite the table of docs/speed.md; nothing else should run meanwhile
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

# Reference data that is not in this repository (real nuScenes frames, reference numbers). Tests skip without it.
ifneq ($(wildcard ../shared),)
export BEVCLI_SHARED ?= $(abspath ../shared)
endif

.PHONY: install demo test test-all fuzz check format bench gpu-check clean

install: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	test -x $(BIN)/python || python3 -m venv $(VENV)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev,onnx,openvino]'
	touch $@

demo: $(INSTALLED)
	$(BIN)/bevcli run samples/street --out runs/street --force

test: $(INSTALLED)
	OMP_NUM_THREADS=1 $(BIN)/pytest --numprocesses 2 --dist loadfile -m "not slow and not gpu"

test-all: $(VENV)/.viewers
	$(BIN)/pytest

$(VENV)/.viewers: $(INSTALLED)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev,notebook,onnx,openvino]' playwright
	.ci/install-viewers
	touch $@

bench: $(INSTALLED)
	$(BIN)/bevcli bench --table docs/speed.md

gpu-check: $(INSTALLED)
	$(BIN)/python -m bevcli.benchmark.gpu_check --device $(or $(DEVICE),auto)

fuzz: $(INSTALLED)
	BEVCLI_FUZZ_CASES=$${BEVCLI_FUZZ_CASES:-150} $(BIN)/pytest tests/fuzz

check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache
