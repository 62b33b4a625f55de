"""A sensor that is noisier than its data sheet states."""

from __future__ import annotations

import diagnose_cases as cases
import numpy as np
import pytest

from rthyb_rt.diagnose import engine, reading, understated

FS_HZ, ROWS = 1024.0, 8192
T = np.arange(ROWS) / FS_HZ
X, V = 1e-2 * np.sin(2.0 * np.pi * T), 2.0 * np.pi * 1e-2 * np.cos(2.0 * np.pi * T)
MOTION = (X, V, -((2.0 * np.pi) ** 2) * X)
MADE = 1e5 * X
ALL = np.ones(ROWS, dtype=np.bool_)


def white(seed: int) -> np.ndarray:
    return 10.0 * np.random.default_rng(seed).standard_normal(ROWS)


def level(rest: np.ndarray, made: np.ndarray = MADE, rows: int = ROWS) -> float:
    motion = [part[:rows] for part in MOTION]
    return understated.level(rest[:rows], made[:rows], ALL[:rows], motion)


@pytest.mark.parametrize("rows", [1024, 4096, ROWS])
def test_white_noise_is_noise_at_any_level_and_about_any_mean(rows):
    found = [level(100.0 * white(seed) + 3.0, 1e2 * MADE, rows) for seed in range(40)]
    assert np.mean(np.array(found) > 0.0) > 0.85
    assert np.max(found) == pytest.approx(1000.0, rel=0.1)


LAWS = {
    "a slow line": lambda noise: noise + 8.0 * np.sin(2.0 * np.pi * 4.0 * T),
    "a line above the motion": lambda noise: noise + 3.0 * np.sin(2.0 * np.pi * 300.7 * T),
    "nothing but a line": lambda noise: 1e-3 * noise + np.sin(2.0 * np.pi * 300.7 * T),
    "slow noise": lambda noise: noise + np.cumsum(noise) / 30.0,
    "jitter of a motion": lambda noise: np.gradient(np.gradient(noise)),
    "coloured": lambda noise: np.convolve(noise, np.ones(4) / 2.0, mode="same"),
    "a bump": lambda noise: noise + 20.0 * np.exp(-(((X - 5e-3) / 1e-3) ** 2)),
    "friction": lambda noise: noise + 5.0 * np.sign(V),
    "louder when fast": lambda noise: noise * (1.0 + 8.0 * np.abs(V)),
    "louder to one side": lambda noise: noise * np.where(X > 0.0, 1.2, 1.0),
    "louder half-way": lambda noise: noise * (0.3 + np.abs(np.sin(4.0 * np.pi * T))),
    "a burst": lambda noise: noise * np.where(np.abs(T - 4.0) < 0.5, 2.0, 1.0),
    "knocks": lambda noise: noise + 150.0 * (np.random.default_rng(1).random(ROWS) < 0.003),
}


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_what_has_a_shape_a_place_a_time_or_a_colour_is_not(seed, law):
    assert level(law(white(seed))) == 0.0


def test_no_level_is_taken_from_a_force_that_changes_from_row_to_row():
    """Quasi-static rows: what a law leaves is as rough as the reading itself."""
    rough = 1e3 * np.random.default_rng(3).standard_normal(ROWS)
    assert level(0.5 * rough, rough) == 0.0


def test_a_few_rows_do_not_show_whether_noise_is_white():
    assert level(white(1), rows=1000) == 0.0


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, 0.0])
def test_a_residual_without_a_level_is_no_noise(value):
    with np.errstate(over="ignore", invalid="ignore"):
        assert level(np.full(ROWS, value)) == 0.0
        one = white(2)
        one[77] = value
        assert level(one) == 0.0 or value == 0.0


def test_a_motion_that_both_sensors_show_is_the_noise_of_neither():
    x = 1e-5 * white(3)
    force = 1e5 * x + 50.0 * np.gradient(x) + white(4)
    assert understated.unrelated(x, white(4), ALL)
    assert not understated.unrelated(x, force, ALL)
    for value in (np.nan, np.inf):
        x[5] = value
        with np.errstate(invalid="ignore"):
            assert not understated.unrelated(x, white(4), ALL)


@pytest.mark.parametrize(
    ("friction_n", "verdict", "names"),
    [(0.0, "none", []), pytest.param(300.0, "explained", ["coulomb"], marks=pytest.mark.long)],
    ids=["nothing missing", "friction"],
)
def test_a_sheet_that_is_wrong_by_a_factor_of_three_is_told_and_the_law_found(
    tmp_path, friction_n, verdict, names
):
    columns = cases.channels(lambda t, x, v, a: friction_n * np.tanh(v / 1e-4))
    random = np.random.default_rng(11)
    columns["f_meas"] += 2.8 * cases.F_STD * random.standard_normal(columns["t"].size)
    columns["x_meas"] += 2.8 * cases.X_STD * random.standard_normal(columns["t"].size)
    recording, toml = cases.write(tmp_path, columns)
    d = engine.diagnose(reading.read_case(recording, reading.read_model(toml)))
    assert (d.verdict, d.effects) == (verdict, names)
    told = {n.split()[3]: float(n.split()[5]) for n in d.notes if "data sheet states" in n}
    # That of the load cell is left as it is where it hides nothing.
    assert {"x_meas"} <= set(told) <= {"x_meas", "f_meas"}
    stated = {"x_meas": cases.X_STD, "f_meas": cases.F_STD}
    assert told == pytest.approx({name: 2.97 * stated[name] for name in told}, rel=0.1)


@pytest.mark.long
def test_an_actuator_that_vibrates_is_no_loud_sensor(tmp_path):
    """At 91 Hz, where no command is: the displacement shows it, and the force as well."""
    columns = cases.channels()
    w = 2.0 * np.pi * 91.3
    more = 3e-5 * np.exp(1j * w * columns["t"])
    columns["x_meas"] += more.imag
    impedance = cases.K * 1.004 + 1j * w * cases.C * 0.95 - w**2 * cases.M
    columns["f_meas"] += (impedance * more).imag
    recording, toml = cases.write(tmp_path, columns)
    d = engine.diagnose(reading.read_case(recording, reading.read_model(toml)))
    assert (d.verdict, d.effects) == ("unknown", [])
    assert not [note for note in d.notes if "data sheet states" in note]
