# SPDX-License-Identifier: MIT
PYTHON ?= $(firstword $(wildcard .venv/bin/python) python3)

.PHONY: check test bench accuracy

check:  ## style and types
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m mypy

test:  ## everything; `make test ARGS="-m 'not slow'"` leaves out the long ones
	$(PYTHON) -m pytest $(ARGS)

bench:  ## one JSON line a case
	$(PYTHON) scripts/bench.py $(ARGS)

accuracy:  ## every row, then the tables and plots of docs/accuracy.md
	$(PYTHON) scripts/accuracy.py --output out/accuracy --write-docs $(ARGS)
