# Each target sets up what it needs in .venv; only Python and make are required.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ARGS ?=
# An environment of an older Python would remain, also with another PYTHON.
CHECK := import sys; sys.version_info >= (3, 10) or sys.exit("Python 3.10 or newer \
is needed, not " + sys.version.split()[0] + ": make PYTHON=python3.11 ...")
# The policy of `make view` and `make demo`.
POLICY ?= field_proximity

.PHONY: train demo view test test-slow test-browser test-warp test-memory verify check
.PHONY: bench docs clean

train: $(VENV)/run
	$(BIN)/python scripts/ppo.py $(ARGS)

view: $(VENV)/run
	$(BIN)/python -m egoskin view $(POLICY) $(ARGS)

demo: $(VENV)/run
	$(BIN)/python scripts/evaluate.py $(POLICY) --episodes 256
	$(BIN)/python scripts/render.py $(POLICY) --standard run --longest-of 16 \
		--out demo.mp4 --fps 20 --size 640 360

test: $(VENV)/dev
	$(BIN)/python -m pytest -m "not slow" -n 2 --dist worksteal $(ARGS)

test-slow: $(VENV)/dev
	$(BIN)/python -m pytest -m slow $(ARGS)

# The page in a Chromium without a display; -rs says what is missing.
test-browser: $(VENV)/dev
	$(BIN)/python -m pip install --quiet --editable ".[browser]"
	$(BIN)/python -m pytest -m slow -rs tests/viewer/test_web_browser.py $(ARGS)

# Engine warp against engine mujoco, without a GPU. Warp compiles first, which it keeps.
test-warp: $(VENV)/dev
	$(BIN)/python -m pip install --quiet --editable ".[gpu]"
	$(BIN)/python -m pytest -m warp -s $(ARGS)

# Trains for half an hour and checks that memory does not grow.
test-memory: $(VENV)/dev
	EGOSKIN_MEMORY_MINUTES=30 $(BIN)/python -m pytest -m slow -s -k memory $(ARGS)

verify: $(VENV)/run
	$(BIN)/python scripts/verify.py $(ARGS)

check: $(VENV)/dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

bench: $(VENV)/run
	$(BIN)/python scripts/bench.py loop $(ARGS)

# The site: docs/_build/index.html.
docs: $(VENV)/dev
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --nitpicky --quiet \
		docs docs/_build

clean:
	rm -rf $(VENV) docs/_build

$(VENV)/run: pyproject.toml
	@$(PYTHON) -c '$(CHECK)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable ".[view,study,export]"
	touch $@

$(VENV)/dev: pyproject.toml
	@$(PYTHON) -c '$(CHECK)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	touch $@ $(VENV)/run
