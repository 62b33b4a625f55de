"""Noise of the sensors in the command of one axis: predicted, and as a run has it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import scipy.stats

from rthyb_rt import config, core
from rthyb_rt.analysis import command_noise, loop_roots, loop_stability
from rthyb_rt.checking import examined
from rthyb_rt.config import response
from rthyb_rt.core.laws import LAWS
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.lab.experiment import Setup

RATE_HZ = 1024.0


def noisy(law: str, **changes: str) -> Setup:
    """Return the built-in test on a spring with ten samples of delay, and noise at rest."""
    given = {"controller.type": law, "numerical.damping_ratio": "20 %"}
    given |= {key.replace("__", "."): value for key, value in changes.items()}
    noise = {
        "sensors.displacement.noise_std_m": "5e-6",
        "sensors.force.noise_std_n": "2",
        "identified.rest_noise_displacement_m": "5e-6",
        "identified.rest_noise_force_n": "2",
    }
    return experiment.prepare(
        config.load_test(config.builtin_test_path(), given),
        config.load_rig(config.shipped_rig("delay-10-elastic"), noise),
    )


def at_rest(law: str, **changes: str) -> Setup:
    """Return a test that hardly moves, with its law and the tangent stiffness held."""
    still = {
        "ground_motion__pga_g": "1e-6",
        "test__duration_s": "20",
        "controller__delay_estimator__enabled": "false",
    }
    setup = noisy(law, **still, **changes)
    held = dataclasses.replace(setup.controller.rfc, end_tick=0)
    return dataclasses.replace(setup, controller=dataclasses.replace(setup.controller, rfc=held))


def predicted(setup: Setup) -> dict[str, float]:
    config_, model = setup.controller, response.plant(setup.rig)
    assert model is not None
    hold = response.hold_of(setup.rig)
    (law,) = loop_roots.laws(config_.law, model, config_.period_s, hold)
    loop = loop_roots.loop_of(config_, model, law, hold)
    lead = law if config_.lead_enabled else loop_roots.gain(1.0)
    return command_noise.of_loop(config_, loop, lead, (5e-6, 2.0))


CASES = [(law, {}) for law in LAWS] + [
    ("alpha-beta", {"controller__rfc__cutoff_hz": "60"}),
    ("alpha-beta", {"controller__rfc__enabled": "false"}),
    ("paper", {"numerical__integrator": '"kr-alpha"', "numerical__rho_inf": "0.8"}),
]


@pytest.mark.parametrize(("law", "changes"), CASES)
def test_a_specimen_at_rest_is_shaken_by_noise_as_predicted(
    law: str, changes: dict[str, str]
) -> None:
    setup = at_rest(law, **changes)
    wanted = predicted(setup)
    rec = virtual_time.run(setup)
    command = rec.samples["x_plc_m"][rec.samples["state"] == core.RUNNING]
    assert np.diff(command, 2).std() * RATE_HZ**2 == pytest.approx(wanted["acceleration"], rel=0.02)
    # Slow motion of the structure has a share in the velocity, and few cycles in a run.
    assert np.diff(command).std() * RATE_HZ == pytest.approx(wanted["velocity"], rel=0.05)


def test_the_variance_of_a_resonance_narrower_than_the_grid_is_exact() -> None:
    """Against the closed form of white noise through one lightly damped pair of poles."""
    r, theta = 1.0 - 1e-6, 0.01
    root = r * np.exp(1j * theta)
    angle = command_noise.angles(np.array([root, root.conjugate()]))
    z = np.exp(1j * angle)
    h = np.sqrt(np.abs(1.0 - 1.0 / z) ** -2.0) / ((z - root) * (z - root.conjugate()))
    found = command_noise.deviations(h[:, None, None].astype(complex), angle, 1.0)
    a1, a2 = -2.0 * r * math.cos(theta), r * r
    variance = (1.0 + a2) / ((1.0 - a2) * ((1.0 + a2) ** 2 - a1 * a1))
    assert found["velocity"][0] == pytest.approx(math.sqrt(variance), rel=0.01)


def test_noise_that_exceeds_the_acceleration_limit_is_said_before_the_test() -> None:
    setup = noisy("alpha-beta", limits__command_acceleration_m_per_s2="0.2")
    found = command_noise.judge(setup)
    assert found is not None
    assert (found.quantity, found.limit) == ("acceleration", 0.2)
    sigmas = found.limit / found.deviation
    assert found.limited == pytest.approx(2.0 * scipy.stats.norm.sf(sigmas), rel=1e-9)
    (text,) = (text for text in loop_stability.demand(setup) if "noise" in text)
    assert "noise of the sensors alone makes the command accelerate by" in text
    assert "more than its limit of 0.2 m/s² allows" in text
    rig = config.load_rig(config.shipped_rig("delay-10-elastic"))
    told = examined.examine(setup.test, setup.rig)
    assert text in told.warnings
    # Without noise at rest there is nothing to warn of.
    silent = examined.examine(setup.test, rig)
    assert not any("noise of the sensors" in one for one in silent.warnings)


def test_noise_that_exceeds_the_velocity_limit_is_said_with_its_unit() -> None:
    setup = noisy("inverse", limits__command_velocity_m_per_s="0.001")
    text = command_noise.remark(command_noise.judge(setup))
    assert text is not None
    assert "makes the command move at 0.00" in text
    assert "its limit of 0.001 m/s allows" in text


def test_a_filter_keeps_noise_below_the_limit() -> None:
    limit = {"limits__command_acceleration_m_per_s2": "0.2"}
    filtered = noisy("alpha-beta", controller__rfc__cutoff_hz="20", **limit)
    assert command_noise.remark(command_noise.judge(filtered)) is None


@pytest.mark.parametrize("law", sorted(LAWS))
@pytest.mark.parametrize("rig", ["shaking-table-can", "hydraulic-25kn", "rths-benchmark"])
def test_no_shipped_rig_is_told_that_its_noise_is_too_large(rig: str, law: str) -> None:
    given = {"controller.type": law, "limits.force_n": "8 kN"}
    test = config.load_test(config.builtin_test_path(), given)
    setup = experiment.prepare(test, config.load_rig(config.shipped_rig(rig)))
    assert not any("noise of the sensors" in text for text in loop_stability.remarks_of(setup))
