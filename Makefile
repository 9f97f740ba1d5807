# Needs only Python >= 3.11, make and a package index. The first run of any target but `clean` creates .venv and installs;
# later runs install nothing until pyproject.toml, constraints.txt, the Python or the checkout's place changes.

PYTHON ?= python3
# Two processes with one torch thread each beat one process with two threads; 0 runs all tests in one process (for pdb).
WORKERS ?= 2
PYTEST_ARGS ?=
VENV := .venv
RUN := $(VENV)/bin/python

.DEFAULT_GOAL := help
.PHONY: help install demo test lint bench clean
.NOTPARALLEL:

ifneq ($(filter-out help clean,$(MAKECMDGOALS)),)
KEY := $(shell $(PYTHON) -c 'import hashlib, os, sys; assert sys.version_info >= (3, 11); \
	print(hashlib.sha256(b"".join(open(f, "rb").read() for f in ("pyproject.toml", "constraints.txt")) \
	+ repr((sys.version, os.getcwd())).encode()).hexdigest()[:12])' 2>/dev/null)
ifeq ($(KEY),)
$(error '$(PYTHON)' is not Python 3.11 or newer: name one with 'make PYTHON=/path/to/python3.11 $(MAKECMDGOALS)')
endif
endif
STAMP := $(VENV)/.installed-$(KEY)

help:
	@echo "make demo     fit light propagation volumes to the Cornell box; report in out/demo/report.html"
	@echo "make test     all tests (PYTEST_ARGS='tests/test_sh.py -x' for some of them)"
	@echo "make lint     ruff and mypy"
	@echo "make bench    speed, memory and accuracy on this machine, and what moved since benchmarks/baseline.json"
	@echo "make install  only create .venv and install (PYTHON=python3.12 to choose the interpreter)"
	@echo "make clean    remove .venv, build output and tool caches; keeps out/"

install: $(STAMP)

# .installing marks an installation under way and becomes the stamp when it is complete: a half-installed environment,
# or one of another Python, is thrown away rather than repaired.
$(STAMP):
	@if [ -e $(VENV)/.installing ]; then echo "The last installation was interrupted: starting afresh."; rm -rf $(VENV); fi
	@if [ -d $(VENV) ] && [ "$$($(RUN) -V 2>&1)" != "$$($(PYTHON) -V 2>&1)" ]; then rm -rf $(VENV); fi
	@echo "Installing difflpv and what it needs into $(VENV) (once; a few minutes)"
	@$(PYTHON) -m venv $(VENV)
	@rm -f $(VENV)/.installed-* && touch $(VENV)/.installing
	@$(RUN) -m pip install --quiet --disable-pip-version-check -c constraints.txt setuptools
	$(RUN) -m pip install --disable-pip-version-check -c constraints.txt --no-build-isolation -e '.[dev]'
	@mv $(VENV)/.installing $@

demo: $(STAMP)
	$(VENV)/bin/difflpv demo --out out/demo

test: $(STAMP)
	OMP_NUM_THREADS=1 $(RUN) -m pytest -n $(WORKERS) --dist loadfile $(PYTEST_ARGS)

lint: $(STAMP)
	$(RUN) -m ruff check .
	$(RUN) -m mypy

bench: $(STAMP)
	$(RUN) benchmarks/baseline.py --out out/bench

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
