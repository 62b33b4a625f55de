"""Recordings as laboratories write them: separators, units, names, times; and what is refused."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import diagnose_cases as cases
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rthyb_rt import cli, config
from rthyb_rt.diagnose import channel_sizes, column_units, engine, mapping, reading, table
from rthyb_rt.diagnose.case import Model
from rthyb_rt.diagnose.noise_level import white_noise
from rthyb_rt.errors import InputError

NAMES = ("t", "x_cmd", "x_meas", "f_meas")


def quick(examples: int) -> settings:
    """Return settings for a property that writes a file for each example."""
    return settings(
        deadline=None, max_examples=examples,
        suppress_health_check=[HealthCheck.function_scoped_fixture],
    )  # fmt: skip


@pytest.fixture(scope="module")
def columns() -> dict[str, np.ndarray]:
    """Two seconds of a drive, as it is in SI."""
    return {k: v[256:768] for k, v in cases.channels().items()}


def model(folder: Path, text: str | None = None):
    path = folder / "baseline.toml"
    path.write_text(text or cases.baseline(), encoding="utf-8")
    return reading.read_model(path)


def written(
    columns: dict[str, np.ndarray], head: str, scales: dict[str, float] | None = None,
    separator: str = ";", decimal: str = ",", end: str = "\r\n", tail: str = "",
) -> str:  # fmt: skip
    """Return a table; ``head`` is what stands above the numbers, ``scales`` multiplies columns."""
    scaled = [v * (scales or {}).get(k, 1.0) for k, v in columns.items()]
    rows = (
        separator.join(f"{v:.12g}".replace(".", decimal) for v in row)
        for row in zip(*scaled, strict=True)
    )
    return end.join([*head.split("\n"), *rows, tail])


def read(folder: Path, text: str | bytes, *maps: str, toml: str | None = None, **options):
    path = folder / "lab.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return reading.read_case(path, model(folder, toml), wishes=mapping.read_wishes(maps), **options)


def same(case, columns: dict[str, np.ndarray]) -> None:
    for name, values in columns.items():
        found = case.t if name == "t" else case.channels[name]
        np.testing.assert_allclose(found, values, rtol=1e-9, atol=1e-14, err_msg=name)


MM_KN = {"x_cmd": 1e3, "x_meas": 1e3, "f_meas": 1e-3}


# ---- as programs export it ----------------------------------------------------------------------


def test_labview_export_with_semicolons_and_decimal_commas(tmp_path, columns):
    head = (
        "LabVIEW Measurement\nWriter_Version;2\nSeparator;Semicolon\nDecimal_Separator;,\n"
        "***End_of_Header***\nX_Value;Soll [mm];Weg (mm);Kraft [kN];Comment"
    )
    case = read(
        tmp_path, written(columns, head, MM_KN),
        "x_cmd=Soll", "x_meas=Weg", "f_meas=Kraft [kN]",
    )  # fmt: skip
    same(case, columns)
    assert any("'X_Value' is read as t" in note for note in case.notes)
    assert any("assumed to be s, which agrees with fs_hz" in note for note in case.notes)
    assert any("semicolons, with a comma as decimal separator" in note for note in case.notes)


def test_catman_export_with_a_row_of_units_in_latin_1(tmp_path, columns):
    a = np.gradient(np.gradient(columns["x_meas"])) * cases.FS**2
    every = {**columns, "a_meas": a}
    head = "CATMAN data\nPrüfung Nr. 3\nZeit\tSoll\tWeg\tKraft\tBeschleunigung\ns\tmm\tµm\tkN\tm/s²"
    text = written(every, head, {**MM_KN, "x_meas": 1e6}, "\t", ",")
    case = read(
        tmp_path, text.encode("latin-1"),
        "x_cmd=Soll", "x_meas=Weg", "f_meas=Kraft", "a_meas=Beschleunigung",
    )  # fmt: skip
    same(case, every)


def test_numpy_savetxt_with_the_names_in_a_comment(tmp_path, columns):
    case = read(tmp_path, written(columns, "# t x_cmd x_meas f_meas", None, " ", "."))
    same(case, columns)
    assert any("in a comment" in note for note in case.notes)


def test_matlab_export_with_percent_comments_and_aligned_columns(tmp_path, columns):
    body = "\n".join(
        "".join(f"{v:20.12e}" for v in row) for row in zip(*columns.values(), strict=True)
    )
    head = "% made by dlmwrite\n% 2026-01-31\n   t   x_cmd [m]   x_meas [m]   f_meas [N]\n"
    same(read(tmp_path, head + body), columns)


def test_excel_in_unicode_with_quotes_and_decimal_commas_between_commas(tmp_path, columns):
    rows = [
        ",".join(f'"{v:.12g}"'.replace(".", ",") for v in row)
        for row in zip(*columns.values(), strict=True)
    ]
    text = '"t","x_cmd","x_meas","f_meas"\r\n' + "\r\n".join(rows)
    same(read(tmp_path, text.encode("utf-16")), columns)


def test_own_names_with_the_unit_behind_them(tmp_path, columns):
    head = "t_ms,x_cmd_mm,x_meas_mm,f_meas_kN"
    case = read(tmp_path, written(columns, head, {**MM_KN, "t": 1e3}, ",", "."))
    same(case, columns)
    assert "x_meas: 'x_meas' converted from mm" in case.notes


def test_a_unit_after_a_comma_in_a_table_of_commas(tmp_path, columns):
    head = "t, s,x_cmd, mm,x_meas, mm,f_meas, kN"
    same(read(tmp_path, written(columns, head, MM_KN, ",", ".")), columns)


def test_two_columns_named_alike_are_told_apart_by_number(tmp_path, columns):
    text = written(columns, "t,LVDT,LVDT,f_meas", None, ",", ".")
    with pytest.raises(InputError, match=r"2 columns named 'LVDT': #2, #3") as caught:
        read(tmp_path, text, "x_meas=LVDT [m]")
    assert '--map x_meas="#2 [m]"' in str(caught.value)
    case = read(tmp_path, text, "x_cmd=#2 [m]", "x_meas=#3 [m]")
    same(case, columns)


def test_a_load_cell_that_counts_the_other_way_is_turned_by_the_map(tmp_path, columns):
    text = written(columns, "t,x_cmd,x_meas,Load cell [kN]", {"f_meas": -1e-3}, ",", ".")
    with pytest.raises(InputError, match=r'wrong sign.*--map f_meas="-Load cell \[kN\]"'):
        read(tmp_path, text, "f_meas=Load cell [kN]")
    same(read(tmp_path, text, "f_meas=-Load cell [kN]"), columns)


def test_a_mapping_file_names_columns_units_and_signs(tmp_path, columns):
    path = tmp_path / "rig-a.toml"
    path.write_text(
        'schema = "rthyb-map/1"\n[channels]\nt = "Zeit [s]"\n'
        'x_cmd = "Soll [mm]"\nx_meas = { column = "LVDT 1", unit = "mm" }\n'
        'f_meas = { column = "KMD", unit = "kN", sign = -1 }\n'
    )
    text = written(columns, "Zeit;Soll;LVDT 1;KMD", {**MM_KN, "f_meas": -1e-3})
    same(read(tmp_path, text, str(path)), columns)
    path.write_text(path.read_text().replace('"kN"', '"kPa"').replace("x_cmd", "x_cdm"))
    with pytest.raises(InputError, match=r'rig-a.toml:4: channels.x_cdm: unknown key .*"x_cmd"'):
        read(tmp_path, text, str(path))
    path.write_text(path.read_text().replace("x_cdm", "x_cmd"))
    with pytest.raises(InputError, match=r"rig-a.toml:6: channels.f_meas: .*'kPa' is not known"):
        read(tmp_path, text, str(path))


# ---- time ---------------------------------------------------------------------------------------


def test_without_a_column_of_time_the_rate_of_the_model_is_taken_and_said(tmp_path, columns):
    text = written({k: columns[k] for k in NAMES[1:]}, "x_cmd,x_meas,f_meas", None, ",", ".")
    case = read(tmp_path, text)
    np.testing.assert_allclose(case.t, np.arange(case.t.size) / cases.FS)
    assert any("1/256 s apart, the fs_hz of the model" in note for note in case.notes)


@pytest.mark.parametrize(
    "day", ["2026-01-31T23:59:59", "2026-01-31 12:00:00", "31.01.2026 8:00:00"]
)
def test_date_times_are_counted_from_midnight_also_past_the_next(tmp_path, columns, day):
    import datetime as dt

    form = "%d.%m.%Y %H:%M:%S.%f" if "." in day else "%Y-%m-%dT%H:%M:%S.%f"
    start = dt.datetime.strptime(day.replace(" ", "T") + ".0", form.replace(" ", "T"))
    stamps = [(start + dt.timedelta(seconds=i / cases.FS)).strftime(form) for i in range(512)]
    rows = (
        ";".join([s, *(f"{v:.12g}" for v in row)])
        for s, *row in zip(stamps, *(columns[k] for k in NAMES[1:]), strict=True)
    )
    case = read(tmp_path, "Timestamp;x_cmd;x_meas;f_meas\n" + "\n".join(rows))
    midnight = start.replace(hour=0, minute=0, second=0)
    assert case.t[0] == pytest.approx((start - midnight).total_seconds())
    assert case.t[-1] - case.t[0] == pytest.approx(511 / cases.FS, abs=2e-6)
    assert any("midnight of 2026-01-31" in note for note in case.notes)


def test_seconds_of_the_calendar_are_counted_from_a_midnight(tmp_path, columns):
    late = {**columns, "t": 1_769_817_600.0 + 3600.0 + np.arange(512) / cases.FS}
    head = ",".join(NAMES)
    text = head + "\n" + "\n".join(
        ",".join([f"{t:.6f}", *(f"{v:.12g}" for v in row)])
        for t, *row in zip(*late.values(), strict=True)
    )  # fmt: skip
    case = read(tmp_path, text)
    assert case.t[0] == pytest.approx(3600.0, abs=1e-3)
    assert any("calendar time" in note for note in case.notes)


def test_a_column_that_counts_up_is_time_though_nothing_says_so(tmp_path, columns):
    text = written(columns, "Kanal 0;x_cmd;x_meas;f_meas", {"t": 1e6})
    case = read(tmp_path, text)
    same(case, columns)
    assert any(
        "'Kanal 0' increases at the rate fs_hz, so it is read as t, in us" in n for n in case.notes
    )


def test_milliseconds_under_the_name_of_seconds_are_refused_with_the_remedy(tmp_path, columns):
    text = written(columns, ",".join(NAMES), {"t": 1e3}, ",", ".")
    with pytest.raises(InputError, match=r'if the time is in ms, give --map t="t \[ms\]"'):
        read(tmp_path, text)
    same(read(tmp_path, text, "t=t [ms]"), columns)


# ---- units that nobody states -------------------------------------------------------------------


def test_one_column_without_a_unit_is_told_by_the_others_and_said(tmp_path, columns, capsys):
    text = written(columns, "t;x_cmd [mm];LVDT;f_meas [kN]", MM_KN)
    case = read(tmp_path, text, "x_meas=LVDT")
    same(case, columns)
    (note,) = (n for n in case.notes if "is not stated" in n)
    assert "assumed to be mm, which makes it" in note


def test_force_and_displacement_without_units_are_not_guessed(tmp_path, columns):
    """In mm and kN, or in m and MN: the stiffness is the same."""
    only = {k: columns[k] for k in ("t", "x_meas", "f_meas")}
    text = written(only, "t;Weg;Kraft", MM_KN)
    with pytest.raises(InputError, match="it cannot be inferred with certainty") as caught:
        read(tmp_path, text, "x_meas=Weg", "f_meas=Kraft")
    assert '--map x_meas="Weg [m]"' in str(caught.value)
    same(read(tmp_path, text, "x_meas=Weg [mm]", "f_meas=Kraft"), only)


def test_a_signal_in_volts_is_no_reading(tmp_path, columns):
    text = written(columns, "t;x_cmd [m];LVDT [V];f_meas [N]")
    with pytest.raises(InputError, match="'V' is the unit of a sensor's electrical signal"):
        read(tmp_path, text, "x_meas=LVDT [V]")


def test_metres_and_meganewtons_that_agree_are_refused_by_their_noise(tmp_path):
    """What was measured in mm and kN: the stiffness is right, no sensor is as bad."""
    whole = cases.channels()
    text = written(whole, "t;x_cmd [m];x_meas [m];f_meas [MN]", MM_KN)
    with pytest.raises(InputError, match="too large for the noise that the model states"):
        read(tmp_path, text)


def test_a_row_of_units_may_hold_some_that_nobody_asks_for(tmp_path, columns):
    every = {**columns, "Temp": np.full(512, 21.5)}
    text = written(every, "Zeit;x_cmd;x_meas;f_meas;Temp\ns;mm;mm;kN;°C", MM_KN)
    same(read(tmp_path, text), columns)


def test_a_unit_of_another_kind_is_refused(tmp_path, columns):
    text = written(columns, "t;x_cmd [m];x_meas [kN];f_meas [N]")
    with pytest.raises(InputError, match="'kN' is not a unit for x_meas, which is in m"):
        read(tmp_path, text)


@pytest.mark.parametrize(
    ("text", "factor", "si"),
    [
        ("mm", 1e-3, "m"), ("µm", 1e-6, "m"), ("in", 0.0254, "m"), ("MM", 1e-3, "m"),
        ("kN", 1e3, "N"), ("KN", 1e3, "N"), ("MN", 1e6, "N"), ("lbf", 4.4482216152605, "N"),
        ("kip", 4448.2216152605, "N"), ("kips", 4448.2216152605, "N"), ("kgf", 9.80665, "N"),
        ("g", 9.80665, "m/s^2"), ("m/s²", 1.0, "m/s^2"), ("m/s2", 1.0, "m/s^2"),
        ("mm/s^2", 1e-3, "m/s^2"), ("gal", 1e-2, "m/s^2"), ("cm/s2", 1e-2, "m/s^2"),
        ("m/s**2", 1.0, "m/s^2"), ("mg", 9.80665e-3, "m/s^2"), ("ms", 1e-3, "s"), ("sec", 1.0, "s"),
        ("mps2", 1.0, "m/s^2"),
    ],
)  # fmt: skip
def test_units_are_converted_exactly(text, factor, si):
    found = column_units.read_unit(text)
    assert found is not None
    assert (float(found.factor), found.si) == (factor, si)


def test_nine_millimetres_are_the_double_next_to_nine_thousandths():
    found = column_units.read_unit("mm")
    assert found is not None
    assert column_units.in_si(np.array([9.0, 0.1]), found.factor).tolist() == [0.009, 0.0001]


# ---- few rows ---------------------------------------------------------------------------------


def coupon(rows: int, c: float = 0.0) -> tuple[str, str]:
    """A steel coupon under growing cycles of 14 rows: a spring beside one that yields (Prandtl).

    Its sensors resolve a hundredth of a per cent of the range, far less than the test moved from
    one row to the next.
    """
    turn = np.arange(rows)
    x = 1e-4 * turn * np.sin(2.0 * np.pi * turn / 14.0)
    k, most, slider = 1e7, 8e3, [0.0]
    for step in np.diff(x):
        slider.append(float(np.clip(slider[-1] + k * step, -most, most)))
    force = 0.05 * k * x + slider + 0.8 * np.random.default_rng(5).standard_normal(rows)
    text = "t,x_meas,f_meas\n" + "\n".join(
        f"{i / 10.0:.10g},{a:.9g},{f:.9g}" for i, (a, f) in enumerate(zip(x, force, strict=True))
    )
    toml = f"""schema = "rthyb-baseline/1"
family = "drive"
fs_hz = 10
[specimen]
k = 2e6
c = {c}
moving_mass = 0
[noise]
x_std = 1e-7
f_std = 0.8
"""
    return text, toml


def test_a_quasi_static_test_of_few_rows_is_read_although_they_are_far_apart(tmp_path):
    text, toml = coupon(70)
    case = read(tmp_path, text, toml=toml)
    assert case.t.size == 70
    d = engine.diagnose(case)
    assert (d.verdict, d.effects) == ("explained", ["hysteresis"])


def test_fewer_rows_than_a_loop_takes_are_refused_as_are_few_rows_of_a_test_with_rates(tmp_path):
    text, toml = coupon(59)
    with pytest.raises(InputError, match="has 59 rows; a diagnosis needs at least 60"):
        read(tmp_path, text, toml=toml)
    text, toml = coupon(99, c=1e3)
    with pytest.raises(InputError, match="has 99 rows; a diagnosis needs at least 100"):
        read(tmp_path, text, toml=toml)


# ---- sizes that cannot be -----------------------------------------------------------------------


def loop(seed: int = 3, seconds: float = 8.0) -> tuple[dict[str, np.ndarray], str]:
    """Return every channel of a closed loop whose numerical part is in balance, and its model."""
    c = cases.channels(seed=seed)
    x, _, a = cases.moved(c["x_cmd"])
    mass, damping = 2000.0, 900.0
    x_num = np.interp(c["t"] - 0.01, c["t"], c["x_cmd"])
    v_num = np.gradient(x_num) * cases.FS
    fy = 300.0 * np.sin(2 * np.pi * 0.7 * c["t"])
    noise = np.random.default_rng(seed).standard_normal((2, x.size))
    every = {
        **c,
        "x_num": x_num,
        "ag": -(mass * np.gradient(v_num) * cases.FS + damping * v_num + c["f_meas"]) / mass,
        "a_meas": a + 5e-3 * noise[0],
        "fy_meas": fy + cases.F_STD * noise[1],
    }
    text = cases.baseline(family='"loop"').replace(
        "[noise]", f"[numerical]\nm = {mass}\nc = {damping}\n[noise]\na_std = 5e-3"
    )
    return every, text


@pytest.mark.parametrize("factor", [1e3, 1e-3])
@pytest.mark.parametrize("name", ["ag", "x_num", "x_cmd", "x_meas", "f_meas", "a_meas", "fy_meas"])
def test_a_factor_of_1000_is_refused_in_every_channel_of_a_loop(tmp_path, name, factor):
    every, toml = loop()
    read(tmp_path, written(every, ",".join(every), None, ",", "."), toml=toml)
    with pytest.raises(InputError, match="probably a wrong unit") as caught:
        read(tmp_path, written(every, ",".join(every), {name: factor}, ",", "."), toml=toml)
    if (factor == 1e3 and name.startswith("x_")) or (factor == 1e-3 and "f" in name):
        unit = "mm" if factor == 1e3 else "kN"
        assert f'--map {name}="{name} [{unit}]"' in str(caught.value)


@pytest.mark.parametrize("name", ["ag", "a_meas"])
def test_accelerations_in_g_are_refused_with_the_option_that_mends_it(tmp_path, name):
    every, toml = loop()
    text = written(every, ",".join(every), {name: 1.0 / 9.80665}, ",", ".")
    with pytest.raises(InputError, match=rf'--map {name}="{name} \[g\]"'):
        read(tmp_path, text, toml=toml)
    same(read(tmp_path, text, f"{name}={name} [g]", toml=toml), every)


def forced(softer: float = 1.0, free: bool = False, seconds: float = 10.0):
    """Return a body under a swept force, or let go, and the model of it."""
    from scipy import signal

    mass, k, c = 6700.0, 4.5e5 / softer, 3600.0
    t = np.arange(int(seconds * cases.FS)) / cases.FS
    push = 900.0 * np.clip(t / 0.5, 0, 1) * np.sin(2 * np.pi * (0.3 * t + 0.1 * t**2))
    push = 0.0 * push if free else push
    system = signal.StateSpace(
        [[0, 1], [-k / mass, -c / mass]], [[0], [1 / mass]], np.eye(2), np.zeros((2, 1))
    )
    _, y, _ = signal.lsim(system, push, t, X0=[0.01, 0.0] if free else [0.0, 0.0])
    noise = 4e-6 * np.random.default_rng(5).standard_normal(t.size)
    head = f'schema = "rthyb-baseline/1"\nfamily = "forced"\nfs_hz = {cases.FS}\n'
    toml = head + (
        "[specimen]\nk = 4.5e5\nc = 3600\nmoving_mass = 6700\nk_tol = 0.01\nc_tol = 0.1\n"
        "[noise]\nx_std = 4e-6\nf_std = 0.4\n"
    )
    return {"t": t, "x_meas": y[:, 0] + noise, "f_in": push}, toml


@pytest.mark.parametrize("factor", [1e3, 1e-3, 9.80665, 1 / 9.80665])
@pytest.mark.parametrize("name", ["x_meas", "f_in"])
def test_a_body_under_a_force_in_a_wrong_unit_is_refused(tmp_path, name, factor):
    every, toml = forced()
    read(tmp_path, written(every, ",".join(every), None, ",", "."), toml=toml)
    with pytest.raises(InputError, match="probably a wrong unit"):
        read(tmp_path, written(every, ",".join(every), {name: factor}, ",", "."), toml=toml)


@pytest.mark.parametrize("ratio", [1 / 30, 1 / 5, 5.0, 30.0])
def test_a_specimen_thirty_times_softer_or_stiffer_is_no_wrong_unit(tmp_path, ratio):
    columns = cases.channels()
    x, v, a = cases.moved(columns["x_cmd"])
    columns["f_meas"] = ratio * cases.K * x + cases.C * v + cases.M * a
    read(tmp_path, written(columns, ",".join(columns), None, ",", "."))


@pytest.mark.parametrize("softer", [0.1, 10.0, 30.0])
def test_a_body_on_another_spring_than_the_model_says_is_no_wrong_unit(tmp_path, softer):
    every, toml = forced(softer)
    read(tmp_path, written(every, ",".join(every), None, ",", "."), toml=toml)


def test_a_play_that_is_never_taken_up_is_no_wrong_unit(tmp_path):
    columns = cases.channels()
    x, _, _ = cases.moved(columns["x_cmd"])
    gap = 0.97 * np.max(np.abs(x))
    rng = np.random.default_rng(4)
    columns["f_meas"] = cases.K * (x - np.clip(x, -gap, gap)) + 2.0 * rng.standard_normal(x.size)
    read(tmp_path, written(columns, ",".join(columns), None, ",", "."))


def test_a_stated_unit_is_believed_for_a_factor_that_a_specimen_can_have(tmp_path):
    columns = cases.channels()
    columns["f_meas"] = columns["f_meas"] / 9.81
    with pytest.raises(InputError, match="wrong unit"):
        read(tmp_path, written(columns, ",".join(columns), None, ",", "."))
    read(tmp_path, written(columns, "t,x_cmd,x_meas,f_meas [N]", None, ",", "."))


@pytest.mark.parametrize("name", ["x_cmd", "x_meas", "f_meas"])
def test_a_second_recording_in_other_units_is_refused(tmp_path, name, columns):
    first = read(tmp_path, written(columns, ",".join(NAMES), None, ",", "."))
    other = {k: v for k, v in columns.items() if k in ("t", name)}
    text = written(other, ",".join(other), {name: 1e-3 if name == "f_meas" else 1e3}, ",", ".")
    with pytest.raises(
        InputError, match="for the recording from which the answer was derived"
    ) as caught:
        read(tmp_path, text, judged=False, beside=first)
    assert f'--map {name}="{name} [{"kN" if name == "f_meas" else "mm"}]"' in str(caught.value)
    smaller = written(other, ",".join(other), {name: 0.02}, ",", ".")
    read(tmp_path, smaller, judged=False, beside=first)


def test_a_second_recording_is_mapped_like_the_first_and_may_lack_outputs(tmp_path, columns):
    maps = ("x_cmd=Soll [mm]", "x_meas=Weg [mm]", "f_meas=Kraft [kN]")
    first = read(tmp_path, written(columns, "t;Soll;Weg;Kraft", MM_KN), *maps)
    inputs = {k: columns[k] for k in ("t", "x_cmd")}
    second = read(tmp_path, written(inputs, "t;Soll", MM_KN), *maps, judged=False, beside=first)
    same(second, inputs)


# ---- a body that is let go ----------------------------------------------------------------------


@pytest.mark.long
# The search divides by the size of a column of nothing, and goes on rightly.
@pytest.mark.filterwarnings("ignore:overflow encountered in divide:RuntimeWarning")
def test_a_free_decay_is_read_and_diagnosed(tmp_path):
    from rthyb_rt.diagnose import engine

    every, toml = forced(softer=1.0 / 0.9, free=True, seconds=5.0)
    d = engine.diagnose(read(tmp_path, written(every, ",".join(every), None, ",", "."), toml=toml))
    # A free swing has one frequency: a softer spring and a larger mass are one thing.
    assert (d.verdict, sorted(d.ambiguous_with)) == ("ambiguous", [["inertia"], ["stiffness"]])
    softer = next(c for c in d.candidates if c.name == "stiffness")
    assert softer.params["dk_ratio"] == pytest.approx(-0.1, abs=1e-3)


def test_a_body_that_is_let_go_needs_no_force_to_be_read(tmp_path):
    every, toml = forced(free=True)
    case = read(tmp_path, written(every, ",".join(every), None, ",", "."), toml=toml)
    assert not case.channels["f_in"].any()
    assert case.notes == []


def test_a_force_that_stands_still_elsewhere_is_a_dead_channel(tmp_path):
    every, toml = forced()
    every["f_in"] = np.full_like(every["t"], 3.0)
    with pytest.raises(InputError, match=r"f_in is constant at 3 N"):
        read(tmp_path, written(every, ",".join(every), None, ",", "."), toml=toml)


# ---- the model ----------------------------------------------------------------------------------


def test_values_of_a_baseline_may_carry_units(tmp_path):
    plain = model(tmp_path)
    text = cases.baseline(k='"500 N/mm"', c='"1.5 kN s/m"', moving_mass='"0.04 t"', k_tol='"1 %"')
    text = text.replace(f"delay_s = {cases.DELAY}", 'delay_s = "5.2 ms"')
    text = text.replace(f"x_std = {cases.X_STD}", 'x_std = "3 µm"')
    assert model(tmp_path, text) == plain


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("k = 500000.0", 'k = "5 kN"', 5, "that is a force.*the stiffness must be from 0"),
        ("k = 500000.0", "k = -5", 5, "found -5; the stiffness must be from 0"),
        ("k = 500000.0", "k = true", 5, "found true"),
        ("moving_mass", "moving_mas", 7, 'unknown key .did you mean "moving_mass".*allowed here'),
        ("zeta = 0.9", "zeta = 0", 13, "found 0; the damping ratio must be from"),
        ("[actuator]", "[actuators]", 10, 'unknown key .did you mean "actuator"'),
        (
            'family = "drive"',
            'family = "driven"',
            2,
            'did you mean "drive".*must be one of "drive"',
        ),
        ("fs_hz = 256.0", "", 1, "fs_hz.*missing; the sampling rate"),
        ("k_tol = 0.01", 'k_tol = "1 mm"', 8, "that is a length.*a number without a unit"),
    ],
)
def test_a_slip_in_a_baseline_is_answered_with_line_value_and_range(
    tmp_path, old, new, line, words
):
    text = cases.baseline().replace(old, new)
    with pytest.raises(InputError, match=rf"(?s)baseline\.toml:{line}\b.*{words}"):
        model(tmp_path, text)


def test_keys_of_a_lab_that_mean_nothing_here_are_said_and_do_no_harm(tmp_path, columns):
    text = "operator = 'N. N.'\n" + cases.baseline() + "\n[weather]\nhumidity = 0.4\n"
    case = read(tmp_path, written(columns, ",".join(NAMES), None, ",", "."), toml=text)
    assert any(
        "parts of the model that are not used: operator, weather" in note for note in case.notes
    )


def test_tolerances_of_an_actuator_come_with_the_model(tmp_path):
    text = cases.baseline().replace(
        "gain = 1.0",
        'gain = 1.0\ndelay_tol_s = "0.2 ms"\nf_tol = 0.05\nzeta_tol = "10 %"\ngain_tol = 0.002',
    )
    lag = model(tmp_path, text).actuator
    assert (lag.delay_tol_s, lag.f_tol, lag.zeta_tol, lag.gain_tol) == (2e-4, 0.05, 0.1, 0.002)
    plain = model(tmp_path, cases.baseline()).actuator
    assert (plain.delay_tol_s, plain.f_tol, plain.zeta_tol, plain.gain_tol) == (None,) * 4


def test_tolerances_of_a_rig_file_are_read_and_change_no_rig(tmp_path):
    from rthyb_rt.lab import experiment
    from rthyb_rt.rig.commissioning.certificate import rig_hash

    path = tmp_path / "rig.toml"
    text = cases.rig(
        'delay_tol_s = "0.1 ms"\nnatural_frequency_tol = "5 %"\n'
        "damping_ratio_tol = 0.1\ngain_tol = 0.01"
    )
    path.write_text(text)
    lag = reading.read_model(path).actuator
    assert (lag.delay_tol_s, lag.f_tol, lag.zeta_tol, lag.gain_tol) == (1e-4, 0.05, 0.1, 0.01)
    rig = config.load_rig(path)
    bare = config.parse_rig("\n".join(n for n in text.splitlines() if "_tol" not in n))
    assert experiment.rig_config(rig) == experiment.rig_config(bare)
    assert rig_hash(rig) == rig_hash(bare)
    assert config.parse_rig(config.dump(rig)) == rig


def test_a_shipped_rig_is_a_model_by_its_name():
    path = reading.find_model("shaking-table-portal-frame")
    assert reading.read_model(path).rig.rig.name == "shaking-table-portal-frame"
    with pytest.raises(InputError, match=r'--model: .*did you mean "shaking-table-portal-frame"'):
        reading.find_model("shaking-table-portal-fram")
    # A test is a model as well: its rig and its numerical part.
    with pytest.raises(InputError, match=r"no rig or test of that name.*section5-T0\.5"):
        reading.find_model("nonsense")
    for misspelt, meant in (
        ("ten-storey", "ten-storeys"),
        ("delay-10-elastik", "delay-10-elastic"),
    ):
        with pytest.raises(InputError, match=rf'of that name \(did you mean "{meant}"\?\); give'):
            reading.find_model(misspelt)


# ---- from the command line ----------------------------------------------------------------------


def run(*arguments: object) -> int:
    return cli.main([str(a) for a in arguments])


@pytest.mark.long
def test_what_was_guessed_is_said_on_stderr_and_in_the_answer(tmp_path, capsys):
    whole = cases.channels()
    (tmp_path / "lab.txt").write_text(written(whole, "Zeit;x_cmd [mm];LVDT;f_meas [kN]", MM_KN))
    (tmp_path / "baseline.toml").write_text(cases.baseline())
    call = ("diagnose", tmp_path / "lab.txt", "--model", tmp_path / "baseline.toml", "--json")
    assert run(*call, "--map", "x_meas=LVDT", "--report", tmp_path / "out") == 0
    said = capsys.readouterr()
    assert "rthyb: x_meas: the unit of 'LVDT' is not stated; assumed to be mm" in said.err
    answer = json.loads(said.out)
    assert answer["verdict"] == "none"
    assert any("assumed to be mm" in note for note in answer["notes"])
    assert "is not stated; assumed to be mm" in (tmp_path / "out" / "report.html").read_text()


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("x_mess=LVDT [mm]", "found channel 'x_mess' (did you mean 'x_meas'?); must be one of t,"),
        ("x_meas=", "names no column"),
        ("x_meas=-", "names no column"),
        ("LVDT", "must be CHANNEL=COLUMN"),
        ("nowhere.toml", "nowhere.toml: no such file"),
        (
            "x_meas=LVTD 1 [mm]",
            "has no column 'LVTD 1' (did you mean 'LVDT 1'?); its columns are 't'",
        ),
        ("x_meas=LVDT 1 [mn]", "the unit 'mn' is not known; allowed are m, cm, mm"),
        ("x_meas=#9", "has no column '#9'"),
    ],
)
def test_a_wrong_map_is_answered_with_what_would_be_right(tmp_path, columns, option, words, capsys):
    text = written(columns, "t,x_cmd,LVDT 1,f_meas", None, ",", ".")
    (tmp_path / "lab.csv").write_text(text)
    (tmp_path / "baseline.toml").write_text(cases.baseline())
    call = ("diagnose", tmp_path / "lab.csv", "--model", tmp_path / "baseline.toml")
    assert run(*call, "--map", option) == 3
    assert words in capsys.readouterr().err


def test_columns_that_nothing_names_are_offered_with_their_options(tmp_path, columns):
    text = written(columns, "Zeit [s];Soll [mm];LVDT 1 [mm];Kraft [kN]", MM_KN)
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert '--map f_meas="Kraft [kN]"' in str(caught.value)
    assert '--map x_meas="' in str(caught.value)


@pytest.mark.parametrize("kind", ["baseline", "map"])
def test_the_schema_of_the_files_of_a_diagnosis_is_printed(kind, capsys):
    assert run("schema", kind) == 0
    schema = json.loads(capsys.readouterr().out)
    assert ("specimen" if kind == "baseline" else "channels") in schema["properties"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no rows"),
        ("t,x_meas,f_meas\n", "no rows"),
        ("0,1,2\n1,2,3\n2,3,4\n", "has no column names; found '0,1,2'"),
        ("t,x_cmd\n0,0,0,1\n1,0,0,2\n", "decimal commas cannot be distinguished"),
        ("t,x_meas,f_meas\n0,1,2\n1,abc,3\n", ":3: column x_meas: 'abc' is not a number"),
        ("t;x_meas;f_meas\n0;1,5;2\n0,1;1.234;3\n0,2;2,5;3\n", "'1.234' is not a number; write"),
        ("t;x_meas;f_meas\n0;1.000,5;2\n1;2.000,7;3\n", "without thousands separators"),
        ("t,x_meas,x_meas\n0,1,2\n1,2,3\n", "two columns of the same name"),
        ("t,x_meas,f_meas\n0,1,2\n1,2\n", ":3: has 2 fields, but the header has 3"),
        ("PK\x03\x04junk\x00\x01", "is not CSV text"),
    ],
)
def test_a_table_that_is_none_is_refused_with_its_line(tmp_path, text, words):
    with pytest.raises(InputError) as caught:
        read(tmp_path, text)
    assert words in str(caught.value)


# ---- whatever comes -----------------------------------------------------------------------------

DIALECTS = st.sampled_from(
    [(",", "."), (";", "."), (";", ","), ("\t", "."), ("\t", ","), ("|", ","), ("  ", ".")]
)
SCALES = {
    "t": {"s": 1.0, "ms": 1e3, "us": 1e6},
    "x_cmd": {"m": 1.0, "mm": 1e3, "cm": 100.0, "µm": 1e6, "in": 1 / 0.0254},
    "x_meas": {"m": 1.0, "mm": 1e3, "um": 1e6},
    "f_meas": {"N": 1.0, "kN": 1e-3, "lbf": 1 / 4.4482216152605, "kip": 1 / 4448.2216152605},
}
FORMS = st.sampled_from(["{} [{}]", "{} ({})", "{}_{}", "{}[{}]", "{} / {}", "row"])


@pytest.mark.long
@quick(60)
@given(data=st.data())
def test_a_table_in_any_dialect_and_unit_reads_back_the_same_numbers(tmp_path, columns, data):
    separator, decimal = data.draw(DIALECTS)
    end = data.draw(st.sampled_from(["\n", "\r\n", "\r"]))
    form = data.draw(FORMS)
    if separator == "  " and form in ("{} / {}", "row"):
        form = "{} [{}]"
    chosen = {k: data.draw(st.sampled_from(sorted(v))) for k, v in SCALES.items()}
    heads = [k if form == "row" else form.format(k, u) for k, u in chosen.items()]
    head = data.draw(st.sampled_from(["", "# a comment\n", "Prüfung 7\n\nvom 3. Mai\n"]))
    head += separator.join(heads)
    if form == "row":
        head += "\n" + separator.join(chosen.values())
    scales = {k: SCALES[k][u] for k, u in chosen.items()}
    part = {k: v[:300] for k, v in columns.items()}
    text = written(part, head, scales, separator, decimal, end)
    coding = data.draw(st.sampled_from(["utf-8", "utf-8-sig", "latin-1", "utf-16"]))
    same(read(tmp_path, text.encode(coding)), part)


ALPHABET = st.sampled_from(
    [*"0123456789.,;\t |eE+-\"'#%[]()xtf_measNmk\r\n\x00\x0bäµ²/:", "t,x_meas\n"]
)


@quick(150)
@given(
    text=st.lists(ALPHABET, max_size=120).map("".join), coding=st.sampled_from(["utf-8", "utf-16"])
)
def test_never_a_traceback_from_any_text(tmp_path, text, coding):
    with contextlib.suppress(InputError):
        read(tmp_path, text.encode(coding))


@pytest.mark.long
@quick(150)
@given(data=st.data())
def test_never_a_traceback_from_a_table_that_something_happened_to(tmp_path, columns, data):
    part = {k: v[:150] for k, v in columns.items()}
    text = written(part, "t;x_cmd [mm];x_meas;f_meas [kN]", MM_KN | {"x_meas": 1.0})
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(text)))
        cut = data.draw(st.integers(0, 30))
        text = text[:at] + "".join(data.draw(st.lists(ALPHABET, max_size=8))) + text[at + cut :]
    maps = data.draw(st.lists(st.sampled_from(["x_meas=#3 [m]", "t=t [s]", "f_meas=-f_meas"])))
    with contextlib.suppress(InputError):
        read(tmp_path, text, *maps)


@quick(150)
@given(data=st.data())
def test_never_a_traceback_from_a_baseline_that_something_happened_to(tmp_path, data):
    text = cases.baseline()
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(text)))
        cut = data.draw(st.integers(0, 20))
        text = text[:at] + "".join(data.draw(st.lists(ALPHABET, max_size=8))) + text[at + cut :]
    with contextlib.suppress(InputError):
        model(tmp_path, text)


@pytest.mark.parametrize("factor", [1e300, 1e200, 1e-200, 1e-320, 0.0, np.nan])
def test_readings_that_no_sensor_has_end_in_words(tmp_path, factor):
    for every, toml in (loop(), forced()):
        for name in every:
            text = written(every, ",".join(every), {name: factor}, ",", ".")
            with contextlib.suppress(InputError):
                read(tmp_path, text, toml=toml)


@pytest.mark.long
def test_a_long_recording_is_read_in_seconds(tmp_path):
    n = 200_000
    values = np.column_stack([np.arange(n) / 1024.0, *np.random.default_rng(1).random((4, n))])
    path = tmp_path / "long.txt"
    np.savetxt(path, values, delimiter=";", header="t;a;b;c;d", comments="", fmt="%.9g")
    import time

    start = time.perf_counter()
    assert len(table.read_table(path).columns) == 5
    assert time.perf_counter() - start < 10.0


def test_a_steel_coupon_far_beyond_yielding_is_no_wrong_unit(tmp_path):
    """Its force may be a tenth of the elastic one, but it then has another shape."""
    columns = cases.channels()
    x = cases.moved(columns["x_cmd"])[0]
    yields, force, held = 0.14 * np.max(np.abs(x)), np.zeros(x.size), 0.0
    for i, dx in enumerate(np.diff(x, prepend=0.0)):
        held = float(np.clip(held + dx, -yields, yields))
        force[i] = cases.K * (0.02 * x[i] + 0.98 * held)
    ratio = float(force @ x) / (cases.K * float(x @ x))
    assert abs(9.81 * ratio - 1.0) < 0.1  # as if it were in kilograms force
    del columns["x_cmd"]
    columns["f_meas"] = force
    read(tmp_path, written(columns, ",".join(columns), None, ",", "."))


def test_fast_motion_at_few_rows_a_cycle_is_no_noise_in_a_wrong_unit():
    """Its fourth differences are as large as itself; the quietest part of the band is noise."""
    rng = np.random.default_rng(6)
    rows, x_std = 4096, 1e-6
    spectrum = np.exp(2j * np.pi * rng.random(rows // 2 + 1))
    spectrum[int(0.6 * spectrum.size) :] = 0.0
    x = np.fft.irfft(spectrum, rows)
    x = 2e-3 * x / np.std(x) + x_std * rng.standard_normal(rows)
    model = Model("forced", 512.0, 1e5, 100.0, 20.0, x_std=x_std)
    assert white_noise(x) > 100.0 * x_std

    def ratio(values: np.ndarray) -> float:
        found = channel_sizes.relations({"x_meas": values}, model)
        return next(r.ratio for r in found if r.channel == "x_meas" and r.bound)

    assert 0.7 < ratio(x) < 1.2
    assert ratio(1000.0 * x) > 700.0


def test_a_random_force_up_to_half_the_sampling_rate_is_no_noise_in_a_wrong_unit():
    """Of a second test whose motion is to be foretold, nothing else says how large its force is."""
    rng = np.random.default_rng(6)
    push = 20.0 * rng.standard_normal(4096)
    model = Model("forced", 512.0, 1e5, 100.0, 20.0, x_std=1e-6, f_std=0.05)
    assert white_noise(push) > 100.0 * 0.05
    assert not [r for r in channel_sizes.relations({"f_in": push}, model) if r.channel == "f_in"]
    start = {"f_in": push, "x_meas": np.where(np.arange(4096) < 300, 1e-4, np.nan)}
    channel_sizes.check(start, model, "second.csv", None)
