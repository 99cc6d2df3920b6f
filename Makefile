# Two commands on a fresh machine with Python >= 3.11: `make demo` and `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo test test-thorough test-guest lint bench bench-peers proto messages-page clean

# The environment: pinned versions from requirements.lock, then the project itself, editable.
$(READY): requirements.lock pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	touch $@

# make demo            the synthetic mission over 150 s of the trials profile
# make demo LOG=x.mcap the same with a real recording
demo: $(READY)
	$(BIN)/straitlink demo $(if $(LOG),--log "$(LOG)") $(DEMO_ARGS)

# First what needs no clock, then the tests with real processes, which mostly wait: two files at a time, so that
# the tests of one can look at the same flight. Then, alone, those that measure time.
test: $(READY)
	$(BIN)/python -m pytest -m "not guest and not live" -n 2 --dist worksteal $(PYTEST_ARGS)
	$(BIN)/python -m pytest -m "live and not guest and not exact" -n 2 --dist loadfile $(PYTEST_ARGS)
	$(BIN)/python -m pytest -m "exact" $(PYTEST_ARGS)

# Twenty times the examples of each property that names no number, others each time for all, and 500 missions of
# chaos: about an hour.
test-thorough: $(READY)
	$(BIN)/python -m pytest -m "not guest and not live" -n 2 --dist loadfile \
		--hypothesis-profile=thorough --timeout=1200 $(PYTEST_ARGS)
	$(BIN)/straitlink chaos --count 500

# Over a real kernel's netem, in user-mode Linux; needs tools/install_guest.sh and takes some minutes more.
test-guest: $(READY)
	$(BIN)/python -m pytest -m guest $(PYTEST_ARGS)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

# Every bench that needs no root, and out/bench/index.html of what they found.
bench: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r bench/requirements.lock
	$(BIN)/python -m bench

# What a user would pick instead, over the same emulated link, in network namespaces: needs root and /dev/net/tun.
bench-peers: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps \
		-r bench/requirements.lock -r bench/peers/requirements.lock
	$(BIN)/python -m bench.peers $(BENCH_ARGS)
	$(BIN)/python -m bench.page

# Regenerates messages/proto/**/*_pb2.py and .pyi; a test checks that they are current.
proto: $(READY)
	$(BIN)/python tools/generate_protobuf.py

# Rewrites docs/messages.md from the catalogue; a test checks that it is current.
messages-page: $(READY)
	$(BIN)/python -m tools.generate_messages_page

clean:
	rm -rf $(VENV) out build *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
