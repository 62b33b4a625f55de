"""Computing times that must hold on any machine: ratios within one run, of least times.

The absolute figures are printed by ``make bench``.
"""

from __future__ import annotations

import numpy as np
import pytest
from bench import loops

from rthyb_rt import core

pytestmark = [pytest.mark.speed, pytest.mark.alone]


@pytest.fixture(scope="module")
def comparison() -> loops.Comparison:
    """A test of 20 s with yielding specimen, in the core, in NumPy-Python and in numba."""
    return loops.compare(20.0, repetitions=200)


def test_core_numpy_and_numba_compute_the_same_test(comparison: loops.Comparison) -> None:
    assert comparison.peak_m > loops.CEILING_M  # it yields, so the whole loop is at work
    assert comparison.difference < 1e-9


def test_core_is_twenty_times_faster_than_a_numpy_loop(comparison: loops.Comparison) -> None:
    assert comparison.numpy_s > 20.0 * comparison.core_s


def test_core_is_not_three_times_slower_than_numba(comparison: loops.Comparison) -> None:
    assert comparison.core_s < 3.0 * comparison.numba_s


@pytest.mark.parametrize("kind", ["pure-delay", "servo-hydraulic"])
def test_a_test_costs_in_proportion_to_its_length(kind: str) -> None:
    servo = core.ServoConfig("pure-delay", delay_samples=10)
    if kind == "servo-hydraulic":
        servo = loops.SHAKING_TABLE
    rig = core.RigConfig(servo, (core.element("stiffness", k_n_per_m=loops.K_E),))
    lengths_s = (10.0, 20.0, 40.0)
    records = {s: np.zeros(round(s * core.FS_HZ), core.RECORD_DTYPE) for s in lengths_s}
    cost = dict.fromkeys(lengths_s, np.inf)
    for _ in range(15):  # in turn, so that a slow minute of the machine meets every length
        for s in lengths_s:
            ag = 0.05 * loops.excitation(s)
            cost[s] = min(cost[s], loops.in_core(ag, records[s], rig) / s)
    assert max(cost.values()) < 1.3 * min(cost.values())


def test_python_goes_on_while_a_test_runs() -> None:
    # A call that held the GIL would leave the thread its last 5 ms at most.
    assert loops.counting_ratio() > 0.2
