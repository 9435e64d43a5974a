# Every verb works on a fresh clone with Python 3.10+ (with venv) and make; nothing else is needed.
# Packages come from the hashed locks alone, into .venv of this checkout.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# setup.sh prints one line with the fix when something is missing.
SETUP := PYTHON=$(PYTHON) sh scripts/setup.sh
PYTEST := $(BIN)/python -m pytest
# One worker more than processors: many tests wait for processes.
WORKERS ?= $(shell expr $$(nproc) + 1)
# Tests start hundreds of processes: without this each of them compiles every module again where the variable is set.
export PYTHONDONTWRITEBYTECODE :=

.DEFAULT_GOAL := help
.PHONY: help setup assets native sanitize synth demo test quick slow browser clients localstack ros lint types bench docs site release lock fuzz sbom audit-deps clean

help: ## show these targets
	@awk -F':.*## ' '/^[a-z-]+:.*## /{printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: ## install everything a developer needs: Node, the CDK, the cloud's packages
	@$(SETUP) dev
	@$(BIN)/python scripts/assets.py
	@sh scripts/cdk.sh

assets: ## build the packages for AWS into build/, and the native core for aarch64
	@$(SETUP) dev
	@$(BIN)/python scripts/assets.py
	@$(BIN)/python scripts/assets.py --arm || echo "assets: the packages for AWS are complete, without a core for ARM"

native: ## compile the native core into native/build; `make -C native check` runs its C++ checks
	@sh scripts/native.sh

sanitize: ## run the native core with the address and undefined-behaviour sanitizers
	@$(SETUP) dev
	@sh scripts/sanitize.sh

synth: ## write the CloudFormation templates into cdk.out; needs no account, and no network after setup
	@$(SETUP) dev
	@$(BIN)/python scripts/assets.py
	@sh scripts/cdk.sh synth --quiet

demo: ## run robots that build point-cloud maps with the PnP service; writes ./out
	@$(SETUP) demo
	@$(BIN)/rse-pf demo --out out $(ARGS)

test: ## run what CI runs: lint, types, all tests but the slow ones
	@$(SETUP) dev
	@$(BIN)/ruff check . && $(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(PYTEST) -m "not slow" -n $(WORKERS) --dist loadfile $(ARGS)

quick: ## run the pure tests only, in seconds
	@$(SETUP) dev
	@$(PYTEST) -q -m "not slow and not system" -n 2 --dist loadfile $(ARGS)

slow: ## run what make test leaves out: conformance suites, recordings, a bare Debian
	@$(SETUP) dev
	@$(BIN)/python scripts/assets.py
	@$(PYTEST) -m slow $(ARGS)

browser: ## try the fleet page in Debian's Chromium, and save its pictures in docs/images
	@$(SETUP) dev ci
	@RSE_PF_SCREENSHOTS=docs/images $(PYTEST) -q -rs -s -n 0 -m slow tests/fleet_page/test_in_chromium.py $(ARGS)

clients: ## run every client through one table against a real platform; writes out/clients.json
	@PYTHON=$(PYTHON) sh scripts/clients.sh
	@$(BIN)/python tests/clients/conformance.py $(ARGS)

localstack: ## run the tests of AWS against LocalStack, without Docker and without an account
	@$(SETUP) dev
	@sh scripts/localstack.sh $(ARGS)

ros: ## try the bridge of ROS with a real ROS 1 and a real ROS 2
	@PYTHON=$(PYTHON) sh scripts/ros.sh
	@$(PYTEST) -q -rs -n 0 -m slow tests/ros_bridge $(ARGS)

lint: ## run ruff, check only
	@$(SETUP) dev
	@$(BIN)/ruff check . && $(BIN)/ruff format --check .

types: ## run mypy --strict
	@$(SETUP) dev
	@$(BIN)/mypy

bench: ## run every benchmark that needs no argument; writes JSON to out/bench
	@$(SETUP) dev
	@$(BIN)/python -m benchmarks all out/bench

docs: ## write the generated pages and documents
	@$(SETUP) dev
	@$(BIN)/rse-pf settings --markdown > docs/settings.md
	@$(BIN)/rse-pf errors --markdown > docs/errors.md
	@$(BIN)/python scripts/asyncapi.py
	@$(BIN)/python scripts/grafana.py

site: ## build the documentation site into build/site; needs no network after setup
	@$(SETUP) ci
	@sh scripts/site.sh

release: ## build the packages that can be published, twice, and compare them; writes build/release
	@$(SETUP) dev
	@sh scripts/release.sh

fuzz: ## fuzz each target for FUZZ_S seconds (600), with atheris where it is installed, else Hypothesis
	@$(SETUP) dev
	@engine=hypothesis; $(BIN)/python -c 'import atheris' 2>/dev/null && engine=atheris; \
	for each in codec frames stream geometry maps keyframes snapshots graph cloud match depth describe track live; do echo "== $$each ($$engine)"; \
	  $(BIN)/python -m fuzz $$each --engine $$engine --seconds $${FUZZ_S:-600} || exit 1; done

sbom: ## write the bill of materials of the locks and of vendored files, as CycloneDX, to build/sbom.json
	@$(SETUP) dev
	@mkdir -p build
	@$(BIN)/python -m cyclonedx_py requirements locks/demo.txt --pyproject pyproject.toml --mc-type application \
	  --output-reproducible --of JSON -o build/sbom.json
	@$(BIN)/python -m cyclonedx_py requirements locks/boot.txt --pyproject pyproject.toml --mc-type application \
	  --output-reproducible --of JSON -o build/sbom-boot.json
	@$(BIN)/python scripts/sbom.py build/sbom.json build/sbom-boot.json
	@echo "build/sbom.json: a robot and the local platform; build/sbom-boot.json: a cloud server"

audit-deps: ## check the locked versions for known weaknesses; needs the network
	@$(SETUP) dev
	@$(BIN)/pip-audit --disable-pip --require-hashes -r locks/demo.txt -r locks/boot.txt -r locks/lambda.txt

lock: ## resolve the newest versions and write them with hashes into locks/
	@$(SETUP) dev
	@sh scripts/lock.sh

clean: ## remove the virtual environment and everything built
	rm -rf $(VENV) build dist out cdk.out node_modules *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
