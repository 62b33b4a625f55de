"""Stability of the loop of several axes: against one axis, the core's own laws, and tests run."""

from __future__ import annotations

import dataclasses
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from frames import shear_building

from rthyb_rt import config
from rthyb_rt.analysis import axes_roots, linear_parts, loop_roots, loop_stability
from rthyb_rt.analysis.axes_roots import AxesLoop, constant, on_each, side_by_side
from rthyb_rt.analysis.linear_parts import LinearPart, LinearStep
from rthyb_rt.config.axes_response import response_of_rig
from rthyb_rt.config.matrix_response import MatrixResponse
from rthyb_rt.core.matrix_lead import MatrixInverse, MatrixLead, MatrixLeadConfig
from rthyb_rt.core.numerical_parts import SparsePart
from rthyb_rt.core.sparse import SparseConfig, Symmetric
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_experiment, virtual_time
from rthyb_rt.lab.experiment import Setup

H = 1.0 / 1024.0
EXAMPLES = Path(__file__).parents[1] / "examples"
FRAME = EXAMPLES / "two-actuator-frame.toml"
Z = np.exp(2j * np.pi * np.array([0.3, 2.0, 11.0, 60.0, 300.0]) * H)


def frame(tmp_path: Path, law: str, **more: str) -> Setup:
    """Return the shipped test of two actuators with another law, and values by key."""
    text = FRAME.read_text("utf-8").replace('"two-actuator-frame/', f'"{FRAME.with_suffix("")}/')
    text = re.sub(r'type = "matrix"', f'type = "{law}"', text)
    for key, value in more.items():
        if key == "damping":
            text = re.sub(r"damping = .*\n", "", text)
            text = text.replace("rho_inf = 0.5", f"rho_inf = 0.5\ndamping = {value}")
        elif key == "free_vibration_s":
            text = text.replace("[test]", f"[test]\nfree_vibration_s = {value}")
        else:
            text = re.sub(rf"{key} = .*", f"{key} = {value}", text)
    path = tmp_path / "frame.toml"
    path.write_text(text, "utf-8")
    return axes_experiment.prepare(
        config.load_test(path), config.load_any_rig(config.shipped_rig("two-axis-frame"))
    )


def pair_of_masses(k_e: np.ndarray, apart: float = 0.0) -> SparseConfig:
    """Return two masses, each with an interface, joined by a spring."""
    m = np.diag([3000.0, 8000.0])
    k = np.diag([2e5, 4e5]) + apart * np.array([[1.0, -1.0], [-1.0, 1.0]])
    interfaces = (((0, 1.0),), ((1, 1.0),))
    between = k_e - np.diag(np.diag(k_e))
    return SparseConfig(
        Symmetric.of(m),
        Symmetric.of(k),
        np.diag(m),
        interfaces,
        tuple(np.diag(k_e)),
        damping_n_s_per_m=Symmetric.of(0.002 * k + 0.1 * m),
        rho_inf=0.7,
        period_s=H,
        k_e_between=tuple(tuple(row) for row in between.tolist()) if between.any() else (),
    )


def test_the_linear_system_of_two_interfaces_steps_as_the_part_does() -> None:
    part = pair_of_masses(np.array([[9e5, -2e5], [-2e5, 7e5]]), 1e5)
    step, own = LinearStep.of(part), SparsePart(part)
    rng = np.random.default_rng(3)
    own.answer_all(0.0, [0.0, 0.0])
    own.advance()
    s, found, expected = np.zeros(len(step.a)), [], []
    for _ in range(600):
        force = rng.normal(0.0, 1e4, 2)
        expected.append(own.answer_all(0.0, force.tolist())[0])
        own.advance()
        s = step.a @ s + step.b @ force
        found.append(step.c @ s)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-14)


def test_modes_with_the_flexibility_of_the_others_are_the_part_at_low_frequencies(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    m, k = shear_building(np.full(12, 2e4), np.full(12, 3e7))
    k_e = np.array([[2e7, 4e6], [4e6, 1e7]])
    at = np.zeros((2, 12))
    at[0, 0], at[1, 4] = 1.0, 1.0
    part = SparseConfig(
        Symmetric.of(m),
        Symmetric.of(k),
        np.diag(m),
        (((0, 1.0),), ((4, 1.0),)),
        (2e7, 1e7),
        by_mass_per_s=0.3,
        by_stiffness_s=2e-4,
        k_e_between=((0.0, 4e6), (4e6, 0.0)),
    )
    assert np.array_equal(part.whole_stiffness().toarray(), k + at.T @ k_e @ at)
    whole = LinearStep.of(part).response(Z[:2])
    monkeypatch.setattr(linear_parts, "MOST_MODES", 7)
    few = LinearStep.of(part)
    assert len(few.a) < 12 * 2
    scale = np.abs(whole).max(axis=(1, 2), keepdims=True)
    assert np.abs((few.response(Z[:2]) - whole) / scale).max() < 0.01


def test_two_axes_that_nothing_couples_have_the_roots_and_margins_of_each() -> None:
    part = pair_of_masses(np.diag([9e5, 7e5]))
    rigs = [
        loop_roots.rational(np.array([0.2]), np.array([1.0, -0.8, 0.0, 0.0])),
        loop_roots.rational(np.array([0.1]), np.array([1.0, -0.9, 0.0])),
    ]
    lead = loop_roots.rational(np.array([9.0, -7.0, 0.0]), np.array([3.0, -2.0, 1.0]))
    axes = side_by_side(rigs).times(np.diag([9e5, 7e5]))
    none = constant(np.zeros((2, 2)))
    both = AxesLoop(LinearStep.of(part), on_each(lead, 2), axes, none)
    alone = []
    for i, k in enumerate((9e5, 7e5)):
        one = SparseConfig(
            Symmetric.of(part.mass_kg.matrix().toarray()[i : i + 1, i : i + 1]),
            Symmetric.of(part.stiffness_n_per_m.matrix().toarray()[i : i + 1, i : i + 1]),
            np.ones(1),
            (((0, 1.0),),),
            (k,),
            damping_n_s_per_m=Symmetric.of(
                part.damping_n_s_per_m.matrix().toarray()[i : i + 1, i : i + 1]  # type: ignore[union-attr]
            ),
            rho_inf=0.7,
            period_s=H,
        )
        linear = LinearPart.of(one)
        block = loop_roots.Block(linear.a, linear.b, linear.c[None, :], np.zeros(1))
        back = lead.then(rigs[i]).weighted((k,))
        alone.append(loop_roots.LinearLoop(block, back, loop_roots.gain(0.0)))
    # Delays give roots at 0, of which a sum of systems may have more.
    separate = np.concatenate([loop.roots() for loop in alone])
    for found, others in ((both.roots(), separate), (separate, both.roots())):
        for root in found[np.abs(found) > 0.1]:
            assert np.abs(others - root).min() < 1e-6
    assert both.gain_margin() == pytest.approx(min(loop.gain_margin() for loop in alone), rel=0.01)
    assert both.delay_margin() == pytest.approx(
        min(loop.delay_margin() for loop in alone), rel=1e-6
    )


def test_the_matrix_law_is_the_one_that_the_core_runs() -> None:
    rng = np.random.default_rng(5)
    inverse = MatrixInverse((5.0, 40.0), rng.normal(0.0, 1.0, (3, 2, 2)) + 3.0 * np.eye(2))
    terms = rng.normal(0.0, 1.0, (3, 2, 2)) * np.array([0.1, 0.01, 1e-5])[:, None, None]
    given = MatrixLeadConfig((1e-6, 1e-6), inverse, first=terms, period_s=H)
    n = 4096
    response = []
    for i in range(2):
        # From rest, an impulse in one command: what it causes, in the frequency domain.
        x = np.zeros((n, 2))
        x[0, i] = 1.0
        response.append(np.fft.fft(MatrixLead(given).run(x), axis=0))
    at = [3, 17, 200, 1500]
    expected = np.stack(response, axis=2)[at]
    found = axes_roots.matrix_law(given, terms).response(np.exp(2j * np.pi * np.array(at) / n))
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_states_and_response_of_a_composed_system_agree() -> None:
    given = MatrixLeadConfig((1e-6,) * 2, MatrixInverse((9.0,), np.ones((2, 2, 2))), period_s=H)
    law = axes_roots.matrix_law(given, np.full((3, 2, 2), 1e-3))
    poles = on_each(axes_roots._Poles.of(H, 7), 2)
    whole = law.then(poles)
    n = len(whole.a)
    direct = np.stack(
        [whole.c @ np.linalg.solve(z * np.eye(n) - whole.a, whole.b) + whole.d for z in Z]
    )
    np.testing.assert_allclose(whole.response(Z), direct, rtol=1e-9, atol=1e-12)


def test_fitted_axes_follow_their_sweep_and_are_quiet_beyond_it(tmp_path: Path) -> None:
    setup = frame(tmp_path, "none")
    assert setup.group is not None
    rig = setup.group.rig
    assert rig.identified is not None
    found = response_of_rig(rig, rig.identified, setup.rate)
    axes = axes_roots.fitted_axes(rig, found, H)
    assert axes is not None
    assert axes.error < axes_roots.GOOD
    back = np.linalg.inv(rig.core_kinematics().jacobian())
    at = np.exp(2j * np.pi * found.frequency_hz * H)
    moved = axes.system.response(at)[:, :2]
    assert np.abs(moved - back @ found.response).max() < 0.02 * np.abs(back).max()
    swept = np.abs(moved[-1]).max()
    outside = np.exp(2j * np.pi * np.linspace(50.0, 512.0, 60) * H)
    assert np.abs(axes.system.response(outside)[:, :2]).max() < swept


def test_axes_that_no_model_follows_are_not_judged(tmp_path: Path) -> None:
    setup = frame(tmp_path, "none")
    assert setup.group is not None
    rig = setup.group.rig
    assert rig.identified is not None
    found = response_of_rig(rig, rig.identified, setup.rate)
    rng = np.random.default_rng(8)
    nonsense = found.response * np.exp(2j * np.pi * rng.random(found.response.shape))
    strange = MatrixResponse(found.frequency_hz, nonsense, found.rest_noise_m)
    assert axes_roots.fitted_axes(rig, strange, H) is None
    few = MatrixResponse(found.frequency_hz[:2], found.response[:2], found.rest_noise_m)
    assert axes_roots.fitted_axes(rig, few, H) is None


def growth_of(setup: Setup, frequency_hz: float) -> float:
    """Return the factor per sample of the motion after the ground has come to rest."""
    rec = virtual_time.run(setup)
    x = rec.samples["x_num_m"][rec.running()][5 * 1024 :]
    k = np.arange(1024)
    w = 2.0 * math.pi * frequency_hz * H
    # Hann's window, so that no other mode reaches this one.
    shape = np.hanning(1024) * np.exp(-1j * w * k)
    sizes = [abs(x[i : i + 1024] @ shape) for i in range(0, len(x) - 1024, 1024)]
    assert len(sizes) > 8
    return float(np.exp(np.polyfit(np.arange(len(sizes)), np.log(sizes), 1)[0] / 1024))


@pytest.mark.parametrize(
    ("law", "ratio", "pga"),
    [("none", 0.02, '"0.12 g"'), ("none", 0.001, '"0.03 g"'), ("robust", 0.02, '"0.03 g"')],
)
def test_motion_decays_or_grows_as_the_largest_root_says(
    law: str, ratio: float, pga: str, tmp_path: Path
) -> None:
    setup = frame(
        tmp_path,
        law,
        damping=f"{{ ratio = {ratio}, modes = [1, 2] }}",
        duration_s='"4 s"',
        free_vibration_s='"20 s"',
        pga_g=pga,
    )
    verdict = loop_stability.judge(setup)
    assert verdict is not None
    assert verdict.unstable is (ratio < 0.01 and law == "none")
    # Friction of the actuators takes a little of the motion.
    grown = growth_of(setup, verdict.frequency_hz)
    assert grown - 1.0 == pytest.approx(verdict.radius - 1.0, rel=0.1, abs=1e-5)


def test_the_delay_margin_is_where_the_roots_leave_the_circle(tmp_path: Path) -> None:
    setup = frame(tmp_path, "none", damping="{ ratio = 0.02, modes = [1, 2] }")
    assert setup.group is not None
    rig = setup.group.rig
    assert rig.identified is not None
    axes = axes_roots.fitted_axes(rig, response_of_rig(rig, rig.identified, setup.rate), H)
    assert axes is not None
    loop = axes_roots.loop_of(
        setup.controller, axes, constant(np.eye(2)), rig.core_kinematics().jacobian()
    )
    late = loop.delay_margin()
    assert 10.0 < late < 60.0

    def with_delay(samples: int) -> AxesLoop:
        waiting = loop_roots.rational(np.array([1.0]), np.eye(1, samples + 1)[0])
        return dataclasses.replace(loop, law=loop.law.then(on_each(waiting, 2)))

    assert with_delay(math.floor(late)).stable()
    assert not with_delay(math.ceil(late)).stable()


def linked(setup: Setup, **link: Any) -> Setup:
    real = config.load_rig(config.shipped_rig("shaking-table-can")).link
    assert real is not None
    assert setup.group is not None
    rig = setup.group.rig
    axes = [rig.axis[0], rig.axis[1].model_copy(update={"link": real.model_copy(update=link)})]
    group = dataclasses.replace(setup.group, rig=rig.model_copy(update={"axis": axes}))
    return dataclasses.replace(setup, group=group)


@pytest.mark.long
def test_unstable_loop_of_two_axes_is_refused_where_one_of_them_is_real(tmp_path: Path) -> None:
    setup = frame(tmp_path, "none", damping="{ ratio = 0.001, modes = [1, 2] }")
    with pytest.raises(InputError, match="the motion will grow: its largest root is 1") as caught:
        loop_stability.demand(linked(setup, virtual=False))
    assert 'on rig "two-axis-frame"' in str(caught.value)
    for harmless in (setup, linked(setup, virtual=True)):
        assert "compensate the delay" in loop_stability.demand(harmless)[0]
    (text,) = loop_stability.demand(linked(frame(tmp_path, "matrix"), virtual=False))
    assert "is stable is known only up to 40 Hz" in text


def test_rotations_without_mass_that_the_step_does_not_damp_are_at_the_limit_of_stability() -> None:
    """As the core would take them: a test file with them is refused before."""
    setup = axes_experiment.prepare(
        config.load_test(FRAME), config.load_any_rig(config.shipped_rig("two-axis-frame"))
    )
    assert isinstance(setup.controller.numerical, SparseConfig)
    part = dataclasses.replace(setup.controller.numerical, rho_inf=1.0)
    controller = dataclasses.replace(setup.controller, numerical=part)
    undamped = dataclasses.replace(setup, controller=controller)
    verdict = loop_stability.judge(undamped)
    assert verdict is not None
    assert verdict.at_limit
    assert verdict.frequency_hz == pytest.approx(512.0)
    assert (verdict.gain_margin, verdict.delay_margin_samples) == (0.0, 0.0)
    (text,) = loop_stability.demand(undamped)
    assert "at the limit of stability, so motion does not decay" in text
    assert 'integrator = "kr-alpha" and rho_inf below 1' in text
    with pytest.raises(
        InputError, match=r"largest root is 1\.00000 at 512 Hz, and must be below 1"
    ):
        loop_stability.demand(linked(undamped, virtual=False))
    (text,) = loop_stability.demand(linked(setup, virtual=False))
    assert "is stable is known only up to 40 Hz" in text
