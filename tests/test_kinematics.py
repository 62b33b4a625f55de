"""Two and three actuators at one coupler: interface coordinates from axes and back, forces, and
what is refused."""

from __future__ import annotations

import importlib
import math
from pathlib import Path

import numpy as np
import pytest
from bench import pins
from kernels import Floats

from rthyb_rt.core import CoreError
from rthyb_rt.core.kinematics import Kinematics, Pin
from rthyb_rt.core.library import STATUS

# The coupler of the multi-axial benchmark (maRTHS): two horizontal actuators above one another.
ARM_M, ANGLE = math.hypot(0.2667, 0.127), math.radians(25.4633)
COUPLER = (
    Pin((0.2667, 0.127), (1.6, 0.127), pulls=True),
    Pin((0.2667, -0.127), (1.6, -0.127), pulls=True),
)
TRIPOD = (*COUPLER, Pin((0.1, -0.2), (0.15, -1.4)))
"""A third actuator from below, which pushes up."""


def coupler() -> Kinematics:
    return Kinematics(pins=COUPLER, coordinates=["x", "theta"])


def tripod() -> Kinematics:
    return Kinematics(pins=TRIPOD, coordinates=["theta", "x", "y"])


def lengths(pins: tuple[Pin, ...], pose: Floats) -> Floats:
    """Written again, in extended precision: pose is (n, 3) of x, y, theta."""
    x, y, t = np.asarray(pose, dtype=np.longdouble).T
    found = []
    for pin in pins:
        p, b = np.array(pin.pin_m, np.longdouble), np.array(pin.base_m, np.longdouble)
        at = np.stack([x + np.cos(t) * p[0] - np.sin(t) * p[1] - b[0],
                       y + np.sin(t) * p[0] + np.cos(t) * p[1] - b[1]])  # fmt: skip
        longer = np.hypot(*at) - np.hypot(*(p - b))
        found.append(-longer if pin.pulls else longer)
    return np.array(found, dtype=np.float64).T


def motion(seconds: float = 4.0) -> Floats:
    """x, y, theta of a coupler: up to 60 mm, 30 mm, 80 mrad, as an earthquake moves it."""
    t = np.arange(round(1024 * seconds)) / 1024
    return np.stack(
        [
            0.06 * np.sin(2 * np.pi * 1.3 * t) * np.cos(2 * np.pi * 0.2 * t),
            0.03 * np.sin(2 * np.pi * 0.9 * t),
            0.08 * np.sin(2 * np.pi * 2.1 * t),
        ],
        axis=1,
    )


def test_the_coupler_of_the_benchmark_moves_its_actuators_as_its_closed_form_says() -> None:
    # Horizontal for ever; the closed form turns the other way round.
    arm = (ARM_M * math.cos(ANGLE), ARM_M * math.sin(ANGLE))
    pins = (
        Pin((arm[0], -arm[1]), (1.0, 0.0), far=True),
        Pin((arm[0], arm[1]), (5.0, 0.0), far=True),
    )
    x, _, t = motion().T
    axes, code = Kinematics(pins=pins, coordinates=["x", "theta"]).axes(np.stack([x, t], axis=1))
    assert code == 0
    closed = np.stack(
        [x + ARM_M * (np.cos(t + sign * ANGLE) - math.cos(ANGLE)) for sign in (-1, 1)], axis=1
    )
    assert np.abs(axes - closed).max() < 1e-16 * 5
    pose, _ = Kinematics(pins=pins, coordinates=["x", "theta"]).pose(closed)
    theta = np.arcsin((closed[:, 0] - closed[:, 1]) / (2 * ARM_M * math.sin(ANGLE)))
    assert np.abs(pose[:, 1] - theta).max() < 1e-12
    assert np.abs(pose[:, 0] - x).max() < 1e-12


def test_lengths_between_pins_and_bases_are_exact_at_sixty_millimetres() -> None:
    pose = motion()
    axes, code = tripod().axes(pose[:, [2, 0, 1]])
    assert code == 0
    assert np.abs(axes - lengths(TRIPOD, pose)).max() < 2e-16
    flat = pose * [1, 0, 1]
    axes, _ = coupler().axes(flat[:, [0, 2]])
    assert np.abs(axes - lengths(COUPLER, flat)).max() < 2e-16


def test_a_micrometre_keeps_its_digits() -> None:
    tiny = motion() * 1e-6
    axes, _ = tripod().axes(tiny[:, [2, 0, 1]])
    exact = lengths(TRIPOD, tiny)
    assert np.abs(axes - exact).max() < 1e-18 + 1e-12 * np.abs(exact).max()


def test_two_steps_of_newton_find_the_pose_of_the_readings() -> None:
    pose = motion()
    for body, columns in ((tripod(), [2, 0, 1]), (coupler(), [0, 2])):
        wanted = pose[:, columns]
        axes, _ = body.axes(wanted)
        found, code = body.pose(axes)
        assert code == 0
        assert np.abs(found - wanted).max() < 1e-12


def test_make_bench_prints_how_exactly_the_pose_of_three_pinned_axes_is_found(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "bench"))
    (figure,) = importlib.import_module("bench.bench").kinematics_figures()
    assert figure.name == "kinematics of pins, 60 mm and 80 mrad: largest closing error"
    assert (figure.unit, figure.target, figure.verdict) == ("m", 1e-12, "ok")
    assert figure.measured > 0.0


def test_the_closing_error_of_a_solution_that_is_not_exact_shows() -> None:
    way = pins.grid()
    assert np.abs(way).max(axis=0) == pytest.approx([0.06, 0.06, 0.08])
    assert (np.abs(np.diff(way, axis=0)) <= np.array([5e-4, 5e-4, 1e-3]) * (1 + 1e-9)).all()
    at_rest = Kinematics(pins=pins.PINS, coordinates=["x", "y", "theta"])
    # The constant slopes at rest, and one step of Newton from the pose of the sample before.
    straight = pins.measure(lambda axes: np.linalg.solve(at_rest.jacobian(), axes.T).T)
    assert straight.axis_m > 1e-3
    assert straight.translation_m > 1e-3

    def one_step(axes: Floats) -> Floats:
        before, found = np.zeros(3), []
        for row in axes:
            slopes = np.stack(
                [(pins.displacements(before + d)[0] - pins.displacements(before - d)[0]) / 2e-6
                 for d in 1e-6 * np.eye(3)[:, None, :]], axis=1,
            )  # fmt: skip
            off = row - pins.displacements(before[None])[0]
            before = before + np.linalg.solve(slopes.astype(float), off.astype(float))
            found.append(before)
        return np.array(found)

    once = pins.measure(one_step, points=3)
    assert 1e-9 < once.axis_m < 1e-5


def test_a_leap_of_sixty_millimetres_is_found_by_the_second_reading() -> None:
    body = coupler()
    axes, _ = body.axes([0.06, 0.08])
    first = body.pose(axes)[0] - [0.06, 0.08]
    second = body.pose(axes)[0] - [0.06, 0.08]
    assert np.abs(first).max() < 1e-5
    assert np.abs(second).max() < 1e-12
    # A constant matrix is wrong by a millimetre there.
    straight = np.linalg.solve(coupler().jacobian(), axes)
    assert np.abs(straight - [0.06, 0.08]).max() > 1e-3


def test_forces_do_the_same_work_on_both_sides() -> None:
    body = tripod()
    here = motion()[777][[2, 0, 1]]
    axes, _ = body.axes(here)
    for _ in range(3):
        body.pose(axes)
    pushes = np.array([1200.0, -340.0, 77.0])
    force, code = body.forces(pushes)
    assert code == 0
    step = 1e-6
    for j in range(3):
        ahead, back = (body.axes(here + sign * step * np.eye(3)[j])[0] for sign in (1, -1))
        assert force[j] == pytest.approx(pushes @ (ahead - back) / (2 * step), rel=1e-8)
    assert np.allclose(force, body.jacobian().T @ pushes, rtol=1e-14)


def test_a_constant_matrix_is_taken_as_it_is() -> None:
    matrix = np.array([[1.0, 0.127], [1.0, -0.127]])
    body = Kinematics(matrix)
    pose = motion()[:, [0, 2]]
    axes, _ = body.axes(pose)
    assert np.allclose(axes, pose @ matrix.T, rtol=0, atol=1e-16)
    assert np.abs(body.pose(axes)[0] - pose).max() < 1e-15
    assert np.allclose(body.forces([3.0, 5.0])[0], matrix.T @ [3.0, 5.0], rtol=1e-15)


@pytest.mark.parametrize("absurd", [math.nan, math.inf, -math.inf, 1e300, 1e4])
@pytest.mark.parametrize("which", [0, 1])
def test_a_senseless_reading_leaves_the_last_good_pose(absurd: float, which: int) -> None:
    for body in (coupler(), Kinematics([[1.0, 0.1], [1.0, -0.1]])):
        axes, _ = body.axes([0.01, 0.02])
        for _ in range(3):
            good, _ = body.pose(axes)
        broken = axes.copy()
        broken[which] = absurd
        found, code = body.pose(broken)
        assert code & (STATUS["not_finite"] | STATUS["out_of_range"])
        assert np.allclose(found, good, rtol=0, atol=1e-15)
        assert np.allclose(body.pose(axes)[0], good, rtol=0, atol=1e-15)
        again = np.array([0.01, 0.02])
        again[which] = absurd
        told, code = body.axes(again)
        assert code
        assert np.allclose(told, axes, rtol=0, atol=1e-15)
        push = np.array([10.0, 20.0])
        before, _ = body.forces(push)
        broken_push = push.copy()
        broken_push[which] = absurd if abs(absurd) != 1e4 else 1e13
        after, code = body.forces(broken_push)
        assert code
        assert np.array_equal(before, after)


def test_lengths_that_no_pose_has_are_refused_and_the_pose_stays() -> None:
    body = coupler()
    axes, _ = body.axes([0.01, 0.02])
    for _ in range(3):
        good, _ = body.pose(axes)
    found, code = body.pose([0.9, -0.9])
    assert code & STATUS["out_of_range"]
    assert np.array_equal(found, good)
    assert np.abs(body.pose(axes)[0] - good).max() < 1e-15


def test_a_pin_that_meets_its_base_gives_numbers_still() -> None:
    body = Kinematics(pins=[Pin((0.5, 0.0), (1.0, 0.0), pulls=True)], coordinates=["x"])
    axes, code = body.axes([0.5])
    assert code == 0
    assert axes[0] == 0.5
    assert np.isfinite(body.pose([0.5])[0]).all()
    assert np.isfinite(body.forces([1.0])[0]).all()


REFUSED = [
    {"matrix": [[1.0, 0.1], [1.0, 0.1]]},
    {"matrix": [[1.0, math.nan], [1.0, 0.1]]},
    {"matrix": [[0.0, 0.0], [0.0, 0.0]]},
    {"matrix": [[1e-30, 0.0], [0.0, 1e-30]]},
    {"matrix": [[1.0, 0.1]]},
    {"matrix": np.eye(5)},
    {},
    {"matrix": np.eye(2), "pins": COUPLER, "coordinates": ["x", "theta"]},
    {"pins": COUPLER, "coordinates": ["x"]},
    {"pins": COUPLER, "coordinates": ["x", "x"]},
    {"pins": COUPLER, "coordinates": ["x", "z"]},
    {"pins": COUPLER, "coordinates": ["x", "y"]},
    {"pins": (COUPLER[0], COUPLER[0]), "coordinates": ["x", "theta"]},
    {"pins": (Pin((0.2, 0.1), (0.2, 0.1)), COUPLER[1]), "coordinates": ["x", "theta"]},
    {"pins": (Pin((0.2, 0.1), (0.0, 0.0), far=True), COUPLER[1]), "coordinates": ["x", "theta"]},
    {"pins": (Pin((math.nan, 0.1), (1.0, 0.0)), COUPLER[1]), "coordinates": ["x", "theta"]},
    {"pins": (Pin((0.2, 0.1), (math.inf, 0.0)), COUPLER[1]), "coordinates": ["x", "theta"]},
    {"pins": (Pin((0.0, 0.0), (1.0, 0.0)),), "coordinates": ["theta"]},
    {"pins": (*TRIPOD, TRIPOD[0]), "coordinates": ["x", "y", "theta", "x"]},
]


@pytest.mark.parametrize("wrong", REFUSED)
def test_axes_that_do_not_set_every_coordinate_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(CoreError):
        Kinematics(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("far", [False, True])
def test_rates_of_the_axes_are_the_slopes_of_their_lengths(far: bool) -> None:
    """Against differences of the lengths themselves along a motion of known rates."""
    from rthyb_rt._core import ffi, lib

    given = Kinematics(
        pins=tuple(Pin(p.pin_m, p.base_m, far=far, pulls=p.pulls) for p in TRIPOD),
        coordinates=["theta", "x", "y"],
    )
    rng = np.random.default_rng(3)
    for _ in range(20):
        pose = rng.uniform(-1, 1, 3) * (0.08, 0.06, 0.03)
        v, a = rng.uniform(-1, 1, 3) * (0.8, 0.3, 0.2), rng.uniform(-1, 1, 3) * (9.0, 4.0, 3.0)
        h = 2e-4
        t = np.array([-h, 0.0, h])[:, None]
        around, code = given.axes(pose + v * t + 0.5 * a * t**2)
        assert code == 0
        found = [ffi.new("double[4]") for _ in range(2)]
        lib.rthyb_kinematics_rates(given.struct, list(pose), list(v), list(a), *found)
        np.testing.assert_allclose(
            list(found[0])[:3], (around[2] - around[0]) / (2 * h), atol=2e-6, rtol=0
        )
        np.testing.assert_allclose(
            list(found[1])[:3], np.diff(around, n=2, axis=0)[0] / h**2, atol=2e-5, rtol=0
        )
