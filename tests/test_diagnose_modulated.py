"""Channels that no model knows: named where they change a law, and nowhere else."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import engine, found_model, outcome, result
from rthyb_rt.diagnose.case import Case, Model
from rthyb_rt.diagnose.reading import read_case

Floats = NDArray[np.float64]
FS_HZ = 100.0
K, C, MASS = 4e5, 1500.0, 40.0
FRICTION_N, FRICTION_PER_V, DRAG_PER_V = 300.0, 110.0, 3500.0
X_STD, F_STD = 1e-6, 6.0


def driven(seed: int, seconds: float = 24.0) -> tuple[Floats, ComputedMotion]:
    """Return time and a motion of fourteen sines between .3 and 3 Hz, none of the model's kind."""
    rng = np.random.default_rng(seed)
    t = np.arange(int(FS_HZ * seconds)) / FS_HZ
    x, v, a = np.zeros((3, t.size))
    for f_hz in np.linspace(0.3, 3.0, 14):
        phase, w = rng.uniform(0.0, 2.0 * np.pi), 2.0 * np.pi * f_hz
        size = 2e-3 / (1.0 + f_hz)
        x += size * np.sin(w * t + phase)
        v += size * w * np.cos(w * t + phase)
        a -= size * w**2 * np.sin(w * t + phase)
    return t, ComputedMotion(x, v, a)


def voltage(seed: int, t: Floats) -> Floats:
    """Return a voltage that is set anew every two seconds, V."""
    levels = np.random.default_rng(seed + 50).integers(0, 4, size=int(t[-1] / 2.0) + 1)
    return levels[(t / 2.0).astype(int)].astype(np.float64)


def recorded(
    seed: int,
    t: Floats,
    motion: ComputedMotion,
    missing: Floats,
    further: dict[str, Floats],
    known: bool,
) -> Case:
    """Return a recording of spring, dashpot and mass with a missing force, beside its model."""
    rng = np.random.default_rng(seed + 90)
    f = K * motion.x + C * motion.v + MASS * motion.a + missing
    channels = {
        "x_meas": motion.x + X_STD * rng.standard_normal(t.size),
        "f_meas": f + F_STD * rng.standard_normal(t.size),
    }
    sure = {"k_tol": 0.01, "c_tol": 0.1} if known else {}
    off = 1.004 if known else 1.1
    model = Model("drive", FS_HZ, K * off, C / off, MASS, x_std=X_STD, f_std=F_STD, **sure)
    return Case("case", model, t, channels, np.ones(t.size, dtype=np.bool_), further=further)


def friction(motion: ComputedMotion) -> Floats:
    return np.asarray(np.tanh(motion.v / 5e-4))


def under_voltage(seed: int, law: str, known: bool) -> Case:
    """A recording in which a voltage changes friction, drag or both."""
    t, motion = driven(seed)
    u = voltage(seed, t)
    missing = np.zeros(t.size)
    if law != "viscous":
        missing += (FRICTION_N + FRICTION_PER_V * (u - 1.5)) * friction(motion)
    if law != "coulomb":
        missing += DRAG_PER_V * (u - 1.5) * motion.v
    return recorded(seed, t, motion, missing, {"voltage_V": u}, known)


@cache
def diagnosed(law: str, known: bool) -> result.DiagnosisResult:
    return engine.diagnose(under_voltage(1, law, known))


@pytest.mark.parametrize(
    ("law", "known"),
    [
        pytest.param("coulomb", True, marks=pytest.mark.long, id="coulomb"),
        pytest.param("viscous", False, marks=pytest.mark.long, id="viscous beside a naive model"),
        pytest.param("both", False, marks=pytest.mark.long, id="both beside a naive model"),
    ],
)
def test_a_voltage_that_changes_a_law_is_named_with_its_size_and_foretells(
    law: str, known: bool
) -> None:
    d, other = diagnosed(law, known), under_voltage(2, law, known)
    done = outcome.finish(d, other, None)

    wanted = {"both": ["coulomb", "viscous"]}.get(law, [law])
    assert (d.verdict, sorted(d.effects)) == ("explained", wanted)
    by = {c.name: c.modulated_by for c in d.candidates if c.name in wanted}
    sizes = {"coulomb": FRICTION_PER_V, "viscous": DRAG_PER_V}
    for name in wanted:
        assert by[name]["channel"] == "voltage_V"
        assert by[name]["per_unit"] == pytest.approx(sizes[name], rel=0.03)
        assert any(f"{name} changes with voltage_V" in note for note in d.notes)
    # Most of what is missing of the second recording at a mean voltage is there with its own.
    at_mean = outcome.finish(d, replace(other, further={}), None)
    after, mean = (o.heldout["heldout_nrmse_after"] for o in (done, at_mean))
    assert after < 0.3 * mean


def spectator(kind: str, seed: int, t: Floats, motion: ComputedMotion) -> Floats:
    rng = np.random.default_rng(seed + 70)
    level = 0.02 * rng.standard_normal(t.size)
    if kind == "steps":
        return voltage(seed, t) + level
    if kind == "warming":
        return 20.0 + 12.0 * (t / t[-1]) ** 0.6 + level
    if kind == "sine":
        return np.asarray(np.sin(2.0 * np.pi * 0.4 * t + 1.0) + level)
    if kind == "random":
        return 50.0 * level
    if kind == "follows speed":
        return 30.0 * np.abs(motion.v) + level
    return np.cumsum(np.abs(motion.v)) / FS_HZ + level


@pytest.mark.parametrize(
    ("kind", "missing"),
    [
        ("steps", "nothing"),
        *(
            pytest.param(kind, missing, marks=pytest.mark.long)
            for kind, missing in (
                ("random", "nothing"),
                ("steps", "coulomb"),
                ("warming", "nothing"),
                ("sine", "quad_damping"),
                ("follows speed", "coulomb"),
                ("follows speed", "quad_damping"),
                ("follows friction's work", "coulomb"),
                ("follows friction's work", "quad_damping"),
            )
        ),
    ],
)
def test_a_channel_that_only_stands_by_or_follows_the_motion_changes_no_law(
    kind: str, missing: str
) -> None:
    """Beside dry friction the model is naive, and leaves more to be taken for another law."""
    seed, known = 3, missing != "coulomb"
    t, motion = driven(seed)
    force = {
        "nothing": np.zeros(t.size),
        "coulomb": FRICTION_N * friction(motion),
        "quad_damping": 6e4 * motion.v * np.abs(motion.v),
    }[missing]
    further = {"pressure_bar": spectator(kind, seed, t, motion)}
    d = engine.diagnose(recorded(seed, t, motion, force, further, known))

    assert d.effects == ([] if missing == "nothing" else [missing])
    assert not any(c.modulated_by for c in d.candidates if c.name in d.effects)


def test_columns_that_are_no_channel_are_read_in_their_own_unit_and_said(tmp_path: Path) -> None:
    t, motion = driven(4)
    rows = np.column_stack((t, motion.x, K * motion.x, voltage(4, t), np.arange(t.size), 0.0 * t))
    path = tmp_path / "recording.csv"
    header = "t,x_meas,f_meas,coil voltage [V],row,spare"
    np.savetxt(path, rows, delimiter=",", header=header, comments="")
    case = read_case(path, Model("drive", FS_HZ, K))

    assert np.array_equal(case.further["coil voltage [V]"], rows[:, 3])
    # What counts the rows is no reading.
    assert "row" not in case.further
    assert any("coil voltage [V]" in note for note in case.notes)
    assert set(case.channels) == {"x_meas", "f_meas"}


@pytest.mark.long
def test_a_recording_without_the_channel_is_foretold_at_its_mean() -> None:
    t, motion = driven(5)
    d = diagnosed("coulomb", True)
    model = found_model.augmented(d)
    without = model.effect_force(motion, t, {})
    coulomb = next(c for c in d.candidates if c.name == "coulomb")

    assert np.abs(without).max() == pytest.approx(coulomb.params["Fc_N"], rel=0.02)
    answer = json.loads(json.dumps(result.to_json(d)))
    assert answer["candidates"][0]["modulated_by"]["channel"] == "voltage_V"
