# Every target sets up .venv by itself on a fresh machine; a repeated call finds it ready. C is not
# built here: the editable install rebuilds the core when Python imports it and a source changed.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
VERSION := $(shell sed -n 's/^.define RTHYB_VERSION "\(.*\)"/\1/p' csrc/rthyb.h)
# A changed version or a moved repository asks for a new installation, as a changed build file does.
# The editable install knows the modules that were there when it was made: a new one asks for another.
KEY := $(VERSION)-$(word 1,$(shell { pwd; find rthyb_rt -name '*.py' | sort; } | cksum))
READY := $(VENV)/.ready-$(KEY)
TEST_READY := $(VENV)/.test-$(KEY)
LINT_READY := $(VENV)/.lint-$(KEY)
C_SOURCES := $(wildcard csrc/*.c)
C_FILES := $(C_SOURCES) $(wildcard csrc/*.h)

# Another environment that happens to be active must not reach into this one. Containers often forbid
# bytecode: every process of the program, and every session of pytest, would then compile all of it anew.
unexport VIRTUAL_ENV PYTHONPATH PYTHONHOME CONDA_PREFIX PYTHONDONTWRITEBYTECODE
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# cmake and ninja of the environment serve where the system has none.
export PATH := $(PATH):$(CURDIR)/$(BIN)

.DELETE_ON_ERROR:
.NOTPARALLEL:
.PHONY: help run install reproduce test test-long test-opensees gfortran test-fortran test-vm test-systemd test-live soak sanitize fuzz \
        fuzz-station tsan validate-realtime proof validate-diagnosis validate-diagnosis-short validate-policy benchmark-rths \
        benchmark-rths-short benchmark-marths bench bench-pairs lint docs man wheels test-aarch64 clean

help:
	@echo 'make run        a whole hybrid test on the built-in ground motion'
	@echo 'make install    the service of docs/service.md into this PC, as root (RIG=my-rig.toml)'
	@echo "make reproduce  the paper's studies: figures, tables, accepted bands"
	@echo 'make test       the test suite'
	@echo 'make test-long  the long tests: each takes a second or more, some a minute'
	@echo 'make test-opensees  structures held against OpenSees, which is installed for it'
	@echo 'make test-fortran  a numerical part in Fortran, whose compiler is installed for it'
	@echo 'make test-vm    the tests that need a kernel with SocketCAN, in a guest machine'
	@echo 'make test-systemd  the service as systemd runs it, in a guest machine'
	@echo 'make test-live  the live view in chromium: moving curves, hold, stop, a trip'
	@echo 'make sanitize   the test suite on a core built with ASan and UBSan'
	@echo 'make fuzz       a minute of libFuzzer on the decoding of frames (SECONDS=60)'
	@echo 'make fuzz-station  ten million random ticks of station, loop and drive (TICKS=, SECONDS=, SEED=)'
	@echo 'make tsan       ring, mailbox, parameters and counters under ThreadSanitizer'
	@echo 'make validate-realtime  the long measurements of real time: stalls, drifting clocks, jitter; minutes'
	@echo 'make soak       a service for five minutes, and nothing that grows (SECONDS=300)'
	@echo 'make validate-diagnosis  the diagnosis on cases that it has not seen, into docs (COUNT=60, SEED=)'
	@echo 'make validate-diagnosis-short  a fixed few of them, held against that page; two minutes'
	@echo 'make validate-policy  each threshold of the diagnosis moved, into docs; minutes a case (COUNT=10, UNMEASURED=1)'
	@echo 'make benchmark-rths  every control law on the benchmark of the field, into docs; half an hour (JOBS=2)'
	@echo 'make benchmark-rths-short  the goals of the law inverse on it, held; three minutes'
	@echo 'make benchmark-marths  the benchmark of two actuators, into docs; ten minutes (JOBS=2)'
	@echo 'make bench      computing times beside the facts of this machine'
	@echo 'make bench-pairs  the time of a sample beside that of another checkout (WITH=../older, PAIRS=9)'
	@echo 'make lint       formatters, linters, type checker, compiler warnings'
	@echo 'make docs       the guide as a web site in build/site; broken links are errors'
	@echo 'make man        the manual page, after a change to the help of a command'
	@echo 'make wheels     source distribution and wheels in dist/; the one for this machine is installed and run'
	@echo 'make test-aarch64  the C tests of the core on an emulated 64-bit ARM processor'
	@echo 'make clean      remove .venv, build and caches; runs/ stays'

run: $(READY)
	@$(BIN)/rthyb run

# Where the service sees it, with the system's own Python; enabled and started by whoever wants that.
install:
	@test "$$(id -u)" -eq 0 || { echo 'The files belong to root: sudo make install RIG=my-rig.toml'; exit 1; }
	$(require_tools)
	@/usr/bin/python3 -m venv /opt/rthyb
	@/opt/rthyb/bin/python -m pip install -q --upgrade '.[live,wire]'
	@ln -sf /opt/rthyb/bin/rthyb /usr/local/bin/rthyb
	@/opt/rthyb/bin/rthyb install-service $(if $(RIG),--rig '$(RIG)')

# The record of Section 4.2, TCU068, comes with a package of the test group.
reproduce: $(TEST_READY)
	@$(BIN)/rthyb reproduce

# What may take the whole of two processors; then what goes by the clock and mostly waits for it, four
# at a time; then what compares computing times. A machine that stalls may make any scenario with more than one
# process fail: what has failed is tried once more, by itself.
with_mark = $(shell grep -l 'mark\.$(1)' tests/test_*.py)
ANYWHERE := not alone and not long
CLOCKED := alone and not long
AGAIN := echo 'Once more, what has failed:'; $(BIN)/python -m pytest --last-failed --last-failed-no-failures none
COMPARED := tests/test_speed.py
# All three parts run, also after a failure in one.
test: $(TEST_READY)
	@failed=; trap 'exit 130' INT; \
	$(BIN)/python -m pytest -m '$(ANYWHERE)' -n 2 --dist loadfile || { $(AGAIN) -m '$(ANYWHERE)'; } \
	    || failed="$$failed, scenarios in virtual time"; \
	$(BIN)/python -m pytest -m '$(CLOCKED)' -n 4 --dist loadfile $(filter-out $(COMPARED),$(call with_mark,alone)) \
	    || { $(AGAIN) -m '$(CLOCKED)'; } || failed="$$failed, scenarios on the clock"; \
	$(BIN)/python -m pytest $(COMPARED) || { $(AGAIN) $(COMPARED); } || failed="$$failed, computing times"; \
	test -z "$$failed" || { echo "Failed:$${failed#,}"; exit 1; }

# Scenarios of a second to a minute, which share next to nothing: whoever is done takes half of what the
# other one has before it. One worker leaves a processor to something else.
WORKERS := 2
test-long: $(TEST_READY)
	@$(BIN)/python -m pytest -m long -n $(WORKERS) --dist worksteal $(call with_mark,long) || { $(AGAIN) -m long; }

# Without openseespy these tests are skipped, so it is installed here, with what it needs of Debian.
OPENSEES = $(BIN)/python -c 'import openseespy.opensees' >/dev/null 2>&1
test-opensees: $(TEST_READY)
	@$(OPENSEES) || $(BIN)/python -m pip install -qq openseespy
	@$(OPENSEES) || $(call or_install,libblas3 liblapack3,what OpenSees needs)
	@$(BIN)/python -c 'import openseespy.opensees'
	@$(BIN)/python -m pytest tests/test_numerical_sparse.py tests/test_openseesmodel.py \
	    tests/test_element_laws.py tests/test_validate_opensees.py -k opensees

# Without a Fortran compiler the example in Fortran is skipped elsewhere.
gfortran:
	@command -v gfortran >/dev/null || $(call or_install,gfortran,gfortran) \
	    || { echo 'gfortran could not be installed: see above'; exit 1; }
test-fortran: gfortran $(TEST_READY)
	@$(BIN)/python -m pytest tests/test_own_library.py -k "fortran or examples"

# The guest is Debian's user-mode Linux, fetched into build/vm (Debian: user-mode-linux,
# busybox-static, can-utils, iproute2). The core is built here first: in the guest nothing is.
IN_GUEST := python -m pytest -rs -o cache_dir=/run/tmp/pytest -o faulthandler_timeout=240
VM_TESTS := tests/vm $(wildcard $(addprefix tests/test_,loop.py links_socketcan.py realtime_vcan.py))
test-vm: $(TEST_READY)
	@$(BIN)/python -c 'import rthyb_rt._core'
	@$(BIN)/python tests/vm/guest.py --timeout 1500 -- sh -c '$(IN_GUEST) $(VM_TESTS) || { echo "Once more, what has failed:"; \
	    $(IN_GUEST) --last-failed --last-failed-no-failures none $(VM_TESTS); }'

# A day of the service in three boots of a guest whose first process is systemd; it is installed from
# a wheel, as in a lab, with the packages of .venv.
test-systemd: $(TEST_READY)
	@$(BIN)/python -m pip install -qq --no-deps --no-build-isolation --upgrade \
	    -Cbuild-dir=build/vm/wheel --target build/vm/program .
	@$(BIN)/python tests/vm/guest.py --systemd --timeout 900 -- sh -c 'exec python -m pytest -p no:cacheprovider -rs \
	    -o python_files="boot_$${RTHYB_BOOT}_*.py" tests/vm/systemd'

# Playwright drives the chromium of the system; root gets one that is missing.
CHROMIUM = command -v chromium >/dev/null || $(call or_install,chromium,chromium)
LIVE_TESTS := -o python_files="browser_*.py" tests/browser
test-live: $(TEST_READY)
	@$(CHROMIUM)
	@$(BIN)/python -m pip install -qq --group browser
	@$(BIN)/python -m pytest $(LIVE_TESTS) || { $(AGAIN) $(LIVE_TESTS); }

bench: $(TEST_READY)
	@$(BIN)/python tests/bench/bench.py

# Another checkout of the program, such as one of an older version: make bench-pairs WITH=../older
PAIRS := 9
bench-pairs: $(READY)
	@test -n '$(WITH)' || { echo 'Name the folder of the other checkout: make bench-pairs WITH=../older'; exit 1; }
	@$(BIN)/python tests/bench/pairs.py '$(WITH)' --pairs $(PAIRS)

# What of C was clean and has not changed since is not looked at again: that takes most of the time.
C_IS_CLEAN = build/lint/clean-$(word 1,$(shell cat $(C_FILES) csrc/CMakeLists.txt .clang-tidy | cksum))
lint: $(LINT_READY)
	@echo 'ruff' && $(BIN)/ruff check --quiet . && $(BIN)/ruff format --check --quiet .
	@echo 'codespell' && git ls-files -z | xargs -0 $(BIN)/codespell --toml pyproject.toml
	@echo 'phrases' && ! git grep -n -i -F -f docs/tools/phrases.txt -- '*.md' '*.py' '*.[ch]' '*.j2' '*.toml' Makefile systemd
	@echo 'mypy --strict' && $(BIN)/mypy --strict --no-error-summary rthyb_rt
	@echo 'clang-format' && $(BIN)/clang-format --dry-run -Werror $(C_FILES)
	@test -e $(C_IS_CLEAN) || { echo 'compiler warnings' && mkdir -p build && { \
	    cmake -S csrc -B build/lint -DRTHYB_PYTHON=OFF -DRTHYB_WERROR=ON && cmake --build build/lint; \
	    } >build/lint.log 2>&1 || { cat build/lint.log; exit 1; }; }
	@test -e $(C_IS_CLEAN) || { echo 'clang-tidy' && printf '%s\n' $(C_SOURCES) \
	    | xargs -n 1 -P 2 $(BIN)/clang-tidy -p build/lint --quiet; }
	@rm -f build/lint/clean-* && touch $(C_IS_CLEAN)

docs: $(READY)
	@$(BIN)/python -m pip install -qq --group docs
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict && echo 'build/site/index.html'

# The page that `man rthyb` shows: after a change to the help of a command.
man: $(READY)
	@$(BIN)/python docs/tools/man_page.py

wheels: $(READY)
	@$(BIN)/python -m pip install -qq --group wheels
	@$(BIN)/python release/wheels.py

# Debian's qemu-user-static; root gets one that is missing.
QEMU = command -v qemu-aarch64-static >/dev/null || $(call or_install,qemu-user-static,qemu)
test-aarch64: $(READY)
	@$(QEMU)
	@$(BIN)/python -m pip install -qq --group wheels
	@$(BIN)/python release/aarch64.py

# The interpreter is not instrumented, so the sanitizer's library is loaded before it; libstdc++ must
# follow at once, or other packages' C++ exceptions are missed. Python frees too little at its end
# for a leak check to mean anything. A second environment, laid over .venv, holds the instrumented
# core; what measures computing time is left out.
OVERLAY := build/sanitize/venv
sanitize: $(TEST_READY)
	@echo 'Building the core with ASan and UBSan'
	@test -x $(OVERLAY)/bin/python || $(BIN)/python -m venv --without-pip $(OVERLAY)
	@$(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))' \
	    >"$$($(OVERLAY)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/venv.pth"
	@$(BIN)/python -m pip --python $(OVERLAY)/bin/python install -qq --no-deps --no-build-isolation \
	    --force-reinstall -Cbuild-dir=build/sanitize/core -Ceditable.rebuild=false -Cinstall.strip=false \
	    -Ccmake.define.RTHYB_SANITIZE=address,undefined -e .
	@LD_PRELOAD="$$(gcc -print-file-name=libasan.so) $$(gcc -print-file-name=libstdc++.so.6)" \
	    ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 \
	    $(OVERLAY)/bin/python -m pytest -p no:cacheprovider --capture=sys -m 'not speed and not long'

# Plain C, since the interpreter is not instrumented. Some kernels place memory where the detector cannot
# follow, hence setarch. The last run has a race on purpose, and must be told of.
TSAN := build/tsan
STRESS := ring_stress loop_stress
tsan: $(READY)
	@mkdir -p $(TSAN) && cd $(TSAN) && for name in $(STRESS); do \
	    gcc -std=c11 -O1 -g -fsanitize=thread -I../../csrc ../../tests/$$name.c $(C_SOURCES:%=../../%) \
	        -lm -lpthread -o $$name || exit 1; done
	@fixed=$$(setarch -R true 2>/dev/null && echo setarch -R) || true; \
	    export TSAN_OPTIONS=halt_on_error=1; \
	    for name in $(STRESS); do echo "$$name" && $$fixed $(TSAN)/$$name || exit 1; done; \
	    if $$fixed $(TSAN)/loop_stress race >$(TSAN)/race.log 2>&1; then \
	        echo 'a race made on purpose was not reported'; exit 1; fi; \
	    grep -q 'WARNING: ThreadSanitizer: data race' $(TSAN)/race.log && echo 'no data race'

# Needs a quiet machine; figures go to build/proof.json.
validate-realtime: $(TEST_READY)
	@$(BIN)/python -m pytest -p no:cacheprovider -o python_files="proof_*.py" tests/proof
# Its name until version 0.3.
proof: validate-realtime

SOAK_SECONDS = $(if $(filter command line,$(origin SECONDS)),$(SECONDS),300)
soak: $(TEST_READY)
	@$(BIN)/python tests/proof/soak.py $(SOAK_SECONDS)

# Both generators, the shipped rigs, real recordings: the page goes to docs/diagnosis-proof.md. Without
# SEED= the state of the program gives it. What was stopped goes on where it was: build/validate.
COUNT := 60
RECORDINGS := ../shared/diagnosis/real-open
PROOF = $(BIN)/python tests/validate/proof.py
validate-diagnosis: $(TEST_READY)
	@$(BIN)/python -m pip install -qq --group prove
	@$(OPENSEES) || $(BIN)/python -m pip install -qq openseespy || :
	@$(PROOF) --count $(COUNT) $(if $(filter command line,$(origin SEED)),--seed $(SEED)) \
	    --recordings '$(RECORDINGS)' --page docs/diagnosis-proof.md

validate-diagnosis-short: $(TEST_READY)
	@$(PROOF) --short --jobs $(WORKERS)

# Minutes a case, one processor. What was stopped goes on at its case: build/policy.
validate-policy: $(TEST_READY)
	@OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/validate/sensitivity.py \
	    $(if $(filter command line,$(origin COUNT)),--count $(COUNT)) \
	    $(if $(filter command line,$(origin SEED)),--seed $(SEED)) \
	    $(if $(UNMEASURED),--unmeasured) --page docs/diagnosis-policy.md

# Every control law on the same plants; the page and its picture go to docs.
JOBS := 2
benchmark-rths: $(READY)
	@OPENBLAS_NUM_THREADS=1 $(BIN)/python docs/tools/benchmark_page.py --jobs $(JOBS)

# The goals of the law inverse, held: all plants, both rates, three minutes of computing time.
benchmark-rths-short: $(READY)
	@OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/bench/benchmark_limits.py --jobs $(WORKERS)

# The numerical part by sparse matrices is factored by what the test group brings.
benchmark-marths: $(TEST_READY)
	@OPENBLAS_NUM_THREADS=1 $(BIN)/python docs/tools/marths_page.py --jobs $(JOBS)

# clang and its run-time library (Debian: clang, libclang-rt-14-dev) are asked for here only. What was
# found stays in build/fuzz and is where the next run begins.
SECONDS := 60
FUZZ := build/fuzz
fuzz: $(READY)
	@command -v clang >/dev/null || { echo 'Install clang: sudo apt-get install clang libclang-rt-14-dev'; exit 1; }
	@mkdir -p $(FUZZ)/corpus && { cmake -S csrc -B $(FUZZ) -DCMAKE_C_COMPILER=clang -DRTHYB_PYTHON=OFF \
	    -DRTHYB_FUZZ=ON -DRTHYB_SANITIZE=address,undefined && cmake --build $(FUZZ) -j 2; \
	    } >build/fuzz.log 2>&1 || { cat build/fuzz.log; exit 1; }
	@$(FUZZ)/fuzz_wire -max_total_time=$(SECONDS) -max_len=4096 -print_final_stats=1 \
	    -artifact_prefix=$(FUZZ)/ $(FUZZ)/corpus >$(FUZZ)/run.log 2>&1 \
	    || { tail -n 60 $(FUZZ)/run.log; exit 1; }
	@sed -n 's/^stat::number_of_executed_units: */inputs without a finding: /p' $(FUZZ)/run.log

# Plain C with gcc; a seed gives the same episodes again. What is broken is told with the seed of
# its episode, and build/fuzz-station/fuzz_station episode SEED shows that one's last ticks again.
TICKS := 10000000
SEED := 1
STATION_FUZZ := build/fuzz-station
STATION_FUZZ_LENGTH = $(if $(filter command line,$(origin SECONDS)),seconds $(SECONDS),ticks $(TICKS))
AXES_FUZZ_LENGTH = $(if $(filter command line,$(origin SECONDS)),seconds $(SECONDS),ticks $(shell expr $(TICKS) / 5))
fuzz-station:
	$(require_tools)
	@mkdir -p $(STATION_FUZZ)
	@gcc -std=c11 -O2 -g -ffp-contract=off -fno-math-errno -fno-omit-frame-pointer -Icsrc \
	    -fsanitize=address,undefined,float-cast-overflow -fno-sanitize-recover=all \
	    tests/fuzz/fuzz_station.c $(C_SOURCES) -lm -lpthread -o $(STATION_FUZZ)/fuzz_station
	@gcc -std=c11 -O2 -g -ffp-contract=off -fno-math-errno -fno-omit-frame-pointer -Icsrc \
	    -fsanitize=address,undefined,float-cast-overflow -fno-sanitize-recover=all \
	    tests/fuzz/fuzz_axes.c $(C_SOURCES) -lm -lpthread -o $(STATION_FUZZ)/fuzz_axes
	@$(STATION_FUZZ)/fuzz_station $(STATION_FUZZ_LENGTH) $(SEED)
	@$(STATION_FUZZ)/fuzz_axes $(AXES_FUZZ_LENGTH) $(SEED)

clean:
	@rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .benchmarks
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +

# ---- the environment ------------------------------------------------------------------------------

# Debian packages that are missing: a C compiler that finds its headers, a Python >= 3.11 that can
# make an environment, and its headers.
MISSING = $(shell \
    py() { $(PYTHON) -c "$$1" >/dev/null 2>&1; }; \
    command -v gcc >/dev/null || echo gcc; \
    echo '\#include <math.h>' | gcc -E - >/dev/null 2>&1 || echo libc6-dev; \
    py '' || echo $(notdir $(PYTHON)); \
    py 'import ensurepip, venv' || echo $(notdir $(PYTHON))-venv; \
    py 'import os, sysconfig as s; os.stat(s.get_path("include") + "/Python.h")' \
        || echo $(notdir $(PYTHON))-dev)
TOO_OLD = $(shell $(PYTHON) -c 'import sys; v = sys.version_info; v < (3, 11) and print(*v[:3], sep=".")' \
    2>/dev/null)
CAN_INSTALL = $(shell test "$$(id -u)" -eq 0 && command -v apt-get)

# Debian packages, by root; another apt-get that runs is waited for.
define apt_install
echo 'Installing $(1)' && apt-get -qq update \
    && DEBIAN_FRONTEND=noninteractive apt-get -qq -o DPkg::Lock::Timeout=300 install -y \
    --no-install-recommends $(1) >/dev/null
endef

# Packages (1) that something needs, called (2): installed, or one line and a stop where root is needed for it.
define or_install
$(if $(CAN_INSTALL),{ $(call apt_install,$(1)); },{ echo 'Install $(2): sudo apt-get install $(1)'; exit 1; })
endef

# One line and a stop, unless the tools are there or root can have them installed.
define require_tools
$(eval old := $(strip $(TOO_OLD)))
$(if $(old),$(error $(PYTHON) is Python $(old), 3.11 or newer is needed: make PYTHON=/path/to/python3.11))
$(eval missing := $(strip $(MISSING)))
$(if $(missing),$(if $(CAN_INSTALL),,$(error Install what is missing: sudo apt-get install $(missing))))
$(if $(missing),@$(call apt_install,$(missing)))
endef

# The rebuild on import looks for cmake on the PATH of whoever imports.
define FIND_CMAKE
import pathlib, sysconfig
scripts, packages = (pathlib.Path(sysconfig.get_path(name)) for name in ("scripts", "purelib"))
if (scripts / "cmake").exists():
    (packages / "rthyb_cmake.pth").write_text(
        'import os, sys; os.environ["PATH"] = os.pathsep.join('
        '(os.environ.get("PATH", os.defpath), os.path.join(sys.prefix, "bin")))\n'
    )
endef
export FIND_CMAKE

$(READY): pyproject.toml csrc/CMakeLists.txt csrc/cffi_build.py
	$(require_tools)
	@echo 'Setting up $(VENV)'
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV)
	@$(BIN)/python -m pip install -qq --upgrade 'pip>=25.1'
	@$(BIN)/python -m pip install -qq --group build
	@needs=$$($(BIN)/python -c 'from scikit_build_core.build import get_requires_for_build_editable as f; \
	    print(*f())') && { test -z "$$needs" || $(BIN)/python -m pip install -qq $$needs; }
	@$(BIN)/python -c "$$FIND_CMAKE"
	@echo 'Building the C core and installing rthyb'
	@$(BIN)/python -m pip install -qq --no-build-isolation -e '.[report,fit,live,structures,data]'
	@rm -f $(VENV)/.ready-* && touch $@

$(TEST_READY): $(READY)
	@echo 'Installing what the tests need'
	@$(BIN)/python -m pip install -qq --group test
	@rm -f $(VENV)/.test-* && touch $@

$(LINT_READY): $(READY)
	@echo 'Installing the linters'
	@$(BIN)/python -m pip install -qq --group lint
	@rm -f $(VENV)/.lint-* && touch $@
