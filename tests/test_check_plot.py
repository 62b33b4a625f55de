"""The curves of a check: delays that are survived, the loop, what tracking is to be expected."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import rthyb_rt as rt
from rthyb_rt import cli
from rthyb_rt.analysis import loop_roots, margins
from rthyb_rt.api import files
from rthyb_rt.api.running import prepared
from rthyb_rt.checking import curves
from rthyb_rt.checking.check_figures import figures_of
from rthyb_rt.checking.plates import plates
from rthyb_rt.lab.experiment import Setup


def setup_of(test: rt.Test) -> Setup:
    return prepared(test, None)


@pytest.fixture(scope="module")
def setup() -> Setup:
    return setup_of(rt.Test("section5-T0.5"))


def test_map_is_that_of_the_check_at_the_period_of_the_test(setup: Setup) -> None:
    found, figures = curves.stability_map(setup), figures_of(setup)
    assert found is not None
    assert found.with_lead_s is not None
    at = int(np.argmin(np.abs(found.periods_s - found.period_s)))
    assert found.periods_s[at] == pytest.approx(0.5, rel=1e-4)
    assert found.alone_s[at] * 1024 == pytest.approx(figures.critical_delay_samples, rel=1e-4)
    assert figures.critical_delay_with_lead_samples is not None
    assert found.with_lead_s[at] * 1024 == pytest.approx(
        figures.critical_delay_with_lead_samples, rel=1e-4
    )
    assert found.delay_s == pytest.approx(17 / 1024)


def test_little_damping_survives_two_zeta_over_omega(setup: Setup) -> None:
    """A delay d of a spring acts as the damping -k d (Horiuchi et al. 1999)."""
    found = curves.stability_map(setup)
    assert found is not None
    zeta = setup.derived.damping_ratio
    assert found.alone_s == pytest.approx(2 * zeta * found.periods_s / (2 * np.pi), rel=0.02)


def test_above_the_curve_a_root_is_outside_and_below_none() -> None:
    setup = setup_of(rt.Test("section5-T0.5").with_({"numerical.damping_ratio": 0.05}))
    found = curves.stability_map(setup)
    assert found is not None
    motion = setup.controller.motion
    for period, limit in zip(found.periods_s[::6], found.alone_s[::6] * 1024, strict=True):
        mass = motion.k_e_n_per_m * (period / (2 * np.pi)) ** 2
        c = 2 * 0.05 * np.sqrt(motion.k_e_n_per_m * mass)
        structure = margins.OneDegree(
            replace(motion, mass_kg=mass - motion.added_mass_kg, damping_n_s_per_m=float(c))
        )
        assert structure.is_stable(int(np.floor(limit)))
        assert not structure.is_stable(int(np.ceil(limit)))


def test_nyquist_curve_meets_the_margins_of_the_check(setup: Setup) -> None:
    found, verdict = curves.nyquist(setup), loop_roots.judge(setup)
    assert found is not None
    assert verdict is not None
    # The curve crosses the negative axis at -1 / gain margin, of the worse of the two laws.
    crossings = []
    for loop in found.curves.values():
        down = np.flatnonzero((loop.imag[1:] >= 0) != (loop.imag[:-1] >= 0))
        for i in down:
            share = loop.imag[i] / (loop.imag[i] - loop.imag[i + 1])
            crossings.append(loop.real[i] + share * (loop.real[i + 1] - loop.real[i]))
    nearest = [-1 / c for c in crossings if c < 0 and -1 / c > 1.0]
    if verdict.gain_margin < loop_roots.MOST_GAIN:
        assert min(nearest) == pytest.approx(verdict.gain_margin, rel=0.01)
    else:
        assert not nearest or min(nearest) >= loop_roots.MOST_GAIN * 0.99


def test_predicted_tracking_is_what_the_test_then_shows() -> None:
    """Without a law: the lag of the rig, and that the test finds by Welch's averages."""
    test = rt.Test("section5-T0.5", controller={"type": "none", "rfc": {"enabled": False}})
    test = test.with_({"numerical.damping_ratio": 0.2, "ground_motion.duration_s": 20})
    found = curves.tracking(setup_of(test))
    assert found is not None
    rec = rt.run(test)
    seen = rec.frequency_response()
    for f in (1.0, 2.0, 3.0):
        line = int(np.argmin(np.abs(seen.frequency_hz - f)))
        near = int(np.argmin(np.abs(found.frequency_hz - seen.frequency_hz[line])))
        g = found.curves["as it begins"][near]
        assert abs(g) == pytest.approx(seen.gain[line], abs=0.02)
        late = -np.angle(g) / (2 * np.pi * found.frequency_hz[near])
        # The table's friction, which no linear response has, and the noise of one line.
        assert late == pytest.approx(seen.delay_s[line], abs=1.5e-3)


def test_compensation_is_predicted_to_take_the_delay_away(setup: Setup) -> None:
    found = curves.tracking(setup)
    assert found is not None
    slow = found.frequency_hz < 3.0

    def delays(name: str) -> np.ndarray:
        return -np.angle(found.curves[name][slow]) / (2 * np.pi * found.frequency_hz[slow])

    assert delays("not compensated").min() > 15e-3
    assert np.abs(delays("once adapted")).max() < 1e-3


@pytest.mark.long
def test_page_has_its_three_figures_and_asks_nothing_of_the_network(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = rt.Test("section5-T0.5").save(tmp_path / "own.toml")
    page = tmp_path / "check.html"
    assert cli.main(["check", str(path), "--plot", str(page)]) == 0
    assert f"Page      {page}" in capsys.readouterr().out
    html = page.read_text()
    assert html.count("<svg ") == 3
    assert "://" not in html.replace("http://www.w3.org/", "")
    assert set(rt.check(path).plots()) == {"stability", "nyquist", "tracking"}


@pytest.mark.long
def test_rig_without_a_known_response_and_many_storeys_say_why_there_is_no_figure() -> None:
    bare = rt.Rig("delay-10-elastic").with_({"identified": None})
    plots = rt.check(rt.Test("section5-T0.5", rig=bare, controller={"alpha0": 10})).plots()
    assert plots["nyquist"].figure is None
    assert "rthyb identify" in plots["tracking"].note
    assert plots["stability"].figure is not None
    many = rt.check(rt.Test("ten-storeys")).plots()
    assert "one degree of freedom" in many["stability"].note
    assert many["modes"].figure is not None
    assert files.file_of_rig(bare).identified is None


@pytest.mark.parametrize("name", ["ten-storeys", "frame-three-storeys", "two-actuator-frame"])
def test_a_structure_has_its_mode_shapes_drawn_before_it_runs(name: str) -> None:
    check = rt.check(rt.Test(name, ground_motion={"duration_s": 1.0}))
    drawn = check.plots()["modes"]
    assert drawn.figure is not None
    (axes,) = drawn.figure.axes
    curves = [line for line in axes.lines if line.get_marker() == "o"]
    found = [text.get_text().partition(" Hz")[0] for text in axes.get_xticklabels()]
    expected = [float(row[1].partition(" Hz")[0]) for row in check.table if row[0][:5] == "Mode "]
    assert 3 <= len(curves) == len(found) <= 5
    assert [float(one) for one in found] == pytest.approx(expected[: len(found)], rel=0.006)


def test_one_degree_of_freedom_has_no_mode_shape(setup: Setup) -> None:
    assert [plate.key for plate in plates(setup)] == ["stability", "nyquist", "tracking"]
