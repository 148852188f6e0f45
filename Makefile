# `make demo` and `make test` do all their own set-up on a machine with Python 3.11+ and make.

PYTHON ?= python3
BIN := .venv/bin
OTHER_PYTHONS ?= 3.12 3.13
SEED ?= 10
NOISE_STD ?= 0.05
# a process for each core; the tests of a file stay in one, whose fixtures they share
PYTEST := -m pytest -q -n auto --dist loadfile

export PIP_DISABLE_PIP_VERSION_CHECK := 1

.PHONY: demo test test-slow test-train test-lowest test-pythons package bench bench-maps bench-forward bench-refine bench-poses lint format clean

demo: .venv/installed
	@mkdir -p demo
	$(BIN)/prim-record demo/session.mcap --seed $(SEED) --noise-std $(NOISE_STD)
	cd demo && ../$(BIN)/prim-replay session.mcap --mapper det,prob,forward
	cd demo && ../$(BIN)/prim-replay session.mcap --mapper forward
	@echo "open it: $(BIN)/rerun demo/session.forward.rrd (all mappers: demo/session.det-prob-forward.rrd)"
	@$(BIN)/python docs/screenshot.py demo/session.forward.rrd demo/session.forward.png; case $$? in \
	  0) echo "picture: demo/session.forward.png" ;; \
	  4) ;; \
	  *) exit 1 ;; esac

test: lint
	$(BIN)/python $(PYTEST)

test-slow: .venv/installed-dev
	$(BIN)/python -m pytest -q -m slow

# The suites below have environments of their own; CONTRIBUTING.md says what each is for and how long it may take.

test-train: .venv-train/installed
	.venv-train/bin/python -c 'import matplotlib, onnx, onnxslim, torch, torchvision, ultralytics'
	.venv-train/bin/python $(PYTEST) tests/detect

test-lowest: .venv-lowest/installed
	.venv-lowest/bin/python $(PYTEST)

test-pythons: $(OTHER_PYTHONS:%=test-python-%)

test-python-%:
	@if python=$$(.ci/find-python $* 2>&1); then \
	  $(MAKE) --no-print-directory .venv-$*/installed PYTHON="$$python" && .venv-$*/bin/python $(PYTEST); \
	else echo "skipped: $$python"; fi

package: .venv/installed-dev
	.ci/package

bench: .venv/installed
	$(BIN)/python -m bench.speed --update docs/speed.md

bench-maps: .venv/installed
	$(BIN)/python -m bench.maps --update docs/forward.md --short README.md

bench-forward: .venv/installed
	$(BIN)/python -m bench.forward --update docs/forward.md
	$(BIN)/python -m bench.heldout --update docs/forward.md
	$(BIN)/python -m bench.calibrate check --update docs/forward.md

bench-refine: .venv/installed
	$(BIN)/python -m bench.refine --update docs/refine.md
	$(BIN)/python -m bench.shipped --update README.md
	$(BIN)/python -m bench.tracks --update docs/detect.md

bench-poses: .venv/installed-dev
	$(BIN)/python -m bench.poses --sessions 12 --update docs/poses.md
	$(BIN)/python -m bench.poses fusion --sessions 50 --update docs/poses.md

lint: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: .venv/installed-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

.venv/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "prim needs Python 3.11 or newer")'
	$(PYTHON) -m venv .venv

.venv/installed: .venv/bin/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install -q -c constraints.txt -e .
	@touch $@

.venv/installed-dev: .venv/installed
	$(BIN)/python -m pip install -q -c constraints.txt -e '.[dev]'
	@touch $@

.venv-train/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv-train
	.venv-train/bin/python -m pip install -q -c constraints.txt -e '.[dev,train]'
	@touch $@

# lower bounds hold for the oldest Python: later ones need later versions of some packages
.venv-lowest/installed: pyproject.toml .ci/lowest
	python=$$(.ci/find-python 3.11) && "$$python" -m venv .venv-lowest
	.venv-lowest/bin/python .ci/lowest dev >.venv-lowest/constraints.txt
	.venv-lowest/bin/python -m pip install -q -c .venv-lowest/constraints.txt -e '.[dev]'
	@touch $@

.venv-3.%/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv-3.$*
	.venv-3.$*/bin/python -m pip install -q -c constraints.txt -e '.[dev]'
	@touch $@

clean:
	rm -rf .venv .venv-* demo build *.egg-info
