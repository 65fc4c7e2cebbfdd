# make demo: run the main job on a sample.  make test / test-all: the tests, without and with the slow ones.
# make check: lint and types.  make bench: measure this machine and write docs/speed.md (nothing else may run).
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed

# Real nuScenes frames and reference numbers, where somebody has laid them beside the checkout.
ifneq ($(wildcard ../shared),)
export BEVCLI_SHARED ?= $(abspath ../shared)
endif

.PHONY: install demo test test-all check format bench clean

install: $(INSTALLED)

$(INSTALLED): pyproject.toml constraints.txt
	test -x $(BIN)/python || python3 -m venv $(VENV)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

demo: $(INSTALLED)
	$(BIN)/bevcli run samples/street --out runs/street --force

test: $(INSTALLED)
	$(BIN)/pytest -m "not slow and not gpu"

test-all: $(VENV)/.viewers
	$(BIN)/pytest

$(VENV)/.viewers: $(INSTALLED)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[dev,notebook]' playwright
	.ci/install-viewers
	touch $@

bench: $(INSTALLED)
	$(BIN)/bevcli bench --table docs/speed.md

check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache
