"""Coupled axes: matrices of gain, delay and curvature are learnt, an identified inverse follows
them, and implausible inputs never lead to implausible outputs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from kernels import Floats

from rthyb_rt.core import CoreError, LawConfig
from rthyb_rt.core.kernels import Law
from rthyb_rt.core.library import STATUS
from rthyb_rt.core.matrix_lead import MatrixInverse, MatrixLead, MatrixLeadConfig

H = 1.0 / 1024.0
UNIT = np.array([np.eye(2), np.zeros((2, 2)), np.zeros((2, 2))])
"""Gain 1, no delay, no curvature."""
G = np.array([[0.06, -0.11], [-0.08, 0.04]])
A_S = np.array([[0.021, 0.006], [-0.004, 0.012]])
B_S2 = np.array([[9e-5, 2e-5], [-3e-5, 5e-5]])
TERMS = np.stack([G, A_S, B_S2])
LOOSE = {
    "gain_sigma": 1.0,
    "delay_sigma_s": 0.1,
    "curvature_sigma_s2": 1e-2,
    "memory_s": 2.0,
}
"""Short of memory: what the first seconds put into the sums, while the filter pair still learns the
mean that it takes away, is forgotten at the end."""


def config(noise_m: float = 0.0, size: int = 2, **settings: Any) -> MatrixLeadConfig:
    return MatrixLeadConfig((noise_m,) * size, **settings)


def shaken(seconds: float, size: int = 2, seed: int = 5) -> Floats:
    """Motions of some millimetres up to 8 Hz, each axis its own, from rest."""
    t = np.arange(round(seconds / H)) * H
    rng = np.random.default_rng(seed)
    out = np.zeros((t.size, size))
    for column in out.T:
        for f in (0.7, 1.4, 2.3, 3.1, 4.9, 7.7):
            column += np.sin(2 * np.pi * f * (1 + 0.1 * rng.normal()) * t + 6 * rng.random()) / f
    return np.asarray(2e-3 * out * np.minimum(t, 1.0)[:, None])


def weights(roll_off_hz: float) -> tuple[float, float, float]:
    rho = math.exp(-2 * math.pi * roll_off_hz * H)
    w1, w2 = 1 / rho**2, -2 / rho
    return w1, w2, w1 + w2 + 1


def axes_of(terms: Floats, u: Floats, roll_off_hz: float = 20.0) -> Floats:
    """What axes make of their commands which that lead undoes exactly: written again, backwards."""
    w1, w2, s = weights(roll_off_hz)
    n = u.shape[1]
    g, a, b = terms[0], terms[1] / H, terms[2] / H**2
    left = np.linalg.inv(w1 * np.eye(n) + s * (g + a + b))
    m = np.zeros_like(u)
    zero = np.zeros(n)
    for k in range(len(u)):
        m1, m2 = (m[k - i] if k >= i else zero for i in (1, 2))
        u1, u2 = (u[k - i] if k >= i else zero for i in (1, 2))
        right = w1 * u[k] + w2 * (u1 - m1) + (u2 - m2) + s * (a @ m1 + b @ (2 * m1 - m2))
        m[k] = left @ right
    return m


def led(terms: Floats, x: Floats, roll_off_hz: float = 20.0) -> Floats:
    """The lead, written again in numpy."""
    w1, w2, s = weights(roll_off_hz)
    back = [np.vstack([np.zeros((i, x.shape[1])), x])[: len(x)] for i in (1, 2)]
    dx, d2x = x - back[0], x - 2 * back[0] + back[1]
    sums = s * (x @ terms[0].T + dx @ terms[1].T / H + d2x @ terms[2].T / H**2)
    e = np.zeros_like(x)
    for k in range(len(x)):
        e1, e2 = (e[k - i] if k >= i else 0.0 for i in (1, 2))
        e[k] = (sums[k] - w2 * e1 - e2) / w1
    return x + e


def taught(lead: MatrixLead, u: Floats, m: Floats) -> MatrixLead:
    for p, x in zip(u, m, strict=True):
        lead.observe(p, x)
        lead.lead(np.zeros(u.shape[1]))
    return lead


# ---- the lead ------------------------------------------------------------------------------------


def test_the_lead_is_the_difference_equation_with_matrices() -> None:
    x = shaken(3.0)
    lead = MatrixLead(config(first=TERMS))
    assert np.abs(lead.run(x) - led(TERMS, x)).max() < 1e-15
    assert np.allclose(lead.matrices, TERMS + UNIT)


def test_axes_that_the_lead_was_made_for_follow_their_commands_to_rounding() -> None:
    x = shaken(4.0)
    u = MatrixLead(config(first=TERMS)).run(x)
    assert np.abs(axes_of(TERMS, u) - x).max() < 1e-12 * np.abs(x).max()


def test_an_inverse_is_as_it_was_written_down() -> None:
    rng = np.random.default_rng(3)
    inverse = MatrixInverse((4.0, 30.0), np.stack([np.eye(2), *rng.normal(size=(2, 2, 2)) / 9]))
    t = np.arange(8192) * H
    for f in (0.5, 6.0, 40.0):
        x = np.outer(np.sin(2 * np.pi * f * t), [1e-3, -2e-3])
        out = MatrixLead(config(inverse=inverse)).run(x)[4096:]
        basis = np.stack([np.sin(2 * np.pi * f * t), np.cos(2 * np.pi * f * t)], axis=1)[4096:]
        part = np.linalg.lstsq(basis, out, rcond=None)[0]
        wanted = inverse.response([f], H)[0] @ np.array([1e-3, -2e-3])
        assert np.allclose(part[0] + 1j * part[1], wanted, rtol=0, atol=1e-9)


# ---- learning ------------------------------------------------------------------------------------


@pytest.mark.long
def test_gain_delay_and_curvature_of_coupled_axes_are_found() -> None:
    u = shaken(40.0)
    lead = taught(MatrixLead(config(**LOOSE)), u, axes_of(TERMS, u))
    found = lead.matrices - UNIT
    for term, wanted, unit in zip(found, TERMS, (1.0, 1e-2, 1e-4), strict=True):
        assert np.abs(term - wanted).max() < 1e-3 * unit
    x = shaken(5.0, seed=8)
    error = axes_of(TERMS, lead.run(x)) - x
    assert error.std() < 1e-4 * x.std()


@pytest.mark.long
def test_four_axes_are_learnt_together() -> None:
    rng = np.random.default_rng(17)
    terms = np.stack(
        [
            0.05 * rng.normal(size=(4, 4)),
            0.004 * rng.normal(size=(4, 4)) + 0.02 * np.eye(4),
            1e-5 * rng.normal(size=(4, 4)) + 1e-4 * np.eye(4),
        ]
    )
    u = shaken(40.0, size=4)
    lead = taught(MatrixLead(config(size=4, **LOOSE)), u, axes_of(terms, u))
    found = lead.matrices - [np.eye(4), np.zeros((4, 4)), np.zeros((4, 4))]
    for term, wanted, unit in zip(found, terms, (1.0, 1e-2, 1e-4), strict=True):
        assert np.abs(term - wanted).max() < 2e-3 * unit


def test_axes_by_themselves_cannot_undo_what_they_do_to_one_another() -> None:
    u = shaken(20.0)
    m = axes_of(TERMS, u)
    alone = taught(MatrixLead(config(coupled=False, **LOOSE)), u, m)
    assert all(np.count_nonzero(term - np.diag(np.diag(term))) == 0 for term in alone.matrices)
    x = shaken(5.0, seed=8)
    assert (axes_of(TERMS, alone.run(x)) - x).std() > 0.05 * x.std()


def test_one_axis_learns_and_leads_as_the_law_of_one_axis_does() -> None:
    settings = {
        "roll_off_hz": 45.0,
        "cutoff_hz": 12.0,
        "memory_s": 2.0,
        "gain_sigma": 0.1,
        "delay_sigma_s": 0.01,
        "curvature_sigma_s2": 1e-4,
        "gain_most": 0.3,
        "delay_most_s": 0.05,
    }
    noise_m = 1e-8
    law = Law(
        LawConfig(
            "gain-alpha-beta",
            {f"gain_alpha_beta.{k}": v for k, v in settings.items()}
            | {
                "gain_alpha_beta.delay_least_s": -0.05,
                "gain_alpha_beta.gain0": 1.0,
                "gain_alpha_beta.delay0_s": 0.0,
                "gain_alpha_beta.curvature0_s2": 0.0,
            },
            rest_noise_m=noise_m,
        )
    )
    lead = MatrixLead(config(noise_m, size=1, **settings))
    terms = np.array([[[0.07]], [[0.018]], [[1.1e-4]]])
    u = shaken(6.0, size=1)
    rng = np.random.default_rng(1)
    m = axes_of(terms, u, 45.0) + noise_m * rng.normal(size=u.shape)
    for p, x in zip(u, m, strict=True):
        law.observe(p[0], x[0])
        lead.observe(p, x)
        one, _ = law.lead(p[0])
        other, _ = lead.lead(p)
        assert other[0] == pytest.approx(one, rel=1e-9, abs=1e-14)
    assert lead.matrices[0, 0, 0] == pytest.approx(law.report()["gain"], rel=1e-9)
    assert abs(lead.matrices[0, 0, 0] - 1.07) < 0.01


@pytest.mark.long
def test_noise_of_the_sensors_does_not_bend_the_matrices() -> None:
    noise_m = 2e-5
    u = shaken(60.0)
    quiet = axes_of(TERMS, u)
    noisy = quiet + noise_m * np.random.default_rng(4).normal(size=u.shape)
    lead = taught(MatrixLead(config(noise_m, **LOOSE | {"memory_s": 600.0})), u, noisy)
    x = shaken(5.0, seed=8)
    assert (axes_of(TERMS, lead.run(x)) - x).std() < 5e-3 * x.std()


def test_axes_that_the_inverse_undoes_leave_nothing_to_learn() -> None:
    inverse = MatrixInverse(
        (8.0, 60.0),
        np.array([[[1.05, -0.1], [-0.2, 1.1]], [[0.3, 0.0], [0.1, 0.2]], [[0.9, 0.1], [0.0, 1.2]]]),
    )
    v = shaken(10.0)
    u = MatrixLead(config(inverse=inverse)).run(v)
    lead = taught(MatrixLead(config(inverse=inverse, **LOOSE)), u, v)
    assert np.abs(lead.matrices - UNIT).max() < 1e-9


@pytest.mark.long
def test_what_the_inverse_leaves_is_learnt() -> None:
    inverse = MatrixInverse((20.0,), np.array([[[1.0, -0.1], [-0.1, 1.0]], 0.2 * np.eye(2)]))
    left = TERMS * [[[0.3]], [[0.3]], [[0.3]]]
    v = shaken(40.0)
    u = MatrixLead(config(inverse=inverse)).run(v)
    lead = taught(MatrixLead(config(inverse=inverse, **LOOSE)), u, axes_of(left, v))
    found = lead.matrices - UNIT
    for term, wanted, unit in zip(found, left, (1.0, 1e-2, 1e-4), strict=True):
        assert np.abs(term - wanted).max() < 1e-3 * unit


def test_nothing_is_learnt_at_rest_or_when_frozen() -> None:
    lead = MatrixLead(config(1e-5, **LOOSE))
    rng = np.random.default_rng(2)
    for _ in range(4000):
        lead.observe([0.0, 0.0], 1e-5 * rng.normal(size=2))
        assert not lead.learning
    u = shaken(3.0)
    for p, x in zip(u, axes_of(TERMS, u), strict=True):
        lead.observe(p, x, frozen=True)
    assert np.array_equal(lead.learnt, UNIT)


# ---- what the station asks of it -----------------------------------------------------------------


def test_what_rests_stays_exact_and_the_way_back_ends_at_zero() -> None:
    inverse = MatrixInverse((9.0,), np.array([[[1.2, -0.1], [0.05, 0.9]], 0.4 * np.eye(2)]))
    lead = MatrixLead(config(inverse=inverse, first=TERMS), [0.01, -0.02])
    here = np.array([0.01, -0.02])
    for _ in range(2000):
        assert np.abs(lead.lead(here)[0] - here).max() < 1e-15
    back = here * (1 - np.minimum(np.arange(6000) / 2048, 1.0))[:, None]
    out = lead.run(back)
    assert np.abs(np.diff(out, axis=0)).max() < 1e-3
    assert np.abs(out[-1]).max() < 1e-12
    lead.rest([0.003, 0.004])
    assert np.abs(lead.lead([0.003, 0.004])[0] - [0.003, 0.004]).max() < 1e-15


def test_what_was_learnt_moves_a_command_by_no_more_than_is_allowed() -> None:
    u = shaken(8.0)
    m = axes_of(TERMS, u)
    lead = MatrixLead(config(**LOOSE))
    at = u[-1] + [1e-3, 2e-3]
    lead.rest(at)
    for p, x in zip(u, m, strict=True):
        lead.observe(p, x)
    before, _ = lead.lead(at, 0.0)
    assert np.array_equal(lead.matrices[0], np.eye(2))
    last = before
    for _ in range(50):
        now, _ = lead.lead(at, 1e-7)
        # The roll-off makes more of each step in the samples after it: 1 / (1 - rho)^2 of it.
        assert np.abs(now - last).max() < 1e-7 * weights(20.0)[0] / weights(20.0)[2]
        last = now
    assert not np.array_equal(lead.matrices[0], np.eye(2))
    lead.lead(at)
    assert np.allclose(lead.matrices, lead.learnt, rtol=1e-15)


@pytest.mark.parametrize("absurd", [math.nan, math.inf, -math.inf, 1e300, -1e4])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_senseless_value_is_replaced_by_the_last_good_one(absurd: float, axis: int) -> None:
    inverse = MatrixInverse((9.0,), np.array([[[1.2, -0.1], [0.05, 0.9]], 0.4 * np.eye(2)]))
    lead = MatrixLead(config(1e-6, inverse=inverse, **LOOSE))
    other = MatrixLead(config(1e-6, inverse=inverse, **LOOSE))
    u = shaken(4.0)
    m = axes_of(TERMS, u)
    wanted = STATUS["out_of_range"] if math.isfinite(absurd) else STATUS["not_finite"]
    for k, (p, x) in enumerate(zip(u, m, strict=True)):
        if k % 700 == 350:
            p, x = p.copy(), x.copy()
            p[axis] = absurd
            assert lead.observe(p, x) & wanted
            p[axis] = u[k - 1][axis]
            other.observe(p, x, frozen=True)
            x[axis] = absurd
            assert lead.observe(p, x) & wanted
            x[axis] = m[k][axis]
            other.observe(p, x, frozen=True)
            p[axis] = absurd
            out, code = lead.lead(p)
            assert code & wanted
            p[axis] = u[k - 1][axis]
            assert np.array_equal(out, other.lead(p)[0])
        else:
            for one in (lead, other):
                assert one.observe(p, x) == 0
            assert np.array_equal(lead.lead(p)[0], other.lead(p)[0])
    assert np.isfinite(lead.matrices).all()


def test_readings_beyond_any_rig_leave_everything_finite() -> None:
    lead = MatrixLead(config(1e-6, inverse=MatrixInverse((9.0,), np.stack([np.eye(2)] * 2))))
    rng = np.random.default_rng(9)
    for _ in range(3000):
        lead.observe(1e3 * rng.uniform(-1, 1, 2), 1e3 * rng.uniform(-1, 1, 2))
        out, _ = lead.lead(1e3 * rng.uniform(-1, 1, 2))
        assert np.isfinite(out).all()
        assert np.isfinite(lead.matrices).all()


UNSTABLE = MatrixInverse((20.0,), np.array([np.eye(2), -1.8 * np.eye(2)]))
"""Undone, it would grow: (1 - 1.8 d) has its zero outside the unit circle."""

WRONG: list[dict[str, Any]] = [
    {"inverse": UNSTABLE},
    {"inverse": MatrixInverse((), np.array([[[1.0, 2.0], [2.0, 4.0]]]))},
    {"inverse": MatrixInverse((20.0,), np.array([np.eye(2), -np.eye(2)]))},
    {"inverse": MatrixInverse((600.0,), np.array([np.eye(2), np.eye(2)]))},
    {"inverse": MatrixInverse((20.0,), np.array([np.eye(2), np.full((2, 2), math.nan)]))},
    {"inverse": MatrixInverse((20.0,), np.array([np.eye(2)]))},
    {"inverse": MatrixInverse((1.0,) * 9, np.stack([np.eye(2)] * 10))},
    {"first": np.full((3, 2, 2), math.nan)},
    {"first": np.zeros((2, 2, 2))},
    {"first": TERMS, "coupled": False},
    {"roll_off_hz": 512.0},
    {"cutoff_hz": 0.0},
    {"cutoff_hz": math.nan},
    {"memory_s": 0.0},
    {"gain_most": 1.0},
    {"gain_sigma": 0.0},
    {"delay_most_s": math.inf},
    {"gate_factor": -1.0},
    {"period_s": 0.0},
]


@pytest.mark.parametrize("wrong", WRONG)
def test_settings_that_cannot_work_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(CoreError):
        MatrixLead(config(**wrong))


def test_sizes_that_do_not_go_together_are_refused() -> None:
    with pytest.raises(CoreError):
        MatrixLead(config(size=5))
    with pytest.raises(CoreError):
        MatrixLead(config(-1e-6))
    with pytest.raises(CoreError):
        MatrixLead(config(), [0.0, math.nan])
    lead = MatrixLead(config())
    for call in (lambda: lead.lead([0.0]), lambda: lead.run(np.zeros(4))):
        with pytest.raises(CoreError):
            call()
