# make setup   prepare .venv/ and install/; the other targets do it by themselves, with what they need
# make demo    tune a simulated loop over real DDS; leaves demo_output/
# make test    lint, type check, and the tests in both environments
# make test-web       the tests of the page in the browser, which need a Chromium
# make lint    ruff and mypy alone
# make test-nightly   the tests that take long and prove little more
# make release lay the two packages side by side in release/, for tools that look there
# make docs    build the user guide as a web site in docs/_build/html
# make clean   remove everything that the above have made

PYTHON ?= python3
ENTER = . ./env.sh
# targets that run beside each other remember apart what failed
PYTEST = python3 -m pytest -q -o cache_dir=.pytest_cache/$@
SOURCES = setup.py docs/conf.py launch relay_autotune test tools $(wildcard bags benchmarks)
# neither the demo nor a test shall meet the nodes of another machine
export ROS_AUTOMATIC_DISCOVERY_RANGE = LOCALHOST
# without the cached bytecode each of some hundred nodes and commands would compile its modules again
export PYTHONDONTWRITEBYTECODE =

.PHONY: setup setup-tests demo test test-nightly test-web test-core test-oldest test-system test-cli test-rest lint docs release clean

setup:
	@$(PYTHON) tools/prepare.py

setup-tests:
	@$(PYTHON) tools/prepare.py tests

demo: setup
	@$(ENTER) && python3 -m relay_autotune.cli.demo

# Both environments beside each other, with the tests in the oldest one, which needs no built
# messages. Then all others beside the running nodes, which `nice` lets go first: a busy machine
# makes them late. Two at a time, the longest first: three took a fifth more of two processors.
test:
	@status=0; $(MAKE) --no-print-directory --jobs=2 setup-tests test-oldest || status=$$?; \
	[ -f install/relay_autotune/.prepared ] || exit $$status; \
	echo "the tests run beside each other now, each prints at its end"; \
	$(MAKE) --no-print-directory --jobs=2 --keep-going --output-sync=target \
		test-system test-core test-cli test-rest lint || status=$$?; exit $$status

test-core: setup-tests
	@$(ENTER) && nice $(PYTEST) test/core

# A machine that is busy with something else can miss the deadline of a running node: what failed
# runs once more, by itself.
ONCE_MORE = || { echo "$@: what failed runs once more, by itself"; \
	$(PYTEST) --last-failed --last-failed-no-failures=none

# running nodes, over real DDS, which wait much: three files at a time
test-system: setup-tests
	@$(ENTER) && { $(PYTEST) --numprocesses=3 --dist=loadfile --no-loadscope-reorder \
		test/system \
		$(ONCE_MORE) test/system; }; }

test-cli: setup-tests
	@$(ENTER) && { nice $(PYTEST) test/cli test/docs $(ONCE_MORE) test/cli test/docs; }; }

ELSEWHERE = $(patsubst %,--ignore=test/%,core system cli docs)
test-rest: setup-tests
	@$(ENTER) && { nice $(PYTEST) $(ELSEWHERE) $(ONCE_MORE) $(ELSEWHERE); }; }

# the numeric core with the oldest numeric libraries, without ROS
test-oldest:
	@$(PYTHON) tools/prepare.py oldest
	@if [ -d .venv-oldest ]; then \
		.venv-oldest/bin/python -m pytest -q -m "not nightly and not long" --first-cases test/core; fi

# What the core says must not turn on the last digit, in which the processors' kernels differ. One
# that a processor lacks falls back to the one before.
test-nightly: setup-tests
	@$(ENTER) && python3 -m pytest -q -m nightly
	@$(ENTER) && for kernel in Haswell Zen SkylakeX; do \
		OPENBLAS_CORETYPE=$$kernel python3 -m pytest -q test/core || exit 1; done
	@$(PYTHON) tools/prepare.py oldest
	@if [ -d .venv-oldest ]; then \
		.venv-oldest/bin/python -m pytest -q -m "" test/core; fi

test-web: setup-tests
	@$(ENTER) && python3 -m pytest -q --require-chromium test/web

lint: setup-tests
	@$(ENTER) && ruff check $(SOURCES)
	@$(ENTER) && ruff check --preview --select CPY001 $(SOURCES)
	@$(ENTER) && ruff format --check $(SOURCES)
	@$(ENTER) && oxlint --quiet relay_autotune/web/static
	@$(ENTER) && nice mypy

docs:
	@$(PYTHON) tools/prepare.py docs
	@$(PYTHON) tools/build_docs.py

release:
	@rm -rf release && $(PYTHON) tools/release_tree.py release

clean:
	rm -rf .venv .venv-* build install log demo_output release docs/_build .hypothesis .*_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
