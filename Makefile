# make demo   installs into .venv, segments the demo recording, and says where the results are
# make test   installs, checks the style and the types, and runs all tests
# make docs   makes a site of docs/, in site/
# make release  checks, tests and builds what is published, in dist/; publishes nothing
# make mutants  changes the core in 1000 places, one at a time: how many of the changes the tests notice; hours
# make lock   pins the newest versions of all dependencies, in requirements/
# make audit  asks a public database whether vulnerabilities of those versions are known
# make clean  removes what these made

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= out

SOURCES := pyproject.toml $(shell find app common drivers evaluation library segmentation recordings src -name '*.py' -o -name '*.txt' -o -name '*.mcap' -o -name '*.html' -o -name '*.j2' -o -name '*.css' -o -name '*.js' -o -name py.typed)

# Tests find more real recordings here; they skip what needs them where there are none.
ifneq ($(wildcard ../shared/data),)
export NURBSEG_DATA ?= $(abspath ../shared/data)
endif

# Cameras are tested against the real OpenNI2, the doctor on a simulated bus; pictures of the viewer need a Vulkan driver.
TEST_PACKAGES := g++ libopenni2-0 libopenni2-dev libusb-1.0-0 mesa-vulkan-drivers
# A browser opens the served viewer and the explanation. These are large: they come second, so that the others are
# there if these do not arrive in time.
LARGE_TEST_PACKAGES := chromium graphviz

.PHONY: demo test docs release mutants setup setup-test lint types lock audit clean

demo: $(VENV)/demo.stamp
	rm -rf $(OUT)/demo $(OUT)/demo.rrd $(OUT)/demo.json $(OUT)/demo.png
	mkdir -p $(OUT)
	$(BIN)/nurbseg-live --replay recordings/demo.mcap --speed 0 --view none \
	    --save $(OUT)/demo.rrd --export $(OUT)/demo --export-preview --report $(OUT)/demo.json
	cp "$$(ls $(OUT)/demo/*_preview.png | tail -1)" $(OUT)/demo.png
	@echo
	@echo "the objects of the last frame:   $(OUT)/demo.png"
	@echo "labels and trees of each frame:  $(OUT)/demo/NNNNNN_labels.png, NNNNNN_tree.json"
	@echo "everything, to look at:          $(BIN)/rerun $(OUT)/demo.rrd"
	@echo "rates, latency, memory:          $(OUT)/demo.json"
	@echo "live, with a viewer:             $(BIN)/nurbseg-live"

# A run takes minutes, or longer on a busy computer. A test has five minutes; what prints nothing for ten does not
# end by itself, and is ended. Many tests wait for a camera that has a rate of its own, so there may be more at once
# than there are cores.
test: setup-test lint types
	$(BIN)/python .ci/silence.py 600 $(BIN)/pytest -n 3 --dist worksteal

# A warning is an error. What it needs has the versions that are tested, so the environment stays the same.
docs: $(VENV)/demo.stamp $(VENV)/docs-dependencies.stamp
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going --conf-dir docs --doctree-dir build/docs . site
	@echo "the site's first page: site/docs/index.html"

# docs/releasing.md says what comes before and after.
release: $(VENV)/test.stamp
	$(BIN)/python .ci/release.py ready
	$(MAKE) test
	rm -rf dist
	$(BIN)/hatchling build --directory dist
	$(BIN)/python .ci/release.py built
	@echo "to publish: $$(echo dist/*)"

# Fails where fewer than 85 % of the changes that could be noticed are.
mutants: setup-test
	$(BIN)/python benchmarks/mutation.py --out build/mutation.md

setup: $(VENV)/demo.stamp

setup-test: $(VENV)/test.stamp
	@.ci/system-packages $(TEST_PACKAGES)
	@.ci/system-packages $(LARGE_TEST_PACKAGES)

lint: $(VENV)/test.stamp
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/python .ci/file_lengths.py

types: $(VENV)/test.stamp
	$(BIN)/mypy -p nurbseg
	$(BIN)/mypy examples recordings/make_demo.py recordings/scene

# The virtual environment, from scratch if its making was interrupted. Debian has venv's half in a package of its own.
$(VENV)/bin/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	    || { echo "$(PYTHON) is older than Python 3.11: make PYTHON=python3.11 ..."; exit 1; }
	@$(PYTHON) -c 'import ensurepip' 2>/dev/null || .ci/system-packages python3-venv
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/pip install --quiet --upgrade pip

# What the project depends on, in pinned versions of known content ...
$(VENV)/demo-dependencies.stamp: $(VENV)/bin/pip requirements/build.txt requirements/run.txt
	$(BIN)/pip install --quiet --require-hashes -r requirements/build.txt -r requirements/run.txt
	touch $@

$(VENV)/test-dependencies.stamp: $(VENV)/bin/pip requirements/build.txt requirements/dev.txt
	$(BIN)/pip install --quiet --require-hashes -r requirements/build.txt -r requirements/dev.txt
	touch $@

$(VENV)/docs-dependencies.stamp: $(VENV)/bin/pip requirements/build.txt requirements/docs.txt
	$(BIN)/pip install --quiet --require-hashes -r requirements/build.txt -r requirements/docs.txt
	touch $@

# ... and the project itself, when one of its files does. It is a plain install: what is tested is what is shipped.
define install
rm -rf build
$(BIN)/pip install --quiet --no-build-isolation --no-deps --force-reinstall .
# The inner loops are compiled now, so that no run waits for that.
$(BIN)/nurbseg-live --quiet --replay recordings/demo.mcap --speed 0 --temporal on --view none --save /dev/null
touch $@
endef

$(VENV)/demo.stamp: $(VENV)/demo-dependencies.stamp $(SOURCES)
	$(install)

$(VENV)/test.stamp: $(VENV)/test-dependencies.stamp $(SOURCES)
	$(install)

# For every Python from 3.11 on, and without the name of the registry that was asked.
pin = $(BIN)/uv pip compile --quiet --upgrade --universal --python-version 3.11 --generate-hashes --no-annotate --no-header

lock: $(VENV)/bin/pip
	$(BIN)/pip install --quiet uv
	$(pin) --output-file requirements/run.txt pyproject.toml
	$(pin) --output-file requirements/dev.txt --extra dev pyproject.toml
	$(pin) --output-file requirements/docs.txt --extra docs --constraint requirements/dev.txt pyproject.toml
	sed -n 's/^requires = \["\(.*\)"\]/\1/p' pyproject.toml \
	    | $(pin) --constraint requirements/dev.txt --output-file requirements/build.txt -

audit: $(VENV)/bin/pip
	$(BIN)/pip install --quiet pip-audit
	$(BIN)/pip-audit --require-hashes --disable-pip --strict -r requirements/dev.txt

clean:
	rm -rf $(VENV) $(OUT) build dist site *.egg-info .mypy_cache .pytest_cache .ruff_cache .hypothesis
