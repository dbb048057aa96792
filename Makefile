PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO := outputs/demo

.PHONY: install demo docs test quick check bench bench-dask clean

install: $(VENV)/installed

$(VENV)/installed: requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	touch $@

demo: install
	rm -rf $(DEMO)
	$(BIN)/pilotage sample stars $(DEMO)/stars
	$(BIN)/pilotage run $(DEMO)/stars --output $(DEMO)/run || test $$? -eq 1
	$(BIN)/pilotage show $(DEMO)/run --truth $(DEMO)/stars/truth.json --limit 20
	$(BIN)/pilotage sample flyby $(DEMO)/flyby
	$(BIN)/pilotage run $(DEMO)/flyby --output $(DEMO)/flyby-run --pictures all || test $$? -eq 1
	$(BIN)/pilotage show $(DEMO)/flyby-run --truth $(DEMO)/flyby/truth.json --limit 24
	$(BIN)/pilotage report $(DEMO)/flyby-run
	$(BIN)/pilotage sample asteroid $(DEMO)/asteroid --images 2 --coverage 0.7
	$(BIN)/pilotage run $(DEMO)/asteroid --output $(DEMO)/asteroid-run || test $$? -eq 1
	$(BIN)/pilotage show $(DEMO)/asteroid-run --truth $(DEMO)/asteroid/truth.json
	$(BIN)/pilotage sample aerial $(DEMO)/aerial
	$(BIN)/pilotage pose $(DEMO)/aerial/matches.parquet --cameras $(DEMO)/aerial/cameras.json --output $(DEMO)/aerial/views.parquet --arcs $(DEMO)/aerial/arcs || test $$? -eq 1
	@echo "The archives are in $(DEMO)/stars, $(DEMO)/flyby and $(DEMO)/asteroid, the answers in $(DEMO)/run, $(DEMO)/flyby-run and $(DEMO)/asteroid-run: offsets/ and the other tables, images/*.json. Open $(DEMO)/flyby-run/report.html in a browser."

test: install
	$(BIN)/python -m pytest -n 2

quick: install
	$(BIN)/python -m pytest -n 2 -m "not slow"

check: install
	$(BIN)/ruff check .
	$(BIN)/mypy

docs: install
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --site-dir build/site

bench-dask: install
	$(BIN)/python -m workflows.bench_dask

bench: install
	$(BIN)/python -m workflows.bench

clean:
	rm -rf $(VENV) $(DEMO)
