"""Storeys and matrices from a file: what they come to, what is recorded, what is refused."""

from __future__ import annotations

import itertools
import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.integrate
import scipy.io
import scipy.linalg
import scipy.sparse
from command_line import Rthyb
from frames import beam_stiffness, shear_building, space_frame

import rthyb_rt as rt
from rthyb_rt import config
from rthyb_rt.analysis import summary
from rthyb_rt.analysis.linear_parts import LinearStep
from rthyb_rt.analysis.summary import recorded_structure
from rthyb_rt.checking.examined import examine
from rthyb_rt.config import deriving, matrixfile
from rthyb_rt.config.sparse_structure import SparseStructure
from rthyb_rt.config.structures import MatrixFile
from rthyb_rt.core import CoreError, sparse
from rthyb_rt.core.numerical_parts import SparsePart
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_experiment, experiment, virtual_time
from rthyb_rt.lab.realtime import station_replay
from rthyb_rt.record import recording
from rthyb_rt.report import figures, frequency
from rthyb_rt.report import structure as structure_figures

K_E = 4737410.0
EXAMPLE = config.builtin_test_path().with_name("ten-storeys.toml")
HEAD = 'schema = "rthyb-test/1"\nrig = "delay-10-elastic"\ntest = { name = "t" }\n'
LAW = (
    'law = { element = "hysteresis", k_n_per_m = 4e6, post_yield_ratio = 0.1, xy_m = 0.006, '
    "eta = 2 }"
)
STOREYS = """
[numerical]
damping = { ratio = 0.02, modes = [1, 3] }
[numerical.storeys]
count = 5
mass_kg = [3000, 2800, 2600, 2400, 2200]
stiffness_n_per_m = "4.5 MN/m"
"""


def structure(text: str) -> SparseStructure:
    found = deriving.structure_of_test(config.parse_test(HEAD + text), K_E, 1.0 / 1024.0)
    assert isinstance(found, SparseStructure)
    return found


# ---- storeys ------------------------------------------------------------------------------------


@pytest.mark.parametrize("specimen", [1, 3])
def test_storeys_are_the_shear_building_with_the_rig_in_one_of_them(specimen: int) -> None:
    found = structure(STOREYS + f"specimen = [{specimen}]")
    stiffness = np.full(5, 4.5e6)
    stiffness[specimen - 1] = K_E
    m, k = shear_building(np.array([3000.0, 2800, 2600, 2400, 2200]), stiffness)
    assert found.part.whole_stiffness().toarray() == pytest.approx(k)
    w2, phi = scipy.linalg.eigh(k, m)
    modes = found.modes()
    assert [mode.frequency_hz for mode in modes] == pytest.approx(np.sqrt(w2) / (2 * np.pi))
    assert [modes[0].damping_ratio, modes[2].damping_ratio] == pytest.approx([0.02, 0.02])
    share = (phi.T @ np.diag(m)) ** 2 / np.trace(m)
    assert [mode.effective_mass for mode in modes] == pytest.approx(share)
    assert sum(mode.effective_mass for mode in modes) == pytest.approx(1.0)
    assert abs(modes[0].shape[-1]) == pytest.approx(1.0)
    x, _ = np.linalg.qr(np.eye(5))  # the actuator moves the storey's drift
    assert found.part.interface_rows()[0] @ x == pytest.approx(
        [float(i == specimen - 1) - float(i == specimen - 2) for i in range(5)]
    )


def test_modal_damping_is_in_the_named_modes_alone() -> None:
    text = STOREYS.replace("modes = [1, 3] }", 'modes = [1, 2, 4], form = "modal" }')
    ratios = [mode.damping_ratio for mode in structure(text).modes()]
    assert ratios == pytest.approx([0.02, 0.02, 0.0, 0.02, 0.0], abs=1e-9)


def test_the_weight_of_the_floors_leans_on_every_storey() -> None:
    plain = structure(STOREYS).part.whole_stiffness().toarray()
    leaning = structure(STOREYS + "height_m = 3\np_delta = true").part.whole_stiffness().toarray()
    weights = 9.80665 * np.cumsum([2200.0, 2400, 2600, 2800, 3000])[::-1]
    assert plain - leaning == pytest.approx(shear_building(np.ones(5), weights / 3.0)[1])


def test_a_yielding_storey_has_its_element_in_the_place_of_its_stiffness() -> None:
    found = structure(STOREYS + f"[[numerical.nonlinear]]\nstoreys = [2, 4]\n{LAW}")
    assert [(j.below, j.above) for j in found.part.joints] == [(0, 1), (2, 3)]
    stiffness = np.array([K_E, 4e6, 4.5e6, 4e6, 4.5e6])
    expected = shear_building(np.ones(5), stiffness)[1]
    assert found.part.whole_stiffness().toarray() == pytest.approx(expected, rel=1e-6, abs=10.0)
    beside = structure(STOREYS + f"[[numerical.nonlinear]]\nstoreys = [2]\nbeside = true\n{LAW}")
    assert beside.part.whole_stiffness()[1, 1] == pytest.approx(4.5e6 + 4e6 + 4.5e6, rel=1e-6)


@pytest.fixture(scope="module")
def ten() -> tuple[experiment.Setup, Any]:
    test, rig = config.load_both(EXAMPLE, None, ["test.free_vibration_s=1"])
    setup = experiment.prepare(test, rig)
    return setup, virtual_time.run(setup)


def test_ten_storeys_follow_their_reference(ten: tuple[experiment.Setup, Any]) -> None:
    setup, rec = ten
    rows = rec.samples[rec.samples["state"] == 4][: setup.ticks]
    reference = setup.reference["x_ref_m"][: rows.size]
    apart = np.abs(rows["x_num_m"] - reference).max() / np.abs(reference).max()
    assert apart < 0.02


def test_drifts_and_shears_are_recorded_by_name(ten: tuple[experiment.Setup, Any]) -> None:
    setup, rec = ten
    names = [channel.name for channel in rec.channels]
    assert names[:20] == [f"{what}_{i}" for what in ("drift", "shear") for i in range(1, 11)]
    rows = rec.samples[rec.samples["state"] == 4]
    # The same row's: what the actuator was told of this tick, and the force that was used.
    assert rows["drift_1"] == pytest.approx(rows["x_num_m"], abs=1e-12)
    assert np.abs(rows["shear_1"] - rows["f_meas_n"]).max() < 0.1 * np.abs(rows["f_meas_n"]).max()
    assert rows["shear_7"] == pytest.approx(4737410.0 * rows["drift_7"], rel=1e-9)
    assert np.abs(rows["drift_2"]).max() > 0.006  # it yields
    _, _, _, values = setup.derived.structure.whole_reference(
        experiment.specimen_elements(setup.rig), setup.ag_mps2
    )
    peak = np.abs(values).max(axis=0)
    count = min(len(rows), len(values))
    apart = [np.abs(rows[n][:count] - values[:count, i]).max() for i, n in enumerate(names[:20])]
    assert np.all(np.array(apart) < 0.05 * peak)


def test_the_way_from_one_floor_to_another_is_recorded_by_name() -> None:
    record = ["x_5 - x_2", "x_5", "x_2", "x_2 - x_3", "drift_3"]
    test = rt.Test("ten-storeys", ground_motion={"duration_s": 2.0}, numerical={"record": record})
    rec = rt.run(test)
    assert np.abs(rec["x_5_less_x_2"]).max() > 1e-3
    assert rec["x_5_less_x_2"] == pytest.approx(rec["x_5"] - rec["x_2"], abs=1e-15)
    assert rec["x_2_less_x_3"] == pytest.approx(-rec["drift_3"], abs=1e-15)
    assert rec.plot.recorded("x_5_less_x_2").note


@pytest.mark.parametrize("name", ["x_6 - x_1", "x_1 - x_6", "x_2 - x_2", "x_0 - x_1", "x_2-x_1"])
def test_a_way_between_floors_that_there_is_not_is_refused_with_those_that_there_are(
    name: str,
) -> None:
    text = STOREYS.replace("damping =", f'record = ["x_1", "{name}"]\ndamping =')
    with pytest.raises(InputError) as caught:
        structure(text + "specimen = [1]\n")
    for words in ("numerical.record.1", f'found "{name}"', "x_1 to x_5", '"x_2 - x_1"'):
        assert words in str(caught.value)


def test_a_reference_that_is_asked_for_again_is_as_it_was(
    ten: tuple[experiment.Setup, Any],
) -> None:
    setup, ag = ten[0], ten[0].ag_mps2[:200]
    elements = experiment.specimen_elements(setup.rig)
    first = setup.derived.structure.whole_reference(elements, ag)
    kept = [values.copy() for values in first]
    for values in first:
        values[:] = 0.0
    again = setup.derived.structure.whole_reference(elements, ag)
    for values, expected in zip(again, kept, strict=True):
        assert np.array_equal(values, expected)


DAMPER = """
[[numerical.nonlinear]]
storeys = [2]
beside = true
law = { element = "coulomb", fc_n = "2 kN", width_m_per_s = "0.5 mm/s" }
"""


def test_a_stop_that_is_too_stiff_for_the_sampling_period_is_suspected(tmp_path: Path) -> None:
    stop = 'law = { element = "stopper", ks_n_per_m = 1e11, xs_m = 0.001, loss_s_per_m = 5 }'
    file = tmp_path / "pounding.toml"
    file.write_text(
        f"{EXAMPLE.read_text()}\n[[numerical.nonlinear]]\nstoreys = [3]\nbeside = true\n{stop}\n"
    )
    with pytest.raises(InputError, match=r"possible: check .*stops, which may be too stiff"):
        experiment.prepare(*config.load_both(file, None, []))


def test_a_friction_damper_in_the_next_storey_does_not_shake_the_actuator(tmp_path: Path) -> None:
    """Ten samples late: a force that changes its sign at every sample would be amplified."""
    file = tmp_path / "damper.toml"
    file.write_text(EXAMPLE.read_text() + DAMPER)
    setup = experiment.prepare(*config.load_both(file, None, ["test.free_vibration_s=1"]))
    rec = virtual_time.run(setup)
    count = 4 * 1024
    rows = rec.samples[rec.samples["state"] == 4][:count]
    drift = drift_with_damper(setup, count)
    assert np.abs(drift).max() > 0.004
    assert np.abs(rows["x_num_m"] - drift).max() < 0.015 * np.abs(drift).max()
    joints = setup.derived.structure.reference(
        experiment.specimen_elements(setup.rig), setup.ag_mps2[:count]
    )
    assert np.abs(joints[0] - drift).max() < 0.002 * np.abs(drift).max()


@pytest.mark.parametrize(("count", "width", "noted"), [(32, 5e-4, 0), (33, 5e-4, 1), (33, 5e-2, 0)])
def test_more_friction_dampers_than_can_be_solved_for_are_noted_if_they_are_steep(
    count: int, width: float, noted: int
) -> None:
    text = STOREYS.replace("count = 5", "count = 40").replace(
        "[3000, 2800, 2600, 2400, 2200]", "3e3"
    )
    text += (
        f"[[numerical.nonlinear]]\nstoreys = {list(range(2, count + 2))}\nbeside = true\n"
        f'law = {{ element = "coulomb", fc_n = 2000, width_m_per_s = {width} }}\n'
    )
    test, rig = config.parse_test(HEAD + text), config.load_rig(config.find_rig("delay-10-elastic"))
    notes = [note for note in deriving.derive(test, rig).notes if "dry friction" in note]
    assert len(notes) == noted
    for note in notes:
        assert "found 33 elements of numerical.nonlinear with dry friction; up to 32 are" in note
        assert "the friction is then 2.1 times too steep" in note


@pytest.mark.parametrize(
    ("law", "advice"),
    [
        ({"element": "coulomb_uneven", "fc_up_n": 0.0, "fc_down_n": 4000.0}, "width_m_per_s"),
        ({"element": "stribeck", "fc_n": 1e3, "fs_n": 3e3, "vs_m_per_s": 0.02, "exponent": 0.7},
         "width_m_per_s"),
        ({"element": "power_damping", "force_n": 2e4, "exponent": 0.2}, "width_m_per_s"),
        ({"element": "power_damping", "force_n": 4e6, "exponent": 0.9}, "force"),
    ],
)  # fmt: skip
def test_the_advice_on_steep_friction_makes_it_just_not_too_steep(
    law: dict[str, Any], advice: str
) -> None:
    def noted(values: dict[str, Any]) -> str:
        text = STOREYS.replace("count = 5", "count = 40").replace(
            "[3000, 2800, 2600, 2400, 2200]", "3e3"
        )
        keys = ", ".join(f"{k} = {json.dumps(v)}" for k, v in values.items())
        text += f"[[numerical.nonlinear]]\nstoreys = {list(range(2, 35))}\nbeside = true\n"
        test = config.parse_test(f"{HEAD}{text}law = {{ {keys} }}\n")
        rig = config.load_rig(config.find_rig("delay-10-elastic"))
        return " ".join(n for n in deriving.derive(test, rig).notes if "dry friction" in n)

    def changed(factor: float) -> dict[str, Any]:
        if advice == "force":
            return law | {"force_n": factor * law["force_n"]}
        return law | {"width_m_per_s": factor * 5e-4}

    found = re.search(r"a width_m_per_s that is (\S+) times|([\d.e-]+) times the force", noted(law))
    assert found is not None
    factor = float(found[1] or found[2])
    assert (found[2] is not None) == (advice == "force")
    less = 1.1 if advice != "force" else 1.0 / 1.1
    assert noted(changed(less * factor)) == ""
    assert noted(changed(factor / less**3)) != ""


def drift_with_damper(setup: experiment.Setup, count: int) -> Any:
    """Drift of the first storey by SciPy: Bouc-Wen in storeys 1 to 3, friction in the second."""
    structure = setup.derived.structure
    part, n = structure.part, structure.part.size
    m, ag = part.mass_kg.matrix().diagonal(), setup.ag_mps2
    stiffness, damping = part.stiffness_n_per_m.matrix().toarray(), part.damping_times(np.eye(n))
    yielding = [(0.02, 300.0, 200.0, 1.5)] + 2 * [(0.1, 0.5 / 0.006**2, 0.5 / 0.006**2, 2.0)]
    a, b, c, eta = np.array(yielding).T

    def rate(now: float, s: Any) -> Any:
        x, v, z = s[:n], s[n : 2 * n], s[2 * n :]
        drift, slip = np.diff(x[:3], prepend=0.0), np.diff(v[:3], prepend=0.0)
        shear = K_E * (a * drift + (1.0 - a) * z)
        shear[1] += 2000.0 * np.tanh(slip[1] / 5e-4)
        force = -m * np.interp(now * 1024.0, np.arange(ag.size), ag)
        force = force - stiffness @ x - damping @ v
        force[:3] -= shear
        force[:2] += shear[1:]
        dz = slip - b * np.abs(slip) * np.abs(z) ** (eta - 1.0) * z - c * slip * np.abs(z) ** eta
        return np.concatenate([v, force / m, dz])

    t = np.arange(count) / 1024.0
    solved = scipy.integrate.solve_ivp(
        rate, (0.0, t[-1]), np.zeros(2 * n + 3), "Radau", t, rtol=1e-6, atol=1e-9, max_step=0.01
    )
    return solved.y[0]


def test_a_recording_of_ten_storeys_replays_bit_for_bit(
    ten: tuple[experiment.Setup, Any], tmp_path: Path
) -> None:
    recording.write(tmp_path / "ten.h5", ten[1])
    found = station_replay.replay(recording.read(tmp_path / "ten.h5"))
    assert found.identical


@pytest.mark.long
def test_the_report_draws_modes_storeys_and_what_was_recorded(
    ten: tuple[experiment.Setup, Any],
) -> None:
    rec = ten[1]
    plates = {plate.key: plate for plate in figures.draw_all(rec, summary.summarize(rec))}
    assert {"modes", "drifts", "shears", "recorded-displacements", "recorded-forces"} <= set(plates)
    assert "0.990 Hz, 2.0 %" in plates["modes"].svg
    assert "storey 2." in plates["drifts"].note
    assert "drift_2" in plates["recorded-displacements"].svg
    assert "7 others, with smaller peaks" in plates["recorded-forces"].note


@pytest.fixture(scope="module")
def named() -> Any:
    """Ten storeys of which seven quantities were chosen by name."""
    wanted = ["x_10", "x_9", "x_8", "x_2", "x_1", "drift_3", "shear_4"]
    settings = [f"numerical.record={wanted}", "ground_motion.duration_s=4"]
    test, rig = config.load_both(EXAMPLE, None, [*settings, "test.free_vibration_s=1"])
    return virtual_time.run(experiment.prepare(test, rig))


def test_all_that_was_chosen_by_name_is_in_the_report(named: Any) -> None:
    found = recorded_structure(named)
    assert isinstance(found, SparseStructure)
    plates = {plate.key: plate for plate in structure_figures.plates(named, found)}
    first, second = (plates[f"recorded-displacements{end}"] for end in ("", "-2"))
    assert (first.title, second.title) == (
        "Recorded displacements, 1 of 2", "Recorded displacements, 2 of 2",
    )  # fmt: skip
    for name in ("x_10", "x_9", "x_8"):
        assert name in first.svg
    for name in ("x_2", "x_1", "drift_3"):
        assert name in second.svg
    assert "shear_4" in plates["recorded-forces"].svg
    assert plates["recorded-forces"].title == "Recorded forces"
    assert "not shown" not in "".join(plate.note for plate in plates.values())


def test_recorded_quantities_are_plotted_by_name(named: Any, tmp_path: Path) -> None:
    recording.write(tmp_path / "recording.h5", named)
    rec = rt.open(tmp_path / "recording.h5")
    plot = rec.plot.recorded("x_10", "shear_4", "x_1")
    assert plot.figure is not None
    upper, lower = plot.figure.axes
    assert [line.get_label() for line in upper.lines if line.get_label()[0] != "_"] == [
        "x_10", "x_1",
    ]  # fmt: skip
    peak = max(np.abs(line.get_ydata()).max() for line in upper.lines)
    assert peak == pytest.approx(1e3 * np.nanmax(np.abs(rec["x_10"])), rel=1e-6)
    assert [line.get_label() for line in lower.lines if line.get_label()[0] != "_"] == ["shear_4"]
    every = rec.plot.recorded().figure
    assert every is not None
    assert {line.get_label() for axes in every.axes for line in axes.lines} >= {
        "x_10", "x_9", "x_8", "x_2", "x_1", "drift_3", "shear_4",
    }  # fmt: skip
    with pytest.raises(InputError, match='no recorded quantity "x_7"'):
        rec.plot.recorded("x_7")


@pytest.mark.parametrize(
    ("others", "said"),
    [
        (0, "."),
        (1, "; 1 other, with a smaller peak, is not shown."),
        (7, "; 7 others, with smaller peaks, are not shown."),
    ],
)
def test_what_is_not_shown_is_said_in_a_sentence(others: int, said: str) -> None:
    assert structure_figures._not_shown(others) == said


@pytest.mark.long
@pytest.mark.parametrize("rows", [0, 5, 3000])
def test_the_report_bears_rows_of_which_the_channels_are_not_known(
    rows: int, ten: tuple[experiment.Setup, Any]
) -> None:
    rec = replace(ten[1], samples=ten[1].samples[:rows].copy())
    for name in ("drift_1", "drift_2", "shear_1"):
        rec.samples[name][: rows // 2 + 1] = np.nan
    keys = {plate.key for plate in figures.draw_all(rec, summary.summarize(rec))}
    assert {"modes", "drifts", "shears"} <= keys


@pytest.mark.parametrize(("rig", "needed"), [("delay-10-elastic", 1), ("delay-10-bouc-wen", 2)])
def test_a_check_simulates_a_large_structure_no_more_than_it_must(
    rig: str, needed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a specimen that does not yield, the elastic reference is the reference."""
    runs = []
    simulate = SparsePart.joined

    def counted(part: SparsePart, *given: Any) -> Any:
        runs.append(given)
        return simulate(part, *given)

    monkeypatch.setattr(SparsePart, "joined", counted)
    settings = ["test.free_vibration_s=1", "numerical.nonlinear=[]"]
    test, rig_file = config.load_both(EXAMPLE, rig, settings)
    found = examine(test, rig_file, rig)
    assert len(runs) == needed
    assert found.figures.reference_peak_m > 0.001


def test_check_shows_the_modes_and_how_much_of_the_mass_moves_in_each(rthyb: Rthyb) -> None:
    answer = rthyb("check", EXAMPLE)
    assert answer.code == 0, answer.err
    assert "Mode 1 of 10" in answer.out
    assert "0.9895 Hz (1.01 s), damping 2.00 %, 84.9 % of the mass" in answer.out
    assert "kr-alpha" in answer.out


def test_a_structure_that_this_computer_cannot_step_in_time_is_refused_in_real_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    test, rig = config.load_both(EXAMPLE, None, [])
    assert SparsePart(config.derive(test, rig).structure.part).step_time_s() > 0.0  # type: ignore[union-attr]
    monkeypatch.setattr(SparsePart, "step_time_s", lambda part: 0.0006)
    with pytest.raises(
        InputError, match=r"takes 600 us on this computer .* at most 488 us is allowed, half of"
    ):
        experiment.prepare(test, rig, real_time=True)
    assert experiment.prepare(test, rig).ticks > 0


@pytest.mark.parametrize("recorded", [True, False], ids=["floor recorded", "drift alone"])
def test_the_floor_of_an_upper_specimen_moves_with_all_storeys_below_it(
    recorded: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = ["x_3", "x_2", "drift_3"] if recorded else ["drift_3"]
    text = EXAMPLE.read_text(encoding="utf-8").replace("specimen = [1]", "specimen = [3]")
    text = text.replace("\nstoreys = [2, 3]", "\nstoreys = [2]").replace("storey = 1", "storey = 3")
    (tmp_path / "third.toml").write_text(text, encoding="utf-8")
    settings = [f"numerical.record={wanted}", "ground_motion.duration_s=6"]
    test, rig = config.load_both(
        tmp_path / "third.toml", None, [*settings, "test.free_vibration_s=1"]
    )
    rec = virtual_time.run(experiment.prepare(test, rig))
    asked: list[dict[str, Any]] = []
    own = frequency.of_oscillators.pseudo_acceleration

    def noted(fs_hz: float, **motion: Any) -> Any:
        asked.append(motion)
        return own(fs_hz, **motion)

    monkeypatch.setattr(frequency.of_oscillators, "pseudo_acceleration", noted)
    plate = frequency.response_spectrum(rec, recorded_structure(rec))
    if not recorded:
        assert plate.svg == ""
        assert 'add "x_3" to record in [numerical]' in plate.note
        return
    run = rec.samples[rec.running()]
    measured, commanded, ground = (one["displacement_m"] for one in asked)
    assert ground is None
    assert commanded == pytest.approx(run["x_3"], abs=1e-12)
    assert measured == pytest.approx(run["x_2"] + run["x_meas_m"], abs=1e-9)
    assert np.abs(commanded).max() > 1.5 * np.abs(run["x_num_m"]).max()


# ---- matrices from a file -----------------------------------------------------------------------

M4, K4 = shear_building(np.array([3000.0, 2800, 2600, 2400]), np.full(4, 4.5e6))
C4 = 0.3 * M4 + 1e-4 * K4
LABELS = ["1.x", "2.x", "3.x", "4.x"]


def written(folder: Path, kind: str) -> str:
    """Write the matrices; return how a test names them."""
    if kind == "npz":
        np.savez(folder / "a.npz", M=M4, K=K4, C=C4, labels=LABELS, influence=np.ones(4))
        return 'file = "a.npz"'
    if kind == "mat":
        cells = np.array(LABELS, dtype=object)
        data = {"M": scipy.sparse.csc_matrix(M4), "K": K4, "C": C4, "labels": cells}
        scipy.io.savemat(folder / "a.mat", data | {"influence": np.ones((4, 1))})
        return 'file = "a.mat"'
    for name, matrix in (("M", M4), ("K", K4), ("C", C4)):
        if kind == "mtx":
            scipy.io.mmwrite(folder / f"{name}.mtx", scipy.sparse.coo_matrix(matrix))
        else:
            np.savetxt(folder / f"{name}.csv", matrix, delimiter=",")
    (folder / "labels.txt").write_text("\n".join(LABELS))
    names = ", ".join(
        f'{key} = "{name}.{kind}"'
        for key, name in (("mass", "M"), ("stiffness", "K"), ("damping", "C"))
    )
    return f'files = {{ {names}, labels = "labels.txt" }}'


def from_file(folder: Path, matrices: str, more: str = '[[interface]]\ndof = "1.x"') -> Any:
    path = folder / "test.toml"
    path.write_text(f"{HEAD}[numerical.matrices]\n{matrices}\n{more}\n")
    return config.load_test(path)


@pytest.mark.parametrize("kind", ["npz", "mat", "mtx", "csv"])
def test_a_structure_is_the_same_from_every_kind_of_file(kind: str, tmp_path: Path) -> None:
    test = from_file(tmp_path, written(tmp_path, kind))
    # As it is dumped into a recording, without the file.
    (tmp_path / "a.npz").unlink(missing_ok=True)
    again = config.parse_test(config.dump(test))
    found = deriving.structure_of_test(again, K_E, 1.0 / 1024.0)
    assert found.labels == tuple(LABELS)
    assert found.part.mass_kg.matrix().toarray() == pytest.approx(M4)
    assert found.part.stiffness_n_per_m.matrix().toarray() == pytest.approx(K4)
    assert found.part.damping_n_s_per_m is not None
    assert found.part.damping_n_s_per_m.matrix().toarray() == pytest.approx(C4)
    assert found.part.load_kg == pytest.approx(np.diag(M4))


@pytest.mark.parametrize("sparse_file", [False, True], ids=["dense", "sparse"])
@pytest.mark.parametrize(
    "names",
    [
        np.array(["sway", "up"], dtype=object),
        np.array([["sway"], ["up"]], dtype=object),
        np.array(["sway", "up"]),
    ],
    ids=["cell row", "cell column", "padded characters"],
)
def test_directions_in_a_matlab_file_are_called_as_in_matlab(
    names: Any, sparse_file: bool, tmp_path: Path
) -> None:
    kind = scipy.sparse.csc_matrix if sparse_file else np.asarray
    moved = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
    data = {"M": kind(M4), "K": kind(K4), "C": kind(C4), "influence": kind(moved)}
    cells = np.array(LABELS, dtype=object)
    scipy.io.savemat(tmp_path / "a.mat", data | {"labels": cells, "directions": names})
    test = from_file(tmp_path, 'file = "a.mat"\ndirection = "up"')
    found = deriving.structure_of_test(test, K_E, 1.0 / 1024.0)
    assert found.influence == pytest.approx(moved[:, 1])
    wrong = from_file(tmp_path, 'file = "a.mat"\ndirection = "down"')
    with pytest.raises(InputError, match='found "down"; must be one of "sway", "up"'):
        deriving.structure_of_test(wrong, K_E, 1.0 / 1024.0)


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["x", "x"], 'directions: found "x" twice; must be different'),
        (["x", ""], "directions: found 2 directions; must be 2, none empty"),
        (["x", "y", "z"], "directions: found 3 directions; must be 2, none empty"),
    ],
)
def test_directions_that_cannot_be_told_apart_are_refused(
    names: list[str], said: str, tmp_path: Path
) -> None:
    cells = np.array(names, dtype=object)
    moved = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
    scipy.io.savemat(
        tmp_path / "a.mat", {"M": M4, "K": K4, "C": C4, "influence": moved, "directions": cells}
    )
    with pytest.raises(InputError) as caught:
        from_file(tmp_path, 'file = "a.mat"', '[[interface]]\ndof = "1"')
    assert said in str(caught.value)


def test_a_specimen_is_taken_out_and_a_combination_moved(tmp_path: Path) -> None:
    more = """specimen = { stiffness_n_per_m = 1e6, mass_kg = 50 }
[numerical]
record = ["4.x", "3.x - 2.x", "element_1"]
[[numerical.nonlinear]]
between = ["2.x", "3.x"]
law = { element = "viscous", c_n_s_per_m = 1000 }
[[interface]]
dof = { "2.x" = 1, "1.x" = -1 }"""
    test = from_file(tmp_path, written(tmp_path, "npz"), more)
    found = deriving.structure_of_test(test, K_E, 1.0 / 1024.0)
    row = np.array([-1.0, 1.0, 0.0, 0.0])
    own = found.part.stiffness_n_per_m.matrix().toarray()
    assert own == pytest.approx(K4 - 1e6 * np.outer(row, row))
    assert found.part.mass_kg.matrix().toarray() == pytest.approx(M4 - 50.0 * np.outer(row, row))
    assert found.joined.mass_kg.matrix().toarray() == pytest.approx(M4)
    assert found.part.load_kg == pytest.approx(np.diag(M4))
    names = [(one.name, one.unit) for one in found.part.responses]
    assert names == [("dof_4_x", "m"), ("dof_3_x_less_2_x", "m"), ("element_1", "N")]


def test_a_recorded_degree_of_freedom_has_the_unit_that_is_known_of_it(tmp_path: Path) -> None:
    """By the end of its label, by the direction that it is, or because the ground moves it."""
    np.savez(
        tmp_path / "a.npz", M=M4, K=K4, C=C4, labels=["sway", "turn", "2.rz", "lift"],
        influence=np.array([1.0, 0.0, 0.0, 0.0]),
    )  # fmt: skip
    more = """[numerical]
record = ["sway", "turn", "2.rz", "lift", "lift - sway", "element_1", "element_2", "element_3"]
[[numerical.nonlinear]]
dof = "2.rz"
law = { element = "viscous", c_n_s_per_m = 1 }
[[numerical.nonlinear]]
dof = "lift"
law = { element = "viscous", c_n_s_per_m = 1 }
[[numerical.nonlinear]]
between = ["lift", "sway"]
law = { element = "viscous", c_n_s_per_m = 1 }
[[interface]]
name = "x"
dof = "sway"
[[interface]]
name = "theta"
dof = { turn = -1 }"""
    test = from_file(tmp_path, 'file = "a.npz"', more)
    k_e = [[K_E, 0.0], [0.0, K_E]]
    wanted = ["m", "rad", "rad", "m or rad", "m", "N m", "N or N m", "N"]
    found = deriving.structure_of_test(test, k_e, 1.0 / 1024.0, turns=(False, True))
    assert [one.unit for one in found.part.responses] == wanted
    wanted[1] = "m"
    found = deriving.structure_of_test(test, k_e, 1.0 / 1024.0)
    assert [one.unit for one in found.part.responses] == wanted


def test_a_vertical_mode_of_a_frame_is_shown_as_vertical(tmp_path: Path) -> None:
    m, k, labels, corners = space_frame((2, 2), 1)
    m, k = m.toarray(), k.toarray()
    moved = np.zeros((len(labels), 1))
    moved[0::6] = 1.0
    np.savez(
        tmp_path / "a.npz", M=m, K=k, C=1e-4 * k, labels=labels, influence=moved, directions=["x"]
    )
    test = from_file(tmp_path, 'file = "a.npz"', f'[[interface]]\ndof = "{labels[corners[0]]}"')
    found = deriving.structure_of_test(test, K_E, 1.0 / 1024.0)
    assert isinstance(found, SparseStructure)
    k[corners[0], corners[0]] += K_E
    # The rotations have no mass: they follow the displacements statically.
    own = np.arange(len(labels)) % 6 < 3
    follow = np.linalg.solve(k[np.ix_(~own, ~own)], k[np.ix_(~own, own)])
    w2, phi = scipy.linalg.eigh(
        k[np.ix_(own, own)] - k[np.ix_(own, ~own)] @ follow, m[np.ix_(own, own)]
    )
    modes, ways = found.modes(), np.array(["x", "y", "z"] * 4)
    assert [one.frequency_hz for one in modes] == pytest.approx(np.sqrt(w2[:10]) / (2.0 * np.pi))
    vertical = []
    for i, mode in enumerate(modes):
        want, got = phi[:, i], np.array(mode.shape)[own]
        want = want / want[np.argmax(np.abs(want))]
        got = got * np.sign(got @ want)
        assert got == pytest.approx(want, abs=1e-6)
        most = ways[np.argmax(np.abs(want))]
        at, way = structure_figures._moving(found, np.array(mode.shape))
        assert np.abs(np.array(mode.shape)[at]).max() > 0.99
        assert way in ("", most)
        if np.abs(want[ways != "z"]).max() < 1e-3:
            vertical.append(i)
            assert way == "z"
            assert mode.effective_mass < 1e-6
    assert vertical


def test_modes_of_a_frame_whose_labels_tell_no_directions_are_drawn_within_the_figure() -> None:
    """The frame of the example: 3 horizontal displacements, 12 vertical ones, 14 rotations."""
    test = config.load_test(EXAMPLE.with_name("two-actuator-frame.toml"))
    rig = config.load_any_rig(config.shipped_rig("two-axis-frame"))
    assert isinstance(rig, config.AxesRig)
    group = axes_experiment.prepare(test, rig).group
    assert group is not None
    found = group.derived.structure
    assert isinstance(found, SparseStructure)
    drawn = structure_figures.modes(found)
    assert drawn.figure is not None
    (axes,) = drawn.figure.axes
    curves = [line for line in axes.lines if line.get_marker() == "o"]
    names = [text.get_text() for text in axes.get_xticklabels()]
    floors = [int(found.labels.index(name)) for name in ("13", "26", "x")]
    for i, (curve, mode, name) in enumerate(zip(curves, found.modes(), names, strict=False)):
        x = np.asarray(curve.get_xdata()) - 2.5 * i
        assert np.abs(x).max() == pytest.approx(1.0)
        # Sway is where the ground motion's mass is: the third and fourth modes have none of it.
        if mode.effective_mass > 1e-3:
            assert x == pytest.approx(np.array(mode.shape)[floors])
            assert "\n" not in name
        else:
            assert len(x) == 12
            assert name.endswith("\nin other directions")
    assert [one.effective_mass > 1e-3 for one in found.modes()[:5]] == [
        True,
        True,
        False,
        False,
        True,
    ]


# ---- what is refused ----------------------------------------------------------------------------


def changed(**arrays: Any) -> dict[str, Any]:
    return {"M": M4, "K": K4, "C": C4, "labels": LABELS, "influence": np.ones(4)} | arrays


def but(matrix: Any, i: int, j: int, value: float) -> Any:
    other = matrix.copy()
    other[i, j] = value
    return other


@pytest.mark.parametrize(
    ("arrays", "said"),
    [
        (changed(K=but(K4, 1, 2, 7.0)), ": K: found 7 in row 2, column 3 and -4.5e+06 in row 3"),
        (changed(M=but(M4, 2, 2, -5.0)), 'M: found a mass of -5 kg at "3.x" (row 3); must be 0 or'),
        (changed(K=but(K4, 0, 0, np.nan)), ": K: found nan in row 1, column 1; every number must"),
        (changed(C=but(C4, 3, 3, np.inf)), ": C: found inf in row 4, column 4"),
        (changed(K=K4[:3, :3]), "K has 3 rows and M 4"),
        (changed(K=K4[:3]), ": K: has 3 rows and 4 columns; must be square"),
        (changed(M=np.zeros((4, 4))), "M: found no mass"),
        (changed(labels=["a", "b", "a", "c"]), 'labels: found "a" twice; must be different'),
        (changed(labels=["a", "b"]), "labels: found 2 labels; must be 4"),
        (changed(influence=np.ones(3)), "influence: has the shape (3,); must have 4 rows"),
        (
            changed(influence=np.array([1.0, 1.0, np.nan, 1.0])),
            'influence: found nan at "3.x" (row 3, column 1); must be from -1e+06 to 1e+06',
        ),
        (
            changed(influence=np.array([[1.0, 0.0, 1.0, 2e6]])),
            'influence: found 2e+06 at "4.x" (row 1, column 4)',
        ),
        (
            changed(influence=np.array([[1.0, 0.0], [1.0, -np.inf], [1.0, 0.0], [0.0, 1.0]])),
            'influence: found -inf at "2.x" (row 2, column 2)',
        ),
        (changed(K=K4.astype(str)), ": K: found an array of <U"),
        ({"mass": M4, "K": K4}, "has no M; it must have M (masses, kg) and K"),
        (changed(M=but(but(M4, 0, 0, 0.0), 0, 1, 5.0)), "M: found 5 in row 1, column 2 and 0 in"),
        (
            changed(M=but(but(but(M4, 0, 0, 0.0), 0, 1, 5.0), 1, 0, 5.0)),
            "M: found 5 in row 1, column 2 beside a mass of 0 on the diagonal",
        ),
    ],
)
def test_a_file_that_is_no_structure_is_refused(
    arrays: dict[str, Any], said: str, tmp_path: Path
) -> None:
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(InputError) as caught:
        from_file(tmp_path, 'file = "a.npz"')
    assert said in str(caught.value)
    assert "a.npz" in str(caught.value)


TRIANGLE = {
    "size": 2, "M_row": [0, 1], "M_column": [0, 1], "M_value": [2e3, 2e3],
    "K_row": [0, 0, 1], "K_column": [0, 1, 1], "K_value": [8e6, -4e6, 4e6],
}  # fmt: skip


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"K_column": [0, 9, 1]}, "K: found K_column = 9 for entry 2; must be 0 to 1: rows and"),
        ({"K_row": [-1, 0, 1]}, "K: found K_row = -1 for entry 1; must be 0 to 1"),
        ({"K_row": [0.5, 0, 1]}, "K: found K_row of float64; must be whole numbers"),
        ({"K_row": [0, 0]}, "K: found 2 rows, 3 columns and 3 values"),
        (
            {"K_row": [0, 1, 1], "K_column": [0, 0, 1]},
            "K: found row 1, column 0 for entry 2, below",
        ),
        ({"K_value": ["a", "b", "c"]}, "K: found K_value of <U1; must be real numbers"),
        ({"size": 10**12}, "M: found size = 1000000000000; must be 1 to 20000"),
        ({"size": None}, "M: has M_value but no size; a sparse matrix is stored as M_row"),
        ({"K_value": [8e6, 1e300, 4e6]}, "K: found 1e+300 in row 1, column 2; must be from -1e+18"),
    ],
)
def test_a_sparse_matrix_whose_entries_are_not_in_it_is_refused(
    changed: dict[str, Any], said: str, tmp_path: Path
) -> None:
    arrays = {key: value for key, value in (TRIANGLE | changed).items() if value is not None}
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(InputError) as caught:
        from_file(tmp_path, 'file = "a.npz"')
    assert f"a.npz: {said}" in str(caught.value)


@pytest.mark.parametrize(("row", "said"), [(77, "row 78"), (-3, "row -2")])
def test_a_damaged_matlab_file_is_refused_with_the_entry(
    row: int, said: str, tmp_path: Path
) -> None:
    path, k = tmp_path / "a.mat", scipy.sparse.csc_matrix(K4)
    scipy.io.savemat(path, {"M": scipy.sparse.csc_matrix(M4), "K": k})
    content = path.read_bytes()
    places = k.indices.astype("<i4").tobytes()
    assert content.count(places) == 1
    damaged = np.append(row, k.indices[1:]).astype("<i4").tobytes()
    path.write_bytes(content.replace(places, damaged))
    with pytest.raises(InputError, match=rf"a\.mat: K: found an entry in {said} of column 1; the"):
        from_file(tmp_path, 'file = "a.mat"')


@pytest.mark.parametrize("in_front", [b"", b"MATLAB 7.3 MAT-file".ljust(512, b"\0")])
def test_a_matlab_file_of_version_7_3_is_refused_with_what_to_do(
    in_front: bytes, tmp_path: Path
) -> None:
    (tmp_path / "a.mat").write_bytes(in_front + b"\x89HDF\r\n\x1a\n" + bytes(2000))
    with pytest.raises(InputError, match=r"a\.mat: is an HDF5 file, as MATLAB writes"):
        from_file(tmp_path, 'file = "a.mat"')


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("k.csv", "2,1\n1,stiff\n", 'found "stiff" in line 2, column 2; must be a number'),
        ("k.csv", "u1,u2\n2,1\n1,2\n", 'found "u1" in line 1, column 1; must be a number'),
        ("k.csv", "2;1\n1;2\n", 'found "2;1" in line 1, column 1; must be a number'),
        ("k.csv", "# N/m\n2,1\n\n1\n", "found 1 numbers in line 4 and 2 in line 2"),
        ("k.csv", "", "has no numbers"),
        ("k.mtx", "%%MatrixMarket matrix coordinate real symmetric\n2 2 2\n1 1 2.0\n7 1 1.0\n",
         'out of bounds: "7 1 1.0"); in coordinate form each line holds row, column and value'),
        ("k.mtx", "%%MatrixMarket matrix coordinate real symmetric\n2 2 2\n1 1 2.0\n",
         "cannot be read as Matrix Market"),
        ("k.mtx", "%%MatrixMarket matrix coordinate real symmetric\n100000 100000 1\n1 1 2.0\n",
         "found 100000 rows and 100000 columns in its line of sizes; at most 20000"),
        ("k.mtx", "%%MatrixMarket matrix coordinate real symmetric\n2 2 1000000000000\n1 1 2.0\n",
         "found 1000000000000 entries in its line of sizes, more than the file can hold"),
        ("k.mtx", "%%MatrixMarket matrix array real general\n20000 20000\n2.0\n",
         "found 400000000 entries in its line of sizes, more than the file can hold"),
    ],
)  # fmt: skip
def test_a_text_file_that_is_no_matrix_is_refused_with_its_line(
    name: str, content: str, said: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(content)
    np.savetxt(tmp_path / "m.csv", np.eye(2), delimiter=",")
    with pytest.raises(InputError) as caught:
        from_file(tmp_path, f'files = {{ mass = "m.csv", stiffness = "{name}" }}')
    assert said in str(caught.value)
    assert name in str(caught.value)


def test_a_table_saved_by_a_spreadsheet_as_utf_8_is_read(tmp_path: Path) -> None:
    """Spreadsheets put a byte-order mark in front of the first number, and of the first label."""
    written = {"m.csv": "2,0\n0,1\n", "k.csv": "4,-1\n-1,1\n", "l.csv": "roof,floor\n"}
    for name, text in written.items():
        (tmp_path / name).write_text(text, encoding="utf-8-sig")
    files = {"mass": "m.csv", "stiffness": "k.csv", "labels": "l.csv"}
    read = matrixfile.read(MatrixFile.model_validate({"files": files}), tmp_path)
    assert read.labels == ("roof", "floor")
    assert read.mass_kg.matrix().toarray().tolist() == [[2.0, 0.0], [0.0, 1.0]]


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.npz", b"rubbish", "cannot be read as .npz"),
        ("a.mat", b"rubbish", "cannot be read as a MATLAB file"),
        ("a.xls", b"", 'file type ".xls" is not supported here; a .npz or .mat file'),
        ("b.npz", b"", "no such file; a relative path is relative to"),
    ],
)
def test_a_file_of_another_kind_is_refused(
    name: str, content: bytes, said: str, tmp_path: Path
) -> None:
    if name != "b.npz":
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError) as caught:
        from_file(tmp_path, f'file = "{name}"')
    assert said in str(caught.value)
    with pytest.raises(InputError, match="text that was not written by this program"):
        matrixfile.unpacked("AAAA")
    with pytest.raises(InputError, match="no such file"):
        matrixfile.read(MatrixFile.model_validate({"files": {"mass": "m.csv", "stiffness": "k"}}),
                        tmp_path)  # fmt: skip


@pytest.mark.parametrize(
    ("text", "where", "said"),
    [
        (STOREYS.replace("count = 5", "count = 0"), "count", "must be a whole number from 1 to"),
        (STOREYS.replace("2600", "-2600"), "mass_kg", "number 3: found -2600"),
        (STOREYS.replace(", 2200", ""), "mass_kg", "found 4 numbers for 5 storeys"),
        (STOREYS + "specimen = [6]", "specimen", "found storey 6 of 5"),
        (STOREYS + "p_delta = true", "p_delta", "found true without a height"),
        (STOREYS.replace("damping", "#"), "damping", "missing; storeys need it"),
        (STOREYS.replace("[1, 3]", "[1, 2, 3]"), "damping.modes", "Rayleigh damping is given at"),
        (STOREYS + "[[interface]]\ndof = 3", "interface.0.dof", "must be a label"),
        (STOREYS + f"[[numerical.nonlinear]]\n{LAW}", "nonlinear.0", "give exactly one of storeys"),
        (
            STOREYS
            + "[[numerical.nonlinear]]\nstoreys = [2]\nlaw = { element = 'inertia', m_kg = 1 }",
            "nonlinear.0.law",
            "enter a mass in the masses of the structure",
        ),
        ("numerical = { mass_kg = 1, damping_ratio = 0, record = ['x'] }", "record", "there are"),
        (
            "numerical = { mass_kg = 1, damping_ratio = 0 }\n[[interface]]\nstorey = 1",
            "interface",
            "needs a structure given by storeys",
        ),
        (
            STOREYS.replace("[numerical]", '[numerical]\nintegrator = "forward-euler"'),
            "integrator",
            "use kr-alpha, cr or central-difference",
        ),
        ("[numerical.matrices]\nfile = 'a'\nfiles = 'b'", "numerical.matrices", "must be a table"),
    ],
)
def test_keys_that_mean_nothing_are_refused_with_their_line(
    text: str, where: str, said: str
) -> None:
    with pytest.raises(InputError) as caught:
        config.parse_test(HEAD + text, "my.toml")
    message = str(caught.value)
    assert said in message
    assert where in message
    assert "my.toml:" in message


@pytest.mark.parametrize(
    ("more", "where", "said"),
    [
        ("[[interface]]\nstorey = 2", "interface.0", "the actuator moves the specimen, storey 1"),
        (f"[[numerical.nonlinear]]\nstoreys = [9]\n{LAW}", "nonlinear.0.storeys", "storey 9 of 5"),
        (f"[[numerical.nonlinear]]\nstoreys = [1]\n{LAW}", "nonlinear.0", "which is the specimen"),
        (f"[[numerical.nonlinear]]\ndof = '1'\n{LAW}", "nonlinear.0", "found degrees of freedom"),
    ],
)
def test_what_does_not_fit_the_storeys_is_refused(more: str, where: str, said: str) -> None:
    test, rig = (
        config.parse_test(HEAD + STOREYS + more),
        config.load_rig(config.find_rig("delay-10-elastic")),
    )
    with pytest.raises(InputError) as caught:
        config.derive(test, rig)
    assert said in str(caught.value)
    assert where in str(caught.value)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ('[[interface]]\ndof = "9.x"', 'interface.0.dof: found "9.x"'),
        ("", "interface: missing; state what the actuator moves"),
        ("[[interface]]\nstorey = 1", "found a storey; with matrices use dof"),
        ('[[interface]]\ndof = { "1.x" = 1 }\n[numerical]\nrecord = ["q"]', 'record.0: found "q"'),
        ('direction = "y"\n[[interface]]\ndof = "1.x"', 'found "y"; must be one of "1"'),
        ("specimen = { mass_kg = 1e6 }\n[[interface]]\ndof = '1.x'", "numerical.matrices: "),
        (
            "specimen = { stiffness_n_per_m = 1e9 }\n[[interface]]\ndof = '1.x'",
            "must be restrained",
        ),
        (
            "[[interface]]\ndof = '1.x'\n[numerical]\ndamping = { ratio = 0.1, modes = [1, 9] }",
            "found mode 9; the structure has 4 modes",
        ),
        (
            '[[interface]]\ndof = "1.x"\n[[numerical.nonlinear]]\nbetween = ["2.x", "2.x"]\n' + LAW,
            'found "2.x" twice',
        ),
    ],
)
def test_what_does_not_fit_the_matrices_is_refused(more: str, said: str, tmp_path: Path) -> None:
    test = from_file(tmp_path, written(tmp_path, "npz"), more)
    rig = config.load_rig(config.find_rig("delay-10-elastic"))
    with pytest.raises(InputError) as caught:
        config.derive(test, rig)
    assert said in str(caught.value)


@pytest.mark.parametrize("storeys", [6, 260])
def test_a_motion_that_nothing_restrains_is_named_by_its_labels(
    storeys: int, tmp_path: Path
) -> None:
    # Without the spring below them, the three top storeys float.
    m, k = shear_building(np.full(storeys, 5000.0), np.full(storeys, 8e6))
    cut = storeys - 3
    k[cut - 1 : cut + 1, cut - 1 : cut + 1] -= 8e6 * np.array([[1.0, -1.0], [-1.0, 1.0]])
    labels = [f"{i + 1}.x" for i in range(storeys)]
    np.savez(tmp_path / "cut.npz", M=m, K=k, C=1e-4 * k, labels=labels)
    test = from_file(tmp_path, 'file = "cut.npz"')
    with pytest.raises(InputError, match="the stiffness of the whole structure") as caught:
        config.derive(test, config.load_rig(config.find_rig("delay-10-elastic")))
    named = {f'"{i}.x"' for i in range(cut + 1, storeys + 1)}
    said = str(caught.value).partition("nothing restrains ")[2].partition(";")[0]
    assert set(said.split(", ")) == named


@pytest.mark.parametrize("seed", range(6))
def test_a_frame_that_is_free_to_turn_about_its_support_is_refused(seed: int) -> None:
    points = np.cumsum(np.random.default_rng(seed).normal(size=(8, 3)), axis=0)
    k = np.zeros((48, 48))
    for i, (start, end) in enumerate(itertools.pairwise(points)):
        at = slice(6 * i, 6 * i + 12)
        k[at, at] += beam_stiffness(start, end, 1e-3, 1e-6, 2e-6, 1e-6)
    k[range(6), range(6)] += 1e9
    assert np.all(sparse.factored(k, "K").factors()[1] > 0.0)
    k[5, 5] -= 1e9
    with pytest.raises(CoreError, match="K is not positive definite"):
        sparse.factored(k, "K")


def test_a_library_that_is_missing_is_named_and_the_structure_is_not_blamed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(sys.modules, "qdldl", None)
    with pytest.raises(InputError) as caught:
        structure(STOREYS)
    assert str(caught.value).endswith('pip install "rthyb-rt[structures]"')
    assert "missing spring" not in str(caught.value)


def test_floors_so_heavy_that_the_storeys_topple_are_told_from_a_missing_spring() -> None:
    heavy = STOREYS + 'height_m = "3 m"\np_delta = true\n'
    heavy = heavy.replace("[3000, 2800, 2600, 2400, 2200]", "3e6")
    with pytest.raises(InputError, match="a weight in p_delta under which the storeys topple"):
        structure(heavy)


def test_a_file_that_is_no_npz_is_refused_without_the_advice_to_run_what_is_in_it(
    tmp_path: Path,
) -> None:
    (tmp_path / "a.npz").write_text("garbage", encoding="utf-8")
    with pytest.raises(
        InputError, match=r"a\.npz: cannot be read as \.npz: not an .npz file"
    ) as caught:
        matrixfile.read(MatrixFile(file="a.npz"), tmp_path)
    assert "pickle" not in str(caught.value)
    np.savez(tmp_path / "a.npz", M=np.eye(1), K=np.eye(1), labels=np.array(["x"], dtype=object))
    with pytest.raises(InputError, match="labels as text, not as arrays of Python objects"):
        matrixfile.read(MatrixFile(file="a.npz"), tmp_path)


def test_a_central_difference_beyond_its_bound_is_refused() -> None:
    stiff = STOREYS.replace("4.5 MN/m", "40000 MN/m").replace(
        "[numerical]", '[numerical]\nintegrator = "central-difference"'
    )
    with pytest.raises(InputError, match="central-difference at 1024 Hz is unstable"):
        structure(stiff)


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("M.csv", but(M4, 1, 1, -1.0), 'M: found a mass of -1 kg at "2.x" (row 2)'),
        ("K.csv", but(K4, 1, 2, 7.0), "K: found 7 in row 2, column 3"),
        ("C.csv", C4[:3, :3], "C has 3 rows and M 4"),
        ("labels.txt", ["1.x", "2.x", "1.x", "4.x"], 'labels: found "1.x" twice'),
        ("labels.txt", ["1.x", "2.x", "3.x"], "labels: found 3 labels; must be 4"),
        ("influence.csv", np.array([1.0, np.nan, 1.0, 1.0]), 'influence: found nan at "2.x"'),
        ("influence.csv", np.ones(3), "influence: has the shape (3, 1)"),
    ],
)
def test_of_several_files_the_one_with_the_error_is_named(
    name: str, content: Any, said: str, tmp_path: Path
) -> None:
    matrices = written(tmp_path, "csv").replace(" }", ', influence = "influence.csv" }')
    np.savetxt(tmp_path / "influence.csv", np.ones(4))
    np.savetxt(tmp_path / name, content, delimiter=",", fmt="%s")
    with pytest.raises(InputError) as refused:
        from_file(tmp_path, matrices)
    assert said in str(refused.value)
    assert str(tmp_path / name) in str(refused.value)


# ---- motions without mass ------------------------------------------------------------------------

JOINTED = np.array([[6e6, -3e6, 0.0], [-3e6, 5e6, -2e6], [0.0, -2e6, 2e6]])
"""Three springs in a row, the joint between the second and the third without mass."""


def jointed(folder: Path, keys: str, mass: Any = (3000.0, 0.0, 2000.0)) -> SparseStructure:
    m = np.asarray(mass)
    np.savez(folder / "a.npz", M=np.diag(m) if m.ndim == 1 else m, K=JOINTED, C=1e-4 * JOINTED)
    path = folder / "test.toml"
    path.write_text(
        f'{HEAD}numerical.matrices.file = "a.npz"\n{keys}\n[[interface]]\nname = "x"\ndof = "1"\n'
    )
    found = deriving.structure_of_test(config.load_test(path), K_E, 1.0 / 1024.0)
    assert isinstance(found, SparseStructure)
    return found


@pytest.mark.parametrize(
    ("keys", "where", "value"),
    [
        ('numerical.integrator = "cr"', "numerical.integrator", 'found "cr"'),
        ("numerical.rho_inf = 1.0", "numerical.rho_inf", "found rho_inf = 1"),
        (
            'numerical.integrator = "central-difference"',
            "numerical.integrator",
            'found "central-difference", which divides by the mass',
        ),
    ],
)
def test_a_joint_without_mass_is_refused_with_an_integrator_that_cannot_calm_it(
    keys: str, where: str, value: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError) as refused:
        jointed(tmp_path, keys)
    assert refused.value.problems[0].where.endswith(where)
    assert value in str(refused.value)
    assert 'without mass: "2"; use integrator = "kr-alpha"' in str(refused.value)
    # With mass there the same keys are good.
    jointed(tmp_path, keys, (3000.0, 500.0, 2000.0))


def test_a_row_of_equal_motions_with_one_mass_is_refused_where_each_has_a_diagonal(
    tmp_path: Path,
) -> None:
    """A mass at the mean of two degrees of freedom: their difference has none."""
    mean = np.array([[3000.0, 0, 0], [0, 500, 500], [0, 500, 500]])
    with pytest.raises(InputError, match="a combination of degrees of freedom"):
        jointed(tmp_path, 'numerical.integrator = "cr"', mean)


@pytest.mark.parametrize("rho_inf", [0.0, 0.5, 0.8, 0.95])
def test_a_joint_without_mass_dies_out_at_the_spectral_radius_at_infinity(
    rho_inf: float, tmp_path: Path
) -> None:
    """Kolay & Ricles (2014): both roots of an infinite frequency are -rho_inf."""
    found = jointed(tmp_path, f"numerical.rho_inf = {rho_inf}")
    step = LinearStep.of(replace(found.part, k_e_n_per_m=(0.0,)))
    roots = np.linalg.eigvals(step.a)
    at_half = roots[np.argmin(np.abs(roots + rho_inf))]
    assert at_half == pytest.approx(-rho_inf, abs=1e-6)
    assert np.abs(roots).max() < 1.0
