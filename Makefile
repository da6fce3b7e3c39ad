# The two commands of the README, and what they need. Only Python, git and make are expected to be there.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := demo

.PHONY: demo test check environment clean

demo: environment
	rm -rf $(DEMO) && mkdir $(DEMO)
	$(BIN)/submin simulate region --out $(DEMO)/catalogue
	$(BIN)/submin create $(DEMO)/network --fit $(DEMO)/catalogue --tile-km 100 --overlap-km 50
	$(BIN)/submin run $(DEMO)/catalogue $(DEMO)/network --workers 2
	$(BIN)/submin query $(DEMO)/network --bbox 99.5 34.5 100.5 35.5 --policy rigorous --out $(DEMO)/control.parquet
	$(BIN)/submin check $(DEMO)/network $(DEMO)/catalogue/check.parquet --out $(DEMO)/accuracy.txt
	$(BIN)/submin map $(DEMO)/network --out $(DEMO)/network.png

test: check
	$(BIN)/python -m pytest

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
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) $(DEMO) build *.egg-info
