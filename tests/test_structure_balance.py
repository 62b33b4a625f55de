"""Energy of whole structures: against scipy's state space, recorded loops, and its own closure."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_numerical_sparse import FRICTION, with_friction

import rthyb_rt as rt
from rthyb_rt.analysis import structure_balance as of
from rthyb_rt.analysis.summary import recorded_structure
from rthyb_rt.config.sparse_structure import SparseStructure
from rthyb_rt.core import DenseConfig
from rthyb_rt.core.sparse import SparseConfig
from rthyb_rt.errors import InputError

EXAMPLES = Path(__file__).parents[1] / "examples"
THREE = """schema = "rthyb-test/1"
rig = "delay-10-elastic"
[test]
name = "three"
free_vibration_s = 1
[ground_motion]
record = "elcentro-1940-ns"
factor = 0.1
duration_s = 6
[numerical]
damping = { ratio = "3 %", modes = [1, 2] }
[numerical.storeys]
count = 3
mass_kg = [9000, 8000, 6000]
stiffness_n_per_m = ["4.73741 MN/m", "6 MN/m", "5 MN/m"]
specimen = [1]
[controller]
type = "none"
"""
TWO = THREE.replace("count = 3", "count = 2").replace("[9000, 8000, 6000]", "[9000, 8000]").replace(
    '["4.73741 MN/m", "6 MN/m", "5 MN/m"]', '["4.73741 MN/m", 0.001]'
).replace("factor = 0.1", "factor = 0.5").replace(
    "[controller]",
    """[[numerical.nonlinear]]
storeys = [2]
[numerical.nonlinear.law]
element = "hysteresis"
k_n_per_m = "4 MN/m"
post_yield_ratio = 0.05
eta = 2
xy_m = "2 mm"
[controller]""",
)  # fmt: skip


@pytest.fixture(scope="module")
def at_once(tmp_path_factory: pytest.TempPathFactory) -> rt.Recording:
    """Three storeys on a specimen that is a spring, and an actuator that is never late."""
    place = tmp_path_factory.mktemp("three") / "three.toml"
    place.write_text(THREE, encoding="utf-8")
    rig = rt.Rig("delay-10-elastic").with_({"actuator.delay_samples": 0})
    return rt.run(rt.Test(place), rig=rig)


def part_of(rec: rt.Recording) -> SparseConfig:
    structure = recorded_structure(rec.raw)
    assert isinstance(structure, SparseStructure)
    return structure.part


def test_three_storeys_have_the_energies_of_scipys_state_space(at_once: rt.Recording) -> None:
    signal = pytest.importorskip("scipy.signal")
    part, found = part_of(at_once), at_once.energy_balance()
    m, k = part.mass_kg.matrix().toarray(), part.whole_stiffness().toarray()
    c, load = part.damping_times(np.eye(3)), part.load_kg
    inverse, none = np.linalg.inv(m), np.zeros((3, 3))
    a = np.block([[none, np.eye(3)], [-inverse @ k, -inverse @ c]])
    b = np.concatenate([np.zeros(3), -inverse @ load])[:, None]
    rows = at_once.running
    ag, t = at_once["ag_mps2"][rows][:-1], found.t_s - found.t_s[0]
    _, s, _ = signal.lsim((a, b, np.eye(6), np.zeros((6, 1))), ag, t)
    x, v = s[:, :3], s[:, 3:]

    def running(power: np.ndarray) -> np.ndarray:
        return np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]))]) / at_once.fs_hz

    wanted = {
        "kinetic_j": 0.5 * np.einsum("ni,ij,nj->n", v, m, v),
        "strain_j": 0.5 * np.einsum("ni,ij,nj->n", x, k, x),
        "damping_j": running(np.einsum("ni,ij,nj->n", v, c, v)),
        "input_j": running(-ag * (v @ load)),
    }
    whole = wanted["input_j"].max()
    assert whole > 10.0
    for name, energy in wanted.items():
        # What is left is the integrator's period error: (w h)^2 / 12 over six seconds.
        assert np.abs(getattr(found, name) - energy).max() < 5e-3 * whole, name
    assert np.abs(found.fed_j).max() < 1e-6 * whole
    assert np.abs(found.specimen_j).max() < 1e-3 * whole
    assert found.gap < 1e-4


def test_yielding_storey_loses_the_area_of_its_recorded_loops(tmp_path: Path) -> None:
    (tmp_path / "two.toml").write_text(TWO, encoding="utf-8")
    rec = rt.run(rt.Test(tmp_path / "two.toml"))
    found, rows = rec.energy_balance(), rec.running
    drift, shear = rec["drift_2"][rows][:-1], rec["shear_2"][rows][:-1]
    taken = np.sum(0.5 * (shear[1:] + shear[:-1]) * np.diff(drift))
    lost = taken - shear[-1] ** 2 / (2 * 4e6)
    assert lost > 0.2 * found.input_j.max()
    assert found.elements_j[-1] == pytest.approx(lost, rel=1e-3)
    assert found.gap < 1e-4


CLOSED = {
    "two yielding storeys of ten, P-Delta": ("ten-storeys.toml", {}, 1e-4),
    "matrices": ("frame-three-storeys.toml", {"ground_motion.factor": 0.2}, 2e-4),
    "matrices, Runge-Kutta": (
        "frame-three-storeys.toml",
        {"ground_motion.factor": 0.2, "numerical.matrices.integrator": "rk4"},
        2e-4,
    ),
    "four times slower": ("ten-storeys.toml", {"test.time_scale": 4}, 1e-4),
}


@pytest.mark.parametrize(("name", "change", "gap"), CLOSED.values(), ids=CLOSED)
def test_balance_of_a_structure_closes(name: str, change: dict[str, object], gap: float) -> None:
    short = {"ground_motion.duration_s": 4, "test.free_vibration_s": 0}
    rec = rt.run(rt.Test(EXAMPLES / name).with_(short | change))
    found = rec.energy_balance()
    assert found.input_j.max() > 1.0
    assert found.gap < gap
    assert found.t_s.size == np.count_nonzero(rec.running) - 1


@pytest.mark.long
def test_frame_on_two_actuators_closes_but_for_the_integrators_own_damping(tmp_path: Path) -> None:
    """Displacement and rotation together; rho_inf = 0.5 takes out of the high modes."""
    test = rt.Test(EXAMPLES / "two-actuator-frame.toml")
    rec = rt.run(test.with_({"ground_motion.duration_s": 6, "test.free_vibration_s": 0}))
    found = rec.energy_balance()
    assert found.input_j.max() > 10.0
    assert found.gap < 2e-3
    # The specimen is elastic, and heavy: what it holds in the end is its motion.
    assert abs(found.specimen_j[-1]) < 0.05 * found.input_j.max()
    plot = rec.plot.balance()
    assert "<svg" in plot.svg
    assert "is unexplained" in plot.note
    written = {path.name: path for path in rec.report_files(tmp_path)}
    assert {"balance.svg", "balance.pdf", "modes.pdf", "axis-1.svg", "table.tex"} <= set(written)
    measures = dict(line.split(",") for line in written["measures.csv"].read_text().splitlines())
    peak = float(measures["axes.upper.peak_force_n"])
    assert peak == rec.measures["axes"]["upper"]["peak_force_n"]
    assert "Axis upper: peak of the force" in written["table.csv"].read_text("utf-8")


def test_what_does_not_belong_together_has_no_balance(at_once: rt.Recording) -> None:
    part = part_of(at_once)
    n = 100
    t, zero, one = np.arange(n) / 1024, np.zeros(n), np.zeros((n, 1))
    assert of.balance(part, t, zero, one + 0.01, one, one) is None
    assert of.balance(part, t, np.full(n, np.nan), one, one, one) is None
    still = of.balance(part, t, zero, one, one, one)
    assert still is not None
    assert np.isnan(still.gap)
    # Up to the first number that is missing.
    broken = zero.copy()
    broken[50] = np.nan
    found = of.balance(part, t, broken, one, one, one)
    assert found is not None
    assert found.t_s.size == 49


def test_force_that_brought_a_part_where_it_is_comes_out_again() -> None:
    """Of two interfaces and of a dense part: forces in, displacements out, forces again."""
    from rthyb_rt.core.numerical_parts import DensePart, SparsePart
    from rthyb_rt.core.sparse import Symmetric

    rng = np.random.default_rng(4)
    m, k = np.diag([900.0, 700.0, 500.0]), 1e5 * np.array([[3, -1, 0], [-1, 2, -1], [0, -1, 2]])
    rows = (((0, 1.0),), ((2, 0.5), (1, -1.0)))
    sparse = SparseConfig(
        Symmetric.of(m), Symmetric.of(k), np.ones(3), rows, (1e5, 2e5), by_mass_per_s=0.3
    )
    dense = DenseConfig(
        "cr", tuple(map(tuple, m)), tuple(map(tuple, 0.001 * k)), tuple(map(tuple, k)),
        (1.0, 1.0, 1.0), at=1, k_e_n_per_m=1e5,
    )  # fmt: skip
    for part, count in ((SparsePart(sparse), 2), (DensePart(dense), 1)):
        twin = SparsePart(sparse) if count == 2 else DensePart(dense)
        for _ in range(50):
            ag, force = float(rng.normal()), rng.normal(size=count) * 1e3
            x, _ = part.answer_all(ag, force.tolist())
            again = twin.force_for(ag, x)
            assert again == pytest.approx(force, abs=1e-5)
            twin.answer_all(ag, force.tolist())
            part.advance()
            twin.advance()


@pytest.mark.parametrize("axes", [1, 2])
@pytest.mark.parametrize("kind", FRICTION)
def test_forces_of_a_structure_with_dry_friction_are_found_as_they_slide_and_hold(
    kind: str, axes: int
) -> None:
    """One of the dampers is at the interface itself, so that its velocity is prescribed."""
    from rthyb_rt.core.numerical_parts import SparsePart

    rows = (((0, 1.0),), ((2, 1.0), (1, -0.5)))[:axes]
    damped = with_friction(FRICTION[kind][0], interfaces=rows, k_e_n_per_m=(1e5, 2e5)[:axes])
    part, twin = SparsePart(damped), SparsePart(damped)
    rng, compared = np.random.default_rng(1), 0
    for n in range(400):
        ag = 5.0 * np.sin(0.02 * n) + rng.normal()
        force = 1e3 * np.sin(0.03 * n) + 200.0 * rng.normal(size=axes)
        x, _ = part.answer_all(ag, force.tolist())
        kept = twin.save()
        again = twin.force_for(ag, x)
        assert twin.save() == kept
        # Commands have friction to 1e-4 of it, here of about 2 kN; what limits of the work between
        # force and command leave appears in one command alone.
        if part.friction_effort()[3]:
            compared += 1
            assert again == pytest.approx(force, abs=4.0)
        twin.answer_all(ag, force.tolist())
        part.advance()
        twin.advance()
    assert compared > 390


def test_balance_closes_where_a_strong_friction_damper_stands_beside_the_specimen(
    tmp_path: Path,
) -> None:
    """Replayed with forces off by twice the friction, it left 1.7e-4 of the input."""
    damper = """[[numerical.nonlinear]]
storeys = [2]
beside = true
law = { element = "coulomb", fc_n = "20 kN" }

[[interface]]"""
    whole = (EXAMPLES / "ten-storeys.toml").read_text(encoding="utf-8")
    (tmp_path / "damped.toml").write_text(whole.replace("[[interface]]", damper), "utf-8")
    short = {"ground_motion.duration_s": 4, "test.free_vibration_s": 0}
    found = rt.run(rt.Test(tmp_path / "damped.toml").with_(short)).energy_balance()
    assert found.input_j.max() > 1e3
    assert found.gap < 3e-5


def test_recording_of_another_structure_says_what_a_balance_needs(at_once: rt.Recording) -> None:
    moved = rt.Recording(at_once.raw)
    rows = np.flatnonzero(moved.running)
    before = moved.raw.samples["x_num_m"][rows].copy()
    moved.raw.samples["x_num_m"][rows] += 0.01
    try:
        with pytest.raises(InputError, match="for the recorded motion"):
            moved.energy_balance()
    finally:
        moved.raw.samples["x_num_m"][rows] = before
