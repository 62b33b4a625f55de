"""Loops of several axes above the end of the sweep: the least response that makes them unstable.

Against the same for one axis, a search over phases, and a rig with a resonance above its sweep.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
from pathlib import Path

import numpy as np
import pytest

from rthyb_rt import config
from rthyb_rt.analysis import axes_roots, linear_parts, loop_roots, loop_stability, unseen_response
from rthyb_rt.analysis.axes_roots import Axes, AxesLoop, System, constant, on_each
from rthyb_rt.analysis.unseen_response import separate_specimens, structured_gain
from rthyb_rt.config import AxesRig
from rthyb_rt.config.matrix_response import MatrixResponse
from rthyb_rt.core.sparse import SparseConfig, Symmetric
from rthyb_rt.lab import axes_experiment, virtual_time
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.rig import identify_axes
from rthyb_rt.rig.identification import SweepPlan

H = 1.0 / 1024.0
FRAME = Path(__file__).parents[1] / "examples" / "two-actuator-frame.toml"
SWEPT_HZ = 40.0

Complexes = np.ndarray


# ---- the bound ----------------------------------------------------------------------------------


def some_matrices(count: int, size: int, seed: int) -> Complexes:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, size, size)) + 1j * rng.normal(size=(count, size, size))


def largest_eigenvalue(e: Complexes) -> float:
    return float(np.abs(np.linalg.eigvals(e)).max())


def test_one_axis_has_the_least_force_of_the_loop_of_one_axis() -> None:
    part = SparseConfig(
        Symmetric.of(np.array([[1800.0]])),
        Symmetric.of(np.array([[3e5]])),
        np.ones(1),
        (((0, 1.0),),),
        (9e5,),
        damping_n_s_per_m=Symmetric.of(np.array([[400.0]])),
        rho_inf=0.7,
        period_s=H,
    )
    step = linear_parts.LinearStep.of(part)
    block = loop_roots.Block(step.a, step.b[:, 0], step.c, np.zeros(1))
    lead = loop_roots.rational(np.array([9.0, -7.0, 0.0]), np.array([3.0, -2.0, 1.0]))
    beside = loop_roots.low_pass(30.0, H).weighted((9e5,))
    by_rig = loop_roots.gain(0.0)
    one = loop_roots.LinearLoop(block, by_rig, beside)
    # A lever doubles the motion of the interface.
    lever = constant(np.array([[2.0]])).then(on_each(lead, 1))
    both = AxesLoop(step, lever, constant(np.zeros((1, 1))), on_each(beside, 1))
    z = np.exp(2j * np.pi * np.geomspace(10.0, 80.0, 50) * H)
    expected = np.abs(one.without_rig(z) * 9e5 * lead.response(z)[:, 0])
    found = unseen_response.loop_gain(both, np.array([[9e5]]), np.array([[0.5]]), z, [[0]])
    np.testing.assert_allclose(found, expected, rtol=1e-10)


@pytest.mark.parametrize("size", [2, 3])
def test_no_response_below_the_bound_makes_the_loop_unstable_and_one_at_it_does(size: int) -> None:
    """Without structure: random responses, and a search over two complex directions."""
    rng = np.random.default_rng(4)
    for e in some_matrices(5, size, size):
        bound = 1.0 / float(structured_gain(e[None], [list(range(size))])[0])
        tried = some_matrices(3000, size, 17)
        tried /= np.linalg.norm(tried, 2, axis=(1, 2))[:, None, None]
        assert max(largest_eigenvalue(0.999 * bound * e @ d) for d in tried) < 1.0
        # D = bound b a^H has the eigenvalue bound a^H E b: improved one direction at a time.
        a = rng.normal(size=size) + 1j * rng.normal(size=size)
        for _ in range(400):
            b = e.conj().T @ a
            b /= np.linalg.norm(b)
            a = e @ b
            a /= np.linalg.norm(a)
        assert largest_eigenvalue(bound * e @ np.outer(b, a.conj())) == pytest.approx(1.0, rel=1e-6)


def most_over_phases(e: Complexes, blocks: list[list[int]], steps: int) -> float:
    """Return the largest eigenvalue of E D over responses of size 1 whose phases alone differ."""
    grid = np.exp(2j * np.pi * np.arange(steps) / steps)
    most = 0.0
    for first in grid:
        # A common phase changes no eigenvalue's magnitude.
        for second in grid if len(blocks) > 2 else [1.0]:
            d = np.ones(len(e), complex)
            for rows, phase in zip(blocks[1:], (first, second), strict=False):
                d[rows] = phase
            most = max(most, largest_eigenvalue(e * d))
    return most


@pytest.mark.parametrize(("size", "steps", "within"), [(2, 720, 1e-4), (3, 90, 5e-3)])
def test_separate_specimens_have_the_bound_of_a_search_over_their_phases(
    size: int, steps: int, within: float
) -> None:
    blocks = [[i] for i in range(size)]
    for e in some_matrices(4, size, 20 + size):
        # Units of the directions that differ, as metres and radians do.
        units = np.geomspace(1.0, 30.0, size)
        scaled = e * units[:, None] / units
        found = float(structured_gain(scaled[None], blocks)[0])
        searched = most_over_phases(scaled, blocks, steps)
        assert searched <= found * (1.0 + 1e-9)
        assert found == pytest.approx(searched, rel=within)
        whole = float(structured_gain(scaled[None], [list(range(size))])[0])
        assert found < 0.5 * whole


def test_a_block_of_two_directions_beside_another_is_between_both_bounds() -> None:
    for e in some_matrices(4, 3, 31):
        both = float(structured_gain(e[None], [[0, 1], [2]])[0])
        each, none = (
            float(structured_gain(e[None], blocks)[0]) for blocks in ([[0], [1], [2]], [[0, 1, 2]])
        )
        assert each <= both * (1.0 + 1e-6)
        assert both <= none * (1.0 + 1e-6)


# ---- which specimens are separate ---------------------------------------------------------------

TWO = """schema = "rthyb-rig/1"
[rig]
name = "two"
load_cell = "specimen"
[[axis]]
name = "left"
actuator = { kind = "pure-delay", delay_samples = 9 }
[[axis]]
name = "right"
actuator = { kind = "pure-delay", delay_samples = 7 }
[kinematics]
kind = "matrix"
interface = ["a", "b"]
matrix = MATRIX
[specimen]
stiffness = STIFFNESS
mass = MASS
"""
FREE, LIGHT = "[[2e6, 0], [0, 9e5]]", "[[200, 0], [0, 90]]"


def two(matrix: str = "[[1, 0], [0, 2]]", stiffness: str = FREE, mass: str = LIGHT) -> AxesRig:
    text = TWO.replace("MATRIX", matrix).replace("STIFFNESS", stiffness)
    found = config.parse_any_rig(text.replace("MASS", mass), "rig.toml")
    assert isinstance(found, AxesRig)
    return found


def test_two_specimens_that_nothing_couples_are_separate() -> None:
    assert separate_specimens(two(), None) == [[1], [0]]


@pytest.mark.parametrize(
    "coupled",
    [
        {"stiffness": "[[2e6, 1e3], [1e3, 9e5]]"},
        {"mass": "[[200, 1], [1, 90]]"},
        {"matrix": "[[1, 0], [0.1, 2]]"},
    ],
)
def test_specimens_that_share_stiffness_mass_or_an_axis_are_one(coupled: dict[str, str]) -> None:
    assert separate_specimens(two(**coupled), None) == [[0, 1]]


@pytest.mark.parametrize(("crosstalk", "count"), [(0.005, 2), (0.05, 1)])
def test_specimens_that_answer_each_others_commands_in_the_sweep_are_one(
    crosstalk: float, count: int
) -> None:
    response = np.tile(np.diag([0.9, 0.8]).astype(complex), (3, 1, 1))
    response[2, 0, 1] = crosstalk * 1j
    found = MatrixResponse(np.array([1.0, 10.0, 40.0]), response, (1e-6, 1e-6))
    assert len(separate_specimens(two(), found)) == count


# ---- a resonance above the sweep ----------------------------------------------------------------


def resonant(share: float, hz: float = 70.0, damping: float = 0.005) -> AxesRig:
    """Return the shipped frame on two slow servos, with a mode that couples them.

    Args:
        share: motion of the mode at rest per motion of the servos.
        hz, damping: of the mode.
    """
    text = config.shipped_rig("two-axis-frame").read_text("utf-8")
    for table in ("actuator", "identified"):
        text = re.sub(rf"\[axis\.{table}\]\n(.+\n)+", "", text)
    text = text[: text.index("# The same for the command")]
    w, shape = 2.0 * math.pi * hz, np.array([1.0, -1.0])
    servos = np.diag(2.0 * math.pi * np.array([9.0, 6.0]))
    a, b = np.zeros((4, 4)), np.vstack([servos, np.zeros((2, 2))])
    a[:2, :2], a[2, 3] = -servos, 1.0
    a[3] = [*(w * w * share * shape), -w * w, -2.0 * damping * w]
    c = np.hstack([np.eye(2), shape[:, None], np.zeros((2, 1))])
    plant = f"[plant]\na = {a.tolist()}\nb = {b.tolist()}\nc = {c.tolist()}\n"
    found = config.parse_any_rig(text + plant, "rig.toml")
    assert isinstance(found, AxesRig)
    sweep = SweepPlan.up_to(SWEPT_HZ, 1e-3)
    return identify_axes.identified_rig(found, identify_axes.identify_rig(found, sweep))


@functools.lru_cache
def setup_of(share: float, folder: Path) -> Setup:
    """Return the shipped test with a matrix law that keeps what the sweep gave it."""
    text = FRAME.read_text("utf-8").replace('"two-actuator-frame/', f'"{FRAME.with_suffix("")}/')
    text = re.sub(r"duration_s = .*", 'duration_s = "5 s"', text)
    path = folder / f"{share}.toml"
    kept = "rfc = { enabled = false }\nmatrix = { gate_factor = 1e6 }\n"
    path.write_text(text + kept, "utf-8")
    return axes_experiment.prepare(config.load_test(path), resonant(share))


def with_the_true_rig(setup: Setup) -> tuple[AxesLoop, np.ndarray]:
    """Return the loop with the plant in place of the model fitted to its sweep, and k_e."""
    assert setup.group is not None
    rig, linalg = setup.group.rig, pytest.importorskip("scipy.linalg")
    assert rig.plant is not None
    a, b, c = (np.array(rows) for rows in (rig.plant.a, rig.plant.b, rig.plant.c))
    whole = np.zeros((len(a) + 2,) * 2)
    whole[: len(a), : len(a)], whole[: len(a), len(a) :] = a * H, b * H
    held = linalg.expm(whole)
    a, b = held[: len(a), : len(a)], held[: len(a), len(a) :]
    tie, k_e = rig.core_kinematics(), np.array(rig.k_e)
    # Damping and mass of the specimen add 1 % to the force of the direction that decides.
    moved = np.vstack([tie.weights() @ c, k_e @ tie.weights() @ c])
    plant = System(
        a, b, moved, np.zeros((4, 2)),
        lambda z: moved @ np.linalg.solve(z[:, None, None] * np.eye(len(a)) - a, b),
    )  # fmt: skip
    known = axes_roots.axes_and_laws(setup)
    assert known is not None
    exact = Axes(plant, SWEPT_HZ, 0.0)
    return axes_roots.loop_of(setup.controller, exact, known[1][0], tie.jacobian()), k_e


def test_a_resonance_above_the_sweep_that_makes_the_test_unstable_is_warned_of(
    tmp_path: Path,
) -> None:
    setup = setup_of(0.2, tmp_path)
    found = loop_stability.judge(setup)
    assert found is not None
    assert not found.unstable
    assert found.unproven
    (text,) = loop_stability.demand(setup)
    assert "is stable is known only up to 40 Hz, the end of the rig's sweep" in text
    assert f"{found.unseen_force:.2g} times the elastic force of the commanded motion" in text
    loop, _ = with_the_true_rig(setup)
    roots = loop.roots()
    largest = roots[np.argmax(np.abs(roots))]
    assert abs(largest) > 1.003
    assert abs(np.angle(largest)) / (2.0 * math.pi * H) == pytest.approx(70.0, abs=1.0)
    assert virtual_time.run(setup).meta["end_reason"].startswith("tripped: force limit")


def test_the_true_response_is_beyond_the_bound_where_it_makes_the_loop_unstable(
    tmp_path: Path,
) -> None:
    for share, unstable in ((0.2, True), (0.005, False)):
        setup = setup_of(share, tmp_path)
        loop, k_e = with_the_true_rig(setup)
        assert loop.stable() is not unstable
        assert setup.group is not None
        weights = setup.group.rig.core_kinematics().weights()
        z = np.exp(2j * np.pi * np.linspace(SWEPT_HZ, 80.0, 2000) * H)
        bound = 1.0 / unseen_response.loop_gain(loop, k_e, weights, z, [[0, 1]])
        root = np.linalg.cholesky(k_e)
        into = np.linalg.inv(root)
        returned = loop.axes.response(z) @ np.linalg.pinv(weights)
        true = np.linalg.norm(into @ returned @ into.T, 2, axis=(1, 2))
        assert bool((true > bound).any()) is unstable


def test_a_sweep_to_80_hz_of_the_shipped_frame_leaves_nothing_open(tmp_path: Path) -> None:
    rig = config.load_any_rig(config.shipped_rig("two-axis-frame"))
    assert isinstance(rig, AxesRig)
    swept = identify_axes.identified_rig(
        rig, identify_axes.identify_rig(rig, SweepPlan.up_to(80.0, 1e-3))
    )
    test = config.load_test(FRAME)
    whole, short = (
        loop_stability.judge(axes_experiment.prepare(test, one)) for one in (swept, rig)
    )
    assert whole is not None
    assert short is not None
    assert math.isinf(whole.unseen_force)
    assert not whole.unproven
    assert whole.gain_margin == loop_roots.MOST_GAIN
    assert short.unproven
    assert dataclasses.replace(short, unseen_force=1.01).unproven is False
