"""The multi-axial benchmark: its frames and plant, its criteria, what is published of it, and how
this program's own compensation does."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from command_line import Rthyb
from kernels import Floats

from rthyb_rt.benchmark import marths, marths_laws, marths_table
from rthyb_rt.benchmark import marths_frame as frame
from rthyb_rt.benchmark.marths import MarthsRun
from rthyb_rt.core.coupled_plant import CoupledPlant
from rthyb_rt.errors import InputError


def of(figures: dict[str, float], name: str) -> list[float]:
    return [figures[f"{name}.{i + 1}"] for i in range(marths.COUNTS[name])]


# ---- frames --------------------------------------------------------------------------------------


def test_the_frame_has_fourteen_freedoms_without_mass_and_its_published_frequencies() -> None:
    whole = frame.reference()
    massive = np.diag(whole.mass) > 0
    assert np.count_nonzero(~massive) == 14
    k = whole.stiffness
    inner = np.linalg.solve(k[np.ix_(~massive, ~massive)], k[np.ix_(~massive, massive)])
    condensed = k[np.ix_(massive, massive)] - k[np.ix_(massive, ~massive)] @ inner
    squares = scipy.linalg.eigh(condensed, whole.mass[np.ix_(massive, massive)], eigvals_only=True)
    assert np.allclose(np.sqrt(squares[:3]) / (2 * np.pi), [2.29, 12.75, 26.28], atol=0.01)


def test_what_is_taken_out_is_not_what_makes_the_forces() -> None:
    mass, _, stiffness = frame.bay()
    k, _, m = frame.specimen()
    assert mass[0, 0] == pytest.approx(902.5, abs=0.1)
    assert m[0, 0] == pytest.approx(8.45, abs=0.01)
    assert k[0, 0] < 0.6 * stiffness[0, 0]


def test_the_specimen_is_the_frame_with_pinned_feet_whose_other_joint_follows() -> None:
    """By the stiffnesses of a column with a pinned foot, 3 E I, and of a beam, 4 and 2 E I."""
    column = 3.0 * 200e9 * 0.7 * 2.52 * 0.0254**4
    beam = 200e9 * 4.21372e-7 / 0.762
    height = 0.64135
    joint = column / height + 4.0 * beam
    side = column / height**2
    whole = np.array(
        [[2 * side / height, side, side], [side, joint, 2 * beam], [side, 2 * beam, joint]]
    )
    wanted = whole[:2, :2] - np.outer(whole[:2, 2], whole[2, :2]) / joint
    k, c, m = frame.specimen()
    assert np.allclose(k[:2], wanted, rtol=1e-9)
    # The other joint is free: no moment acts on it.
    assert np.abs(k[2]).max() < 1e-9 * k[1, 1]
    assert (np.diag(c[:2]) > 0).all()
    assert np.abs(m[0, 1]) < 1e-9


def test_the_numerical_part_and_the_bay_are_the_reference() -> None:
    part, whole = frame.numerical(), frame.reference()
    where = np.ix_(frame.INTERFACE, frame.INTERFACE)
    pairs = ((part.damping, whole.damping), (part.stiffness, whole.stiffness))
    for (own, total), out in zip(pairs, frame.bay()[1:], strict=True):
        restored = own.copy()
        restored[where] += out
        assert np.allclose(restored, total, rtol=0, atol=1e-9 * np.abs(total).max())
    assert part.mass[frame.X, frame.X] == whole.mass[frame.X, frame.X] - frame.bay()[0][0, 0]


# ---- plant ---------------------------------------------------------------------------------------


def test_the_plant_has_its_published_gains_at_rest_and_delays_at_one_hertz() -> None:
    a, b, c = frame.plant_matrices(None)
    at_rest = -c @ np.linalg.solve(a, b)
    assert np.allclose(at_rest, [[0.864, 0.131], [0.140, 0.926]], atol=5e-4)
    s = 2j * np.pi
    slow = c @ np.linalg.solve(s * np.eye(8) - a, b)
    delays_ms = -1e3 * np.angle(np.diag(slow)) / (2 * np.pi)
    assert np.allclose(delays_ms, [61, 24], atol=1.0)


def test_the_plant_is_the_product_of_its_zeros_and_poles() -> None:
    f = np.array([0.5, 3.0, 17.0, 80.0])
    s, turn = 2j * np.pi * f, 2 * np.pi
    pair = (s / turn + 50) ** 2 + 63**2
    first = (s + 120 * turn) * (s + 90 * turn) / ((s + 2.65 * turn) * (s + 40 * turn))
    second = 1 / ((s + 3.5 * turn) * (s + 18.5 * turn))
    wanted = np.array(
        [
            [2165.2 * first, 4.5394e6 * second * (s + 3 * turn)],
            [349.95 * first, 1.9238e7 * second * (s + 5 * turn)],
        ]
    ) / (pair * turn**2)
    a, b, c = frame.plant_matrices(None)
    found = np.array([c @ np.linalg.solve(one * np.eye(8) - a, b) for one in s])
    assert np.allclose(found.transpose(1, 2, 0), wanted, rtol=1e-9)


def test_a_held_command_goes_through_the_plant_as_scipy_has_it() -> None:
    rig = frame.plant(None, 1, 0.0)
    exact, by_input, *_ = scipy.signal.cont2discrete(
        (*frame.plant_matrices(None), np.zeros((2, 2))), frame.PERIOD_S
    )
    # ode4's series ends after the fourth power of a sample: poles of 80 Hz times 2 pi / 1024 Hz.
    assert np.abs(rig.a - exact).max() < 1e-2 * np.abs(exact).max()
    u = np.cumsum(np.random.default_rng(1).normal(size=(3000, 2)), axis=0) * 1e-5
    _, wanted, _ = scipy.signal.dlsim((exact, by_input, rig.c, np.zeros((2, 2)), frame.PERIOD_S), u)
    x, _ = CoupledPlant(rig).run(u)
    assert np.abs(x - wanted).max() < 1e-3 * np.abs(wanted).max()


def test_perturbed_plants_are_as_far_off_as_stated_and_keep_their_gains_at_rest() -> None:
    many = [frame.roots(seed) for seed in range(2000)]
    for name, deviation in frame.DEVIATIONS.items():
        share = np.array([one[name] / frame.ROOTS[name] for one in many])
        assert np.abs(share.imag).max() < 1e-12
        assert share.real.std() == pytest.approx(deviation, rel=0.06)
    nominal = frame.plant_matrices(None)
    at_rest = -nominal[2] @ np.linalg.solve(nominal[0], nominal[1])
    for seed in frame.SEEDS:
        a, b, c = frame.plant_matrices(seed)
        assert np.allclose(-c @ np.linalg.solve(a, b), at_rest, rtol=1e-9)
        assert np.linalg.eigvals(a).real.max() < 0
    assert frame.roots(8001) == frame.roots(8001) != frame.roots(8002)
    for name, root in frame.roots(8003, 3.0).items():
        once = frame.roots(8003)[name] / frame.ROOTS[name] - 1.0
        assert root / frame.ROOTS[name] - 1.0 == pytest.approx(3.0 * once, rel=1e-9)
    assert all(
        np.linalg.eigvals(frame.plant_matrices(seed, 3.0)[0]).real.max() < 0 for seed in frame.SEEDS
    )


# ---- integration ---------------------------------------------------------------------------------


def test_newmark_gives_what_an_exact_solution_gives() -> None:
    """Of the massive freedoms, by the matrix exponential of the condensed frame."""
    whole = frame.reference()
    ag = marths.ground_motion("elcentro")[:8192]
    massive = np.diag(whole.mass) > 0
    fine = frame.Newmark(whole, frame.PERIOD_S / 8)
    finer = fine.run(np.interp(np.arange(8 * ag.size) / 8, np.arange(ag.size), ag))[::8]
    found = frame.Newmark(whole).run(ag)
    error = np.abs(found - finer)[:, massive].max() / np.abs(finer).max()
    assert error < 1e-3


@pytest.mark.long
@pytest.mark.parametrize("law", ["none", "rodeac", "matrix-inverse"])
def test_kr_alpha_and_newmark_agree_on_the_response(law: str) -> None:
    runs = [
        marths.simulate(MarthsRun(law, "elcentro", integrator=integrator, noisy=False))
        for integrator in marths.PARTS
    ]
    one, other = (found.displacement[:, list(frame.UPPER.values())] for found in runs if found)
    assert (one - other).std() < 0.015 * one.std()


# ---- criteria ------------------------------------------------------------------------------------


def test_the_delay_is_the_lag_of_the_largest_correlation_of_either_sign() -> None:
    rng = np.random.default_rng(5)
    x = np.convolve(rng.normal(size=4000), np.ones(20), "same")
    for late in (0, 3, 41):
        assert marths._delay(x, np.concatenate([np.zeros(late), x])[: x.size]) == late
        assert marths._delay(x, -np.concatenate([np.zeros(late), x])[: x.size]) == late
    early = np.concatenate([x[7:], np.zeros(7)])
    assert marths._delay(x, early) == -7
    assert marths._delay(np.zeros(50), np.zeros(50)) == 0


def signals(error: float) -> marths.MarthsSignals:
    """A run whose readings are all wrong by so much of their size, without noise."""
    as_one = marths.joined("elcentro")
    node = marths._node(as_one)
    target, _ = frame.kinematics().axes(node)
    found = marths.MarthsSignals.of(len(target))
    rows = zip(target, node, as_one, strict=True)
    for n, (axes, pose, x) in enumerate(rows):
        found.put(n, (axes, (1 + error) * axes, axes, axes, pose, x, np.zeros(3)))
    return found


@pytest.mark.long
def test_figures_of_a_run_that_is_wrong_by_a_known_share() -> None:
    figures = marths.figures(MarthsRun("none", "elcentro"), signals(0.02))
    for name in ("J2", "J3"):
        assert of(figures, name) == pytest.approx([2.0, 2.0], rel=1e-9)
    for name in ("J5", "J6", "true", "joined", "joined-upper", "J1", "force"):
        assert of(figures, name) == pytest.approx([0.0] * marths.COUNTS[name], abs=1e-9)
    # The floor: the frame that is taken out is not the one that makes the forces.
    assert min(of(figures, "J7")) > 5.0
    assert min(of(figures, "J8")) > 5.0
    names = [f"{name}.{i + 1}" for name, count in marths.COUNTS.items() for i in range(count)]
    assert list(figures) == names


@pytest.mark.long
def test_forces_of_the_actuators_do_the_specimens_work() -> None:
    found = signals(0.0)
    for n in range(len(found.force)):
        found.force[n] = (1000.0, 25.4, 0.0)
    forces = marths.actuator_forces(found)
    assert np.allclose(forces.sum(axis=1), 1000.0, rtol=1e-9)
    # By hand: the slope of d (cos(theta -+ a) - cos a) is the lever arm of an actuator.
    theta = found.pose[:, 1]
    arms = [-frame.ARM_M * np.sin(theta + side * frame.ARM_RAD) for side in (-1, 1)]
    moment = forces[:, 0] * arms[0] + forces[:, 1] * arms[1]
    assert np.allclose(moment, 25.4, rtol=1e-9)


# ---- what is known of it -------------------------------------------------------------------------


@pytest.mark.long
def test_without_compensation_the_actuators_err_by_half() -> None:
    figures = marths.measure(MarthsRun("none", "elcentro")).figures
    assert of(figures, "J2") == pytest.approx([53, 32.5], abs=0.5)
    assert of(figures, "J5") == pytest.approx([39, 12.5], abs=0.6)
    assert of(figures, "J7") == pytest.approx([36, 11.3], abs=0.5)
    assert of(figures, "joined") == pytest.approx([39, 13], abs=0.5)
    assert of(figures, "J1") == pytest.approx([40, 23.4], abs=0.1)


@pytest.mark.long
def test_rodeac_is_what_another_derivation_of_it_is() -> None:
    """Figures of a simulation of ours that shares nothing with this one but the sources."""
    quiet = marths.measure(MarthsRun("rodeac", "elcentro", noisy=False)).figures
    assert of(quiet, "J2") == pytest.approx([0.92, 1.11], abs=0.02)
    figures = marths.measure(MarthsRun("rodeac", "elcentro")).figures
    assert of(figures, "J2") == pytest.approx([3.4, 1.8], abs=0.1)
    assert of(figures, "J5") == pytest.approx([1.65, 5.2], abs=0.1)
    assert of(figures, "J7") == pytest.approx([9.6, 8.5], abs=0.1)


@pytest.mark.long
@pytest.mark.parametrize("integrator", marths.PARTS)
@pytest.mark.parametrize("plant", [marths.NOMINAL, *frame.SEEDS])
def test_our_own_keeps_to_what_is_wanted_of_it(plant: int, integrator: str) -> None:
    """J2 of 3.3 and 2.0 % is wanted on the nominal plant; 3.5 and 2.2 % would do on the worst."""
    figures = marths.measure(MarthsRun("matrix-inverse", "elcentro", plant, integrator)).figures
    first, second = of(figures, "J2")
    assert first <= 3.3
    assert second <= 2.0
    assert max(of(figures, "joined-upper")) <= 0.7
    assert max(of(figures, "command")) <= 8.0


def test_matrices_undo_what_axes_by_themselves_cannot() -> None:
    alone, together = (
        of(marths.measure(MarthsRun(law, "elcentro", noisy=False)).figures, "J2")
        for law in ("lead", "matrix-inverse")
    )
    assert together[0] < 0.2 * alone[0]
    assert together[1] < 0.3 * alone[1]


def test_a_run_that_goes_unstable_ends_and_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    class Wrong(marths_laws.Nothing):
        def lead(self, target_m: Floats) -> Floats:
            return -40.0 * target_m

    monkeypatch.setattr(frame, "STROKE_M", 1e3)
    monkeypatch.setattr(marths_laws, "compensation", lambda name: Wrong())
    outcome = marths.measure(MarthsRun("none", "elcentro"))
    assert not outcome.completed
    line = marths_table.lines([outcome])[0]
    assert line.unstable == 1
    assert marths_table.cells(line, marths_table.BESIDE)[-1] == "1 of 1"


# ---- the command ---------------------------------------------------------------------------------


def test_unknown_names_are_refused() -> None:
    for arguments, says in (
        ((["best"], ["elcentro"], 0), "--law"),
        ((["none"], ["loma-prieta"], 0), "--motion"),
        ((["none"], ["elcentro"], 21), "--plants"),
        ((["none"], ["elcentro"], 0, "euler"), "--integrator"),
    ):
        with pytest.raises(InputError, match=says):
            marths.planned(*arguments)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="--law: found lead twice; give each value once"):
        marths.planned(["lead", "none", "lead"], ["kobe"], 0)
    assert len(marths.planned(["none", "lead"], ["kobe"], 20)) == 42


def test_a_width_beyond_any_plant_is_refused(rthyb: Rthyb) -> None:
    for width in ("4", "-1", "nan"):
        done = rthyb("benchmark", "marths", "--width", width)
        assert done.code != 0
        assert "must be above 0, up to 3" in done.err


def test_a_width_without_any_spread_is_refused_with_what_it_would_do(rthyb: Rthyb) -> None:
    done = rthyb("benchmark", "marths", "--width", "0")
    assert done.code != 0
    assert "would draw the nominal" in " ".join(done.err.split())


def test_worst_plants_stand_behind_the_mean() -> None:
    runs = marths.planned(["none"], ["elcentro"], 2)
    one = marths.measure(runs[0])
    many = [replace(one, run=run, figures={k: v * f for k, v in one.figures.items()})
            for run, f in zip(runs, (1.0, 1.1, 0.9), strict=True)]  # fmt: skip
    line = marths_table.lines(many)[0]
    mean, worst = of(dict(line.mean), "J2"), of(dict(line.worst), "J2")
    assert mean == pytest.approx(of(one.figures, "J2"))
    assert worst == pytest.approx([1.1 * value for value in mean])
    cell = marths_table.cells(line, ["J2"])[0]
    assert re.fullmatch(r"53\.0/32\.5 \(58\.3/35\.8\)", cell)


def test_the_command_prints_tables_and_json(rthyb: Rthyb) -> None:
    done = rthyb("benchmark", "marths", "--law", "none", "--plants", "1", "--jobs", "1", "--json")
    document = json.loads(done.out)
    assert document["benchmark"] == "marths"
    assert [run["plant"] for run in document["runs"]] == [0, 8001]
    assert document["lines"][0]["mean"]["J2.1"] == pytest.approx(53, abs=2)
    assert "joined upper" in done.err
