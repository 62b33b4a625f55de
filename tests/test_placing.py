"""A fault that shows only between two files names the file and the line that hold the key."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import rthyb_rt as rt
from rthyb_rt import config
from rthyb_rt.config.placing import NOWHERE, placing
from rthyb_rt.errors import InputError, Problem
from rthyb_rt.lab import experiment

TEST = """schema = "rthyb-test/1"
rig = "delay-10-bouc-wen"

[test]
name = "frame"

[ground_motion]
record = "elcentro-1940-ns"
pga_g = 0.02

[numerical]
damping = { ratio = 0.02, modes = [1, 2] }

[numerical.storeys]
count = 3
mass_kg = 2700
stiffness_n_per_m = 4.7e6

[[numerical.nonlinear]]
storeys = [2, 3]
law = { element = "hysteresis", k_n_per_m = 4.7e6, post_yield_ratio = 0.1, eta = 2, xy_m = 0.006 }

[[interface]]
name = "first-storey"
storey = 1
"""


def line_of(text: str) -> int:
    (line,) = (i for i, row in enumerate(TEST.splitlines(), 1) if row.startswith(text))
    return line


def refused(folder: Path, old: str, new: str, *settings: str) -> str:
    file = folder / "frame.toml"
    assert old in TEST
    file.write_text(TEST.replace(old, new))
    with pytest.raises(InputError) as caught:
        experiment.prepare(*config.load_both(file, None, settings))
    return str(caught.value).replace(str(file), "frame.toml")


@pytest.mark.parametrize(
    ("old", "new", "row", "said"),
    [
        ("storey = 1", "storey = 3", "[[interface]]", "interface.0: found storey 3"),
        ("modes = [1, 2]", "modes = [1, 9]", "damping", "numerical.damping.modes: found mode 9"),
        ("[2, 3]", "[2, 7]", "storeys", "numerical.nonlinear.0.storeys: found storey 7 of 3"),
    ],
)
def test_slip_that_only_the_whole_structure_shows_is_answered_with_its_line(
    tmp_path: Path, old: str, new: str, row: str, said: str
) -> None:
    assert refused(tmp_path, old, new).startswith(f"frame.toml:{line_of(row)}: {said}")


def test_slip_in_an_option_is_answered_with_the_option(tmp_path: Path) -> None:
    said = refused(tmp_path, "", "", "numerical.damping.modes=[1, 8]")
    assert said.startswith("--set numerical.damping.modes: found mode 8")


def test_key_that_stands_nowhere_is_answered_with_the_file(tmp_path: Path) -> None:
    matrices = tmp_path / "three.npz"
    k = np.diag([2e6, 2e6, 1e6]) - np.diag([1e6, 1e6], 1) - np.diag([1e6, 1e6], -1)
    np.savez(matrices, M=np.eye(3) * 1e3, K=k, labels=np.array(["a", "b", "c"]))
    storeys = TEST[TEST.index("[numerical.storeys]") :]
    said = refused(tmp_path, storeys, f'[numerical.matrices]\nfile = "{matrices}"\n')
    assert said.startswith("frame.toml: interface: missing; state what the actuator moves")


def test_a_key_of_both_files_is_that_of_the_file_which_has_it() -> None:
    test = config.parse_test(TEST, "frame.toml")
    text = config.shipped_rig("shaking-table-portal-frame").read_text()
    text += '\n[limits]\nforce_n = "20 kN"\n'
    rig = config.parse_rig(text, "table.toml")

    @placing
    def find(*_: object) -> None:
        raise InputError([Problem("limits.force_n", "too much"), Problem("elsewhere", "lost")])

    with pytest.raises(InputError) as caught:
        find(test, rig)
    table, lost = caught.value.problems
    assert table.where.startswith("table.toml:")
    assert text.splitlines()[int(table.where.split(":")[1]) - 1].startswith("force_n")
    assert str(caught.value).splitlines()[1] == "elsewhere: lost"
    assert lost == Problem("elsewhere", "lost")


@pytest.mark.parametrize("name", ["test.toml", "rig.toml", "numerical.toml"])
def test_file_that_is_named_like_one_of_its_tables_has_its_place_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    # From its own folder its path is its name, which a place in it begins with.
    monkeypatch.chdir(tmp_path)
    Path(name).write_text(TEST.replace("storey = 1", "storey = 3"))
    with pytest.raises(InputError) as caught:
        experiment.prepare(*config.load_both(Path(name), None, ()))
    (problem,) = caught.value.problems
    assert problem.where == f"{name}:{line_of('[[interface]]')}: interface.0"


def test_what_looks_like_a_key_and_is_none_stays_as_it_is() -> None:
    test = config.parse_test(TEST, "frame.toml")

    @placing
    def find(*_: object) -> None:
        raise InputError([Problem("test.at2", "not there"), Problem("test.toml:3: rig", "unknown")])

    with pytest.raises(InputError) as caught:
        find(test)
    assert [one.where for one in caught.value.problems] == ["test.at2", "test.toml:3: rig"]


def test_where_it_was_read_is_no_part_of_a_test() -> None:
    one, other = config.parse_test(TEST, "a.toml"), config.parse_test(TEST, "b.toml")
    assert one == other
    assert one.source.path != other.source.path
    assert one.model_copy(update={"rig": "x"}).source.path == "a.toml"
    assert "source" not in one.model_dump()
    sine = {"kind": "sine", "amplitude_m": 0.001, "frequency_hz": 1.0, "cycles": 2}
    made = config.check_values(config.TestFile, {"test": {"name": "x"}, "history": sine}, "Test")
    assert made.source == NOWHERE
    assert made.source.path == ""


def test_values_made_in_python_are_named_by_key() -> None:
    made = rt.Test(
        rig="delay-10-bouc-wen",
        test={"name": "frame"},
        ground_motion={"record": "elcentro-1940-ns", "pga_g": 0.02},
        numerical={
            "storeys": {"count": 3, "mass_kg": 2700, "stiffness_n_per_m": 4.7e6},
            "damping": {"ratio": 0.02, "modes": [1, 9]},
        },
        interface=[{"name": "first-storey", "storey": 1}],
    )
    with pytest.raises(InputError, match=r"numerical\.damping\.modes: found mode 9"):
        rt.check(made)
