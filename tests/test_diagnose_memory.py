"""A force with a spectrum of relaxation times is no relaxation beside a spring or a dashpot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from diagnose_cases import C, K, M
from scipy.signal import lfilter
from scipy.special import gamma

from rthyb_rt.diagnose import memory
from rthyb_rt.diagnose.policy import POLICY
from tests.test_diagnose_steady import FS, Force, fitted


@pytest.mark.parametrize("order", [0.2, 0.5, 0.8])
def test_derivative_of_a_fractional_order_is_that_of_the_closed_forms(order: float) -> None:
    t = np.arange(4000) / FS
    ramp = memory.derivative(3.0 * t + 7.0, 1.0 / FS, order)
    np.testing.assert_allclose(ramp, 3.0 * t ** (1.0 - order) / gamma(2.0 - order), atol=1e-9)
    bent = memory.derivative(t**2, 1.0 / FS, order)
    exact = 2.0 * t ** (2.0 - order) / gamma(3.0 - order)
    np.testing.assert_allclose(bent[400:], exact[400:], rtol=5e-3)


def relaxing(x: np.ndarray, tau_s: float) -> np.ndarray:
    """Force per N/m of a spring and a dashpot in series, for even motion between rows."""
    kept = np.exp(-1.0 / (FS * tau_s))
    moved = np.diff(x, prepend=x[0]) * tau_s * FS * (1.0 - kept)
    return np.asarray(lfilter([1.0], [1.0, -kept], moved))


def spectrum(order: float) -> Force:
    """A bank of relaxations, two to an octave, whose stiffness falls with a power of the time."""
    times = 2e-3 * 2.0 ** (0.5 * np.arange(24))
    return lambda t, x, v: 1e4 * sum(relaxing(x, tau) * tau**-order for tau in times)


@pytest.mark.parametrize("order", [0.3, 0.5, 0.7])
@pytest.mark.parametrize("beside", ["stiffness", "viscous"])
def test_spectrum_of_relaxation_times_explains_more_than_one_with_its_limits(
    order: float, beside: str
) -> None:
    problem, fit = fitted(spectrum(order), *sorted(("maxwell", beside)))
    assert memory.gain(problem, fit) > 1.5 * POLICY.same_evidence


@pytest.mark.parametrize(
    ("force", "names"),
    [
        (lambda t, x, v: 2e4 * relaxing(x, 0.05), ("maxwell",)),
        (lambda t, x, v: 2e4 * relaxing(x, 0.05) + 400.0 * v, ("maxwell", "viscous")),
        (lambda t, x, v: 2e4 * relaxing(x, 0.3) + 9e3 * x, ("maxwell", "stiffness")),
        (lambda t, x, v: 2e4 * relaxing(x, 0.1) + 40.0 * np.sign(v), ("coulomb", "maxwell")),
    ],
    ids=["alone", "beside a dashpot", "beside a spring", "beside friction"],
)
def test_relaxation_with_one_time_is_what_it_is(force: Force, names: tuple[str, ...]) -> None:
    assert memory.gain(*fitted(force, *names)) < POLICY.same_evidence


def test_spectrum_behind_a_late_load_cell_is_compared_as_that_cell_reads_it() -> None:
    late_s, own = 8e-3, spectrum(0.7)

    def late(t: np.ndarray, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        known = K * x + C * v + M * np.gradient(v, 1.0 / FS)
        whole = known + 0.03 * own(t, x, v)
        turn = np.exp(-2j * np.pi * np.fft.rfftfreq(2 * t.size, 1.0 / FS) * late_s)
        both = np.fft.irfft(np.fft.rfft(np.r_[whole, whole[::-1]]) * turn)
        return both[: t.size] - known

    problem, fit = fitted(late, "maxwell", "stiffness", "time_skew")
    assert memory.gain(problem, fit) > POLICY.same_evidence


def test_weak_laws_are_not_given_up_for_their_price_alone() -> None:
    """A spectrum may cost less than two laws, and must fit as well to take their place."""
    problem, fit = fitted(lambda t, x, v: 2e4 * relaxing(x, 0.05) + 400.0 * v, "maxwell", "viscous")
    cheap = replace(fit, chi2=fit.chi2 - 1e3)
    assert memory.gain(problem, cheap) == -np.inf


def test_without_relaxation_nothing_is_compared() -> None:
    assert memory.gain(*fitted(lambda t, x, v: 2e3 * v, "viscous")) == -np.inf
