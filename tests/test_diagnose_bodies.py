"""What the diagnosis says of bodies that move freely, on moving ground or under a force."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import diagnose_cases as cases
import numpy as np
import pytest
from diagnose_answers import diagnosed, found, holds
from scipy import optimize, signal

from rthyb_rt.diagnose import effects, engine, force, freebody, motion_evaluated, reading, remainder
from rthyb_rt.diagnose.case import Case
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Member, ResidualProblem
from rthyb_rt.diagnose.refinement import refine, solve

MASS, SPRING, DASHPOT = 6700.0, 4.5e5, 3600.0


def rows(seconds: float) -> int:
    return round(seconds * cases.FS)


def free_body(
    x: np.ndarray, push: np.ndarray, a: np.ndarray, x_std: float = 4e-6, f_std: float = 0.4
) -> tuple[dict[str, np.ndarray], str]:
    """Return the columns of a recording of a body under a force, and its model."""
    rng = np.random.default_rng(7)
    n = x.size
    columns = {
        "t": np.arange(n) / cases.FS,
        "f_in": push,
        "x_meas": x + x_std * rng.standard_normal(n),
        "a_meas": a + 5e-3 * rng.standard_normal(n),
    }
    model = cases.baseline(
        family='"forced"', k=SPRING, c=DASHPOT, moving_mass=MASS, c_tol=0.1
    ).replace(f"f_std = {cases.F_STD}", f"f_std = {f_std}")
    head, _, tail = model.partition("[actuator]")
    return columns, head + "[noise]" + tail.partition("[noise]")[2]


def of_a_free_body(x: np.ndarray, push: np.ndarray, a: np.ndarray, folder: Path, **noise: float):
    return diagnosed(folder, *free_body(x, push, a, **noise))


EITHER = [pytest.param("inertia", marks=pytest.mark.long), "stiffness"]


@pytest.mark.parametrize("missing", EITHER)
def test_a_body_under_a_sine_of_force_does_not_tell_mass_from_stiffness(missing, tmp_path):
    """The closed form of the steady state: only k - m w^2 is in it."""
    w = 2 * np.pi * 0.9
    k, m = (SPRING, 1.25 * MASS) if missing == "inertia" else (0.9 * SPRING, MASS)
    t = np.arange(rows(12.0)) / cases.FS
    swing = 1200.0 / (k - m * w**2 + 1j * DASHPOT * w) * np.exp(1j * w * t)
    push = 1200.0 * np.cos(w * t)
    d = of_a_free_body(swing.real, push, -(w**2) * swing.real, tmp_path)
    assert d.verdict == "ambiguous"
    assert sorted(d.ambiguous_with) == [["inertia"], ["stiffness"]]


@pytest.mark.long
@pytest.mark.parametrize("missing", EITHER)
def test_a_body_under_a_sweep_of_force_tells_mass_from_stiffness(missing, tmp_path):
    n = rows(16.0)
    t = np.arange(n) / cases.FS
    k, m = (SPRING, 1.25 * MASS) if missing == "inertia" else (0.87 * SPRING, MASS)
    ramp = np.clip(t / 0.5, 0, 1) * np.clip((t[-1] - t) / 0.5, 0, 1)
    push = 900.0 * ramp * np.sin(2 * np.pi * (0.3 * t + 0.1 * t**2))
    system = signal.StateSpace(
        [[0, 1], [-k / m, -DASHPOT / m]], [[0], [1 / m]], np.eye(2), np.zeros((2, 1))
    )
    _, y, _ = signal.lsim(system, push, t)
    d = of_a_free_body(y[:, 0], push, (push - k * y[:, 0] - DASHPOT * y[:, 1]) / m, tmp_path)
    assert (d.verdict, d.effects) == ("explained", [missing])


@pytest.mark.long
def test_what_the_balance_of_forces_would_lose_shows_in_the_motion(tmp_path):
    """A relaxation that is nearly a dashpot, beside a dashpot known to a tenth."""
    n = rows(10.0)
    t = np.arange(n) / cases.FS
    km, tau = 6.0e4, 0.03
    push = 900.0 * np.clip(t / 0.5, 0, 1) * np.sin(2 * np.pi * (0.3 * t + 0.2 * t**2))
    system = signal.StateSpace(
        [[0, 1, 0], [-SPRING / MASS, -DASHPOT / MASS, -1 / MASS], [0, km, -1 / tau]],
        [[0], [1 / MASS], [0]], np.eye(3), np.zeros((3, 1)),
    )  # fmt: skip
    _, y, _ = signal.lsim(system, push, t)
    a = (push - SPRING * y[:, 0] - DASHPOT * y[:, 1] - y[:, 2]) / MASS
    d = of_a_free_body(y[:, 0], push, a, tmp_path)
    assert (d.verdict, d.effects) == ("explained", ["maxwell"])
    # Beside a dashpot of a tenth more or less, stiffness and time alone are not known to a tenth.
    assert holds(d, "maxwell", "km_N_m", km)
    assert holds(d, "maxwell", "tau_s", tau)


FINE = 64
"""Steps of a simulated body in a row."""


def moved_body(push, law, mass: float, n: int, friction=lambda v: 0.0):
    """Return x and a of a body by symplectic Euler steps, from rest: (n,) each.

    ``push`` has the force of each step, ``law(x, v)`` is that of the specimen, ``friction(v)`` the
    level of dry friction, of which no more acts than stops the body.
    """
    h = 1.0 / (FINE * cases.FS)
    x = v = 0.0
    out = np.empty((n, 2))
    for i in range(n * FINE):
        free = push[i] - law(x, v)
        # A body that friction could stop within the step is stopped: it sticks.
        grip = friction(v)
        need = free + mass * v / h
        a = (free - min(max(need, -grip), grip)) / mass
        if i % FINE == 0:
            out[i // FINE] = x, a
        v += h * a
        x += h * v
    return out[:, 0], out[:, 1]


def swept(n: int, f0: float, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a swept sine at the rows and at the steps between, of amplitude one."""
    fine = np.arange(n * FINE) / (FINE * cases.FS)
    rise = np.clip(fine / 0.5, 0, 1)
    wave = rise * np.sin(2 * np.pi * (f0 * fine + rate * fine**2))
    return wave[::FINE], wave


@pytest.mark.long
def test_a_mass_beside_a_play_of_a_body_under_a_force_is_named_too(tmp_path):
    """What an estimate may blur of the mass is half a per cent, and no fifteen."""
    n, gap = rows(10.0), 1.5e-4
    push, fine = swept(n, 0.3, 0.12)
    x, a = moved_body(
        900.0 * fine,
        lambda x, v: SPRING * (x - min(max(x, -gap), gap)) + DASHPOT * v,
        1.15 * MASS,
        n,
    )
    d = of_a_free_body(x, 900.0 * push, a, tmp_path, x_std=1.5e-6, f_std=0.15)
    assert (d.verdict, sorted(d.effects)) == ("explained", ["gap", "inertia"])
    assert found(d, "inertia", "m_kg") == pytest.approx(0.15 * MASS, rel=0.05)
    assert found(d, "gap", "gap_m") == pytest.approx(gap, rel=0.05)


@pytest.mark.long
@pytest.mark.parametrize(
    ("way_m", "name"),
    [(1.2e-5, "coulomb"), (3.6e-5, "coulomb"), (6e-5, "lugre"), (4e-4, "lugre")],
    ids=["contact", "contact at its limit", "bristle at its limit", "bristle"],
)
def test_friction_of_a_body_is_dry_if_its_contact_shears_little_before_it_slips(
    way_m, name, tmp_path
):
    """The limit is four thousandths of the amplitude of 12 mm."""
    n, fc, z = rows(10.0), 70.0, [0.0, 0.0]
    push, fine = swept(n, 0.3, 0.12)

    def law(x, v):
        z[0] = min(max(z[0] + x - z[1], -way_m), way_m)
        z[1] = x
        return SPRING * x + DASHPOT * v + fc / way_m * z[0]

    x, a = moved_body(900.0 * fine, law, MASS, n)
    d = of_a_free_body(x, 900.0 * push, a, tmp_path, x_std=1.5e-6, f_std=0.15)
    assert (d.verdict, d.effects) == ("explained", [name])
    assert found(d, name, "Fc_N") == pytest.approx(fc, rel=0.01)


@pytest.mark.long
def test_yielding_of_a_body_that_the_balance_proposes_is_compared_by_its_motion(tmp_path):
    """A smooth loop, k (alpha x + (1 - alpha) z) with z' = v (1 - |z / xy|^2) while it loads."""
    n, xy, alpha, z = rows(10.0), 5e-3, 0.85, [0.0]
    push, fine = swept(n, 0.3, 0.12)
    h = 1.0 / (FINE * cases.FS)

    def law(x, v):
        at = z[0]
        z[0] += h * v * (1.0 - (0.5 + 0.5 * math.copysign(1.0, v * at)) * (at / xy) ** 2)
        return SPRING * (alpha * x + (1.0 - alpha) * z[0]) + DASHPOT * v

    x, a = moved_body(900.0 * fine, law, MASS, n)
    d = of_a_free_body(x, 900.0 * push, a, tmp_path, x_std=1.5e-6, f_std=3.0)
    assert (d.verdict, d.effects) == ("explained", ["hysteresis"])
    assert found(d, "hysteresis", "xy_m") == pytest.approx(xy, rel=0.05)
    assert found(d, "hysteresis", "alpha") == pytest.approx(alpha, rel=0.02)


def of_a_shaken_body(x, a, ag, folder: Path, x_std: float, f_std: float):
    rng = np.random.default_rng(5)
    n = x.size
    columns = {
        "t": np.arange(n) / cases.FS,
        "ag": ag,
        "x_meas": x + x_std * rng.standard_normal(n),
        "f_meas": -MASS * (a + ag) + f_std * rng.standard_normal(n),
    }
    model = cases.baseline(family='"ground"', k=SPRING, c=DASHPOT, moving_mass=0.0)
    model = model.replace(f"f_std = {cases.F_STD}", f"f_std = {f_std}")
    model = model.replace(f"x_std = {cases.X_STD}", f"x_std = {x_std}")
    head, _, tail = model.partition("[actuator]")
    noise = f"[numerical]\nm = {MASS}\n[noise]" + tail.partition("[noise]")[2]
    return diagnosed(folder, columns, head + noise)


@pytest.mark.long
def test_a_body_that_stands_still_most_of_the_time_is_told_by_its_friction(tmp_path):
    """Three fifths of the load hold it, and a displacement of a thousand times its noise."""
    n, peak = rows(10.0), 0.15
    shake, fine = swept(n, 0.5, 0.1)
    grip = 0.6 * MASS * peak
    x, a = moved_body(
        -MASS * peak * fine, lambda x, v: SPRING * x + DASHPOT * v, MASS, n, lambda v: grip
    )
    d = of_a_shaken_body(x, a, peak * shake, tmp_path, 1e-3 * float(np.std(x)), 3.0)
    assert (d.verdict, d.effects) == ("explained", ["coulomb"])
    # The misfit has minima from 600 to 608 N within 3.6 of chi-squared, which the interval must
    # span as far as they are found: that depends on where the search begins.
    low, high = d.candidates[0].ci95["Fc_N"]
    assert low < grip < high
    assert high - low < 0.02 * grip


@pytest.mark.long
def test_a_stop_beside_sticking_friction_on_moving_ground_shows_in_the_motion(tmp_path):
    """A friction with a peak, before a noisy cell: no estimate follows a body that sticks."""
    n, fc, fs, vs, ks, xs = rows(12.0), 245.0, 590.0, 4e-3, 2.5e5, 9e-3
    shake, fine = swept(n, 0.5, 0.1)
    x, a = moved_body(
        -MASS * 0.15 * fine,
        lambda x, v: SPRING * x + DASHPOT * v + ks * (x - min(max(x, -xs), xs)),
        MASS,
        n,
        lambda v: fc + (fs - fc) * math.exp(-((v / vs) ** 2)),
    )
    d = of_a_shaken_body(x, a, 0.15 * shake, tmp_path, 7e-6, 100.0)
    assert (d.verdict, sorted(d.effects)) == ("explained", ["stopper", "stribeck"])
    assert found(d, "stopper", "xs_m") == pytest.approx(xs, rel=0.05)
    assert found(d, "stribeck", "Fc_N") == pytest.approx(fc, rel=0.1)


@pytest.mark.parametrize(
    ("missed", "known"), [(0.0, True), pytest.param(0.5, False, marks=pytest.mark.long)]
)
def test_a_body_that_moves_as_simulated_lacks_no_force_whatever_its_sensors_hum(
    missed, known, tmp_path
):
    """Slow noise of the displacement makes a force that nothing pushes with."""
    n = rows(12.0)
    t = np.arange(n) / cases.FS
    push = 900.0 * np.clip(t / 0.5, 0, 1) * np.sin(2 * np.pi * (0.3 * t + 0.1 * t**2))
    system = signal.StateSpace(
        [[0, 1], [-SPRING / MASS, -DASHPOT / MASS]], [[0], [1 / MASS]], np.eye(2), np.zeros((2, 1))
    )
    # A force of its own timing, that no law of the motion has.
    other = missed * 90.0 * np.sign(np.sin(2 * np.pi * 0.37 * t**1.2))
    _, y, _ = signal.lsim(system, push - other, t)
    a = (push - other - SPRING * y[:, 0] - DASHPOT * y[:, 1]) / MASS
    rng = np.random.default_rng(3)
    slow = signal.lfilter([1.0], [1.0, -0.995], rng.standard_normal(n))
    slow *= 1e-6 / np.std(slow)
    d = of_a_free_body(y[:, 0] + slow, push, a + 50.0 * slow, tmp_path, x_std=3e-7)
    assert (d.verdict == "none") == known


def proposed(case: Case, name: str, shape: Trial | None = None) -> force.Search:
    """Return a law in a form, as if the force balance had named it."""
    motion = motion_evaluated.motion_of(case, None)
    assert motion is not None
    law = effects.catalogue()[name]
    problem = ResidualProblem(case, motion_evaluated.context_of(case, motion), motion, [law])
    null, best = solve(problem, [], []), refine(problem, [Member(law, shape or Trial())])
    assert null is not None
    assert best is not None
    return force.Search(problem, null, [best], best, [], 1.0, 1.0, 1.0, 1.0, 1.0)


@pytest.mark.long
def test_a_law_from_the_balance_of_forces_is_judged_by_the_motion_that_it_makes(tmp_path):
    """A hardening spring makes its body's motion to the noise; a damper in its place does not.

    What the model alone leaves is compared with scipy's fit of a linear body.
    """
    n, k3, x_std = rows(8.0), 4e7, 4e-6
    push, fine = swept(n, 0.5, 0.1)
    x, a = moved_body(900.0 * fine, lambda x, v: SPRING * x + k3 * x**3 + DASHPOT * v, MASS, n)
    columns, model = free_body(x, 900.0 * push, a, x_std)
    recording, toml = cases.write(tmp_path, columns, model)
    case = reading.read_case(recording, reading.read_model(toml))
    made = {}
    for name in ("cubic", "quad_damping"):
        search = proposed(case, name)
        made[name] = remainder.reproduced(search, search.problem.ctx)
    right, wrong = made["cubic"], made["quad_damping"]
    assert right is not None
    assert wrong is not None
    assert right.after == pytest.approx(0.0, abs=0.1)
    assert wrong.after > 0.3 * wrong.before

    def linear(p: np.ndarray) -> np.ndarray:
        """Return the misfit of a linear body in noise, and of its priors as the model has them."""
        k, c, mass = SPRING * p[0], DASHPOT * p[1], MASS * p[2]
        body = signal.StateSpace(
            [[0, 1], [-k / mass, -c / mass]], [[0], [1 / mass]], np.eye(2), np.zeros((2, 1))
        )
        _, y, _ = signal.lsim(body, 900.0 * push, columns["t"], p[3:5])
        late = y[:, 0] - 5e-5 * p[5] * y[:, 1]
        prior = [(p[0] - 1) / 0.01, (p[1] - 1) / 0.1, (p[2] - 1) / POLICY.mass_blur, p[5]]
        return np.r_[(columns["x_meas"] - late) / x_std, prior]

    reach = POLICY.nuisance_reach * np.array([POLICY.mass_blur, 1.0])
    far = np.array([0.5, 0.9, reach[0], 0.1, 1.0, reach[1]])
    start = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    scale = [0.01, 0.1, 0.01, 1e-4, 1e-3, 1.0]
    least = optimize.least_squares(linear, start, bounds=(start - far, start + far), x_scale=scale)
    assert right.before == pytest.approx(wrong.before, rel=1e-3)
    # A fit far above the noise ends where a step gains little: see `freebody.LITTLE`.
    assert 0.98 < right.before / (2.0 * least.cost / n - 1.0) < 1.5


@pytest.mark.long
def test_force_that_was_lost_for_a_moment_is_fitted_with_the_motion_that_it_made(tmp_path):
    """Three gaps of up to a tenth of a second, near resonance: a line across them is felt long."""
    n = rows(8.0)
    push, fine = swept(n, 0.5, 0.1)
    x, a = moved_body(900.0 * fine, lambda x, v: SPRING * x + 4e7 * x**3 + DASHPOT * v, MASS, n)
    columns, model = free_body(x, 900.0 * push, a)
    for first, after in ((400, 424), (900, 926), (1500, 1512)):
        for name in ("f_in", "x_meas", "a_meas"):
            columns[name][first:after] = np.nan
    recording, toml = cases.write(tmp_path, columns, model)
    case = reading.read_case(recording, reading.read_model(toml))
    for name, known in (("cubic", True), ("quad_damping", False)):
        search = proposed(case, name)
        made = remainder.reproduced(search, search.problem.ctx)
        assert made is not None
        assert (made.after < 0.1) is known
        assert known or made.after > 0.3 * made.before
    d = engine.diagnose(case)
    assert (d.verdict, d.effects) == ("explained", ["cubic"])


def test_motion_with_friction_is_close_or_not_whatever_its_evidence_was_scaled_down_by(tmp_path):
    """Friction of a body under a force whose noise is recorded nowhere: near resonance it moves the
    body by more than the noise of its sensor, and by a thousandth of what friction does."""
    n, x_std = rows(8.0), 4e-6
    push, fine = swept(n, 0.5, 0.1)
    shaken = 15.0 * np.random.default_rng(3).standard_normal(n)
    felt = 900.0 * fine + np.repeat(shaken, FINE)
    x, a = moved_body(
        felt, lambda x, v: SPRING * x + 300.0 * math.tanh(v / 2e-4) + DASHPOT * v, MASS, n
    )
    columns, model = free_body(x, 900.0 * push, a, x_std)
    recording, toml = cases.write(tmp_path, columns, model)
    case = reading.read_case(recording, reading.read_model(toml))
    search = proposed(case, "coulomb")
    body = freebody.Body(case, search.problem.ctx)
    found = body.settled(search.problem, search.best)
    assert found is not None
    assert POLICY.motion_met < found.chi2 / body.rows.size < 50.0
    for fit in (found, replace(found, chi2=found.chi2 / 300.0)):
        assert body.motion(search.problem, fit) is not None
    # What correlated rows show beside another law may be a law that is missing.
    other = proposed(case, "quad_damping")
    wrong = body.settled(other.problem, other.best)
    assert wrong is not None
    for fit in (wrong, replace(wrong, chi2=1.0)):
        assert body.motion(other.problem, fit) is None


@pytest.mark.parametrize(
    "shape",
    [Trial((2.5e-3, 0.3), "impact both"), Trial((2.5e-3, 2e-4), "rough")],
    ids=["as if it lost energy", "as if its surface were rough"],
)
def test_hard_stop_is_simulated_as_one_whatever_an_estimated_motion_makes_of_it(shape, tmp_path):
    n, ks, xs = rows(8.0), 1e6, 2.5e-3
    push, fine = swept(n, 0.5, 0.1)
    x, a = moved_body(
        900.0 * fine,
        lambda x, v: SPRING * x + DASHPOT * v + ks * (x - min(max(x, -xs), xs)),
        MASS,
        n,
    )
    columns, model = free_body(x, 900.0 * push, a, 4e-6)
    recording, toml = cases.write(tmp_path, columns, model)
    case = reading.read_case(recording, reading.read_model(toml))
    search = proposed(case, "stopper", shape)
    body = freebody.Body(case, search.problem.ctx)
    assert search.best.members[0].trial.variant == shape.variant
    found_one = body.settled(search.problem, search.best)
    assert found_one is not None
    assert found_one.chi2 / body.rows.size < POLICY.motion_met
    assert found_one.members[0].trial.variant == "both"
    assert found_one.members[0].trial.theta == pytest.approx([xs], rel=1e-3)


def test_beside_dry_friction_each_law_is_tried_that_a_friction_which_falls_may_stand_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Friction that falls with velocity leads; damping is missing beside dry friction."""
    catalogue = effects.catalogue()

    def of(*names: str) -> SimpleNamespace:
        return SimpleNamespace(names=tuple(sorted(names)))

    def larger(dictionary: object, fit: SimpleNamespace, most: int) -> list[tuple[Member, ...]]:
        assert fit is dry
        added = ("quad_damping", "viscous", "stribeck", "bias")
        return [tuple(Member(catalogue[n], Trial()) for n in (*fit.names, own)) for own in added]

    monkeypatch.setattr(force, "larger", larger)
    dry, best, body = of("coulomb", "stiffness"), of("stiffness", "stribeck"), SimpleNamespace()
    known = {f.names: f for f in (dry, best, of("coulomb", "stiffness", "viscous"))}
    mover = SimpleNamespace(leading=best, by_names=known)

    def tried(held: bool = True) -> list[list[str]]:
        body.held = held
        sets = force.beside_dry_friction(None, body, mover)  # type: ignore[arg-type]
        return [sorted(m.name for m in members) for members in sets]

    damped = ["coulomb", "quad_damping", "stiffness"]
    # A load cell's effect does not move a body that is judged by its motion.
    assert tried() == [damped]
    assert tried(held=False) == [damped, ["bias", "coulomb", "stiffness"]]
    mover.leading = dry
    assert tried() == []
    mover.leading = of("stiffness", "stribeck", "viscous")
    assert tried() == []
