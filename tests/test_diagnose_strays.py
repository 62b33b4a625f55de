"""Single readings that show what was not there."""

from __future__ import annotations

import diagnose_cases as cases
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rthyb_rt.diagnose import engine, reading, strays
from rthyb_rt.errors import InputError

ROWS = 4096
T = np.arange(ROWS) / 512.0
W = 2.0 * np.pi * 1.3
X, V = np.sin(W * T) / W, np.cos(W * T)
ALL = np.ones(ROWS, dtype=np.bool_)
TURNS = np.flatnonzero(V[:-1] * V[1:] < 0.0)
INSIDE = np.flatnonzero(np.abs(X * W) < 0.9)


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(ROWS)


def isolated(rest: np.ndarray, sheet: float = 0.0, x: np.ndarray = X, v: np.ndarray = V) -> list:
    return strays.isolated(rest, ALL, sheet, x, v).tolist()


@given(
    rows=st.lists(st.sampled_from(INSIDE[8:-8].tolist()), min_size=1, max_size=4, unique=True),
    size=st.floats(25.0, 1e6),
    sign=st.sampled_from([-1.0, 1.0]),
    seed=st.integers(0, 99),
)
def test_stray_readings_are_found_in_noise_and_on_what_is_slow(rows, size, sign, seed):
    apart = sorted(r for i, r in enumerate(rows) if all(abs(r - o) > 8 for o in rows[:i]))
    rest = noise(seed) + 30.0 * np.sin(2.0 * np.pi * 2.0 * T)
    rest[apart] += sign * size
    same_place = len(apart) > 2 and np.ptp(X[apart]) < 0.02 * np.ptp(X)
    assert isolated(rest) == ([] if same_place else apart)


@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize(
    "shape",
    [
        lambda rest: rest,
        lambda rest: rest + 50.0 * (T > 3.0),
        lambda rest: rest + 50.0 * ((T > 3.0) & (T < 3.0 + 3.5 / 512.0)),
        lambda rest: rest + 50.0 * np.exp(-(((T - 3.0) / 0.01) ** 2)),
        lambda rest: rest + 50.0 * np.sign(V),
    ],
    ids=["noise", "a step", "three rows", "a pulse", "friction"],
)
def test_steps_pulses_and_friction_are_no_stray_readings(seed, shape):
    assert isolated(shape(noise(seed))) == []


def knocked(rows: np.ndarray) -> np.ndarray:
    rest = noise(5)
    rest[rows] += 50.0
    return rest


def test_a_law_may_act_in_single_rows_at_an_end_at_a_reversal_or_at_one_place():
    assert isolated(knocked(TURNS[3:4])) == []  # an end of the motion, even if only once
    assert isolated(knocked(TURNS)) == []
    centre = np.flatnonzero(X[:-1] * X[1:] < 0.0)
    assert isolated(knocked(centre)) == []  # too many
    assert isolated(knocked(centre[1:4])) == []  # one place
    assert isolated(knocked(INSIDE[[300, 1200]])) == INSIDE[[300, 1200]].tolist()
    # Where most are of no law, so is the one that happens to be at an end.
    mixed = np.sort(np.append(INSIDE[[300, 1200]], TURNS[3]))
    assert isolated(knocked(mixed)) == mixed.tolist()


def test_reversals_within_the_range_are_places_of_a_law_only_if_most_of_them_show_it():
    """A motion with small reversals on a large one; a rest before it has no reversals."""
    slow = np.sin(2.0 * np.pi * 0.25 * T) + 0.2 * np.sin(2.0 * np.pi * 1.3 * T)
    x = np.where(T > 2.0, slow, slow[1024])
    v = np.where(T > 2.0, np.gradient(slow, T), 0.0)
    turns = np.flatnonzero(v[:-1] * v[1:] < 0.0)
    inner = turns[np.abs(x[turns]) < 0.8 * np.abs(x).max()]
    assert inner.size > 8
    assert isolated(knocked(inner[:4]), x=x, v=v) == inner[:4].tolist()
    # In a shorter test, these are most of all.
    rows = int(inner[5]) + 40
    part = strays.isolated(knocked(inner[:4])[:rows], ALL[:rows], 0.0, x[:rows], v[:rows])
    assert part.size == 0


@pytest.mark.parametrize("value", [0.0, 1.0, 1e300, np.inf, np.nan])
def test_no_row_of_a_residual_without_noise_is_a_stray_reading(value):
    with np.errstate(over="ignore", invalid="ignore"):
        assert isolated(np.full(ROWS, value)) == []
        one = noise(7)
        one[100] = value
        assert len(isolated(one)) <= 1


@pytest.mark.parametrize("rows", [0, 1, 4, 9, 16])
def test_a_few_rows_have_no_stray_readings(rows):
    few = np.ones(rows)
    assert strays.isolated(few, few > 0.0, 1.0, few, few).size == 0


def test_what_is_small_against_the_data_sheet_or_not_evaluated_is_no_stray_reading():
    rest = 1e-3 * knocked(INSIDE[[900]])
    assert isolated(rest) == [INSIDE[900]]
    assert isolated(rest, sheet=1.0) == []
    rows = ALL.copy()
    rows[INSIDE[900] - 1] = False
    assert strays.isolated(rest, rows, 0.0, X, V).size == 0


def test_a_reading_far_beyond_all_others_is_impossible_and_a_group_of_them_is_not():
    values = np.sin(T)
    values[1000] = 90.0
    assert strays.impossible(values).tolist() == [1000]
    values[1001] = 90.0
    assert strays.impossible(values).size == 0
    assert strays.impossible(np.zeros(ROWS)).size == 0


def spoiled(tmp_path, friction_n: float = 0.0):
    columns = cases.channels(lambda t, x, v, a: friction_n * np.tanh(v / 1e-4))
    columns["f_meas"][[702, 1300]] += 60.0 * cases.F_STD
    columns["x_meas"][[500, 1601]] -= 60.0 * cases.X_STD
    recording, toml = cases.write(tmp_path, columns)
    return reading.read_case(recording, reading.read_model(toml))


@pytest.mark.parametrize(
    ("friction_n", "verdict", "names"),
    [(300.0, "explained", ["coulomb"]), pytest.param(0.0, "none", [], marks=pytest.mark.long)],
    ids=["friction", "nothing missing"],
)
def test_stray_readings_within_the_range_hide_no_law_and_are_told(
    tmp_path, friction_n, verdict, names
):
    d = engine.diagnose(spoiled(tmp_path, friction_n))
    assert (d.verdict, d.effects) == (verdict, names)
    told = {note.split()[0]: note for note in d.notes if "stray" in note}
    # Those of the force are left in where they hide nothing.
    assert {"x_meas"} <= set(told) <= {"x_meas", "f_meas"}
    assert all("2 stray readings" in note for note in told.values())


def test_if_the_rest_is_not_enough_the_first_answer_stands(tmp_path, monkeypatch):
    case, tried = spoiled(tmp_path), []
    diagnosed = engine._diagnosed

    def once(case, progress):
        tried.append(case)
        if len(tried) > 1:
            raise InputError("too few rows", "recording")
        return diagnosed(case, progress)

    monkeypatch.setattr(engine, "_diagnosed", once)
    d = engine.diagnose(case)
    assert len(tried) == 2
    assert d.verdict == "unknown"
    assert not [note for note in d.notes if "stray" in note]


@pytest.mark.long
def test_a_stop_that_is_touched_once_is_no_stray_reading(tmp_path, monkeypatch):
    """Nine micrometres into a stop, in one row: not decidable, and not "nothing is missing"."""
    t = np.arange(2048) / cases.FS
    burst = 7e-3 * np.exp(-(((t - 4.0) / 2.0) ** 2)) * np.sin(6.0 * np.pi * t)
    monkeypatch.setattr(cases, "command", lambda *_, **__: burst)
    x = cases.moved(burst)[0]
    at = int(np.argmax(x))
    columns = cases.channels()
    columns["f_meas"][at] += 60.0 * cases.F_STD
    recording, toml = cases.write(tmp_path, columns)
    d = engine.diagnose(reading.read_case(recording, reading.read_model(toml)))
    assert d.verdict == "unknown"
