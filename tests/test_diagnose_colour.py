"""The colour of a channel's noise: read beside the motion, held by its sheet, no hide for a law."""

from __future__ import annotations

import numpy as np
import pytest
from test_diagnose_noise import (
    DRIVE,
    F_HZ,
    F_STD,
    FS_HZ,
    LATE_S,
    X_STD,
    ZETA,
    C,
    K,
    M,
    motion,
    written,
)

from rthyb_rt.diagnose import noise

FINE_HZ, N = 1024.0, 14336
"""Of what is asked of the noise alone; whole recordings have half as many rows."""
F_GRID = np.fft.rfftfreq(N, 1.0 / FINE_HZ)


def coloured(
    random: np.random.Generator, shape: np.ndarray, size: int = N, fs_hz: float = FINE_HZ
) -> np.ndarray:
    """Noise of unit rms whose spectrum has a shape over `F_GRID`, cut out of twice as much."""
    f = np.fft.rfftfreq(2 * size, 1.0 / fs_hz)
    spectrum = np.fft.rfft(random.standard_normal(2 * size))
    y = np.fft.irfft(spectrum * np.sqrt(np.interp(f, F_GRID, shape)), 2 * size)[:size]
    return np.asarray(y / np.std(y))


def pink() -> np.ndarray:
    return 1.0 / np.maximum(F_GRID, 0.05)


def random_walk_over_white() -> np.ndarray:
    return 1.0 + (2.0 / np.maximum(F_GRID, 0.05)) ** 2


def filtered() -> np.ndarray:
    return 1.0 / (1.0 + (F_GRID / 80.0) ** 4) + 4e-4


def resonant() -> np.ndarray:
    r = F_GRID / 60.0
    return (0.5 + 1.0 / np.sqrt((1.0 - r**2) ** 2 + (0.15 * r) ** 2)) ** 2


COLOURS = [pink, random_walk_over_white, filtered, resonant]


def velocity() -> np.ndarray:
    return motion(FINE_HZ)[3]


def rms_seen(found: noise.Colour) -> float:
    """The rms of noise about the mean of its recording."""
    return float(np.sqrt(np.sum(found.at(F_GRID[2.0 * found.least_hz <= F_GRID])) / F_GRID.size))


def colour_left_by(y, sheet=1.0, rows=None, v=None):
    rows = np.ones(N, dtype=np.bool_) if rows is None else rows
    lines = noise.Lines(rows, FINE_HZ)
    return noise.colour_of(lines, lines.power(y), velocity() if v is None else v, sheet)


@pytest.mark.parametrize("colour", COLOURS)
def test_noise_within_the_band_of_the_motion_is_told_from_beside_it(colour):
    """From 0.7 to 3.3 Hz nothing is evaluated; the extrapolated level is within a factor of 2.5."""
    inside = (F_GRID > 0.7) & (F_GRID < 3.3)
    ratios = []
    for seed in range(8):
        y = coloured(np.random.default_rng(seed), colour())
        found = colour_left_by(y)
        assert found is not None
        truth = colour() / np.mean(colour())
        ratios.append(np.mean(found.at(F_GRID[inside])) / np.mean(truth[inside]))
        assert rms_seen(found) == pytest.approx(1.0, rel=0.27)
    assert np.exp(np.mean(np.log(ratios))) == pytest.approx(1.0, rel=0.35)
    assert min(ratios) > 0.4
    assert max(ratios) < 2.5


def test_white_noise_is_called_white():
    """By BIC: not once in forty."""
    found = [colour_left_by(np.random.default_rng(seed).standard_normal(N)) for seed in range(40)]
    assert found == [None] * 40


def test_mains_line_is_not_taken_for_noise():
    y = np.random.default_rng(3).standard_normal(N)
    hum = 0.5 * np.sin(2.0 * np.pi * 50.0 * np.arange(N) / FINE_HZ)
    found = colour_left_by(y + hum)
    assert found is None or found.at(np.array([50.0]))[0] < 1.5


def test_noise_is_never_larger_than_its_sheet_allows():
    """Three times the sheet, and all of it below 40 Hz: two thirds are left to be explained."""
    y = 3.0 * coloured(np.random.default_rng(4), filtered())
    found = colour_left_by(y)
    assert found is not None
    assert rms_seen(found) <= 1.25 * 1.001


def test_force_beside_a_motion_down_to_the_slowest_line_is_no_noise_beyond_the_sheet():
    """As a stiffness that changes with time makes it: the band holds what goes on below it, too."""
    random = np.random.default_rng(6)
    v = coloured(random, ((F_GRID > 0.0) & (F_GRID < 2.1)).astype(float))
    aside = coloured(random, ((F_GRID > 2.1) & (F_GRID < 3.5)).astype(float))
    found = colour_left_by(random.standard_normal(N) + 8.0 * aside, v=v)
    assert found is not None
    whole = float(np.sqrt(np.sum(found.at(F_GRID[2:])) / F_GRID.size))
    assert whole <= 1.25 * 1.001


@pytest.mark.parametrize("broken", ["no sheet", "gaps", "short", "nan"])
def test_recording_that_tells_no_colour_is_left_white(broken):
    y, rows = coloured(np.random.default_rng(5), pink()), np.ones(N, dtype=np.bool_)
    v, sheet = velocity(), 1.0
    if broken == "no sheet":
        sheet = None
    elif broken == "gaps":
        rows[::2] = False
    elif broken == "short":
        y, rows, v = y[:200], rows[:200], v[:200]
    else:
        y = np.full(N, np.nan)
    assert colour_left_by(y, sheet, rows, v) is None


def recorded(random: np.random.Generator, extra, shape: np.ndarray, of_x: bool = False):
    """A drive of 14 s in coloured noise of the load cell, or of the displacement."""
    t, u, x, v, a = motion(FS_HZ)
    hears = coloured(random, shape, t.size, FS_HZ)
    white = random.standard_normal(t.size)
    return {
        "t": t,
        "x_cmd": u,
        "x_meas": x + X_STD * (hears if of_x else white),
        "f_meas": K * x + C * v + M * a + extra(t, x, v) + F_STD * (white if of_x else hears),
    }


@pytest.mark.parametrize(
    "colour", [*(pytest.param(one, marks=pytest.mark.long) for one in (pink, filtered)), resonant]
)
def test_load_cell_of_coloured_noise_within_its_sheet_misses_nothing(tmp_path, colour):
    columns = recorded(np.random.default_rng(11), lambda t, x, v: 0.0, colour())
    d = written(tmp_path, columns, DRIVE)
    assert (d.verdict, d.effects) == ("none", [])


@pytest.mark.long
@pytest.mark.parametrize("colour", [pink])
def test_displacement_of_coloured_noise_within_its_sheet_misses_nothing(tmp_path, colour):
    columns = recorded(np.random.default_rng(21), lambda t, x, v: 0.0, colour(), of_x=True)
    d = written(tmp_path, columns, DRIVE)
    assert (d.verdict, d.effects) == ("none", [])


LAWS = {
    "coulomb": (lambda t, x, v: 60.0 * np.tanh(v / 1e-3), "Fc_N", 60.0),
    "cubic": (lambda t, x, v: 1.2e9 * x**3, "k3_N_m3", 1.2e9),
    "drift": (lambda t, x, v: 8.0 * t, "rate_N_s", 8.0),
}


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "colour"),
    [
        ("coulomb", pink),
        ("coulomb", resonant),
        ("cubic", filtered),
        ("drift", random_walk_over_white),
    ],
)
def test_law_in_coloured_noise_has_its_name_and_no_other(tmp_path, name, colour):
    extra, param, value = LAWS[name]
    columns = recorded(np.random.default_rng(31), extra, colour())
    d = written(tmp_path, columns, DRIVE)
    assert (d.verdict, d.effects) == ("explained", [name])
    found = d.candidates[0]
    low, high = found.ci95[param]
    assert found.params[param] == pytest.approx(value, rel=0.15)
    assert low < value < high


@pytest.mark.long
@pytest.mark.parametrize("colour", [pink, filtered])
def test_force_that_nothing_explains_is_not_taken_for_coloured_noise(tmp_path, colour):
    """A ripple of the force over 0.4 mm of the displacement, as large as the noise."""
    columns = recorded(
        np.random.default_rng(41),
        lambda t, x, v: 14.0 * F_STD * np.exp(-(((x - 2e-3) / 2e-4) ** 2)) * np.sin(x / 4e-5),
        colour(),
    )
    d = written(tmp_path, columns, DRIVE)
    assert d.verdict == "unknown"


@pytest.mark.long
def test_late_load_cell_does_not_make_a_stated_damping_wrong(tmp_path):
    """What the model's damping may be wrong by comes as late as all of the force.

    A quiet cell: only what is of second order tells a damping from a delay.
    """
    random, f_std = np.random.default_rng(51), F_STD / 4.0
    t, u, x, _v, _a = motion(FINE_HZ)
    late_s = 4.0e-3
    shifted = motion(FINE_HZ, 0.004 + late_s)
    force = K * shifted[2] + 0.85 * C * shifted[3] + M * shifted[4]
    columns = {
        "t": t,
        "x_cmd": u,
        "x_meas": x + X_STD * random.standard_normal(t.size),
        "f_meas": force + f_std * random.standard_normal(t.size),
    }
    drive = DRIVE.replace(f"fs_hz = {FS_HZ}", f"fs_hz = {FINE_HZ}")
    d = written(tmp_path, columns, drive.replace(f"f_std = {F_STD}", f"f_std = {f_std}"))
    assert (d.verdict, d.effects) == ("explained", ["time_skew"])
    assert d.candidates[0].params["skew_s"] == pytest.approx(late_s, abs=1e-4)


def of_one_frequency(random: np.random.Generator, extra, shape: np.ndarray):
    """The same drive at 1.9 Hz alone, in steady state from the first row on."""
    t = np.arange(int(14.0 * FS_HZ)) / FS_HZ
    w, w0 = 2.0 * np.pi * 1.9, 2.0 * np.pi * F_HZ
    turning = 4e-3 * np.exp(1j * (w * t + 1.0))
    lagged = turning * w0**2 / (w0**2 - w**2 + 2j * ZETA * w0 * w) * np.exp(-1j * w * LATE_S)
    x, v, a = ((lagged * (1j * w) ** n).imag for n in range(3))
    return {
        "t": t,
        "x_cmd": turning.imag,
        "x_meas": x + X_STD * random.standard_normal(t.size),
        "f_meas": K * x + C * v + M * a + extra(x) + F_STD * coloured(random, shape, t.size, FS_HZ),
    }


@pytest.mark.long
def test_sine_recorded_in_mid_course_leaves_mass_and_stiffness_one(tmp_path):
    """The model's actuator starts from rest, and its jump is in no row that is judged."""
    columns = of_one_frequency(
        np.random.default_rng(61), lambda x: -0.08 * K * x, random_walk_over_white()
    )
    d = written(tmp_path, columns, DRIVE)
    assert d.verdict == "ambiguous"
    assert {tuple(names) for names in d.ambiguous_with} == {("inertia",), ("stiffness",)}
    assert d.estimate is not None
    assert d.estimate.coloured
    jump = np.zeros(columns["t"].size)
    jump[0] = 1e6 * F_STD
    assert not np.any(d.estimate.whiten(jump))


@pytest.mark.parametrize(
    "shape",
    [random_walk_over_white, pytest.param(resonant, marks=pytest.mark.long)],
    ids=["slow", "resonant"],
)
def test_damping_that_begins_in_mid_test_is_damping_in_coloured_noise(tmp_path, shape):
    """It is half of the stated damping, whose tolerance is no doubt of its beginning."""
    columns = recorded(
        np.random.default_rng(1), lambda t, x, v: np.where(t > 6.0, 600.0 * v, 0.0), shape()
    )
    d = written(tmp_path, columns, DRIVE)
    assert (d.verdict, d.effects) == ("explained", ["viscous"])
    assert d.candidates[0].params["c_Ns_m"] == pytest.approx(600.0, rel=0.05)
    assert any("viscous begins at 6.0" in note for note in d.notes)
