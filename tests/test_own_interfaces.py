"""Numerical parts of your own with several interfaces, on rigs of several axes.

Each is compared with the same M, C, K as matrices in files: a second formulation of the step.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rthyb_rt as rt
from rthyb_rt import config, core
from rthyb_rt.api import files
from rthyb_rt.config import AxesRig
from rthyb_rt.core import CoreError, own
from rthyb_rt.core.numerical_parts import Part
from rthyb_rt.core.own import PythonPartConfig
from rthyb_rt.core.own_library import LibraryConfig, tried
from rthyb_rt.core.own_parts import of_plain
from rthyb_rt.lab import axes_experiment

ROOT = Path(__file__).resolve().parents[1]
OWN = ROOT / "examples" / "own_parts"
K_E = ((2.324117e6, 8.612325e5), (8.612325e5, 1.085954e6))
PARAMETERS = {
    "mass_kg": 8000.0, "inertia_kg_m2": 400.0, "damping_n_s_per_m": 20600.0,
    "damping_n_m_s_per_rad": 4900.0, "stiffness_n_per_m": 3.0e6, "stiffness_n_m_per_rad": 5.0e6,
    "coupling_n": 4.0e5,
}  # fmt: skip
SETTINGS = tuple(PARAMETERS.items())
MASS, DAMPING = np.diag([8000.0, 400.0]), np.diag([20600.0, 4900.0])
STIFFNESS = np.array([[3.0e6, 4.0e5], [4.0e5, 5.0e6]])
SIGNALS = ("x_num_m", "x_num_m_1", "x_meas_m", "x_meas_m.1", "f_meas_n", "f_meas_n.1")


def compiled(folder: Path, source: str, name: str = "corner") -> str:
    (folder / f"{name}.c").write_text(source, encoding="utf-8")
    target = folder / f"{name}.so"
    subprocess.run(
        ["gcc", "-O2", "-ffp-contract=off", "-shared", "-fPIC", f"-I{ROOT / 'csrc'}",
         folder / f"{name}.c", "-o", target],
        check=True,
    )  # fmt: skip
    return str(target)


def in_c(folder: Path) -> str:
    """The example in C, built with the options in its first lines."""
    return compiled(folder, (OWN / "corner.c").read_text("utf-8"))


@pytest.fixture(scope="module")
def corner(tmp_path_factory: pytest.TempPathFactory) -> str:
    return in_c(tmp_path_factory.mktemp("corner"))


@pytest.fixture(scope="module")
def in_python() -> str:
    """The example in Python, importable under a name of its own."""
    spec = importlib.util.spec_from_file_location("own_corner", OWN / "corner_in_python.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["own_corner"] = module
    spec.loader.exec_module(module)
    return "own_corner:Corner"


def inline(value: Any) -> str:
    """A value in TOML."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {inline(one)}" for key, one in value.items()) + " }"
    return json.dumps(value)


def short(folder: Path, kind: str, given: dict[str, Any], **more: Any) -> rt.Test:
    """Three seconds of the example with a numerical part of this kind, and values by key."""
    text = (OWN / "corner.toml").read_text("utf-8").replace('"10 s"', '"3 s"')
    head, rest = text.split("\n[numerical.library]\n")
    tables = "\n[[interface]]" + rest.split("[[interface]]", 1)[1]
    if "interface" in more:
        rows = "".join(f"[[interface]]\n{_lines(one)}" for one in more.pop("interface"))
        tables = f"\n{rows}[controller]" + tables.split("[controller]")[1]
    path = folder / "test.toml"
    path.write_text(f"{head}\n[numerical.{kind}]\n{_lines(given)}{tables}", encoding="utf-8")
    return rt.Test(path, **more)


def _lines(given: dict[str, Any]) -> str:
    return "".join(f"{key} = {inline(value)}\n" for key, value in given.items())


def by_library(folder: Path, file: str, **more: Any) -> rt.Test:
    return short(folder, "library", {"file": file, "parameters": PARAMETERS}, **more)


def by_matrices(
    folder: Path, integrator: str = "cr", influence: tuple[float, float] = (1.0, 0.0), **more: Any
) -> rt.Test:
    """The same test with matrices from files."""
    given = {"mass": MASS, "damping": DAMPING, "stiffness": STIFFNESS} | more
    names = {}
    for name, matrix in given.items():
        np.savetxt(folder / f"{name}.csv", matrix, delimiter=",")
        names[name] = f"{name}.csv"
    (folder / "labels.txt").write_text("side\nturn\n", encoding="utf-8")
    np.savetxt(folder / "influence.csv", influence)
    names |= {"labels": "labels.txt", "influence": "influence.csv"}
    text = (OWN / "corner.toml").read_text("utf-8")
    head, rest = text.split("\n[numerical]")
    middle = f'\n[numerical]\nintegrator = "{integrator}"\n[numerical.matrices.files]\n'
    middle += "".join(f'{key} = "{file}"\n' for key, file in names.items())
    middle += '[[interface]]\nname = "x"\ndof = "side"\n[[interface]]\nname = "theta"\n'
    middle += 'dof = "turn"\n[controller]' + rest.split("[controller]")[1]
    path = folder / "matrices.toml"
    path.write_text(head.replace('"10 s"', '"3 s"') + middle, encoding="utf-8")
    return rt.Test(path)


def close(one: rt.Recording, other: rt.Recording, names: tuple[str, ...] = SIGNALS) -> None:
    """Compare up to the end of the test proper; its ramp depends on the reference simulation."""
    running = core.STATES.index("RUNNING")
    rows = 1 + int(np.flatnonzero(one["state"] == running)[-1])
    assert rows > 3 * 1024
    for name in names:
        found, expected = one[name][:rows], other[name][:rows]
        peak = np.abs(expected).max()
        assert peak > 0.0
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * peak, err_msg=name)


# ---- against matrices ---------------------------------------------------------------------------


def test_a_library_with_two_interfaces_does_what_the_same_matrices_do(
    corner: str, tmp_path: Path
) -> None:
    rec, other = rt.run(by_library(tmp_path, corner)), rt.run(by_matrices(tmp_path))
    assert rec.completed
    close(rec, other)
    # In CR the velocity is the change over the last step.
    turned = np.diff(rec["x_num_m_1"]) * 1024
    alike = np.abs(rec["corner_rate"][1:] - turned) < 1e-9 * np.abs(turned).max()
    assert alike[200:-200].all()


@pytest.mark.long
def test_a_class_in_python_does_so_too(in_python: str, corner: str, tmp_path: Path) -> None:
    given = {"class": in_python, "settings": PARAMETERS}
    mine = short(tmp_path, "python", given)
    rec = rt.run(mine)
    close(rec, rt.run(by_library(tmp_path, corner)))
    assert rt.replay(rec).identical


def test_the_reference_has_the_specimens_masses_as_forces(corner: str, tmp_path: Path) -> None:
    """Matrices hold the specimen in the step; a library meets it as a force, one step later."""
    one, other = (
        axes_experiment.prepare(files.file_of_test(test), rig_of(test))
        for test in (by_library(tmp_path, corner), by_matrices(tmp_path))
    )
    assert one.group is not None
    assert other.group is not None
    for name in ("x", "force", "axis_m", "axis_n"):
        found, expected = getattr(one.group.reference, name), getattr(other.group.reference, name)
        peaks = np.abs(expected).max(axis=0)
        assert np.all(np.abs(found - expected).max(axis=0) < 0.01 * peaks), name


def rig_of(test: rt.Test) -> AxesRig:
    found = files.file_of_rig(test.rig)
    assert isinstance(found, AxesRig)
    return found


def test_a_recording_is_replayed_bit_for_bit_with_its_library(corner: str, tmp_path: Path) -> None:
    path = tmp_path / "kept.h5"
    rt.run(by_library(tmp_path, corner)).save(path)
    again = rt.open(path)
    assert rt.replay(again).identical
    assert "number = 2" in again.test.to_toml()


# ---- the order of the interfaces ----------------------------------------------------------------


@pytest.mark.long
def test_the_number_of_an_interface_finds_its_direction(corner: str, tmp_path: Path) -> None:
    """A library that counts the rotation first, and a file that says so."""
    source = (OWN / "corner.c").read_text("utf-8")
    for name in ("force_n", "x_next_m"):
        source = source.replace(f"{name}[i]", f"{name}[1 - i]")
    source = source.replace("k_e[i * INTERFACES + j]", "k_e[(1 - i) * INTERFACES + 1 - j]")
    swapped = compiled(tmp_path, source, "swapped")
    tables = [{"name": "x", "number": 2}, {"name": "theta", "number": 1}]
    rec = rt.run(by_library(tmp_path, swapped, interface=tables))
    other = rt.run(by_library(tmp_path, corner))
    for name in SIGNALS:
        np.testing.assert_array_equal(rec[name], other[name], err_msg=name)
    assert rt.replay(rec).identical


@pytest.mark.long
def test_the_order_of_the_tables_does_not_matter(corner: str, tmp_path: Path) -> None:
    tables = [{"name": "theta", "number": 2}, {"name": "x", "number": 1}]
    rec = rt.run(by_library(tmp_path, corner, interface=tables))
    other = rt.run(by_library(tmp_path, corner))
    for name in SIGNALS:
        np.testing.assert_array_equal(rec[name], other[name], err_msg=name)


def test_settings_are_read_back_as_they_were_written(corner: str, in_python: str) -> None:
    parts = [
        LibraryConfig(corner, K_E, SETTINGS, place=(1, 0)),
        LibraryConfig(corner, K_E, SETTINGS, place=(0, 1)),
        PythonPartConfig(own.OwnClass(in_python, SETTINGS), K_E, place=(1, 0)),
    ]
    for part in parts:
        found = of_plain(json.loads(json.dumps(part.plain())))
        assert found.place == part.place
        assert found.k_e_n_per_m == part.k_e_n_per_m
        assert found.plain() == part.plain()
    with pytest.raises(CoreError, match=r"each of 0 to 1 must occur once"):
        Part(LibraryConfig(corner, K_E, SETTINGS, place=(0, 0)))


# ---- saved, frozen, timed -----------------------------------------------------------------------


@pytest.mark.parametrize("place", [(0, 1), (1, 0)])
def test_a_state_is_saved_and_restored_as_bytes(corner: str, place: tuple[int, int]) -> None:
    part = Part(LibraryConfig(corner, K_E, SETTINGS, place=place))
    forces = 1e3 * np.sin(np.arange(160).reshape(80, 2) / 5.0)

    def run(rows: Any) -> list[list[float]]:
        found = []
        for force in rows:
            found.append(part.answer_all(0.2, force.tolist())[0].tolist())
            part.advance()
        return found

    run(forces[:40])
    kept = part.save()
    first = run(forces[40:])
    part.restore(kept)
    assert run(forces[40:]) == first


def test_time_stands_still_while_a_path_moves_the_axes(tmp_path: Path) -> None:
    more = """
void rthyb_part_freeze(void *state, const double *force_n)
{
    corner *s = state;
    s->v[0] += 1e-9 * force_n[0];
    s->v[1] += 1e-6 * force_n[1];
}
"""
    source = (OWN / "corner.c").read_text("utf-8") + more
    part = Part(LibraryConfig(compiled(tmp_path, source, "frozen"), K_E, SETTINGS, place=(1, 0)))
    before = part.motion()[0]
    part.freeze_all([300.0, 500.0])
    assert np.array_equal(part.motion()[0], before)
    # Interface 1 of the part stands at the second place of the rig.
    assert part.reported(2) == pytest.approx([1e-9 * 500.0, 1e-6 * 300.0], rel=1e-12)


def test_the_trial_meets_the_whole_matrix_of_the_specimen(tmp_path: Path, corner: str) -> None:
    """Without the coupling of the specimen, its negative stiffness would not be held."""
    found = tried(LibraryConfig(corner, K_E, SETTINGS))
    assert found.allocations == 0
    assert found.system_call is None
    assert not found.ill
    # Restrained by the specimen alone, in the coupled direction: two springs of a mechanism.
    free = PARAMETERS | {
        "stiffness_n_per_m": 0.0, "stiffness_n_m_per_rad": 0.0, "coupling_n": 0.0,
        "damping_n_s_per_m": 0.0, "damping_n_m_s_per_rad": 0.0,
    }  # fmt: skip
    assert not tried(LibraryConfig(corner, K_E, tuple(free.items()))).ill


def test_it_may_run_in_real_time_and_its_step_is_timed(corner: str, tmp_path: Path) -> None:
    test = by_library(tmp_path, corner)
    setup = axes_experiment.prepare(files.file_of_test(test), rig_of(test), real_time=True)
    assert setup.controller.numerical is not None
    source = (OWN / "corner.c").read_text("utf-8")
    source = source.replace(
        "int32_t rthyb_part_advance(void *state)\n{\n",
        "#include <stdlib.h>\nint32_t rthyb_part_advance(void *state)\n{\n"
        "    void *volatile block = malloc(8);\n    free(block);\n",
    )
    greedy = by_library(tmp_path, compiled(tmp_path, source, "greedy"))
    with pytest.raises(rt.InputError, match="allocates or frees memory"):
        axes_experiment.prepare(files.file_of_test(greedy), rig_of(greedy), real_time=True)


def test_an_old_library_with_one_interface_goes_on_working(tmp_path: Path) -> None:
    """Built with version 1 of the header, whose setup ended after three entries."""
    source = """
#include <stdint.h>
typedef struct { double period_s; const double *parameter, *k_e_n_per_m; } setup;
typedef struct { double h, k, x, x1; } state;
int32_t rthyb_part_version(void) { return 1; }
int32_t rthyb_part_interfaces(void) { return 1; }
int64_t rthyb_part_state_bytes(const setup *s) { (void)s; return sizeof(state); }
int32_t rthyb_part_init(void *at, const setup *s)
{
    *(state *)at = (state){.h = s->period_s, .k = *s->k_e_n_per_m};
    return s->k_e_n_per_m[0] == 666400.0 ? 0 : 7;
}
int32_t rthyb_part_answer(void *at, double ag, const double *force, double *x)
{
    state *s = at;
    const double next = 2.0 * s->x - s->x1 - s->h * s->h * (ag + *force / 4220.0);
    s->x1 = s->x;
    *x = s->x = next;
    return 0;
}
"""
    given = {"ground_motion": {"duration_s": 3}, "test": {"free_vibration_s": 0.5}}
    old = rt.Test("section5-T0.5", **given)
    rec = rt.run(old.with_({"numerical.library": {"file": compiled(tmp_path, source, "old")}}))
    assert rec.completed
    assert rt.replay(rec).identical


# ---- refused ------------------------------------------------------------------------------------


def refusal(test: rt.Test) -> str:
    with pytest.raises(rt.InputError) as caught:
        axes_experiment.prepare(files.file_of_test(test), rig_of(test))
    return str(caught.value)


def test_a_part_with_one_interface_too_few_is_refused_with_both_numbers(
    corner: str, in_python: str, tmp_path: Path
) -> None:
    one = compiled(tmp_path, (OWN / "oscillator.c").read_text("utf-8"), "one")
    given = {"mass_kg": 4220, "damping_n_s_per_m": 2121, "stiffness_n_per_m": 0}
    said = refusal(short(tmp_path, "library", {"file": one, "parameters": given}))
    assert "one.so: rthyb_part_interfaces returns 1; it must be 2" in said
    assert "numerical.library.file" in said
    alone = rt.Test("section5-T0.5").with_(
        {"numerical.library": {"file": corner, "parameters": PARAMETERS}}
    )
    with pytest.raises(rt.InputError, match=r"returns 2; it must be 1, because the rig has one"):
        rt.run(alone)
    mine = {"numerical.python": {"class": in_python, "settings": PARAMETERS}}
    with pytest.raises(rt.InputError, match=r"interfaces is 2; it must be 1"):
        rt.run(rt.Test("section5-T0.5").with_(mine))


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        ([{"name": "x", "number": 1}, {"name": "theta", "number": 1}], "found the numbers 1, 1"),
        ([{"name": "x", "number": 1}, {"name": "theta", "number": 3}], "each of 1 to 2"),
        ([{"name": "x", "number": 1}, {"name": "theta", "dof": "a"}], "interface 2 has no number"),
        ([{"name": "x", "number": 0}, {"name": "theta", "number": 1}], "number of the interface"),
    ],
)
def test_numbers_that_leave_an_interface_open_are_refused(
    tables: list[dict[str, Any]], said: str, tmp_path: Path
) -> None:
    with pytest.raises(rt.InputError, match=said):
        files.file_of_test(by_library(tmp_path, "corner.so", interface=tables))


def test_a_number_in_a_structure_is_refused(tmp_path: Path) -> None:
    tables = [{"name": "x", "number": 1}, {"name": "theta", "dof": "turn"}]
    with pytest.raises(rt.InputError, match=r"number = 1, which is for a numerical part of your"):
        by_matrices(tmp_path).with_(interface=tables)


@pytest.mark.parametrize(
    ("key", "line", "said"),
    [
        ("period_s", "mass_kg = 8000", "8000 kg; on a rig with several axes"),
        ("damping_ratio", "damping_n_s_per_m = 100", "state period_s and damping_ratio"),
        (
            "damping_ratio", "damping_ratio = 0.05\nstiffness_n_per_m = 1e6",
            "a single stiffness does not describe",
        ),
    ],
)  # fmt: skip
def test_values_for_one_degree_of_freedom_are_refused(
    key: str, line: str, said: str, corner: str, tmp_path: Path
) -> None:
    by_library(tmp_path, corner)
    path = tmp_path / "test.toml"
    path.write_text(re.sub(rf"(?m)^{key} = .*$", line, path.read_text("utf-8")), "utf-8")
    assert said in refusal(rt.Test(path))


def test_a_wrong_period_is_noted(corner: str, tmp_path: Path) -> None:
    notes = rt.check(by_library(tmp_path, corner, **{"numerical.period_s": 0.5})).notes
    assert any("its period is 0.25" in note for note in notes)
    notes = rt.check(by_library(tmp_path, corner)).notes
    assert not any("states a period" in note for note in notes)


def test_a_class_that_forgets_an_interface_is_told_so(tmp_path: Path) -> None:
    import own_parts

    part = PythonPartConfig(own.spelled(own_parts.Forgetful()), K_E, place=(0, 1))
    with pytest.raises(rt.RthybError, match=r"returned 1 values instead of 2; .* each interface"):
        Part(part).answer_all(0.0, [1.0, 2.0])


@pytest.mark.long
def test_check_and_report_say_what_is_not_known_of_a_part_of_ones_own(
    corner: str, tmp_path: Path
) -> None:
    test = by_library(tmp_path, corner)
    found = rt.check(test)
    text = str(found.table)
    assert "a numerical part of your own, library" in text
    assert "the matrices of your own part are not known" in text
    rec = rt.run(test)
    page = rec.report(tmp_path / "report.html").read_text("utf-8")
    assert "whose energies are not known" in page
    with pytest.raises(rt.InputError, match="energy balance"):
        rec.energy_balance()


def test_a_test_file_of_the_examples_names_the_library_beside_it(
    corner: str, tmp_path: Path
) -> None:
    path = tmp_path / "corner.toml"
    path.write_text((OWN / "corner.toml").read_text("utf-8"), encoding="utf-8")
    (tmp_path / "corner.so").write_bytes(Path(corner).read_bytes())
    test = config.load_test(path)
    assert test.numerical.library is not None
    assert test.numerical.library.file == str(tmp_path / "corner.so")


def test_an_example_in_python_runs_where_it_was_started_beside_its_library(
    corner: str, tmp_path: Path
) -> None:
    """As an installed command, which does not look for modules in the folder where it is."""
    text = (OWN / "corner.toml").read_text("utf-8")
    named = '[numerical.library]\nfile = "corner.so"\n\n[numerical.library.parameters]\n'
    assert named in text
    table = '[numerical.python]\nclass = "{}:Corner"\n\n[numerical.python.settings]\n'
    (tmp_path / "corner.so").write_bytes(Path(corner).read_bytes())
    for file in ("corner_in_python.py", "corner.toml"):
        (tmp_path / file).write_text((OWN / file).read_text("utf-8"), encoding="utf-8")
    (own_class,) = re.findall(r'#   class = "(\w+):Corner"', text)
    (tmp_path / "mine.toml").write_text(text.replace(named, table.format(own_class)), "utf-8")
    program = Path(sys.executable).with_name("rthyb")
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    for folder, expected in ((tmp_path, 0), (tmp_path.parent, 3)):
        done = subprocess.run(
            [program, "check", tmp_path / "mine.toml", "--set", "ground_motion.duration_s=1"],
            cwd=folder, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == expected, done.stderr
    assert "start the program in the module's folder" in done.stderr
