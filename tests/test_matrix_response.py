"""Coupled axes are swept in turn, and their inverse is fitted to the response."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from kernels import Floats

from rthyb_rt.benchmark import marths_frame, marths_laws
from rthyb_rt.config import matrix_response, response
from rthyb_rt.config.matrix_response import MatrixResponse
from rthyb_rt.core import CoreError
from rthyb_rt.core.coupled_plant import CoupledPlant
from rthyb_rt.core.matrix_lead import MatrixInverse, MatrixLead, MatrixLeadConfig
from rthyb_rt.errors import InputError
from rthyb_rt.rig import identify_axes

H = 1.0 / 1024.0
TONES = np.array([0.25, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, 40.0])
PLANT = marths_frame.plant(None, 3)


def exact(f_hz: Floats) -> Any:
    """Response of the benchmark's plant as a controller meets it, (n, 2, 2)."""
    z = np.exp(2j * np.pi * f_hz * H)
    return np.array([PLANT.c @ np.linalg.solve(one * np.eye(8) - PLANT.a, PLANT.b) for one in z])


def found(f_hz: Floats = TONES) -> MatrixResponse:
    return MatrixResponse(f_hz, exact(f_hz), np.full(2, marths_frame.NOISE_M))


def test_a_sweep_of_each_axis_in_turn_shows_the_whole_matrix_through_the_noise() -> None:
    swept = identify_axes.identify_axes(lambda c: CoupledPlant(PLANT).run(c)[0], 2)
    wanted = exact(swept.frequency_hz)
    error = np.abs(swept.response - wanted).max(axis=(1, 2)) / np.abs(wanted).max(axis=(1, 2))
    slow = swept.frequency_hz <= 10.0
    assert error[slow].max() < 3e-3
    assert error.max() < 0.02
    assert np.allclose(swept.rest_noise_m, marths_frame.NOISE_M, rtol=0.03)


def test_the_inverse_undoes_the_plant_where_structures_answer() -> None:
    fit = matrix_response.fit(found(), H)
    assert fit.worst <= matrix_response.GOOD
    assert fit.largest_root < 1.0
    between = np.arange(0.3, 10.0, 0.2)
    error = np.abs(exact(between) @ fit.inverse.response(between, H) - np.eye(2))
    assert error.max() < 1.5 * matrix_response.GOOD
    loud = fit.inverse.response(np.linspace(40.0, 512.0, 300), H)
    assert np.linalg.norm(loud, 2, axis=(1, 2)).max() <= 1.05 * fit.loudest


@pytest.mark.parametrize(
    ("rate_hz", "most"),
    # At 256 Hz the fit of five poles is accepted, but not as good as one need not look beyond.
    [
        (256.0, response.LARGEST_ERROR),
        (512.0, matrix_response.GOOD),
        (2048.0, matrix_response.GOOD),
    ],
)
def test_at_another_rate_the_inverse_has_the_poles_that_the_rate_can_hold(
    rate_hz: float, most: float
) -> None:
    fit = matrix_response.fit(found(), 1.0 / rate_hz)
    poles = tuple(one for one in matrix_response.POLES_HZ if one < 0.5 * rate_hz)
    assert fit.inverse.pole_hz == poles
    assert fit.worst <= most
    between = np.arange(0.3, 10.0, 0.2)
    error = np.abs(exact(between) @ fit.inverse.response(between, 1.0 / rate_hz) - np.eye(2))
    assert error.max() < 1.5 * most


def test_a_closer_fit_would_be_louder(monkeypatch: pytest.MonkeyPatch) -> None:
    quiet = matrix_response.fit(found(), H)
    monkeypatch.setattr(matrix_response, "GOOD", 0.01)
    close = matrix_response.fit(found(), H)
    assert close.worst < 0.3 * quiet.worst
    assert close.loudest > 2.0 * quiet.loudest


@pytest.mark.parametrize("seed", range(12))
def test_the_largest_root_is_what_the_core_judges_by(seed: int) -> None:
    rng = np.random.default_rng(seed)
    inverse = MatrixInverse((6.0, 70.0), np.stack([np.eye(2), *rng.normal(size=(2, 2, 2))]))
    stable = matrix_response.largest_root(inverse, H) < 1.0
    try:
        MatrixLead(MatrixLeadConfig((0.0, 0.0), inverse))
    except CoreError:
        assert not stable
    else:
        assert stable


def test_both_verdicts_occur_among_those() -> None:
    roots = [
        matrix_response.largest_root(
            MatrixInverse(
                (6.0, 70.0),
                np.stack([np.eye(2), *np.random.default_rng(seed).normal(size=(2, 2, 2))]),
            ),
            H,
        )
        for seed in range(12)
    ]
    assert 2 <= sum(root < 1.0 for root in roots) <= 10


def test_what_undoes_nothing_has_no_root_within_the_circle() -> None:
    singular = MatrixInverse((6.0,), np.array([[[1.0, 1.0], [1.0, 1.0]], np.eye(2)]))
    assert matrix_response.largest_root(singular, H) == np.inf


def test_a_lead_of_one_axis_is_fitted_as_for_one_axis_and_matrices_fit_better() -> None:
    own = found()
    alone = matrix_response.fitted_terms(own, H, 20.0, coupled=False)
    rho = float(np.exp(-2 * np.pi * 20.0 * H))
    one = response.fitted_terms(TONES, own.response[:, 1, 1], H, 1 / rho**2, -2 / rho, (0, 1, 2))
    assert np.allclose(alone[:, 1, 1], np.array(one) * [1.0, H, H * H], rtol=1e-12)
    assert np.count_nonzero(alone[:, 0, 1]) == 0
    together = matrix_response.fitted_terms(own, H, 20.0, coupled=True)

    def worst(terms: Floats) -> float:
        lead = MatrixLead(MatrixLeadConfig((0.0, 0.0), first=terms, gain_most=0.9))
        t = np.arange(8192) * H
        x = 1e-3 * np.outer(np.sin(2 * np.pi * 2.0 * t), [1.0, 0.7])
        reading, _ = CoupledPlant(marths_frame.plant(None, 3, 0.0)).run(lead.run(x))
        return float(np.abs(reading - x)[4096:].max())

    assert worst(together) < 0.3 * worst(alone)


def test_an_inverse_before_the_lead_is_seen_through() -> None:
    before = matrix_response.fit(found(), H).inverse
    left = matrix_response.fitted_terms(found(), H, 20.0, coupled=True, before=before)
    assert np.abs(left[0]).max() < 0.05
    assert np.abs(left[1]).max() < 1e-3


WRONG: list[tuple[str, dict[str, Any]]] = [
    ("one matrix for each frequency", {"response": exact(TONES)[:5]}),
    ("one matrix for each frequency", {"rest_noise_m": np.zeros(3)}),
    ("not finite", {"response": exact(TONES) * np.nan}),
    ("must be positive and increasing", {"frequency_hz": TONES[::-1]}),
    ("must be positive and increasing", {"frequency_hz": TONES - 0.25}),
]


@pytest.mark.parametrize(("says", "wrong"), WRONG)
def test_a_response_that_is_none_is_refused(says: str, wrong: dict[str, Any]) -> None:
    given = {"frequency_hz": TONES, "response": exact(TONES), "rest_noise_m": np.zeros(2)}
    with pytest.raises(InputError, match=says):
        MatrixResponse(**given | wrong)


def test_a_sweep_that_is_too_short_and_poles_that_are_none_are_refused() -> None:
    with pytest.raises(InputError, match="needs at least 8"):
        matrix_response.fit(found(TONES[:7]), H)
    for poles in ((), (600.0,), (-1.0,), (5.0,) * 9):
        with pytest.raises(InputError, match="1 to 8"):
            matrix_response.fit(found(), H, poles)
    with pytest.raises(InputError, match="no inverse of 1 poles"):
        matrix_response.fit(found(), H, (300.0,))


def test_the_benchmarks_inverse_comes_from_a_noisy_sweep_alone() -> None:
    fit = marths_laws.inverse()
    assert fit.worst <= matrix_response.GOOD
    exact_error = np.abs(exact(TONES[:10]) @ fit.inverse.response(TONES[:10], H) - np.eye(2))
    assert exact_error.max() < 1.1 * matrix_response.GOOD
