"""The compiled simulators of the diagnosis against closed forms and a second formulation."""

from __future__ import annotations

from dataclasses import replace

import diagnose_cases as cases
import numpy as np
import pytest
from rthyb_rt._core import ffi, lib
from scipy.interpolate import CubicHermiteSpline

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import (
    ActuatorModel,
    SimulationError,
    _compiled,
    actuator,
    body,
    iwan,
    play,
)
from rthyb_rt.diagnose import effects
from rthyb_rt.diagnose.case import Model, ModelBoucWen
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.effects.sensor import shifted
from rthyb_rt.diagnose.noise_level import white_noise
from rthyb_rt.diagnose.predict import Augmented
from rthyb_rt.diagnose.problem import Member

LAG = ActuatorModel(cases.DELAY, cases.F_HZ, cases.ZETA)


@pytest.fixture(autouse=True)
def at_the_rate_of_a_station(monkeypatch):
    """Comparison with closed forms takes little time, so it uses smaller steps."""
    monkeypatch.setattr(cases, "FS", core.FS_HZ)


def test_the_actuator_agrees_with_a_finer_simulation():
    u = cases.command()
    x, v, a = cases.moved(u)
    motion = actuator(LAG, u, cases.FS)
    assert np.max(np.abs(motion.x - x)) < 2e-8
    assert np.max(np.abs(motion.v - v)) < 3e-6
    assert np.max(np.abs(motion.a - a)) < 2e-3


def test_a_held_command_steps_like_the_closed_form():
    u = np.r_[np.zeros(5), np.ones(300)] * 1e-3
    lag = ActuatorModel(0.0, 20.0, 1.0, hold="zoh")
    motion = actuator(lag, u, cases.FS)
    t = np.maximum(np.arange(u.size) - 5, 0) / cases.FS
    w = 2 * np.pi * 20.0
    assert motion.x == pytest.approx(1e-3 * (1 - np.exp(-w * t) * (1 + w * t)), abs=1e-12)


def test_between_rows_a_motion_agrees_with_a_finer_simulation(monkeypatch):
    """A command that bends at each row changes the acceleration there within a fraction of it."""
    u = cases.command()[:2000]
    at = np.arange(4 * (u.size - 1) + 1) / 4
    motion = actuator(LAG, u, cases.FS)
    assert motion.between is not None
    monkeypatch.setattr(cases, "FS", 4 * cases.FS)
    x, v, a = cases.moved(np.interp(at, np.arange(u.size), u))
    for quarters in (1, 2, 3):
        late = motion.between(quarters / 4)
        for got, exact, least in ((late.x, x, 2e-8), (late.v, v, 3e-6), (late.a, a, 2e-3)):
            assert np.max(np.abs(got[1:] - exact[4 - quarters :: 4])) < least


def test_between_rows_a_motion_whose_actuator_changes_is_a_whole_motion_of_rows():
    """Late by a whole row, it is the motion at the rows."""
    u = cases.command()[:2000]
    other = replace(LAG, gain=0.8, f_hz=12.0)
    motion = actuator(other, u, cases.FS, (700.4, LAG))
    assert motion.between is not None
    late = motion.between(1.0)
    assert late.x[1:] == pytest.approx(motion.x[:-1], abs=1e-9)
    assert late.a[1:] == pytest.approx(motion.a[:-1], abs=1e-4 * np.max(np.abs(motion.a)))


def test_between_rows_a_motion_late_by_its_speed_is_late_by_the_same():
    """Against the same motion at twice the rate, of which every other row is between."""
    u = cases.command()[:3000]
    late = replace(LAG, kappa_s2_m=0.05, kappa_of="motion", hold="zoh")
    motion, finer = actuator(late, u, cases.FS), actuator(late, np.repeat(u, 2), 2 * cases.FS)
    assert motion.between is not None
    half = motion.between(0.5)
    assert half.x[1:] == pytest.approx(finer.x[1:-1:2], abs=1e-7)
    turns = np.abs(finer.v[1:-1:2]) < 0.02 * np.max(np.abs(finer.v))
    assert half.v[1:][~turns] == pytest.approx(
        finer.v[1:-1:2][~turns], abs=1e-3 * np.max(np.abs(finer.v))
    )


def test_between_rows_a_motion_has_the_zero_of_its_sensor():
    motion = actuator(LAG, cases.command()[:500], cases.FS)
    off = motion.from_zero(3e-4)
    assert motion.between is not None
    assert off.between is not None
    late, plain = off.between(0.3), motion.between(0.3)
    assert late.x == pytest.approx(plain.x + 3e-4, abs=1e-12)
    assert np.array_equal(late.v, plain.v)
    assert late.between is not None
    assert late.between(0.2).x == pytest.approx(motion.between(0.5).x + 3e-4, abs=1e-12)


def test_between_rows_a_motion_of_the_longest_delay_is_known_too():
    motion = actuator(replace(LAG, delay_s=10.0), cases.command()[:500], cases.FS)
    assert motion.between is not None
    assert np.array_equal(motion.between(0.5).x, motion.x)  # it has not moved yet


def test_jumps_of_a_pure_delay_have_nothing_between_rows():
    motion = actuator(
        ActuatorModel(3.0 / cases.FS, 1e5, 1.0, jumps=True), cases.command(), cases.FS
    )
    assert motion.between is None


@pytest.mark.parametrize("zeta", [0.2, 1.0, 12.0])
def test_delay_that_grows_by_nothing_and_a_limit_never_met_change_nothing(zeta):
    u = cases.command()
    plain = actuator(ActuatorModel(0.004, 25.0, zeta), u, cases.FS)
    other = actuator(ActuatorModel(0.004, 25.0, zeta, kappa_s2_m=1e-12, vmax_m_s=1e3), u, cases.FS)
    assert np.max(np.abs(plain.x - other.x)) < 1e-7


@pytest.mark.parametrize("kappa_s2_m", [0.04, -0.02])
def test_a_motion_late_by_its_own_speed_follows_the_closed_form(kappa_s2_m):
    """Behind a lag too fast to matter: x(t) = x0(t - kappa |v0(t)|), from 1.5 s on."""
    t = np.arange(int(3.0 * cases.FS)) / cases.FS
    w, size, begins = 2 * np.pi * 1.5, 8e-3, 1.5
    lag = ActuatorModel(0.0, 2e4, 1.0)
    late = ActuatorModel(0.0, 2e4, 1.0, kappa_s2_m=kappa_s2_m, kappa_of="motion")
    motion = actuator(late, size * np.sin(w * t), cases.FS, (begins * cases.FS, lag))
    by = np.where(t >= begins, kappa_s2_m * np.abs(size * w * np.cos(w * t)), 0.0)
    exact = size * np.sin(w * (t - by))
    known = t < 2.99  # a motion that is ahead of itself ends before the command does
    assert motion.x[known] == pytest.approx(exact[known], abs=2e-6)
    turns = np.abs(np.cos(w * t)) < 0.05  # there the velocity has a corner
    speed, inside = np.gradient(exact, t), ~turns & (np.abs(t - begins) > 0.01) & (t > 0.05) & known
    assert motion.v[inside] == pytest.approx(speed[inside], abs=0.02 * size * w)


@pytest.mark.parametrize("after", ["late by its speed", "on time", "later by the command's speed"])
def test_a_motion_late_by_its_speed_is_so_before_something_else_changes_too(after):
    """Up to the row it is the motion of the first actuator alone, in every of its derivatives."""
    first = ActuatorModel(0.004, 40.0, 1.2, kappa_s2_m=0.03, kappa_of="motion")
    then = {
        "late by its speed": replace(first, delay_s=0.007, zeta=0.8),
        "on time": replace(first, kappa_s2_m=0.0),
        "later by the command's speed": replace(first, kappa_of="command"),
    }[after]
    u, row = cases.command(), 2000
    alone, motion = actuator(first, u, cases.FS), actuator(then, u, cases.FS, (row, first))
    for name, off in (("x", 1e-9), ("v", 2e-5), ("a", 1e-3)):
        there = getattr(alone, name)[: row - 2]
        error = np.abs(getattr(motion, name)[: row - 2] - there)
        if after == "later by the command's speed" and name == "a":
            # Without an equation from row to row: by differences, which round off each corner.
            assert np.sqrt(np.mean(error**2)) < 0.2 * np.std(there)
            continue
        assert np.max(error) < off
    settled = slice(row + 400, None)
    assert motion.x[settled] == pytest.approx(actuator(then, u, cases.FS).x[settled], abs=2e-8)


# Between two rows the acceleration is taken to be straight; behind a command in steps it is not.
@pytest.mark.parametrize(("hold", "off"), [("foh", 0.03), ("zoh", 0.15)])
def test_acceleration_of_a_motion_late_by_its_speed_is_that_of_the_instant(hold, off):
    """Against differences on a grid 64 times as fine: within a row it changes by its own size."""
    fine, kappa_s2_m = 64, 0.05
    u = cases.command()[:3000]
    model = ActuatorModel(0.0047, 60.0, 1.5, kappa_s2_m=kappa_s2_m, kappa_of="motion", hold=hold)
    motion = actuator(model, u, cases.FS)
    rows = np.arange(fine * (u.size - 1) + 1) / fine
    between = np.interp(rows, np.arange(u.size), u) if hold == "foh" else u[rows.astype(int)]
    before = actuator(replace(model, kappa_s2_m=0.0), between, fine * cases.FS)
    step = 1.0 / (fine * cases.FS)
    by = kappa_s2_m * np.abs(before.v) / step
    late = CubicHermiteSpline(np.arange(rows.size), before.x, before.v * step)(
        np.maximum(np.arange(rows.size) - by, 0.0)
    )
    exact = np.gradient(np.gradient(late, step), step)[::fine]
    inside = (np.abs(motion.v) > 0.1 * np.max(np.abs(motion.v))) & (np.arange(u.size) > 20)
    inside[-20:] = False
    assert inside.sum() > 1000
    error = (motion.a - exact)[inside]
    assert np.sqrt(np.mean(error**2)) < off * np.std(exact)


@pytest.mark.parametrize(
    "model",
    [
        ActuatorModel(3.0 / cases.FS, 1e5, 1.0, jumps=True),
        ActuatorModel(3.0 / cases.FS, 1e4, 200.0),
        ActuatorModel(0.004, 40.0, 1.0, vmax_m_s=0.03, vmax_of="command"),
        ActuatorModel(0.004, 40.0, 1.0, vmax_m_s=0.03, vmax_of="actuator"),
    ],
    ids=["a delay in steps", "one slow pole", "a limited command", "a limited actuator"],
)
def test_a_motion_late_by_its_speed_that_no_lag_smooths_accelerates_by_its_differences(model):
    """Where the command bends, the lag's own equation has another acceleration for an instant."""
    late = replace(model, kappa_s2_m=0.02, kappa_of="motion")
    motion = actuator(late, cases.command(), cases.FS)
    np.testing.assert_array_equal(motion.a, np.gradient(motion.v) * cases.FS)
    assert np.std(motion.a) < 3.0 * np.std(np.gradient(np.gradient(motion.x))) * cases.FS**2


@pytest.mark.parametrize(
    "bad",
    [
        {"kappa_s2_m": np.nan},
        {"kappa_s2_m": np.inf},
        {"kappa_s2_m": 1e300},
        {"f_hz": np.nan},
        {"zeta": np.nan},
    ],
)
def test_a_delay_by_speed_that_is_no_number_is_refused(bad):
    model = ActuatorModel(0.004, 40.0, 1.0, kappa_s2_m=0.02, kappa_of="motion")
    with pytest.raises(SimulationError):
        actuator(replace(model, **bad), cases.command(), cases.FS)


@pytest.mark.parametrize("of", ["actuator", "motion"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_change_at_a_row_that_is_no_number_is_refused(bad, of):
    late = replace(LAG, kappa_s2_m=0.02, kappa_of=of)
    with pytest.raises(SimulationError, match=r"before: found row .*; it must be a finite number"):
        actuator(late, cases.command()[:100], cases.FS, (bad, LAG))


@pytest.mark.parametrize("of", ["actuator", "motion"])
def test_a_change_far_beyond_the_recording_is_one_at_its_end(of):
    u = cases.command()[:500]
    late = replace(LAG, kappa_s2_m=0.02, kappa_of=of)
    for row, whole in ((1e300, LAG), (-1e300, late)):
        motion, alone = actuator(late, u, cases.FS, (row, LAG)), actuator(whole, u, cases.FS)
        assert motion.x[:-1] == pytest.approx(alone.x[:-1], abs=1e-9)


def test_the_core_refuses_a_row_that_is_no_number_and_takes_one_beyond_the_end_as_the_end():
    u = cases.command()[:64]
    model, out = _compiled(LAG, cases.FS), [np.zeros(u.size) for _ in range(3)]
    for row, fine in (
        (np.nan, False),
        *((r, True) for r in (np.inf, -np.inf, 1e300, -1e300, 63.5)),
    ):
        rows = [ffi.from_buffer("double[]", o, require_writable=True) for o in out]
        u_c = ffi.from_buffer("double[]", u)
        code = lib.rthyb_simulate_actuator(model, model, row, u_c, u.size, *rows)
        assert (code == 0) == fine
        assert out[0] == pytest.approx(actuator(LAG, u, cases.FS).x if fine else 0.0)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
def test_a_first_actuator_with_a_number_that_is_none_is_refused(bad):
    late = replace(LAG, kappa_s2_m=0.02, kappa_of="motion")
    for name in ("delay_s", "f_hz", "zeta", "gain", "shift_s", "kappa_s2_m"):
        for model in (LAG, late):
            with pytest.raises(SimulationError):
                actuator(LAG, cases.command()[:99], cases.FS, (50.0, replace(model, **{name: bad})))


@pytest.mark.parametrize("where", ["command", "actuator"])
def test_a_velocity_limit_is_kept(where):
    u = cases.command()
    motion = actuator(ActuatorModel(0.0, 40.0, 1.0, vmax_m_s=0.05, vmax_of=where), u, cases.FS)
    assert np.max(np.abs(motion.v)) < 0.0505


def test_an_actuator_at_its_own_velocity_limit_accelerates_no_more():
    u = cases.command()
    model = ActuatorModel(0.0, 40.0, 1.0, vmax_m_s=0.05, vmax_of="actuator")
    motion = actuator(model, u, cases.FS)
    rate = np.gradient(motion.v) * cases.FS
    # Two rows from any corner: there the difference of the velocities straddles it.
    limited = np.abs(motion.v) > 0.05 - 1e-9
    corner = np.convolve(np.abs(np.diff(limited, prepend=False)), np.ones(5), mode="same") > 0
    assert limited.sum() > 500
    assert np.max(np.abs((motion.a - rate)[limited & ~corner])) < 1e-6
    assert np.max(np.abs((motion.a - rate)[~corner])) < 0.02 * np.max(np.abs(rate))


def test_a_body_on_a_spring_swings_as_it_must():
    mass, k = 50.0, 5e4
    w = np.sqrt(k / mass)
    n = 2048
    motion = body(
        mass, [core.element("stiffness", k_n_per_m=k)], np.zeros(n), cases.FS, (1e-3, 0.0),
        substeps=16,
    )  # fmt: skip
    t = np.arange(n) / cases.FS
    assert motion.x == pytest.approx(1e-3 * np.cos(w * t), abs=2e-6)


def test_a_constant_force_ends_at_rest_on_the_spring():
    elements = [core.element("stiffness", k_n_per_m=1e5), core.element("viscous", c_n_s_per_m=4e3)]
    motion = body(100.0, elements, np.full(4096, 500.0), cases.FS)
    assert motion.x[-1] == pytest.approx(5e-3, rel=1e-3)


def sharp(kind: str = "coulomb", **params: float) -> core.ElementConfig:
    """Return dry friction whose step over velocity has next to no width."""
    return core.element(kind, **params, width_m_per_s=1e-9)


def test_a_body_that_slides_on_a_table_stops_where_its_energy_is_spent_and_stays():
    mass, grip, v0, n = 40.0, 60.0, 0.2, 4096
    motion = body(mass, [sharp(fc_n=grip)], np.zeros(n), cases.FS, (0.0, v0), substeps=4)
    t, slows = np.arange(n) / cases.FS, grip / mass
    stops = v0 / slows
    x = np.where(t < stops, v0 * t - 0.5 * slows * t**2, 0.5 * v0**2 / slows)
    assert motion.x == pytest.approx(x, abs=1e-9)
    assert motion.a == pytest.approx(np.where(t < stops, -slows, 0.0), abs=1e-6)


def test_friction_takes_the_same_off_each_half_swing_until_the_spring_holds_no_more():
    """Half swings of w about -+grip / k (e.g. Den Hartog, Trans. ASME 53, 1931)."""
    mass, k, grip, x0, n = 50.0, 5e4, 12.0, 1.9e-3, 2048
    w, off = np.sqrt(k / mass), grip / k
    elements = [core.element("stiffness", k_n_per_m=k), sharp(fc_n=grip)]
    motion = body(mass, elements, np.zeros(n), cases.FS, (x0, 0.0), substeps=16)
    t, x, from_s, at = np.arange(n) / cases.FS, np.full(n, np.nan), 0.0, x0
    while abs(at) > off:
        middle = np.sign(at) * off
        part = (t >= from_s) & (t <= from_s + np.pi / w)
        x[part] = middle + (at - middle) * np.cos(w * (t[part] - from_s))
        from_s, at = from_s + np.pi / w, 2.0 * middle - at
    x[t > from_s] = at
    assert motion.x == pytest.approx(x, abs=1e-3 * x0)
    assert np.ptp(motion.x[t > from_s + 0.01]) < 1e-9


@pytest.mark.parametrize(
    ("friction", "up", "down"),
    [
        (sharp(fc_n=80.0), 80.0, 80.0),
        (sharp("coulomb_uneven", fc_up_n=80.0, fc_down_n=50.0), 80.0, 50.0),
        (sharp("coulomb_uneven", fc_up_n=80.0, fc_down_n=0.0), 80.0, 0.0),
        (sharp("stribeck", fc_n=30.0, fs_n=80.0, vs_m_per_s=1e-3), 80.0, 80.0),
    ],
)
def test_a_body_that_stands_is_held_by_what_pushes_it_and_goes_when_that_is_more(
    friction, up, down
):
    mass, n = 20.0, 2048
    for force, grip in ((0.97, up), (-0.97, down), (1.03, up), (-1.03, down)):
        push = np.full(n, force * grip) if grip else np.full(n, force)
        motion = body(mass, [friction], push, cases.FS, substeps=4)
        gone = abs(motion.x[-1])
        assert gone < 1e-8 if abs(force) < 1.0 and grip else gone > 5e-3


def test_the_velocity_of_a_body_that_sticks_tells_the_force_that_holds_it():
    """Its friction is a law of velocity: along the simulated motion it is the same force."""
    mass, grip, width = 900.0, 400.0, 2e-6
    push = 0.9 * grip * np.sin(2 * np.pi * 0.7 * np.arange(3072) / cases.FS)
    friction = core.element("coulomb", fc_n=grip, width_m_per_s=width)
    motion = body(mass, [friction], push, cases.FS, substeps=4)
    held = grip * np.tanh(motion.v / width)
    assert held == pytest.approx(push - mass * motion.a, abs=2e-3 * grip)
    assert np.max(np.abs(motion.a)) < 1e-3 * grip / mass


def test_a_softer_loop_moves_as_the_model_that_has_its_stiffness():
    """An error of a yielding spring's stiffness is that of its whole loop."""
    n = 2048
    t = np.arange(n) / cases.FS
    push = 900.0 * np.sin(2 * np.pi * 1.5 * t)
    loop = ModelBoucWen(0.2, 3e-3, 2.0, 0.55, 0.45)
    model = Model("forced", cases.FS, 2e5, 300.0, 500.0, k_tol=0.01, c_tol=0.1, bouc_wen=loop)
    member = Member(effects.catalogue()["stiffness"], Trial())
    ranges = (1e-2, 0.1, 1.0)
    for share in (-0.3, 0.4):
        found = Augmented(model, model, (member,), (np.array([share]),), None, ranges)
        assert not found.elements()[2]
        moved = found.moved_by(push, 0.0, t, {}).x
        other = replace(model, k=(1.0 + share) * model.k)
        softer = Augmented(other, other, (), (), None, ranges).moved_by(push, 0.0, t, {}).x
        assert moved == pytest.approx(softer, abs=1e-9 * np.ptp(softer))


def test_a_narrow_step_ends_where_a_wide_one_tends_to():
    """Explicit steps, small enough, of ever narrower friction against the one that is solved."""
    mass, n = 50.0, 1024
    push = 60.0 * np.sin(2 * np.pi * 2.0 * np.arange(n) / cases.FS)
    spring = core.element("stiffness", k_n_per_m=5e4)
    solved = body(mass, [spring, sharp(fc_n=20.0)], push, cases.FS, substeps=16).x
    off = []
    for width in (8e-4, 2e-4):
        friction = core.element("coulomb", fc_n=20.0, width_m_per_s=width)
        assert 20.0 / (mass * 256 * cases.FS) < 0.01 * width
        explicit = body(mass, [spring, friction], push, cases.FS, substeps=256).x
        off.append(np.std(explicit - solved) / np.std(solved))
    assert off[1] < 0.4 * off[0] < 0.02


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e300])
@pytest.mark.parametrize(
    "element", [core.element("stiffness", k_n_per_m=1.0), sharp(fc_n=1.0)], ids=["spring", "grip"]
)
def test_a_force_that_is_no_number_does_not_pass_as_a_motion(bad, element):
    force = np.zeros(100)
    force[50] = bad
    with pytest.raises(SimulationError):
        body(1.0, [element], force, cases.FS)


def test_what_cannot_be_simulated_is_refused():
    with pytest.raises(SimulationError):
        actuator(ActuatorModel(0.0, -1.0, 1.0), np.zeros(10), cases.FS)
    with pytest.raises(SimulationError):
        actuator(LAG, np.r_[np.zeros(10), np.nan, np.zeros(90)], cases.FS)
    with pytest.raises(SimulationError):
        body(0.0, [], np.zeros(10), cases.FS)
    with pytest.raises(SimulationError):
        iwan(np.ones(33), np.ones(33), np.zeros(4))


def test_a_play_follows_after_its_gap_and_a_slider_slips_at_its_limit():
    x = np.array([0.0, 1.0, 2.0, 1.5, 0.0, -3.0])
    assert play(1.0, x) == pytest.approx([0.0, 0.0, 1.0, 1.0, 1.0, -2.0])
    assert iwan(np.array([1.0]), np.array([1.0]), x) == pytest.approx(x - play(1.0, x))


def test_bouc_wen_is_that_of_the_interchange_format():
    loop = ModelBoucWen(0.2, 3e-3, 2.0, 0.55, 0.45)
    x = 8e-3 * np.sin(np.linspace(0.0, 20.0, 60000))
    force = core.CoreElement(loop.element(4e5)).run(x)
    z, expected = 0.0, np.zeros(x.size)
    for i in range(1, x.size):
        dx = x[i] - x[i - 1]
        z += dx * (1.0 - abs(z / loop.xy) ** loop.n * (0.55 + 0.45 * np.sign(dx * z)))
        expected[i] = 4e5 * (0.2 * x[i] + 0.8 * z)
    assert np.max(np.abs(force - expected)) < 2e-3 * np.max(np.abs(expected))


def test_a_signal_is_shifted_by_parts_of_a_row():
    t = np.arange(400) / 100.0
    late = shifted(np.sin(2 * np.pi * t), 2.3)
    assert late[10:-10] == pytest.approx(np.sin(2 * np.pi * (t - 0.023))[10:-10], abs=1e-5)


def test_noise_is_read_off_under_a_motion():
    noisy = cases.command() * 1e5 + 3.0 * np.random.default_rng(0).standard_normal(8192)
    assert white_noise(noisy) == pytest.approx(3.0, rel=0.05)
