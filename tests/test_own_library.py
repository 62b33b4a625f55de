"""A numerical part in a shared library: the examples in C and Fortran against the program's own,
what a library does that no test may wait for, and what is refused before it is run."""

from __future__ import annotations

import math
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from realtime_bench import Bench

import rthyb_rt as rt
from rthyb_rt import core
from rthyb_rt.analysis import summary
from rthyb_rt.api import files
from rthyb_rt.core import loop
from rthyb_rt.core.numerical_parts import Part
from rthyb_rt.core.own_library import LibraryConfig, tried
from rthyb_rt.lab import experiment

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples" / "own_parts"
K_E = 666_400.0
SHORT = rt.Test("section5-T0.5", ground_motion={"duration_s": 3}, test={"free_vibration_s": 0.5})

TEMPLATE = """
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>
#include "rthyb_library.h"
BEFORE
typedef struct { double h, k, x, x1; long n; } state;
int32_t rthyb_part_version(void) { return VERSION; }
int32_t rthyb_part_interfaces(void) { return INTERFACES; }
int64_t rthyb_part_state_bytes(const rthyb_part_setup *setup) { (void)setup; return sizeof(state); }
int32_t rthyb_part_init(void *at, const rthyb_part_setup *setup)
{
    state *s = at;
    s->h = setup->period_s;
    INIT;
    return 0;
}
int32_t rthyb_part_answer(void *at, double ag, const double *force, double *x)
{
    state *s = at;
    const double next = 2.0 * s->x - s->x1 - s->h * s->h * (ag + force[0] / 4220.0);
    s->x1 = s->x;
    s->x = next;
    s->n++;
    *x = next;
    ANSWER;
    return 0;
}
MORE
"""

Build = Callable[..., str]


@pytest.fixture
def build(tmp_path: Path) -> Build:
    """Build a library from the template with something in it; return its path."""

    def make(name: str = "part", **inserts: str) -> str:
        texts = {
            "VERSION": "1",
            "INTERFACES": "1",
            "INIT": "",
            "ANSWER": "",
            "MORE": "",
            "BEFORE": "",
        } | inserts
        source = TEMPLATE
        for key, text in texts.items():
            source = source.replace(key, text)
        path = tmp_path / f"{name}.c"
        path.write_text(source, encoding="utf-8")
        target = tmp_path / f"{name}.so"
        command = ["gcc", "-O1", "-shared", "-fPIC", f"-I{ROOT / 'csrc'}"]
        subprocess.run([*command, path, "-o", target, "-lm"], check=True)
        return str(target)

    return make


def built(folder: Path, source: str, *command: str) -> str:
    target = folder / f"{source.replace('.', '_')}.so"
    subprocess.run([*command, str(EXAMPLES / source), "-o", str(target)], check=True)
    return str(target)


def in_c(folder: Path) -> str:
    """The example in C, by the command of its first lines."""
    return built(
        folder, "oscillator.c", "gcc", "-O2", "-ffp-contract=off", "-shared", "-fPIC",
        f"-I{ROOT / 'csrc'}",
    )  # fmt: skip


def in_fortran(folder: Path) -> str:
    """The example in Fortran, by the command of its first lines."""
    if shutil.which("gfortran") is None:
        pytest.skip("there is no gfortran")
    return built(folder, "oscillator.f90", "gfortran", "-O2", "-shared", "-fPIC", f"-J{folder}")


def of_test(file: str, **more: Any) -> rt.Test:
    """The short test with a library in the place of its equation of motion."""
    return SHORT.with_({"numerical.library": {"file": file, **more}})


def parameters() -> dict[str, float]:
    figures = rt.check(SHORT).figures
    return {
        "mass_kg": figures["mass_kg"], "damping_n_s_per_m": figures["damping_n_s_per_m"],
        "stiffness_n_per_m": 0.0,
    }  # fmt: skip


def refused(test: rt.Test, *, real_time: bool = False) -> list[rt.Problem]:
    with pytest.raises(rt.InputError) as caught:
        experiment.prepare(
            files.file_of_test(test), files.file_of_rig(test.rig), real_time=real_time
        )
    return list(caught.value.problems)


# ---- the examples -------------------------------------------------------------------------------


def test_the_example_in_c_moves_the_specimen_as_the_programs_own_equation_does(
    tmp_path: Path,
) -> None:
    plain = rt.run(SHORT)
    rec = rt.run(of_test(in_c(tmp_path), parameters=parameters()))
    for name in ("x_num_m", "x_meas_m", "f_meas_n"):
        np.testing.assert_array_equal(rec[name], plain[name], err_msg=name)
    assert rec["velocity"].any()
    assert rt.replay(rec).identical


def test_the_example_in_fortran_does_so_to_rounding(tmp_path: Path) -> None:
    config = LibraryConfig(in_fortran(tmp_path), K_E, tuple(parameters().items()))
    settings = {name: value for name, value in parameters().items() if value}
    own = core.Motion(core.MotionConfig("central-difference", **settings))
    model = [core.element("stiffness", k_n_per_m=K_E)]
    ag = np.sin(np.arange(4000) / 90.0)
    x = own.reference(model, ag)[0]
    found = Part(config).joined(model, ag, 0)[0]
    np.testing.assert_allclose(found, x, atol=1e-11 * np.abs(x).max())


def test_without_a_mass_on_the_specimen_the_reference_is_the_programs_own(tmp_path: Path) -> None:
    test = of_test(in_c(tmp_path), parameters=parameters()).with_(rig="delay-10-elastic")
    one, other = rt.run(test), rt.run(SHORT.with_(rig="delay-10-elastic"))
    good = np.isfinite(other["x_ref_m"])
    np.testing.assert_array_equal(one["x_ref_m"][good], other["x_ref_m"][good])


@pytest.mark.parametrize("example", [in_c, in_fortran])
def test_the_examples_may_run_in_real_time(tmp_path: Path, example: Callable[[Path], str]) -> None:
    test = of_test(example(tmp_path), parameters=parameters())
    setup = experiment.prepare(
        files.file_of_test(test), files.file_of_rig(test.rig), real_time=True
    )
    assert setup.controller.numerical is not None


def test_a_test_file_names_a_library_beside_it(tmp_path: Path) -> None:
    in_c(tmp_path)
    path = tmp_path / "test.toml"
    text = of_test("oscillator_c.so", parameters=parameters()).to_toml()
    path.write_text(text, encoding="utf-8")
    assert rt.Test(path)["numerical.library.file"] == str(tmp_path / "oscillator_c.so")
    assert rt.run(rt.Test(path), SHORT.rig).completed


def test_a_state_is_saved_and_restored_as_bytes(tmp_path: Path) -> None:
    settings = tuple({**parameters(), "stiffness_n_per_m": 0.0}.items())
    part = Part(LibraryConfig(in_c(tmp_path), K_E, settings))
    forces = 1e3 * np.sin(np.arange(80) / 5.0)
    for force in forces[:40]:
        part.step(0.2, float(force))
    kept = part.save()
    first = [part.step(0.1, float(force))[0] for force in forces[40:]]
    part.restore(kept)
    assert [part.step(0.1, float(force))[0] for force in forces[40:]] == first


def test_what_a_library_keeps_elsewhere_it_may_bring_along(build: Build) -> None:
    more = """
    void rthyb_part_save(void *at) { ((state *)at)->k = elsewhere; }
    void rthyb_part_restore(void *at) { elsewhere = ((state *)at)->k; }
    """
    file = build(ANSWER="*x = elsewhere += 1e-3", MORE=more, BEFORE="static double elsewhere;")
    part = Part(LibraryConfig(file, K_E))
    part.step(0.0, 0.0)
    saved = part.save()
    assert part.step(0.0, 0.0)[0] == pytest.approx(2e-3)
    part.restore(saved)
    assert part.step(0.0, 0.0)[0] == pytest.approx(2e-3)


# ---- what it may not do -------------------------------------------------------------------------

IN_REAL_TIME = {
    "allocates": (
        "void *volatile block = malloc(64 + (size_t)s->n % 7); free(block)",
        "allocates or frees memory in its step function",
    ),
    "allocates in another library": ('free(strdup("a"))', "allocates or frees memory"),
    "prints": ('printf("%g\\n", next), fflush(stdout)', "makes a system call in its step function"),
    "asks who it is": (
        "s->k = (double)getppid()",
        "makes a system call in its step function (system call",
    ),
    "waits": ("nanosleep(&(struct timespec){.tv_nsec = 1000}, 0)", "makes a system call"),
    "takes long": ("for (volatile int i = 0; i < 1000000; i++) s->k += i", "half of the sampling"),
}


@pytest.mark.long
@pytest.mark.parametrize("what", IN_REAL_TIME)
def test_what_a_step_must_not_do_in_real_time_it_may_in_virtual_time(
    build: Build, what: str
) -> None:
    code, message = IN_REAL_TIME[what]
    test = of_test(build(ANSWER=code))
    (problem,) = refused(test, real_time=True)
    assert problem.where.split(" ")[-1] == "numerical.library"
    assert message in problem.message
    experiment.prepare(files.file_of_test(test), files.file_of_rig(test.rig))


def test_init_may_allocate_and_call_what_it_likes(build: Build) -> None:
    test = of_test(build(INIT='s->k = *strdup("12") + getppid()'))
    experiment.prepare(files.file_of_test(test), files.file_of_rig(test.rig), real_time=True)


ANYWHERE = {
    "crashes": ({"ANSWER": "if (s->n > 5) *(volatile int *)0 = 1"}, "crashed in a step (SIGSEGV"),
    "aborts": ({"ANSWER": "abort()"}, "crashed in a step (SIGABRT"),
    "crashes at once": ({"INIT": "*(volatile int *)0 = 1"}, "crashed while it was set up"),
    "refuses": ({"INIT": "return 42"}, "rejected its settings (its init returned 42)"),
    "exits": ({"ANSWER": "exit(3)"}, "ended the process"),
}


@pytest.mark.parametrize("what", ANYWHERE)
def test_a_library_that_cannot_step_is_refused_and_takes_nothing_along(
    build: Build, what: str
) -> None:
    inserts, message = ANYWHERE[what]
    (problem,) = refused(of_test(build(**inserts)))
    assert problem.where.split(" ")[-1] == "numerical.library"
    assert problem.message.startswith("part.so ")
    assert message in problem.message


def test_a_step_without_an_end_is_ended(build: Build, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rthyb_rt.core.own_library.TRIAL_S", 0.3)
    (problem,) = refused(of_test(build(ANSWER="while (s->n > 3) s->k += 1")))
    assert "did not finish" in problem.message
    assert "in a step" in problem.message


SENSELESS = {"nan": "NAN", "inf": "INFINITY", "huge": "1e300", "none": "*x", "no": "0; return 7"}


@pytest.mark.parametrize("what", SENSELESS)
def test_senseless_displacements_never_leave_it_and_are_noted(build: Build, what: str) -> None:
    part = Part(LibraryConfig(build(ANSWER=f"if (s->n > 3) {{ *x = {SENSELESS[what]}; }}"), K_E))
    before = [part.step(0.5, 0.0) for _ in range(3)]
    assert all(code == 0 for _, code in before)
    x, code = part.step(0.5, 0.0)
    if what == "none":
        assert code == 0
        return
    assert code != 0
    assert x == (1e3 if what in ("inf", "huge") else before[-1][0])


LATER = "*x = 0; if (s->n > 1200) *x = NAN"
"""After the steps of the trial, in the middle of the test."""


def test_library_without_a_number_in_real_time_is_named_with_what_to_do(build: Build) -> None:
    rec = Bench({"numerical.library.file": build("frame", ANSWER=LATER)}).run()
    assert rec.meta["end_reason"] == "tripped: a value was not a number"
    trip = rec.samples[np.argmax(rec.samples["cause"] == core.CAUSES.index("not_finite"))]
    said = summary.notices(summary.summarize(rec))[1].text
    assert "The numerical part is your own, frame.so: check it first" in said
    assert f"acceleration was {trip['ag_mps2']:.4g} m/s²" in said
    assert trip["ag_mps2"] != 0.0
    assert f"force {trip['f_meas_n']:.4g} N" in said
    assert "run the test in virtual time, where the part may print" in said
    assert "sensor" not in said


def test_reading_without_a_number_is_not_blamed_on_the_library(build: Build) -> None:
    part = {"numerical.library.file": build(ANSWER="*x = 0")}
    rec = Bench(part, faults=(loop.Fault("not-finite", 1000, 5),)).run()
    assert rec.meta["end_reason"] == "tripped: a value was not a number"
    said = summary.notices(summary.summarize(rec))[1].text
    assert "was received from the drive: check the sensor" in said
    assert "part.so" not in said


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), 1e300])
def test_senseless_forces_never_reach_it(build: Build, bad: float) -> None:
    code = "if (!isfinite(force[0]) || fabs(force[0]) > 1e12 || !isfinite(ag)) *x = 77"
    part = Part(LibraryConfig(build(ANSWER=code), K_E))
    part.step(0.1, 10.0)
    for ag, force in ((0.1, bad), (bad, 10.0)):
        x, status = part.step(ag, force)
        assert x != 77.0
        assert status != 0


def test_time_stands_still_in_a_hold(tmp_path: Path) -> None:
    part = Part(LibraryConfig(in_c(tmp_path), K_E, tuple(parameters().items())))
    part.step(0.3, 0.0)
    kept = part.save()
    part.freeze(50.0)
    again = Part(LibraryConfig(in_c(tmp_path), K_E, tuple(parameters().items())))
    again.restore(kept)
    assert part.step(0.3, 5.0)[0] == again.step(0.3, 5.0)[0]


# ---- what is refused when it is loaded ----------------------------------------------------------


def test_a_file_that_is_not_there_or_is_no_library_is_refused(tmp_path: Path) -> None:
    (problem,) = refused(of_test(str(tmp_path / "nothing.so")))
    assert problem.where.split(" ")[-1] == "numerical.library.file"
    assert "does not exist; build it first" in problem.message
    text = tmp_path / "text.so"
    text.write_text("no library\n", encoding="utf-8")
    (problem,) = refused(of_test(str(text)))
    assert "cannot be loaded" in problem.message
    assert "shared library for this machine" in problem.message


def test_a_library_without_a_function_is_refused_with_what_it_must_have(tmp_path: Path) -> None:
    source, target = tmp_path / "few.c", tmp_path / "few.so"
    source.write_text("int rthyb_part_version_(void) { return 1; }", encoding="utf-8")
    subprocess.run(["gcc", "-shared", "-fPIC", source, "-o", target], check=True)
    (problem,) = refused(of_test(str(target)))
    assert "has no function rthyb_part_version, rthyb_part_interfaces" in problem.message
    assert 'bind(C, name = "rthyb_part_version")' in problem.message


def test_another_version_and_too_many_interfaces_are_refused(build: Build) -> None:
    (problem,) = refused(of_test(build("old", VERSION="3")))
    assert "version 3 of the interface, but this program accepts versions 1 to 2" in problem.message
    (problem,) = refused(of_test(build("wide", INTERFACES="9")))
    assert "returns 9; it must be from 1 to 8" in problem.message


def test_a_library_for_two_actuators_is_refused_where_the_test_file_names_it(build: Build) -> None:
    (problem,) = refused(of_test(build("two", INTERFACES="2")))
    assert "numerical.library.file" in problem.where
    assert "rthyb_part_interfaces returns 2; it must be 1" in problem.message


def test_parameters_that_are_missing_or_unknown_are_refused_with_those_that_there_are(
    tmp_path: Path,
) -> None:
    file = in_c(tmp_path)
    takes = "it takes mass_kg, damping_n_s_per_m, stiffness_n_per_m"
    (problem,) = refused(of_test(file, parameters=parameters() | {"masse": 1.0}))
    assert f"has no parameter masse; {takes}" in problem.message
    (problem,) = refused(of_test(file, parameters={"mass_kg": 4220}))
    assert "the parameter damping_n_s_per_m, stiffness_n_per_m of" in problem.message
    found = parameters() | {"mass_kg": -1.0}
    (problem,) = refused(of_test(file, parameters=found))
    assert "rejected its settings (its init returned 1)" in problem.message
    with pytest.raises(rt.InputError, match=r"found \"a lot\""):
        of_test(file, parameters={"mass_kg": "a lot"})


def test_names_that_no_recording_can_have_are_refused(build: Build) -> None:
    def naming(name: str, responses: str) -> str:
        code = (
            "void rthyb_part_names(int32_t of, char *text) "
            f'{{ strcpy(text, of == RTHYB_PART_RESPONSES ? "{responses}" : ""); }}'
        )
        return build(name, MORE=code)

    (problem,) = refused(of_test(naming("capital", "Roof[m]")))
    assert 'the response "Roof[m]"' in problem.message
    (problem,) = refused(of_test(naming("unreported", "roof[m]")))
    assert "has no function rthyb_part_report" in problem.message


def test_report_without_names_is_refused_because_nobody_would_call_it(build: Build) -> None:
    report = "void rthyb_part_report(const void *at, double *v) { *v = ((const state *)at)->x; }"
    named = "void rthyb_part_names(int32_t of, char *text) { (void)of; *text = 0; }"
    for name, more in (("nameless", report), ("empty", report + named)):
        (problem,) = refused(of_test(build(name, MORE=more)))
        assert (
            "has a function rthyb_part_report, but rthyb_part_names returns no" in problem.message
        )
        assert 'names with units, such as "roof[m]"' in problem.message


# What a report gives after a while, and what is recorded for it.
REPORTED = {
    "0.25": 0.25, "-1e150": -1e150, "2e150": math.nan, "1e300": math.nan, "-1e300": math.nan,
    "NAN": math.nan, "INFINITY": math.nan, "-INFINITY": math.nan, "not written": math.nan,
}  # fmt: skip


@pytest.mark.parametrize("what", REPORTED)
def test_what_a_library_cannot_report_is_recorded_as_nan_and_the_test_goes_on(
    build: Build, what: str
) -> None:
    """A recorded 0 would look like a value; the other response is not affected."""
    late = "(void)0" if what == "not written" else f"v[1] = {what}"
    file = build(
        MORE="""
        void rthyb_part_names(int32_t of, char *text)
        { strcpy(text, of == RTHYB_PART_RESPONSES ? "steps[1] late[m]" : ""); }
        void rthyb_part_report(const void *at, double *v)
        { const state *s = at; v[0] = (double)s->n; if (s->n < 100) v[1] = 0.5; else LATE; }
        """.replace("LATE", late)
    )
    rec = rt.run(of_test(file))
    steps, late_m = rec["steps"], rec["late"]
    assert rec.completed
    assert np.isfinite(steps).all()
    before = (steps > 0) & (steps < 100)
    assert before.sum() == 99
    assert (late_m[before] == 0.5).all()
    np.testing.assert_array_equal(late_m[steps >= 100], REPORTED[what])
    assert rt.replay(rec).identical


def test_only_one_numerical_part_is_taken(tmp_path: Path) -> None:
    text = of_test(in_c(tmp_path), parameters=parameters()).to_toml()
    text += '[numerical.python]\nclass = "own_parts:Oscillator"\n'
    with pytest.raises(rt.InputError, match="library and python are both given"):
        rt.Test.from_toml(text)


def test_a_recording_asks_for_the_very_library_that_it_was_made_with(build: Build) -> None:
    part = LibraryConfig(build(), K_E)
    plain = part.plain()
    assert LibraryConfig.of_plain(plain) == LibraryConfig(part.path, K_E, sha256=plain["sha256"])
    with pytest.raises(core.CoreError, match="is not the library that was recorded"):
        Part(LibraryConfig.of_plain(plain | {"sha256": "0" * 64}))


def test_a_trial_tells_what_a_step_takes(build: Build) -> None:
    found = tried(
        LibraryConfig(build(ANSWER="for (volatile int i = 0; i < 20000; i++) s->k += i"), K_E)
    )
    assert found.steps == 512
    assert 5e-6 < found.answer_s <= found.step_s <= found.worst_s
    assert found.allocations == 0
    assert found.system_call is None
    assert not found.ill
