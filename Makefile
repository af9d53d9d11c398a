# Two commands: `make demo` trains and shows a team, `make test` runs the checks.
PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || command -v python3.13 || command -v python3)
BIN := .venv/bin

.PHONY: demo test slow docs clean

demo: .venv/installed
	@rm -rf demo
	$(BIN)/race sweep docs/examples/demo.toml --run-dir demo/runs
	$(BIN)/race plot demo/runs --team all --out demo/curve.png
	$(BIN)/race render demo/runs/mamujoco-HalfCheetah-2x3-race-matd3-seed1 --out demo/team.mp4
	@echo "demo/curve.png: RACE's teams and its base MATD3 alone, one seed each: too few to tell which"
	@echo "is better. RACE's 'selected' is its MARL team or its champion, whichever had the better"
	@echo "training episodes; chosen by luck in part, it may test worse than the MARL team."
	@echo "demo/team.mp4: a video of it."

test: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest -n 2

slow: .venv/installed-dev .venv/installed-docs
	$(BIN)/pytest -m slow

docs: .venv/installed-docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "The site is in build/site; open build/site/index.html"

.venv/bin/python:
	$(PYTHON) -c "import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))" \
	  || { echo "race needs Python 3.11, 3.12 or 3.13; name one: make PYTHON=/path/to/python3.11 ..."; exit 1; }
	$(PYTHON) -m venv .venv

.venv/installed: .venv/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable .
	@touch $@

.venv/installed-dev: .venv/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[dev]'
	@touch $@ .venv/installed

.venv/installed-docs: .venv/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	@touch $@ .venv/installed

clean:
	rm -rf .venv build dist *.egg-info demo
