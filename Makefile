# The two commands of the README, and what they need. Only Python, git and make are expected to be there.
PYTHON ?= python3
# a second Python, to which networks must travel; looked for when not given
PYENV := $(shell pyenv root 2>/dev/null || echo $(HOME)/.pyenv)
OTHER_PYTHON ?= $(firstword $(wildcard $(PYENV)/versions/3.13*/bin/python) $(shell python3.13 -c 'import sys; print(sys.executable)' 2>/dev/null))
VENV := .venv
BIN := $(VENV)/bin
DEMO := demo

.PHONY: demo test check environment other-environment other-python clean

demo: environment
	rm -rf $(DEMO) && mkdir $(DEMO)
	$(BIN)/submin simulate region --out $(DEMO)/catalogue
	$(BIN)/submin create $(DEMO)/network --fit $(DEMO)/catalogue --tile-km 100 --overlap-km 50
	$(BIN)/submin run $(DEMO)/catalogue $(DEMO)/network --workers 2
	$(BIN)/submin query $(DEMO)/network --bbox 99.5 34.5 100.5 35.5 --policy rigorous --out $(DEMO)/control.parquet
	$(BIN)/submin check $(DEMO)/network $(DEMO)/catalogue/check.parquet --out $(DEMO)/accuracy.txt
	$(BIN)/submin map $(DEMO)/network --out $(DEMO)/network.png

test: check
	$(BIN)/python -m pytest --numprocesses auto --dist loadfile

check: environment
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

environment: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit("submin needs Python 3.11 or later") if sys.version_info < (3, 11) else None'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable '.[dev,benchmarks]'
	touch $@

other-environment: $(VENV)-other/.ready

# which one that would be; nothing where there is none
other-python:
	@echo "$(OTHER_PYTHON)"

$(VENV)-other/.ready: pyproject.toml
	test -n "$(OTHER_PYTHON)" || { echo "no second Python found: give OTHER_PYTHON=python3.13 or another"; exit 1; }
	$(OTHER_PYTHON) -m venv $(VENV)-other
	$(VENV)-other/bin/python -m pip install --quiet --upgrade pip
	$(VENV)-other/bin/python -m pip install --quiet --editable .
	touch $@

clean:
	rm -rf $(VENV) $(VENV)-other $(DEMO) build *.egg-info
