# Everything a developer or CI runs. `make setup` once, then the rest; all of it in .venv.

PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
# On its own first, so that a build for this machine's device can be chosen (TORCH="torch==2.13.0 --index-url ...").
TORCH_VERSION := 2.13.0
TORCH  ?= torch==$(TORCH_VERSION)
# An old generator, so that robots are free in their protobuf and grpcio versions (1.71.2 emits code for protobuf >= 5.29).
# It pins an old protobuf itself, hence its own environment.
PROTO_TOOLS := grpcio-tools==1.71.2 setuptools==80.9.0
PROTO_VENV  := $(VENV)/proto-tools

# uv compiles no packages when it installs them. Where Python may not write what it has compiled, each of the tests' hundred
# processes compiles all that it imports: a server takes 3.0 s of processor time to start instead of 1.3.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help setup lock test nightly weights lint format proto released demo demo-video bench bench-turns bench-gpu bench-retrieval evidence load load-ray fuzz \
    sbom release-images release-image reference docs clean

help:  ## List the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 12

# Kapture's own library, to which tests compare ours. Without what it depends on, a compiler of 200 MB among it, and hence in
# a folder of its own.
KAPTURE := kapture==1.1.12 numpy-quaternion==2024.0.13

# uv installs in seconds what takes pip minutes. All versions are those of the lock.
INSTALL = $(BIN)/python .ci/uv.py pip install --quiet
LOCKED  = --constraint requirements.lock

$(VENV)/.installed: pyproject.toml requirements.lock
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check $(LOCKED) uv
	$(INSTALL) $(LOCKED) $(TORCH)
	$(INSTALL) $(LOCKED) --editable '.[server,tools,networks,otel,postgres,ray,view,gateway,reconstruct,dev]'
	$(INSTALL) --no-deps --target $(VENV)/kapture $(KAPTURE)
	touch $@

# The modules that are compiled, in place. Without a compiler numpy computes the same in more time.
COMPILED := $(patsubst %.c,%.abi3.so,$(wildcard server/mapless_server/kernels/*.c))
$(COMPILED): setup.py $(wildcard server/mapless_server/kernels/*.c) $(VENV)/.installed
	$(BIN)/python setup.py --quiet build_ext --inplace
	test ! -e $@ || touch $@

setup: $(VENV)/.installed $(COMPILED)  ## Create .venv with everything

lock: $(VENV)/.installed  ## Write the versions of all packages anew after a change of pyproject.toml; UPGRADE=1 for the newest
	$(BIN)/python .ci/lock.py $(TORCH_VERSION) $(if $(UPGRADE),--upgrade)
	cd client/web && npm install --package-lock-only --ignore-scripts --no-audit --no-fund

# The matrices are small: threads gain nothing, and wait for one another where cores are shared. Not so the full networks.
THREADS ?= 1
# Three processes, for tests of servers wait a quarter of their time: two use 1.5 of two cores. The one that has finished takes
# over tests of the others; WORKERS= for one process.
WORKERS ?= -n 3 --dist worksteal
tools: setup $(PROTO_VENV)/.installed  ## Install all that tests need

test: tools  ## Run the tests in at most five minutes; ARGS=... for pytest
	OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=$(THREADS) PROTO_PYTHON=$(PROTO_VENV)/bin/python $(BIN)/python -m pytest $(WORKERS) $(ARGS)

nightly: weights  ## Run the tests that are slow and not specific to a change; TENTH=0 to 9 for a tenth of them, as CI does
	$(MAKE) test ARGS="-m nightly --timeout=600 $(if $(TENTH),--tenth=$(TENTH)) $(ARGS)"

# Freely licensed, in the environment's own folder, where tests look for them.
export TEST_WEIGHTS ?= $(abspath $(VENV))/weights
weights: setup
	MAPLESS_WEIGHTS_DIR=$(TEST_WEIGHTS) $(BIN)/mapless-server weights fetch aliked

lint: setup  ## Check style, types and protos
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/buf lint
	$(BIN)/buf breaking --against proto/released.binpb.gz

format: setup  ## Format the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(PROTO_VENV)/.installed: Makefile $(VENV)/.installed
	$(PYTHON) -m venv --without-pip $(PROTO_VENV)
	$(INSTALL) --python $(PROTO_VENV)/bin/python $(PROTO_TOOLS)
	touch $@

proto: $(PROTO_VENV)/.installed  ## Regenerate client/mapless/v1 from proto/
	$(PROTO_VENV)/bin/python -m grpc_tools.protoc -I proto --python_out=client --pyi_out=client \
	    --grpc_python_out=client $(wildcard proto/mapless/v1/*.proto)

released: setup  ## At a release: keep the interface that later ones must not break
	$(BIN)/buf build --exclude-source-info -o proto/released.binpb.gz

demo: setup  ## Localize photographs end to end; DATA=folder for real ones
	$(BIN)/mapless-server demo $(if $(DATA),--data '$(DATA)')

# The programs that measure, and the video of the room, are not installed.
FROM_HERE := PYTHONPATH=client:server
demo-video: setup  ## From a video of a room with a printed tag to localized photographs, judged against the rendered truth
	$(FROM_HERE) $(BIN)/python -m research.rendered_room.demo demo-output/video

bench: setup  ## Measure accuracy and latency on the real scenes; DATA=folder with the scenes
	$(FROM_HERE) $(BIN)/python -m bench $(if $(DATA),'$(DATA)',../shared/data)

bench-turns: setup  ## Compare two commits by turns in one run: BEFORE=commit AFTER=commit or the working tree; WHAT="import start saturation"
	$(FROM_HERE) $(BIN)/python -m bench.turns '$(BEFORE)' '$(AFTER)' $(if $(DATA),--data '$(DATA)') $(WHAT:%=--what %) $(ARGS)

bench-gpu: setup  ## Measure the networks and whole queries on a CUDA device; without one, what a CPU can measure
	$(FROM_HERE) $(BIN)/python -m bench.network $(ARGS)

bench-retrieval: setup  ## Measure retrieval in a scene of a million references: an hour, 5 GB; DATA=folder with the scenes
	$(FROM_HERE) $(BIN)/python -m bench.retrieval --data $(if $(DATA),'$(DATA)',../shared/data) $(ARGS)

evidence: setup  ## Measure a constant again and write its page; KEY=..., without it the keys; DATA=folder with the scenes
	$(FROM_HERE) $(BIN)/python -m research.evidence $(KEY) $(if $(DATA),'$(DATA)') $(ARGS)

load: setup  ## Measure the server under load; DATA=folder for real photographs, ARGS="--minutes 2" for all's options
	$(FROM_HERE) $(BIN)/python -m bench.load all $(if $(DATA),--data '$(DATA)') $(ARGS)

RUNS ?= 1000000
fuzz: setup  ## Fuzz what reads untrusted input; TARGET="images colmap" for some, RUNS=1000 for few, ARGS="--parallel 2"
	PYTHONPATH=tests $(BIN)/python -m fuzz.campaign --output fuzz-output --runs $(RUNS) --targets $(TARGET) $(ARGS)

load-ray: setup  ## Measure replicas on Ray Serve, on this machine: half an hour; PART=overhead, throughput, failover or redeploys
	$(FROM_HERE) $(BIN)/python -m bench.load_ray $(or $(PART),all) $(if $(DATA),--data '$(DATA)') $(ARGS)

$(VENV)/.docs: $(VENV)/.installed
	$(INSTALL) $(LOCKED) --editable '.[docs]'
	touch $@

# What an image holds, for `make sbom`; it is installed as the image's packages are.
EXTRAS ?= server,otel,postgres,networks
sbom: setup  ## Write what an image contains as CycloneDX, build/mapless-VERSION.cdx.json; EXTRAS=... for another image
	$(INSTALL) $(LOCKED) --editable '.[release]'
	$(BIN)/uv venv --quiet --clear build/image
	$(INSTALL) --python build/image/bin/python $(LOCKED) $(TORCH)
	$(INSTALL) --python build/image/bin/python $(LOCKED) '.[$(EXTRAS)]'
	$(BIN)/python .ci/sbom.py $$($(BIN)/python -c "import importlib.metadata as it; print(it.version('mapless'))") build/image

release-images:  ## At a release: pin the images that are deployed by digest; REGISTRY=host IMAGES="mapless:... python:..." for some
	$(PYTHON) .ci/images.py pin '$(REGISTRY)' $(IMAGES)

release-image:  ## At a release: build an image, if the version is a release's and the base is pinned; TARGET=cpu TAG=mapless:...
	$(PYTHON) .ci/images.py build '$(or $(TARGET),cpu)' '$(TAG)'

reference: setup  ## Write the parts of docs/reference that come from the code
	$(BIN)/python docs/reference.py

docs: $(VENV)/.docs  ## Build the documentation as a site in build/docs; a broken link is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

clean:  ## Remove the environment and caches
	rm -rf $(VENV) .mypy_cache .pytest_cache .ruff_cache build *.egg-info
