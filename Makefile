# SPDX-License-Identifier: MIT
PYTHON ?= $(firstword $(wildcard .venv/bin/python) python3)

.PHONY: check test docs docs-serve bench accuracy nightly

check:  ## style and types
	$(PYTHON) -m ruff check .
	$(PYTHON) -m ruff format --check .
	$(PYTHON) -m mypy

test:  ## the default suite; `make test ARGS="-m 'not slow'"` leaves out real data and long runs
	$(PYTHON) -m pytest $(ARGS)

docs:  ## the site, in out/site; open out/site/index.html
	NO_MKDOCS_2_WARNING=1 $(PYTHON) -m mkdocs build --strict

docs-serve:  ## the site at 127.0.0.1:8000, built anew when a page is saved
	NO_MKDOCS_2_WARNING=1 $(PYTHON) -m mkdocs serve --no-strict

bench:  ## one JSON line a case
	$(PYTHON) lab/bench/bench.py $(ARGS)

accuracy:  ## every row, then the tables and plots of docs/accuracy.md
	$(PYTHON) lab/evaluation/accuracy.py --output out/accuracy --write-docs $(ARGS)

nightly:  ## the long forms of what the tests try: about two hours
	$(PYTHON) -m pytest --nightly -m nightly
	$(PYTHON) lab/reliability/chaos.py --seeds 20
	$(PYTHON) lab/reliability/hostile.py
	$(PYTHON) lab/reliability/hostile.py --access stranger
	$(PYTHON) lab/reliability/hostile.py --access allowed
	$(PYTHON) lab/reliability/fuzz.py --cases 1000000
	$(PYTHON) lab/reliability/soak.py --keyframes 10000 --kills 12
	$(PYTHON) lab/reliability/faults.py
	$(PYTHON) lab/reliability/plant_faults.py
	$(PYTHON) lab/reliability/delivery.py
	$(PYTHON) lab/bench/cluster.py --kills 20
