"""A numerical part in an FMU, FMI 2 and 3: against the program's own equation of motion and against
fmpy's own master; FMUs that cannot be run are refused with what they lack."""

from __future__ import annotations

import functools
import json
import platform
import re
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_own_interfaces import K_E as K_TWO
from test_own_interfaces import by_matrices, close, short

import rthyb_rt as rt
from rthyb_rt import core
from rthyb_rt.api import files
from rthyb_rt.config import AxesRig
from rthyb_rt.core import own_parts
from rthyb_rt.core.numerical_parts import Part, SparsePart
from rthyb_rt.core.own_fmu import FmuConfig
from rthyb_rt.core.own_library import tried
from rthyb_rt.core.sparse import SparseConfig, Symmetric
from rthyb_rt.lab import axes_experiment, experiment

fmpy = pytest.importorskip("fmpy", reason="has the headers that the tests' FMU is built with")
SOURCE = Path(__file__).parent / "fmu" / "oscillator.c"
HEADERS = Path(fmpy.__file__).parent / "c-code"
K_E = 666_400.0
SHORT = rt.Test("section5-T0.5", ground_motion={"duration_s": 3}, test={"free_vibration_s": 0.5})
BINARY = {
    2: "linux64" if platform.machine() == "x86_64" else platform.machine(),
    3: f"{platform.machine()}-linux",
}
BOTH = pytest.mark.parametrize("fmi", [2, 3])

_VARIABLES = (
    ("ag", "input", 'start="0"'), ("f", "input", 'start="0"'), ("x", "output", ""),
    ("m", "parameter", 'start="1000"'), ("c", "parameter", 'start="0"'), ("part.v", "local", ""),
    ("start", "parameter", 'start="0"'),
)  # fmt: skip
_SECOND = (
    ("f2", "input", 'start="0"'), ("x2", "output", ""), ("k", "parameter", 'start="0"'),
    ("m2", "parameter", 'start="1000"'),
)  # fmt: skip


def description(
    fmi: int, *, kind: str = "CoSimulation", attributes: str = "", second: bool = False
) -> str:
    """modelDescription.xml of the oscillator, as the standard wants it; of both masses or one."""
    rows = []
    for i, (name, causality, start) in enumerate((*_VARIABLES, *(_SECOND if second else ()))):
        variability = "tunable" if causality == "parameter" else "continuous"
        about = f'name="{name}" valueReference="{i}" causality="{causality}" '
        about += f'variability="{variability}"'
        initial = ' initial="calculated"' if causality in ("output", "local") else ""
        if fmi == 2:
            rows.append(f"<ScalarVariable {about}{initial}><Real {start}/></ScalarVariable>")
        else:
            rows.append(f"<Float64 {about}{initial} {start}/>")
    token = "guid" if fmi == 2 else "instantiationToken"
    outputs = (
        '<Outputs><Unknown index="3"/></Outputs>' if fmi == 2 else '<Output valueReference="2"/>'
    )
    return (
        f'<?xml version="1.0" encoding="UTF-8"?><fmiModelDescription fmiVersion="{fmi}.0" '
        f'modelName="oscillator" {token}="{{oscillator}}"><{kind} modelIdentifier="oscillator" '
        f'canHandleVariableCommunicationStepSize="true" {attributes}/>'
        f"<ModelVariables>{''.join(rows)}</ModelVariables>"
        f"<ModelStructure>{outputs}</ModelStructure></fmiModelDescription>"
    )


Build = Callable[..., str]


@functools.cache
def compiled(fmi: int, wrong: str, folder: Path) -> bytes:
    target, others = folder / "oscillator.so", folder / "others.c"
    others.write_text(unused(fmi), encoding="utf-8")
    flags = ["-O2", "-ffp-contract=off", "-shared", "-fPIC", f"-DFMI={fmi}", f"-DWRONG={wrong}"]
    command = ["gcc", *flags, f"-I{HEADERS}", SOURCE, others, "-o", target, "-lm"]
    subprocess.run(command, check=True)
    return target.read_bytes()


def unused(fmi: int) -> str:
    """The functions of the standard that the oscillator has no use for, and fmpy asks for."""
    declared = (HEADERS / f"fmi{fmi}Functions.h").read_text(encoding="utf-8")
    names = set(re.findall(rf"fmi{fmi}\w+TYPE\s+(fmi{fmi}\w+);", declared))
    own = set(re.findall(rf"^\S.*\b(fmi{fmi}[A-Z]\w+)\(", SOURCE.read_text("utf-8"), re.MULTILINE))
    return "\n".join(f"int {name}(void) {{ return 3; }}" for name in sorted(names - own))


@pytest.fixture
def build(tmp_path: Path) -> Build:
    """Build an FMU; return its path."""

    def make(
        fmi: int, wrong: str = "", binaries: tuple[str, ...] | None = None, **more: Any
    ) -> str:
        path = tmp_path / f"oscillator{fmi}.fmu"
        with zipfile.ZipFile(path, "w") as archive:
            archive.writestr("modelDescription.xml", description(fmi, **more))
            for place in (BINARY[fmi],) if binaries is None else binaries:
                library = compiled(fmi, wrong, tmp_path)
                archive.writestr(f"binaries/{place}/oscillator.so", library)
        return str(path)

    return make


def of_test(file: str, **more: Any) -> rt.Test:
    names = {"force": "f", "displacement": "x", "ground_acceleration": "ag"}
    return SHORT.with_({"numerical.fmu": {"file": file, **names, **more}})


def parameters() -> dict[str, float]:
    figures = rt.check(SHORT).figures
    return {"m": figures["mass_kg"], "c": figures["damping_n_s_per_m"]}


def refused(test: rt.Test, *, real_time: bool = False) -> rt.Problem:
    with pytest.raises(rt.InputError) as caught:
        experiment.prepare(
            files.file_of_test(test), files.file_of_rig(test.rig), real_time=real_time
        )
    (problem,) = caught.value.problems
    return problem


# ---- what it computes ---------------------------------------------------------------------------


@BOTH
def test_an_fmu_moves_the_specimen_as_the_programs_own_equation_does(
    build: Build, fmi: int
) -> None:
    plain = rt.run(SHORT)
    rec = rt.run(of_test(build(fmi), parameters=parameters(), record=["part.v"]))
    for name in ("x_num_m", "x_meas_m", "f_meas_n"):
        np.testing.assert_array_equal(rec[name], plain[name], err_msg=name)
    assert rec["fmu_part_v"].any()
    assert rt.replay(rec).identical


@BOTH
@pytest.mark.parametrize("bad", ["NAN", "INFINITY", "1e300"])
def test_what_an_fmu_has_no_value_for_is_recorded_as_nan_and_the_test_goes_on(
    build: Build, fmi: int, bad: str
) -> None:
    """A recorded 0 would look like a velocity."""
    known = rt.run(of_test(build(fmi), parameters=parameters(), record=["part.v"]))["fmu_part_v"]
    wrong = f"if (fabs(s->x) > 1e-3) s->value[V] = {bad}"
    rec = rt.run(of_test(build(fmi, wrong), parameters=parameters(), record=["part.v"]))
    found = rec["fmu_part_v"]
    assert rec.completed
    lost = np.isnan(found)
    assert 0 < lost.sum() < found.size
    np.testing.assert_array_equal(found[~lost], known[~lost])
    assert rt.replay(rec).identical


@BOTH
def test_fmpys_own_master_gives_the_same_displacements(build: Build, fmi: int) -> None:
    path, h, n = build(fmi), 1.0 / 1024.0, 600
    t = np.arange(n) * h
    ag, force = 0.3 * np.sin(9.0 * t), 200.0 * np.sin(5.0 * t)
    part = Part(FmuConfig(path, K_E, "f", "x", "ag", (("m", 500.0), ("c", 40.0))))
    mine = [part.step(float(a), float(f))[0] for a, f in zip(ag, force, strict=True)]
    signals = np.array(
        list(zip(t, ag, force, strict=True)), dtype=[("time", "f8"), ("ag", "f8"), ("f", "f8")]
    )
    found = fmpy.simulate_fmu(
        path, stop_time=n * h, step_size=h, output_interval=h, input=signals, output=["x"],
        start_values={"m": 500.0, "c": 40.0}, validate=fmi == 2, fmi_type="CoSimulation",
    )  # fmt: skip
    np.testing.assert_allclose(found["x"][1 : n + 1], mine, rtol=1e-9, atol=1e-15)


@BOTH
def test_it_may_run_in_real_time_where_its_steps_do_nothing_that_a_tick_has_no_time_for(
    build: Build, fmi: int
) -> None:
    test = of_test(build(fmi), parameters=parameters())
    experiment.prepare(files.file_of_test(test), files.file_of_rig(test.rig), real_time=True)
    found = tried(FmuConfig(test["numerical.fmu.file"], K_E, "f", "x", "ag", (("m", 500.0),)))
    assert found.allocations == 0
    assert found.system_call is None


@BOTH
def test_an_fmu_that_allocates_while_it_steps_is_refused_in_real_time(
    build: Build, fmi: int
) -> None:
    test = of_test(build(fmi, "void *volatile b = malloc(80); free(b)"), parameters=parameters())
    problem = refused(test, real_time=True)
    assert problem.where.split(" ")[-1] == "numerical.fmu"
    assert "allocates or frees memory in its step function" in problem.message
    experiment.prepare(files.file_of_test(test), files.file_of_rig(test.rig))


@BOTH
@pytest.mark.parametrize("wrong", ["s->value[X]=NAN", "s->value[X]=1e300", "return 3", "return 4"])
def test_senseless_displacements_and_failed_steps_never_leave_it(
    build: Build, fmi: int, wrong: str
) -> None:
    part = Part(FmuConfig(build(fmi, wrong), K_E, "f", "x", "ag", (("m", 500.0),)))
    for force in (0.0, float("nan"), float("inf"), 1e300):
        x, code = part.step(0.1, force)
        assert abs(x) <= 1e3
        assert code != 0


def test_what_it_says_of_settings_that_it_refuses_is_told(build: Build) -> None:
    problem = refused(of_test(build(2), parameters={"m": -1.0}))
    assert 'it says "the mass must be positive"' in problem.message
    problem = refused(of_test(build(3), parameters={"m": 1e3, "start": 0.01}))
    assert "begins at 0.01 m; a numerical part must begin at 0" in problem.message


# ---- what cannot be run -------------------------------------------------------------------------


@BOTH
def test_an_fmu_without_binaries_for_this_machine_is_refused_with_those_that_it_has(
    build: Build, fmi: int
) -> None:
    problem = refused(of_test(build(fmi, binaries=("win64", "darwin64"))))
    assert problem.where.split(" ")[-1] == "numerical.fmu.file"
    assert f"binaries/{BINARY[fmi]}/oscillator.so; it has darwin64, win64" in problem.message
    assert "export it for 64-bit Linux" in problem.message


def test_an_fmu_without_any_binary_is_refused(build: Build) -> None:
    assert "it has no binaries" in refused(of_test(build(2, binaries=()))).message


@BOTH
def test_model_exchange_alone_is_refused(build: Build, fmi: int) -> None:
    problem = refused(of_test(build(fmi, kind="ModelExchange")))
    assert (
        "is an FMU for model exchange, which has no solver; export it for co-simulation"
        in problem.message
    )


def test_an_fmu_that_can_be_instantiated_once_is_refused(build: Build) -> None:
    once = 'canBeInstantiatedOnlyOncePerProcess="true"'
    assert "instantiated only once" in refused(of_test(build(2, attributes=once))).message


WRONG_NAMES = {
    "force": ({"force": "F"}, 'has no variable "F"; of input it has ag, f'),
    "displacement": ({"displacement": "f"}, '"f" has the causality input; it must be output'),
    "ground_acceleration": ({"ground_acceleration": "a"}, 'no variable "a"'),
    "parameters": ({"parameters": {"mass": 3.0}}, 'no variable "mass"'),
    "record": ({"record": ["part.w"]}, 'no variable "part.w" (did you mean "part.v"?)'),
}


@pytest.mark.parametrize("key", WRONG_NAMES)
def test_variables_that_are_not_there_are_refused_with_those_that_are(
    build: Build, key: str
) -> None:
    change, message = WRONG_NAMES[key]
    problem = refused(of_test(build(2), **change))
    assert problem.where.split(" ")[-1].startswith("numerical.fmu")
    assert problem.message.startswith(f"{key}: ")
    assert message in problem.message


def test_what_is_no_fmu_is_refused(tmp_path: Path) -> None:
    assert "does not exist; export it first" in refused(of_test(str(tmp_path / "none.fmu"))).message
    text = tmp_path / "text.fmu"
    text.write_text("no archive", encoding="utf-8")
    assert "is not an FMU (File is not a zip file)" in refused(of_test(str(text))).message
    with zipfile.ZipFile(text, "w") as archive:
        archive.writestr("readme.txt", "nothing")
    said = refused(of_test(str(text))).message
    assert "text.fmu is not an FMU: it has no modelDescription.xml, but readme.txt" in said
    assert "rthyb-fmu-" not in said  # where it was unpacked is no concern of the user's
    with zipfile.ZipFile(text, "w") as archive:
        archive.writestr("building/modelDescription.xml", "<fmiModelDescription/>")
    assert "zip what is in building, not the folder" in refused(of_test(str(text))).message
    with zipfile.ZipFile(text, "w") as archive:
        archive.writestr("modelDescription.xml", "<fmi")
    assert "its modelDescription.xml is no valid XML" in refused(of_test(str(text))).message
    with zipfile.ZipFile(text, "w") as archive:
        archive.writestr("modelDescription.xml", '<fmiModelDescription fmiVersion="1.0"/>')
    assert "is for FMI 1.0; FMI 2.0 and 3.0 are supported" in refused(of_test(str(text))).message


def test_a_recording_asks_for_the_very_fmu_that_it_was_made_with(build: Build) -> None:
    part = FmuConfig(build(2), K_E, "f", "x", "ag", (("m", 500.0),))
    plain = part.plain()
    assert FmuConfig.of_plain(plain).path == part.path
    with pytest.raises(core.CoreError, match="is not the FMU that was recorded"):
        Part(FmuConfig.of_plain(plain | {"sha256": "0" * 64}))


# ---- two interfaces -----------------------------------------------------------------------------

TWO = {"m": 8000.0, "c": 20600.0, "k": 4e5, "m2": 2000.0}
NAMES = {"force": ["f", "f2"], "displacement": ["x", "x2"], "ground_acceleration": "ag"}


def matrices() -> dict[str, Any]:
    return {
        "mass": np.diag([TWO["m"], TWO["m2"]]), "damping": np.diag([TWO["c"], 0.0]),
        "stiffness": TWO["k"] * np.array([[1.0, -1.0], [-1.0, 1.0]]),
    }  # fmt: skip


@BOTH
@pytest.mark.parametrize("place", [(0, 1), (1, 0)])
def test_both_interfaces_move_as_the_same_matrices_do(
    build: Build, fmi: int, place: tuple[int, int]
) -> None:
    part = Part(
        FmuConfig(build(fmi, second=True), K_TWO, ("f", "f2"), ("x", "x2"), "ag",
                  tuple(TWO.items()), place=place)
    )  # fmt: skip
    given = {name: Symmetric.of(matrix) for name, matrix in matrices().items()}
    whole = SparsePart(
        SparseConfig(
            given["mass"], given["stiffness"], np.array([TWO["m"], TWO["m2"]]),
            (((0, 1.0),), ((1, 1.0),)), (0.0, 0.0), damping_n_s_per_m=given["damping"],
            integrator="central-difference",
        )
    )  # fmt: skip
    order, found, expected = list(place), [], []
    for n in range(2000):
        ag, force = np.sin(n / 90.0), 3e3 * np.cos([n / 70.0, n / 50.0])
        found.append(part.answer_all(ag, force[order].tolist())[0])
        expected.append(whole.answer_all(ag, force.tolist())[0])
        part.advance()
        whole.advance()
    peak = np.abs(expected).max(axis=0)
    # A place of the rig holds the interface of this number.
    assert np.all(np.abs(np.array(found) - np.array(expected)[:, order]) < 1e-10 * peak[order])


@BOTH
def test_an_fmu_with_two_interfaces_runs_on_two_axes_and_is_replayed(
    build: Build, fmi: int, tmp_path: Path
) -> None:
    fmu = {"file": build(fmi, second=True), **NAMES, "parameters": TWO, "record": ["part.v"]}
    same = by_matrices(tmp_path, "central-difference", (1.0, 1.0), **matrices())
    # The window of the force compensation is a share of the period.
    modes = rt.check(same).document["modes"]
    period_s = 1.0 / max(modes, key=lambda mode: mode["effective_mass"])["frequency_hz"]
    test = short(tmp_path, "fmu", fmu, **{"numerical.period_s": period_s})
    rec, other = rt.run(test), rt.run(same)
    assert rec.completed
    close(rec, other)
    assert rec["fmu_part_v"].any()
    assert rt.replay(rec).identical
    rig = files.file_of_rig(test.rig)
    assert isinstance(rig, AxesRig)
    setup = axes_experiment.prepare(files.file_of_test(test), rig, real_time=True)
    assert setup.controller.interface_count == 2


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ({"force": ["f", "f2"], "displacement": "x"}, "found 1 outputs for 2 forces"),
        ({"force": ["f", "f"], "displacement": ["x", "x2"]}, 'found "f" twice'),
        ({"force": [], "displacement": ["x", "x2"]}, "must be the name of a variable"),
        ({"force": "f", "displacement": "x"}, "number of names in force is 1; it must be 2"),
        ({"force": ["f", "f3"], "displacement": ["x", "x2"]}, 'has no variable "f3"'),
        ({"force": ["f", "f2"], "displacement": ["x", "c"]}, '"c" has the causality parameter'),
    ],
)
def test_names_that_leave_an_interface_open_are_refused(
    build: Build, tmp_path: Path, names: dict[str, Any], said: str
) -> None:
    fmu = {"file": build(2, second=True), "ground_acceleration": "ag", "parameters": TWO, **names}
    with pytest.raises(rt.InputError, match=re.escape(said)):
        rt.run(short(tmp_path, "fmu", fmu))


def test_settings_of_two_interfaces_are_read_back(build: Build) -> None:
    part = FmuConfig(build(2, second=True), K_TWO, ("f", "f2"), ("x", "x2"), place=(1, 0))
    found = own_parts.of_plain(json.loads(json.dumps(part.plain())))
    assert found.plain() == part.plain()
    assert found.place == (1, 0)
