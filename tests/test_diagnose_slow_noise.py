"""Noise that swells towards slow motion, where nothing is seen beside the motion's band."""

from __future__ import annotations

import re
from types import SimpleNamespace

import event_cases
import numpy as np
import pytest
from test_diagnose_colour import (
    F_GRID,
    FINE_HZ,
    N,
    coloured,
    pink,
    random_walk_over_white,
    recorded,
)
from test_diagnose_noise import DRIVE, F_STD, written

from rthyb_rt.diagnose import engine, evidence, noise, reading, remainder, whitening

ALL = np.ones(N, dtype=np.bool_)
LINES = noise.Lines(ALL, FINE_HZ)


@pytest.mark.parametrize("seed", range(5))
def test_random_walk_is_read_within_the_band_as_well(seed):
    y = coloured(np.random.default_rng(seed), random_walk_over_white())
    found = noise.red_of(LINES, LINES.power(y), 1.0)
    assert found is not None
    truth = random_walk_over_white() / np.mean(random_walk_over_white())
    at = np.array([0.3, 1.0, 3.0, 30.0])
    ratio = found.at(at) / np.interp(at, F_GRID, truth)
    assert ratio.min() > 0.3
    assert ratio.max() < 3.0


def test_white_noise_and_a_line_are_not_red():
    """By BIC: not once in twenty; nor is a motion's line at 1 Hz in it."""
    line = 0.5 * np.sin(2.0 * np.pi * np.arange(N) / FINE_HZ)
    for seed in range(20):
        white = np.random.default_rng(seed).standard_normal(N)
        assert noise.red_of(LINES, LINES.power(white), 1.0) is None
        found = noise.red_of(LINES, LINES.power(white + line), 1.0)
        assert found is None or found.at(np.array([1.0]))[0] < 10.0


def test_drift_is_likelier_in_white_noise_than_slow_noise_without_it():
    """Its own lines are not those of a random walk, and the sheet holds both."""
    random, t = np.random.default_rng(6), np.arange(N) / FINE_HZ
    white, drift = random.standard_normal(N), 0.5 * (t - t.mean()) / t.max()
    v = np.sin(2.0 * np.pi * t)
    kept = whitening.likelihood(white, ALL, v, FINE_HZ, 1.0, 1.0)[0]
    swallowed = whitening.likelihood(white + drift, ALL, v, FINE_HZ, 1.0, 1.0)[0]
    assert kept + 40.0 < swallowed


def test_slow_noise_twice_its_sheet_gives_way_to_a_set_that_stays_within():
    """However likely it is: nothing that is larger than the sheet allows is noise alone."""
    random, v = np.random.default_rng(7), np.sin(2.0 * np.pi * np.arange(N) / FINE_HZ)
    loud = (2.0 * coloured(random, random_walk_over_white()), v, 0.0)
    quiet = (random.standard_normal(N), v, 1e6)
    assert whitening.likeliest([loud, quiet], ALL, FINE_HZ, 1.0, 1.0) is None
    # Where none stays within, and where no sheet bounds the noise, the likelier one.
    larger = (3.0 * quiet[0], v, 1e6)
    assert whitening.likeliest([loud, larger], ALL, FINE_HZ, 1.0, 1.0) is not None
    assert whitening.within_sheet(quiet[0], 1.0, 0.0)
    assert not whitening.within_sheet(1.3 * quiet[0], 1.0, 0.0)
    assert whitening.within_sheet(1.3 * quiet[0], 1.0, 0.1)


def red_at_the_ends(random: np.random.Generator, extra) -> dict[str, np.ndarray]:
    shape = 1.0 + (1.0 / np.maximum(F_GRID, 0.03)) ** 2
    return recorded(random, extra, shape)


@pytest.mark.parametrize("seed", [61, pytest.param(62, marks=pytest.mark.long)])
def test_slow_noise_of_a_load_cell_is_neither_an_offset_nor_a_drift(tmp_path, seed):
    d = written(tmp_path, red_at_the_ends(np.random.default_rng(seed), lambda t, x, v: 0.0), DRIVE)
    assert (d.verdict, d.effects) == ("none", [])


def slower_than_the_recording() -> np.ndarray:
    """A random walk over white, down to 0.02 Hz: 14 s of it have a mean like their scatter."""
    return 1.0 + (2.0 / np.maximum(F_GRID, 0.02)) ** 2


@pytest.mark.parametrize(
    ("friction_n", "names"),
    [(60.0, ["coulomb"]), pytest.param(0.0, [], marks=pytest.mark.long)],
    ids=["friction", "nothing missing"],
)
def test_mean_of_noise_slower_than_the_recording_is_no_unknown_law(tmp_path, friction_n, names):
    random = np.random.default_rng(4)
    columns = recorded(
        random, lambda t, x, v: friction_n * np.tanh(v / 1e-3), slower_than_the_recording()
    )
    d = written(tmp_path, columns, DRIVE)
    assert (d.verdict, d.effects) == ("explained" if names else "none", names)


def test_noise_is_within_its_sheet_about_its_mean_and_without_bursts():
    white = np.random.default_rng(7).standard_normal(N)
    assert noise.mere(white + 3.0, white, 1.0, FINE_HZ)
    assert not noise.mere(1.3 * white, white, 1.0, FINE_HZ)
    burst = np.where(np.arange(N) < FINE_HZ, 1.5, 0.9) * white
    assert not noise.mere(burst, burst, 1.0, FINE_HZ)


@pytest.mark.parametrize(
    ("rms", "error_of_motion", "within"),
    [(1.2, 0.0, True), (1.3, 0.0, False), (1.3, 0.5, True), (1.5, 0.5, False)],
)
def test_sheet_holds_along_an_estimated_motion_with_the_error_of_the_estimate(
    monkeypatch, rms, error_of_motion, within
):
    """Whitened, the residual is too large for the colour; its lines need not be those of a law."""
    white = np.random.default_rng(3).standard_normal(N)
    left = rms * white / np.std(white)
    found = SimpleNamespace(
        coloured=True, blur=SimpleNamespace(rms=error_of_motion), share=1.0, rows=ALL, scatter=0.0,
        whiten=lambda y: 1.3 * y / np.std(y), read=None,
    )  # fmt: skip
    case = SimpleNamespace(channels={"f_meas": left}, fs_hz=FINE_HZ)
    search = SimpleNamespace(problem=SimpleNamespace(case=case, estimate=found), best=None)
    monkeypatch.setattr(remainder, "stated", lambda _: 1.0)
    monkeypatch.setattr(remainder, "bend", lambda *_: 0.0)
    monkeypatch.setattr(remainder, "left_by", lambda *_: left)
    assert remainder.by_the_sheet(search) is within


@pytest.mark.long
def test_drift_beside_much_dry_friction_in_pink_noise_is_no_form_of_the_friction(tmp_path):
    """It explains a part in two thousand of what the friction does, and earns its price."""
    columns = recorded(
        np.random.default_rng(1), lambda t, x, v: 60.0 * np.tanh(v / 1e-3) + 3.0 * t, pink()
    )
    d = written(tmp_path, columns, DRIVE)
    assert (d.verdict, sorted(d.effects)) == ("explained", ["coulomb", "drift"])
    params = {c.name: c.params for c in d.candidates}
    assert params["drift"]["rate_N_s"] == pytest.approx(3.0, rel=0.1)


@pytest.mark.long
def test_hum_that_sets_in_amid_pink_noise_is_hum(tmp_path):
    """Its beginning was believed to be noise, and what rings at 50 Hz a mass on a spring."""
    columns = recorded(
        np.random.default_rng(71),
        lambda t, x, v: 3.0 * F_STD * np.sin(2.0 * np.pi * 49.93 * t) * (t > 6.2),
        pink(),
    )
    d = written(tmp_path, columns, DRIVE)
    assert (d.verdict, d.effects) == ("explained", ["hum"])
    assert d.candidates[0].params["f_Hz"] == pytest.approx(49.93, abs=0.05)
    assert d.candidates[0].from_s == pytest.approx(6.2, abs=0.1)


def on_ground(folder, seed: int, dashpot: float = 0.0, drift_per_s: float = 0.0):
    """A body on a shaking table whose load cell has pink noise as its sheet says.

    Its drift is in standard deviations of that noise.
    """
    random = np.random.default_rng(seed)
    level = {}

    def cell(force: np.ndarray, fs_hz: float) -> np.ndarray:
        level["n"] = 0.02 * float(np.std(force))
        drift = drift_per_s * (np.arange(force.size) / fs_hz)
        return force + level["n"] * (coloured(random, pink(), force.size, fs_hz) + drift)

    recording, toml = event_cases.on_ground(seed, folder, dashpot, cell)
    stated = float(np.hypot(level["n"], 0.3 * level["n"]))
    toml.write_text(re.sub(r"f_std = \S+", f"f_std = {stated}", toml.read_text()))
    return engine.diagnose(reading.read_case(recording, reading.read_model(toml)))


@pytest.mark.long
@pytest.mark.parametrize("seed", [3, 4])
def test_pink_noise_of_a_load_cell_on_a_shaking_table_misses_nothing(tmp_path, seed):
    d = on_ground(tmp_path, seed)
    assert (d.verdict, d.effects) == ("none", [])


@pytest.mark.long
def test_damping_on_a_shaking_table_is_found_in_pink_noise(tmp_path):
    d = on_ground(tmp_path, 3, dashpot=1.5)
    assert (d.verdict, d.effects) == ("explained", ["viscous"])


@pytest.mark.long
def test_drift_of_a_load_cell_on_a_shaking_table_is_seen_in_pink_noise(tmp_path):
    """It is small beside so slow a noise, and no motion that is estimated errs by so much force."""
    d = on_ground(tmp_path, 5, drift_per_s=0.3)
    assert d.verdict == "ambiguous"  # an offset of the cell goes with so short a recording as well
    assert ["drift"] in d.ambiguous_with


def test_the_power_of_the_slowest_lines_is_that_of_the_noise_at_their_frequencies():
    """Of noise that is white up to 8 half cosines over the recording, 25 times as loud there."""
    random, n = np.random.default_rng(4), 4096
    white, slow = [], []
    cosines = np.cos(np.pi * np.outer(np.arange(1, 9), (np.arange(n) + 0.5) / n))
    for _ in range(40):
        y = random.standard_normal(n)
        loud = y + np.sqrt(24.0 * 2.0 / n) * (random.standard_normal(8) @ cosines)
        kept = np.sort(random.permutation(n)[: n // 2])
        for out, residual in ((white, y), (slow, loud)):
            problem = SimpleNamespace(rows=kept)
            out.append(evidence.slow_power(problem, SimpleNamespace(residual=residual[kept])))
    assert np.mean(white) == pytest.approx(1.0, abs=0.2)
    # Half of the rows carry half of the slow power.
    assert np.mean(slow) == pytest.approx(13.0, rel=0.25)
