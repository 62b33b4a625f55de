"""Diagnosis of servo-hydraulic rigs: what decides is the whole rig, simulated with each set."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rthyb_rt import config, core
from rthyb_rt.config.rigfile import RigFile
from rthyb_rt.diagnose import effects, estimate, gaps, motion_evaluated, reading, rigged
from rthyb_rt.diagnose.case import Case
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.fitter import SetFitter
from rthyb_rt.diagnose.motion_fitter import MotionFitter
from rthyb_rt.diagnose.predict import Augmented
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem
from rthyb_rt.lab import experiment, virtual_time
from tests.test_diagnose_loop import SECTION_5, TABLE, answer_of, recorded, run

BARE = {"moving_mass_kg": 0.5, "friction_n": 0.0, "viscous_n_s_per_m": 0.0}
"""A table of which the model holds next to nothing."""


def changed(**actuator: float) -> RigFile:
    rig = config.load_rig(TABLE)
    return rig.model_copy(update={"actuator": rig.actuator.model_copy(update=actuator)})


def file_of(rig: RigFile, path: Path) -> Path:
    path.write_text(config.dump(rig), encoding="utf-8")
    return path


def recording_of(rig: RigFile, folder: Path, pga_g: str, duration_s: str = "10") -> Path:
    wanted = {"ground_motion.pga_g": pga_g, "test.duration_s": duration_s}
    test = config.load_test(SECTION_5, wanted)
    return recorded(folder, virtual_time.run(experiment.prepare(test, rig)))


@pytest.fixture(scope="module")
def table_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recording_of(config.load_rig(TABLE), tmp_path_factory.mktemp("table") / "run", "0.08")


def case_of(folder: Path, rig: RigFile) -> Case:
    return reading.read_case(folder, reading.model_of_rig(rig))


def nothing(case: Case) -> Augmented:
    return Augmented(case.model, case.model, (), (), None, None)


# ---- a lab's story -------------------------------------------------------------------------------


@pytest.mark.long
def test_table_that_the_model_leaves_out_is_named_and_the_loop_closes(table_run, tmp_path, capsys):
    """45 kg, 80 N and 600 N s/m were in the rig; the model has 0.5 kg and nothing else of them."""
    naive = file_of(changed(**BARE), tmp_path / "naive.toml")
    other = recording_of(config.load_rig(TABLE), tmp_path / "other", "0.05", "6")
    answer = answer_of(table_run, naive, capsys, "--heldout", other, "--report", tmp_path / "out")
    assert answer["verdict"] == "explained"
    assert answer["effects"] == ["coulomb", "inertia", "viscous"]
    params = {c["name"]: c["params"] for c in answer["candidates"]}
    assert params["coulomb"]["Fc_N"] == pytest.approx(80.0, rel=0.02)
    assert params["inertia"]["m_kg"] == pytest.approx(44.5, rel=0.03)
    assert params["viscous"]["c_Ns_m"] == pytest.approx(600.0, rel=0.05)
    loop = answer["closed_loop"]
    assert loop["nrmse_before"]["x_meas"] > 0.2
    assert loop["nrmse_after"]["x_meas"] < 0.02
    # Foretold by the rig in another test: to the noise of the cell, 5 N, and no more.
    assert answer["fit"]["heldout_nrmse_before"] > 0.04
    assert answer["fit"]["heldout_nrmse_after"] < 0.01
    # What was found is a rig file that loads, and lacks nothing.
    augmented = tmp_path / "out" / "augmented.toml"
    assert answer_of(table_run, augmented, capsys)["verdict"] == "none"


@pytest.mark.long
def test_table_is_named_though_one_law_of_many_parameters_imitates_its_parts(tmp_path, capsys):
    """Along the model's motion, a contact that slips at 8 um fits better than mass and damper."""
    parts = {"moving_mass_kg": 53.2, "friction_n": 62.5, "viscous_n_s_per_m": 600.0}
    folder = recording_of(changed(**parts), tmp_path / "run", "0.04", "20")
    answer = answer_of(folder, file_of(changed(**BARE), tmp_path / "naive.toml"), capsys)
    assert answer["effects"] == ["coulomb", "inertia", "viscous"]
    params = {c["name"]: c["params"] for c in answer["candidates"]}
    assert params["inertia"]["m_kg"] == pytest.approx(52.7, rel=0.03)
    assert params["coulomb"]["Fc_N"] == pytest.approx(62.5, rel=0.02)
    assert answer["closed_loop"]["nrmse_after"]["x_meas"] < 0.02


@pytest.mark.long
def test_rig_that_is_as_its_model_lacks_nothing(table_run, capsys):
    answer = answer_of(table_run, TABLE, capsys)
    assert answer["verdict"] == "none"
    assert answer["closed_loop"]["nrmse_after"]["x_meas"] < 0.02


def test_sliding_within_the_noise_of_the_displacement_is_dry_friction(table_run):
    """The sensor has 2 um of noise: a slider that yields at 4 um is a second dry friction."""
    case = case_of(table_run, config.load_rig(TABLE))
    found = estimate.from_sensors(case)
    assert found is not None
    ctx = motion_evaluated.context_of(case, found)
    body, laws = rigged.RigBody(case, ctx), effects.catalogue()

    def fit(*parts: tuple[str, Trial]) -> Fit:
        members = tuple(Member(laws[name], trial) for name, trial in parts)
        return Fit(members, tuple(np.ones(1) for _ in members), 0.0, 0)

    dry = ("coulomb", Trial((5e-4,)))
    narrow, wide = (("hysteresis", Trial((xy_m, 50.0), "slider")) for xy_m in (4e-6, 4e-5))
    assert not body.distinct(fit(dry, narrow))
    assert body.distinct(fit(dry, wide))
    assert body.distinct(fit(narrow))
    assert body.distinct(fit(dry, ("viscous", Trial())))
    problem = ResidualProblem(case, ctx, found, laws.values())
    mover = MotionFitter(problem, body, SetFitter(problem))
    assert mover.move(fit(dry, narrow)) is None
    assert body.runs == rigged.RUNS, "no simulation is spent on it"


@pytest.mark.long
def test_stiffer_specimen_that_softens_is_told_from_either_alone(tmp_path, capsys):
    rig = config.load_rig(TABLE)
    data = json.loads(json.dumps(rig.model_dump(mode="json", by_alias=True, exclude_unset=True)))
    data["specimen"] += [
        {"element": "stiffness", "k_n_per_m": 8e4},
        {"element": "coulomb", "fc_n": 120.0, "width_m_per_s": 1e-3},
    ]
    folder = recording_of(RigFile.model_validate(data), tmp_path / "run", "0.06", "8")
    answer = answer_of(folder, TABLE, capsys)
    assert answer["effects"] == ["coulomb", "stiffness"]
    params = {c["name"]: c["params"] for c in answer["candidates"]}
    assert params["coulomb"]["Fc_N"] == pytest.approx(120.0, rel=0.03)
    assert params["stiffness"]["dk_ratio"] == pytest.approx(8e4 / 666.4e3, rel=0.03)


# ---- the simulated rig ---------------------------------------------------------------------------


def test_true_model_leaves_the_noise_of_both_sensors(table_run):
    """The recording's own noise is the second formulation: 5 N and 2 um, white."""
    case = case_of(table_run, config.load_rig(TABLE))
    found = estimate.from_sensors(case)
    assert found is not None
    body = rigged.RigBody(case, motion_evaluated.context_of(case, found))
    model = nothing(case)
    off = body.differences(model, np.zeros(2), (0.0, 0.0))
    force, displacement = np.split(off, 2)
    # Ten seconds tell a noise to 2.4 per cent (one sigma) by the median of its fourth differences.
    assert float(np.mean(force**2)) == pytest.approx(1.0, abs=0.1)
    assert float(np.mean(displacement**2)) == pytest.approx(1.0, abs=0.1)
    neighbours = np.corrcoef(force[1:], force[:-1])[0, 1]
    assert abs(neighbours) < 4.0 / np.sqrt(force.size)


def test_prediction_of_a_rig_is_what_its_sensors_read_without_their_noise(table_run):
    case = case_of(table_run, config.load_rig(TABLE))
    other = {k: gaps.filled(v) for k, v in case.channels.items()}
    answered = rigged.along(nothing(case), case, other)
    assert answered is not None
    x, f = answered
    assert float(np.std(x - case.channels["x_meas"])) == pytest.approx(2e-6, rel=0.05)
    assert float(np.std(f - case.channels["f_meas"])) == pytest.approx(5.0, rel=0.05)
    # A specimen that moved otherwise is not foretold by this rig.
    case.channels["x_meas"][:] += 1e-4 * np.sin(np.arange(case.t.size))
    assert rigged.along(nothing(case), case, other) is None


def test_late_load_cell_reads_the_force_of_before(table_run):
    case = case_of(table_run, config.load_rig(TABLE))
    by_name = {e.name: e for e in effects.catalogue().values()}
    late = Member(by_name["time_skew"], Trial((2.5 * case.dt,)))
    zero = Member(by_name["bias"], Trial())
    betas = (np.array([1.0]), np.array([7.0]))
    model = Augmented(case.model, case.model, (late, zero), betas, None, (1e-2, 0.1, 5e3))
    found = estimate.from_sensors(case)
    assert found is not None
    ctx = motion_evaluated.context_of(case, found)
    wave = 1000.0 * np.sin(2.0 * np.pi * 3.0 * case.t)
    expected = 1000.0 * np.sin(2.0 * np.pi * 3.0 * (case.t - 2.5 * case.dt)) + 7.0
    assert np.max(np.abs(rigged.read(model, wave, ctx) - expected)[8:-8]) < 0.01


def test_steep_friction_on_a_light_table_is_one_that_the_substeps_follow():
    rig = changed(**BARE)
    model = reading.model_of_rig(rig)
    dry = next(e for e in effects.catalogue().values() if e.name == "coulomb")
    member = Member(dry, Trial((1e-5,)))
    ranges = (1e-2, 0.1, 5e3)
    made = rigged.config_of(Augmented(model, model, (member,), (np.array([300.0]),), None, ranges))
    assert made.servo.substeps == rigged.FINER * rig.actuator.substeps
    friction = next(e for e in made.elements if e.kind == "coulomb")
    per_substep = core.PERIOD_S / made.servo.substeps / rig.actuator.moving_mass_kg
    assert friction.params[0] / friction.params[1] * per_substep <= rigged.STEEP * (1 + 1e-9)
    x, f = core.VirtualRig(made).run(1e-3 * np.sin(2.0 * np.pi * np.arange(2048) / 1024))
    assert np.isfinite(f).all()
    # No chatter: with a table that runs off from substep to substep the displacement is a comb.
    assert np.max(np.abs(np.diff(x, 4))) < 1e-6
    assert made.force.noise_std == 0.0
    assert made.displacement.noise_std == 0.0


def test_mass_that_the_table_has_too_much_of_is_taken_off_it():
    model = reading.model_of_rig(config.load_rig(TABLE))
    mass = next(e for e in effects.catalogue().values() if e.name == "inertia")
    found = Augmented(model, model, (Member(mass, Trial()),), (np.array([-15.0]),), None, None)
    made = rigged.config_of(found)
    assert made.servo.moving_mass_kg == pytest.approx(30.0)
    assert not any(e.kind == "inertia" for e in made.elements)


@pytest.mark.long
@pytest.mark.parametrize("force_n", [np.nan, np.inf, 1e300])
def test_recording_that_holds_no_number_ends_in_words(table_run, tmp_path, capsys, force_n):
    """A reading that is none is a gap, or refused; never a fault of the program."""
    from rthyb_rt.record import recording

    rec = recording.open_run(table_run)
    rec.samples["f_meas_n"][4000:4200] = force_n
    folder = recorded(tmp_path / "run", rec)
    code = run("diagnose", folder, "--model", TABLE)
    said = capsys.readouterr()
    assert code in (0, 3, 8)
    assert "Traceback" not in said.err
