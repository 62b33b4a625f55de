"""Configuration by random files: round trips, line numbers, units, junk."""

from __future__ import annotations

import contextlib
import math
import tomllib
import typing
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from rthyb_rt import config, units
from rthyb_rt.config import lawtables
from rthyb_rt.config.fields import Count, Names, OneOf, Range, Sign, Table, Text
from rthyb_rt.config.limits import WATCHED, Limits, resolve
from rthyb_rt.config.lines import KeyLines
from rthyb_rt.config.numerical import Labels, Matrices, Numbers, Place, Square
from rthyb_rt.config.own_tables import Settings
from rthyb_rt.config.rigfile import (
    BoucWen,
    DegradationElement,
    LinkTable,
    RigFile,
    Sensors,
    ServoHydraulic,
    assumable,
)
from rthyb_rt.config.structures import Counts, Each, Terms
from rthyb_rt.config.testfile import AxisLaw, Controller, Numerical, TestFile
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axis_wires

relaxed = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.too_slow])

texts = st.text(st.characters(codec="utf-8"), max_size=20)


def values_of(annotation: Any, metadata: tuple[Any, ...] = ()) -> st.SearchStrategy[Any]:
    """Values that a field's annotation allows."""
    for limits in metadata:
        if isinstance(limits, Range):
            return st.floats(
                limits.low,
                limits.high,
                exclude_min=limits.open_low,
                exclude_max=limits.open_high,
            )
        if isinstance(limits, Count):
            return st.integers(limits.low, limits.high)
        if isinstance(limits, OneOf):
            return st.sampled_from(limits.words)
        if isinstance(limits, Sign):
            return st.sampled_from([1, -1])
        if isinstance(limits, Text):
            if limits.pattern == r"[\s\S]*":
                return texts
            if ":" in limits.pattern:
                return st.from_regex(
                    r"\A[a-z][a-z0-9_]{0,9}:[A-Z][A-Za-z0-9]{0,9}\Z"
                )  # a class of a module
            return st.from_regex(r"\A[a-z0-9][a-z0-9._-]{0,20}\Z")
        if isinstance(limits, Settings):
            return st.dictionaries(
                st.from_regex(r"\A[a-z][a-z0-9_]{0,9}\Z"), st.floats(-1e9, 1e9), max_size=3
            )
        if isinstance(limits, Each):
            return values_of(float, (limits.one,))
        if isinstance(limits, Counts):
            return st.just([1])
        if isinstance(limits, Terms):
            return st.just([["7.x", 1.0]])
        if isinstance(limits, Names):
            return st.just(["x_1"])
        if isinstance(limits, (Square, Numbers, Labels, Place)):
            return st.just([1.0])  # `matrices` has them fit
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return values_of(arguments[0], arguments[1:])
    if origin is typing.Literal:
        return st.sampled_from(arguments)
    if origin is list and arguments[0] is AxisLaw:
        return st.lists(tables(AxisLaw), max_size=1)
    if origin is list:
        return st.lists(values_of(arguments[0]), min_size=1, max_size=4)
    if origin is dict:
        return st.dictionaries(*map(values_of, arguments), max_size=3)
    if arguments:
        return st.one_of([values_of(argument) for argument in arguments])
    if annotation is type(None):
        return st.none()
    if annotation is bool:
        return st.booleans()
    assert issubclass(annotation, Table)
    return tables(annotation)


ELSEWHERE: dict[type[Table], tuple[str, ...]] = {
    Numerical: ("library", "fmu", "python"),
    TestFile: ("history",),
    Sensors: ("extra",),
    Controller: ("python",),
}
"""Tables with files, classes and cross-checks of their own, in test files of their own."""


@st.composite
def tables(draw: st.DrawFn, model: type[Table]) -> dict[str, Any]:
    """Values of one table; keys that exclude each other and cross-checks are kept to."""
    data = {
        (info.alias or name): draw(values_of(info.annotation, tuple(info.metadata)))
        for name, info in model.model_fields.items()
        if name not in ELSEWHERE.get(model, ())
    }
    for choice in model.choices:
        kept = draw(st.sampled_from(choice.keys))
        for key in choice.keys:
            if key != kept:
                data[key] = None
        if choice.required and data[kept] is None:
            data[kept] = 1.0
    if model is Numerical:
        data["matrices"] = draw(st.none() | tables(Matrices))
        data.update(draw(of_many()) if data["matrices"] is None else ONE_DEGREE)
        single = ("mass_kg", "period_s", "damping_n_s_per_m", "damping_ratio")
        if data["matrices"] is not None:
            data.update(dict.fromkeys(single), integrator="central-difference")
            data["stiffness_n_per_m"] = 0.0
        elif data["storeys"] is not None:
            data.update(dict.fromkeys(single), integrator=draw(st.sampled_from(["cr", "kr-alpha"])))
            data["stiffness_n_per_m"] = 0.0
        elif None in (data["mass_kg"] or data["period_s"], data["damping_n_s_per_m"]):
            data.update(dict.fromkeys(single), mass_kg=1.0, damping_ratio=0.02)
    if model is TestFile:
        many = data["numerical"]["storeys"] is not None
        data["interface"] = [{"name": "x", "storey": 1, "dof": None}] if many else []
    if model is Matrices:
        data.update(draw(matrices()))
    if model is RigFile:
        listed = [key for key in assumable(data["actuator"]) if draw(st.booleans())]
        data["rig"]["assumed"] = listed or draw(st.sampled_from([None, []]))
        (fits,) = ServoHydraulic.checks
        for name in (key.removeprefix("actuator.") for key in listed):
            if name not in fits.needs and draw(st.booleans()):
                data["actuator"][name] = ServoHydraulic.model_fields[name].default
    if model is RigFile and data["actuator"]["kind"] == "servo-valve":
        data["specimen"] = [*data["specimen"][:3], {"element": "inertia", "m_kg": 29.13}]
    if issubclass(model, BoucWen):
        data.update(xy_m=None, b=draw(st.floats(1, 1e6)), c=draw(st.floats(0, 1e6)))
    if model is DegradationElement and not any(map(data.get, LOST_WITH)):
        data[draw(st.sampled_from(LOST_WITH))] = draw(st.floats(1e-6, 1e3))
    if "fs_n" in data:
        data["fs_n"] = max(data["fs_n"], data["fc_n"])
    if "ultimate_m" in data:
        data["ultimate_m"] = max(data["ultimate_m"], 1.001 * data["xy_m"])
    if "start_m" in data:
        data["reach_m"] = max(data["reach_m"], 1.001 * data["start_m"])
    if "oil_stiffness_n_per_m" in data:
        stiffest = 3.99 * data["moving_mass_kg"] * (1024 * data["substeps"]) ** 2
        data["oil_stiffness_n_per_m"] = min(data["oil_stiffness_n_per_m"], stiffest)
    if "frequency_hz" in data:
        size = draw(st.integers(0, 3))
        for key in ("frequency_hz", "amplitude", "delay_at_frequency_s"):
            data[key] = [0.5 + i for i in range(size)] if key == "frequency_hz" else [0.5] * size
        forces = size if draw(st.booleans()) else 0
        for key in ("force_in_phase_n_per_m", "force_in_quadrature_n_per_m"):
            data[key] = [draw(st.floats(-1e9, 1e9)) for _ in range(forces)]
        data["command_amplitude_m"] = [1e-3] * (size if draw(st.booleans()) else 0)
    if model is LinkTable:
        data.update(draw(links()))
    if "offset_m" in data:
        data["offset_m"] = min(data["offset_m"], 1e3 * data["scale"])
        data["offset_m"] = max(data["offset_m"], -1e3 * data["scale"])
    if data.get("type") == "python":  # needs a class that is there
        data["type"] = "paper"
    if data.get("type") == "matrix":
        data["axis"] = []
    elif "matrix" in data:
        data["matrix"] = None
    if "alpha_min" in data:
        data["alpha_min"], data["alpha_max"] = draw(st.floats(0, 20)), draw(st.floats(40, 1000))
    if "w1" in data:
        data["w1"] = draw(st.floats(1.001, 100))
        data["w2"] = draw(st.floats(-data["w1"], data["w1"]))
        data["alpha0"] = draw(st.none() | st.floats(20, 40))
        data["beta0"] = draw(st.floats(-800, 800))
        # A law's own table falls back on its defaults where its values do not fit together.
        for place, _, _ in list(lawtables.faults(data)):
            data[place[0]] = None
    return data


LOST_WITH = ("travel_m", "work_j", "amplitude_m")
"""Of these a degrading loop needs at least one."""

ONE_DEGREE: dict[str, Any] = {"storeys": None, "damping": None, "nonlinear": [], "record": None}


@st.composite
def of_many(draw: st.DrawFn) -> dict[str, Any]:
    """Storeys, or none, with what goes with them."""
    if draw(st.booleans()):
        return ONE_DEGREE
    count = draw(st.integers(1, 5))
    each = st.lists(st.floats(0.1, 100.0), min_size=count, max_size=count)
    law = {"element": "cubic", "k3_n_per_m3": draw(st.floats(0.0, 1e9))}
    element = {"storeys": [count], "dof": None, "between": None, "beside": True, "law": law}
    return {
        "storeys": {
            "count": count,
            "mass_kg": draw(each | st.floats(1.0, 1e6)),
            "stiffness_n_per_m": draw(each | st.floats(1.0, 1e9)),
            "height_m": draw(each),
            "p_delta": draw(st.booleans()),
            "specimen": [draw(st.integers(1, count))],
        },
        "damping": {"ratio": draw(st.floats(0, 1)), "modes": [1], "form": "rayleigh"},
        "nonlinear": draw(st.just([]) | st.just([element])),
        "record": draw(st.none() | st.just(["x_1", "drift_1"])),
    }


@st.composite
def matrices(draw: st.DrawFn) -> dict[str, Any]:
    """What of a numerical part by matrices has one size."""
    n = draw(st.integers(1, 8))

    def numbers(low: float, high: float) -> list[float]:
        return draw(st.lists(st.floats(low, high), min_size=n, max_size=n))

    k = [numbers(-1e12, 1e12) for _ in range(n)]
    labels = draw(st.none() | st.just([f"floor {i}" for i in range(n)]))
    return {
        "m_kg": numbers(1.0, 1e9),
        "k_n_per_m": [[k[max(i, j)][min(i, j)] for j in range(n)] for i in range(n)],
        "c_n_s_per_m": None,
        "damping_ratios": draw(st.just(numbers(0.0, 2.0)) | st.just([0.02])),
        "influence": draw(st.none() | st.just(numbers(-1e3, 1e3))),
        "labels": labels,
        "interface": draw(st.integers(1, n) | st.sampled_from(labels or [1])),
        "specimen": draw(st.none() | st.just({"mass_kg": 0.5, "stiffness_n_per_m": 3.0})),
    }


def identifiers() -> st.SearchStrategy[dict[str, int]]:
    """Three different ones."""
    three = st.lists(st.integers(1, 0x7FF), min_size=3, max_size=3, unique=True)
    return three.map(lambda ids: dict(zip(("command", "displacement", "force"), ids, strict=True)))


@st.composite
def links(draw: st.DrawFn) -> dict[str, Any]:
    """What depends on the kind of a link."""
    kind = draw(st.sampled_from(["can", "serial", "socket", "python-can"]))
    bus = kind in ("can", "python-can")
    fd, dbc = bus and draw(st.booleans()), draw(st.sampled_from(["drive.dbc", None]))
    # What a bit rate has room for: the least one for 1024 samples a second.
    least = 358_400 if kind == "serial" else 600_000
    rates = st.integers(least, 12_000_000 if kind == "serial" else 1_000_000)
    bitrate = None if kind == "socket" else draw(rates if fd else rates | st.none())
    most_hz = 4096 if kind == "socket" else min(4096, (bitrate or least) * 1024 // least)
    rate_hz = draw(st.integers(256, most_hz))
    changes: dict[str, Any] = {
        "kind": kind,
        "channel": {"serial": "/dev/ttyUSB0", "socket": "/run/rig"}.get(kind, "can0"),
        "interface": "virtual" if kind == "python-can" else None,
        "bitrate": bitrate,
        "sample_rate_hz": rate_hz,
        "lead_us": draw(st.none() | st.floats(20.0, min(480.0, 0.5e6 / rate_hz))),
        "fd": fd,
        "data_bitrate": draw(st.none() | st.integers(1_000_000, 8_000_000)) if fd else None,
        "dbc": dbc if bus else None,
        "ids": draw(st.none() | identifiers()) if bus and dbc is None else None,
    }
    if fd and changes["ids"]:
        # A frame of CAN FD that does not switch is longer than a classic one.
        changes["data_bitrate"], changes["bitrate"] = 2_000_000, 1_000_000
        changes["sample_rate_hz"], changes["lead_us"] = 1024, None
    return changes if changes["dbc"] else {**changes, "names": {}, "reset_state": None}


@pytest.mark.long
@given(tables(TestFile))
@relaxed
def test_resolved_test_reads_back_equal(data: dict[str, Any]) -> None:
    test = TestFile.model_validate(data)
    assert config.parse_test(config.dump(test)) == test


@pytest.mark.long
@given(tables(RigFile))
@relaxed
def test_resolved_rig_reads_back_equal(data: dict[str, Any]) -> None:
    rig = RigFile.model_validate(data)
    text = config.dump(rig)
    assert config.parse_rig(text) == rig
    assert config.dump(config.parse_rig(text)) == text


@pytest.mark.long
@given(tables(RigFile))
@relaxed
def test_every_calibration_is_one_that_the_core_takes_and_its_command_comes_back(
    data: dict[str, Any],
) -> None:
    data["calibration"]["command"] = None
    c = axis_wires.calibration(RigFile.model_validate(data))
    c.struct()
    for x_m in (0.0, 0.01, -2.0):
        wire = c.cmd_gain * x_m + c.cmd_offset_m
        error = abs(c.x_gain * wire + c.x_offset_m - x_m)
        # Eight roundings on the way there and back, each of half a unit in the last place, or of
        # what is left of it among the smallest numbers.
        assert error <= 8 * 2.0**-53 * (abs(x_m) + 2 * abs(c.x_offset_m)) + 1e-300


ORDER = ["none", "indicate", "hold", "ramp-out", "trip"]


@st.composite
def files_that_fit(draw: st.DrawFn) -> tuple[dict[str, Any], dict[str, Any]]:
    """Limits of a rig, and of a test that leaves some out and is within the others."""
    rig = draw(tables(Limits))
    test: dict[str, Any] = {}
    for key, bound in rig.items():
        if draw(st.booleans()) or key.startswith(("path_", "brake_")):
            continue
        if isinstance(bound, dict):
            stronger = ORDER[ORDER.index(bound["action"]) :]
            test[key] = {**bound, "enable": True, "action": draw(st.sampled_from(stronger))}
        elif bound is not None:
            test[key] = bound
    return rig, test


@pytest.mark.long
@given(files_that_fit())
@settings(relaxed, max_examples=100)
def test_resolved_limits_are_never_weaker_than_the_rigs(
    files: tuple[dict[str, Any], dict[str, Any]],
) -> None:
    bound, own = map(Limits.model_validate, files)
    problems: list[Any] = []
    found = resolve(own, bound, "rig", 1e-6, problems)
    assert not problems
    for key in WATCHED:
        limit, of_rig = getattr(found.limits, key), getattr(bound, key)
        if of_rig is not None and of_rig.acts:
            assert limit.enable
            assert limit.value <= of_rig.value
            assert ORDER.index(limit.action) >= ORDER.index(of_rig.action)
    # What a recording holds is taken again, on the same rig, and comes to the same.
    again = Limits.model_validate(tomllib.loads(config.dump(found.limits)))
    assert resolve(again, bound, "rig", 1e-6, problems).limits == found.limits
    assert not problems


@pytest.mark.long
@given(tables(Limits), tables(Limits))
@settings(relaxed, max_examples=100)
def test_limits_that_were_taken_are_within_the_rigs_and_others_are_named(
    test: dict[str, Any], rig: dict[str, Any]
) -> None:
    own, bound = Limits.model_validate(test), Limits.model_validate(rig)
    problems: list[Any] = []
    resolve(own, bound, "rig", 1e-6, problems)
    named = {problem.where.removeprefix("limits.") for problem in problems}
    for key in WATCHED:
        limit, of_rig = getattr(own, key), getattr(bound, key)
        if limit is None or of_rig is None or not of_rig.acts:
            continue
        weaker = ORDER.index(limit.action) < ORDER.index(of_rig.action) or not limit.enable
        assert (limit.value > of_rig.value or weaker) == (own.as_written(key) in named)


junk = st.recursive(
    st.one_of(
        st.booleans(), st.integers(), st.floats(), texts, st.sampled_from([10**400, "1e999 m"])
    ),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=5,
)


@pytest.mark.long
@given(st.data())
@relaxed
def test_junk_in_any_place_is_refused_without_a_traceback(data: st.DataObject) -> None:
    models: list[type[Table]] = [TestFile, RigFile]
    model = data.draw(st.sampled_from(models))
    good = data.draw(tables(model))
    table = good
    while True:
        key = data.draw(st.sampled_from(sorted(table) or ["x"]))
        if isinstance(table.get(key), dict) and data.draw(st.booleans()):
            table = table[key]
        else:
            break
    table[key] = data.draw(junk)
    faults = []
    try:
        model.model_validate(good)
    except ValidationError as error:
        faults = error.errors()
    assert {fault["type"] for fault in faults} <= {"explained"}
    assert all(fault["ctx"]["text"] for fault in faults)


@given(st.text(max_size=200) | st.lists(st.sampled_from(list("[]{}=\"'.,#\n\\ ab1")), max_size=60))
@relaxed
def test_any_text_is_read_or_refused(text: str | list[str]) -> None:
    with pytest.raises(InputError):
        config.parse_test("".join(text))


# ---- line numbers --------------------------------------------------------------------------------


@st.composite
def numbered_files(draw: st.DrawFn) -> tuple[str, dict[tuple[str | int, ...], int]]:
    """A TOML text written key by key in the forms TOML has, with the line of each key."""
    rows: list[str] = []
    lines: dict[tuple[str | int, ...], int] = {}
    filler = ["", "# [x] = 1", "   ", '# "']
    scalar = [
        '"a = [1]"',
        "'''\n[no]\nkey = 1 ''''",
        '"""\n# \\""" no\n\\\\"""',
        "1_000.5e3",
        "2024-01-01 07:32:00",
        "'C:\\'",
        "true # ]",
    ]

    def write(text: str, *path: str | int) -> None:
        for _ in range(draw(st.integers(0, 2))):
            rows.extend(draw(st.sampled_from(filler)).split("\n"))
        lines.setdefault(path, len(rows) + 1)
        rows.extend(text.split("\n"))

    def pairs(*path: str | int) -> None:
        for name in draw(st.lists(st.sampled_from(["a", "b-1", "c d", "e"]), unique=True)):
            key = f'"{name}"' if " " in name else name
            form = draw(st.integers(0, 3))
            if form == 0:
                write(f"  {key} = {draw(st.sampled_from(scalar))}", *path, name)
            elif form == 1:
                write(f"{key} . x = 3", *path, name, "x")
            elif form == 2:
                write(f"{key} = {{ p = [ 1, 2 ], q.r = '}}' }}", *path, name)
                for inner in (("p",), ("p", 1), ("q", "r")):
                    lines[(*path, name, *inner)] = lines[(*path, name)]
            else:
                write(f"{key} = [ # list", *path, name)
                for index in range(draw(st.integers(0, 3))):
                    write("  { k = ']' },", *path, name, index)
                    lines[(*path, name, index, "k")] = lines[(*path, name, index)]
                write("]", *path, name)

    pairs()
    for table in draw(st.lists(st.sampled_from(["t1", "t2", "t3"]), unique=True)):
        write(f"[{table}]", table)
        pairs(table)
        if draw(st.booleans()):
            write(f"[ {table} . in ]", table, "in")
            pairs(table, "in")
    for index in range(draw(st.integers(0, 3))):
        write("[[array]]", "array", index)
        pairs("array", index)
        if draw(st.booleans()):
            write("[array.sub]", "array", index, "sub")
            pairs("array", index, "sub")
    return "\n".join(rows) + "\n", lines


@pytest.mark.long
@given(numbered_files(), st.sampled_from(["\n", "\r\n"]))
@settings(deadline=None, max_examples=300, suppress_health_check=[HealthCheck.too_slow])
def test_each_key_is_found_on_its_line(
    file: tuple[str, dict[tuple[str | int, ...], int]], line_end: str
) -> None:
    text, lines = file
    found = KeyLines(text.replace("\n", line_end))
    assert {path: found.lines.get(path) for path in lines} == lines


def test_missing_key_points_at_its_table() -> None:
    lines = KeyLines("a = 1\n\n[t.u]\nx = 1\n[t]\ny = 2\n")
    assert lines.find(("t", "u", "missing")) == 3
    assert lines.find(("t", "missing")) == 5
    assert lines.find(("missing",)) == 1
    assert lines.has(("t",))
    assert not lines.has(("missing",))


# ---- units ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("25 mm", "m", 0.025),
        ("9mm", "m", 0.009),
        ("0.04 g", "g", 0.04),
        ("100 gal", "m/s^2", 1.0),
        ("1 m/s2", "g", 1 / 9.80665),
        ("9.80665 m/s^2", "g", 1.0),
        ("666.4 kN/m", "N/m", 666400.0),
        ("80 N", "N", 80.0),
        ("2 kN", "N", 2000.0),
        ("15 ms", "s", 0.015),
        ("5 Hz", "Hz", 5.0),
        ("31.4 1/s", "Hz", 31.4),
        ("45 kg", "kg", 45.0),
        ("4.22 t", "kg", 4220.0),
        ("3 %", "", 0.03),
        ("2121 N s/m", "N s/m", 2121.0),
        ("2.121 kN*s/m", "N s/m", 2121.0),
        ("2.121 kN·s/m", "N s/m", 2121.0),
        ("2.121 kN/(m/s)", "N s/m", 2121.0),
        ("1 N s² / m²", "N s^2/m^2", 1.0),
        ("1 kN s m⁻¹", "N s/m", 1000.0),
        ("-2 µm", "m", -2e-6),
        ("1 kN/mm", "N/m", 1e6),
        ("1e3 N/cm", "N/m", 1e5),
        ("4.5 in", "m", 0.1143),
        ("17 samples", "samples", 17.0),
    ],
)
def test_units_of_a_laboratory(text: str, unit: str, value: float) -> None:
    assert units.convert(text, unit) == value


@pytest.mark.parametrize(
    ("text", "unit", "complaint"),
    [
        ("25 kg", "m", "a mass"),
        ("25", "m", "needs a unit"),
        ("25 furlong", "m", '"furlong" is not known'),
        ("25 mm mm", "m", "a quantity in mm mm"),
        ("0,5 mm", "m", "point, not a comma"),
        ("mm", "m", "not a number"),
        ("1 N/(m", "N/m", '")" is missing'),
        ("1 m^", "m", "exponent is missing"),
        ("1 m^x", "m", "exponent is missing"),
        ("1 N/", "N", "not known"),
        ("1 m)", "m", "not known"),
        ("1e999 km", "m", "too large"),
        ("1e9999 m", "m", "not known"),
        ("nan m", "m", "not a number"),
        ("15 ms", "samples", "a time"),
        ("1 °", "", "not known"),
    ],
)
def test_text_that_is_no_such_quantity_is_refused(text: str, unit: str, complaint: str) -> None:
    with pytest.raises(units.UnitError) as caught:
        units.convert(text, unit)
    assert complaint in str(caught.value)


@given(st.floats(-1e12, 1e12))
def test_millimetres_are_rounded_once(number: float) -> None:
    text = f"{number:.6f}"
    millimetres = units.convert(f"{text} mm", "m")
    assert millimetres == pytest.approx(float(text) / 1000, rel=1e-15, abs=5e-324)
    assert units.convert(f"{text} m", "m") == float(text)


@given(st.text(max_size=12), st.text(alphabet="mkgsN/*^()23·² %", max_size=10))
def test_any_text_is_a_quantity_or_refused(number: str, unit: str) -> None:
    for text in (number, f"1 {unit}"):
        with contextlib.suppress(units.UnitError):
            assert math.isfinite(units.convert(text, "m"))
