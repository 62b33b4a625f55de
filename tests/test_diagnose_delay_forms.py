"""Actuators whose delay grows with velocity by another law than the formula of the diagnosis."""

from __future__ import annotations

from collections.abc import Callable

import diagnose_cases as cases
import numpy as np
import pytest
from scipy import signal
from scipy.interpolate import CubicSpline

from rthyb_rt.diagnose import actuator_choice, reading

FASTEST = 0.17
"""Largest velocity along the command, m/s."""


def named(folder, delay_of: Callable[[np.ndarray], np.ndarray], *, later_s: float = 0.0):
    """Return the effects named for an actuator that is late by a function of its own speed.

    Args:
        folder: where the recording is written.
        delay_of: delay, s, at each speed, m/s, behind the lag.
        later_s: constant delay ahead of the lag in addition to the stated one.
    """
    u = cases.command()
    t = np.arange((u.size - 1) * cases.FINE + 1) / (cases.FS * cases.FINE)
    late = np.interp(t - cases.DELAY - later_s, np.arange(u.size) / cases.FS, u)
    w = 2.0 * np.pi * cases.F_HZ
    lag = signal.StateSpace(
        [[0, 1], [-(w**2), -2 * cases.ZETA * w]], [[0], [w**2]], np.eye(2), np.zeros((2, 1))
    )
    _, y, _ = signal.lsim(lag, late, t, X0=[late[0], 0.0])
    x = CubicSpline(t, y[:, 0])(np.clip(t - delay_of(np.abs(y[:, 1])), 0.0, None))[:: cases.FINE]
    noise = cases.X_STD * np.random.default_rng(3).standard_normal(u.size)
    columns = {"t": np.arange(u.size) / cases.FS, "x_cmd": u, "x_meas": x + noise,
               "f_meas": cases.K * x}  # fmt: skip
    recording, toml = cases.write(folder, columns)
    found = actuator_choice.displacement(reading.read_case(recording, reading.read_model(toml)))
    assert found is not None
    return found.best.names


FORMS = {
    "without a cusp at rest": lambda v: 0.03 * (np.hypot(v, 0.05 * FASTEST) - 0.05 * FASTEST),
    "levelling off": lambda v: 0.03 * v / (1.0 + 0.1 * v / FASTEST),
    "as stated": lambda v: 0.03 * v,
}


@pytest.mark.parametrize("form", FORMS)
def test_the_form_of_a_delay_that_grows_with_velocity_is_no_second_lag(tmp_path, form):
    assert named(tmp_path, FORMS[form]) == ("delay_rate",)


def test_a_constant_delay_beside_one_that_grows_with_velocity_is_named(tmp_path):
    names = named(tmp_path, FORMS["as stated"], later_s=2e-3)
    assert names == ("delay", "delay_rate")


def of_a_delay(folder, kind: str):
    """Return what is found of an actuator that is 3 ms later than stated."""
    u = cases.command(kind)
    x, v, _ = cases.moved(u, cases.DELAY + 3e-3)
    noise = cases.X_STD * np.random.default_rng(3).standard_normal(u.size)
    columns = {"t": np.arange(u.size) / cases.FS, "x_cmd": u, "x_meas": x + noise,
               "f_meas": cases.K * x + cases.C * v}  # fmt: skip
    recording, toml = cases.write(folder, columns)
    found = actuator_choice.displacement(reading.read_case(recording, reading.read_model(toml)))
    assert found is not None
    return found.best.names, [f.names for f in found.equal]


def test_one_frequency_does_not_tell_a_delay_from_a_lag(tmp_path):
    """Gain and phase at one frequency are two numbers, and a lag has two."""
    assert of_a_delay(tmp_path / "sine", "sine") == (("delay",), [("oil_column",)])
    assert of_a_delay(tmp_path / "sweep", "sweep") == (("delay",), [])
