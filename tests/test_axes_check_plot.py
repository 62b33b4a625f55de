"""The curves of a check of several axes: roots over delay and period, the loop, the tracking."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_axes_roots import frame

import rthyb_rt as rt
from rthyb_rt import cli
from rthyb_rt.analysis import loop_roots, loop_stability
from rthyb_rt.checking import axes_curves
from rthyb_rt.checking.axes_curves import KnownLoop

H = 1.0 / 1024.0
FRAME = Path(__file__).parents[1] / "examples" / "two-actuator-frame.toml"
DAMPED = "{ ratio = 0.02, modes = [1, 2] }"


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> KnownLoop:
    """The loop of the frame without compensation, which a delay of some 20 ms makes unstable."""
    found = axes_curves.known(frame(tmp_path_factory.mktemp("frame"), "none", damping=DAMPED))
    assert found is not None
    return found


@pytest.fixture(scope="module")
def curves(loop: KnownLoop) -> axes_curves.StabilityCurves:
    found = axes_curves.stability(loop)
    assert found is not None
    return found


@pytest.mark.long
def test_the_first_root_is_that_of_the_check(
    loop: KnownLoop, curves: axes_curves.StabilityCurves
) -> None:
    verdict = loop_stability.judge(loop.setup)
    assert verdict is not None
    (growth,) = curves.growth_per_s.values()
    assert growth[0] == pytest.approx(1024 * np.log(verdict.radius), rel=1e-6)


@pytest.mark.long
def test_the_largest_delay_is_that_of_the_frequency_response(
    loop: KnownLoop, curves: axes_curves.StabilityCurves
) -> None:
    """Of roots, in whole samples; the margin of the check is found on the unit circle."""
    (limit_s,) = curves.limit_s.values()
    at = int(np.argmin(np.abs(curves.factors - 1.0)))
    late = limit_s[at] / H
    assert 0 < late < 48
    for factor, limit in zip(
        curves.factors[at - 2 : at + 3], limit_s[at - 2 : at + 3], strict=True
    ):
        (other,) = loop.loops(float(factor)).values()
        assert limit / H == np.floor(other.delay_margin()) or np.isinf(limit)
    (growth,) = curves.growth_per_s.values()
    samples = curves.delay_s / H
    assert np.array_equal(growth > 0.0, samples > late)


def test_a_longer_period_scales_every_mode_and_keeps_its_damping(loop: KnownLoop) -> None:
    assert loop.setup.group is not None
    structure = loop.setup.group.derived.structure
    for mode, slow in zip(structure.modes(), structure.slowed(2.0).modes(), strict=True):  # type: ignore[union-attr]
        assert slow.frequency_hz == pytest.approx(0.5 * mode.frequency_hz, rel=1e-6)
        assert slow.damping_ratio == pytest.approx(mode.damping_ratio, rel=1e-6)


def encirclements(curve: np.ndarray) -> int:
    """Clockwise turns about -1 over the whole circle; the other half is the conjugate."""
    return round(-2.0 * float(np.unwrap(np.angle(curve + 1.0))[-1]) / (2.0 * np.pi))


@pytest.mark.parametrize("late", [0, 48])
def test_the_determinant_encircles_minus_one_as_often_as_roots_are_outside(
    loop: KnownLoop, late: int
) -> None:
    """Generalised Nyquist criterion, with the roots as second formulation."""
    waiting = loop_roots.rational(np.array([1.0]), np.eye(1, late + 1)[0])
    count = len(loop.jacobian)
    laws = {
        name: law.then(axes_curves.on_each(waiting, count)) if late else law
        for name, law in loop.laws.items()
    }
    other = replace(loop, laws=laws)
    found = axes_curves.nyquist(other)
    assert found is not None
    (curve,) = found.curves.values()
    (whole,) = other.loops().values()
    opened = np.abs(whole.roots(0.0)).max()
    assert opened <= 1.0 + loop_roots.ROUNDING
    outside = int(np.count_nonzero(np.abs(whole.roots()) > 1.0 + loop_roots.ROUNDING))
    assert encirclements(curve) == outside
    assert (outside > 0) == (late > 0)


def test_tracking_without_compensation_is_the_sweep_along_the_directions(loop: KnownLoop) -> None:
    assert loop.setup.group is not None
    rig = loop.setup.group.rig
    assert rig.identified is not None
    found = axes_curves.tracking(loop)
    swept = np.array(rig.identified.real) + 1j * np.array(rig.identified.imaginary)
    jacobian = rig.core_kinematics().jacobian()
    expected = np.linalg.inv(jacobian) @ swept @ jacobian
    for k, f in enumerate(rig.identified.frequency_hz):
        at = int(np.argmin(np.abs(found.frequency_hz - f)))
        for curve in found.curves.values():
            # m per rad in the row of x, rad per m in that of theta.
            scale = np.array([[1.0, 0.127], [1 / 0.127, 1.0]])
            assert np.all(np.abs(curve[at] - expected[k]) < 0.03 * scale)


def test_coupling_counts_directions_by_the_energy_that_they_store() -> None:
    response = np.array([[[1.0, 0.2], [0.0, 1.0]]], dtype=complex)
    stiffness = np.array([4.0, 9.0])
    assert axes_curves.coupling(response, stiffness, 0) == pytest.approx([0.2 * 2.0 / 3.0])
    assert axes_curves.coupling(response, stiffness, 1) == pytest.approx([0.0])


@pytest.mark.long
def test_page_has_a_figure_for_every_direction_and_asks_nothing_of_the_network(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "check.html"
    assert cli.main(["check", str(FRAME), "--plot", str(page)]) == 0
    assert f"Page      {page}" in capsys.readouterr().out
    html = page.read_text("utf-8")
    assert html.count("<svg ") == 5
    assert "Mode shapes" in html
    assert "Predicted tracking of theta" in html
    assert "://" not in html.replace("http://www.w3.org/", "")


def test_what_is_not_known_is_said_in_place_of_a_figure() -> None:
    bare = rt.Rig("two-axis-frame").with_({"identified": None})
    test = rt.Test(FRAME, rig=bare, controller={"type": "none"})
    plots = rt.check(test).plots()
    assert set(plots) == {"stability", "nyquist", "tracking-0", "tracking-1", "modes"}
    assert all(one.figure is None for key, one in plots.items() if key != "modes")
    assert plots["modes"].figure is not None
    assert "response of the axes is not known" in plots["nyquist"].note
