"""A line in the load cell's signal: its frequency is as exact as the noise allows."""

from __future__ import annotations

import numpy as np
import pytest
from diagnose_cases import F_STD
from test_diagnose_steady import fitted


@pytest.mark.parametrize("f_hz", [16.731, 49.93, 60.0355, 101.7])
def test_the_frequency_of_a_hum_is_as_exact_as_its_noise_allows(f_hz: float) -> None:
    """Its bound: Rife and Boorstyn, IEEE Trans. Inf. Theory 20 (1974) 591, for unknown phase."""
    size_n = 300.0
    problem, fit = fitted(lambda t, x, v: size_n * np.sin(2.0 * np.pi * f_hz * t + 0.7), "hum")
    n, length_s = problem.y.size, float(problem.ctx.t[-1])
    bound_hz = np.sqrt(6.0 / n) * F_STD / (np.pi * size_n * length_s)
    assert abs(fit.members[0].trial.theta[0] - f_hz) < 4.0 * bound_hz
