"""An OpenSees model as a structure of a test: `rthyb import-opensees`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.linalg
from command_line import Rthyb

from rthyb_rt import config
from rthyb_rt.config import deriving, openseesmodel
from rthyb_rt.errors import InputError

HEAD = """schema = "rthyb-test/1"
rig = "delay-10-elastic"
test = { name = "t" }
"""
FRAME = """import openseespy.opensees as ops
ops.wipe()
ops.model("basic", "-ndm", 2, "-ndf", 3)
for level in range(3):
    for side in range(2):
        tag = 10 * level + side + 1
        ops.node(tag, 6.0 * side, 3.2 * level)
        if level == 0:
            ops.fix(tag, 1, 1, 1)
        else:
            ops.mass(tag, 2e3, 2e3, 0.0)
ops.geomTransf("Linear", 1)
number = 1
for level in (1, 2):
    for side in range(2):
        ops.element("elasticBeamColumn", number, 10 * level - 9 + side, 10 * level + side + 1,
                    0.02, 2e11, 4e-5, 1)
        number += 1
    ops.element("elasticBeamColumn", number, 10 * level + 1, 10 * level + 2, 0.01, 2e11, 3e-5, 1)
    number += 1
ops.rayleigh(0.4, 0.0, 3e-4, 0.0)
"""


@pytest.fixture
def opensees() -> Any:
    try:
        return openseesmodel.opensees()
    except InputError as error:
        pytest.skip(str(error))


def test_a_frame_of_opensees_becomes_the_computed_part(
    opensees: Any, rthyb: Rthyb, tmp_path: Path
) -> None:
    (tmp_path / "frame.py").write_text(FRAME)
    answer = rthyb("import-opensees", tmp_path / "frame.py", tmp_path / "frame.npz")
    assert answer.code == 0, answer.err
    assert "12" in answer.out
    assert "4 without mass" in answer.out
    (tmp_path / "t.toml").write_text(
        f"""{HEAD}[numerical.matrices]
file = "frame.npz"
direction = "x"
specimen = {{ stiffness_n_per_m = 0 }}
[[interface]]
dof = "11.x"
"""
    )
    found = deriving.structure_of_test(config.load_test(tmp_path / "t.toml"), 0.0, 1 / 1024)
    assert found.labels[:3] == ("11.x", "11.y", "11.rz")
    # OpenSees' own eigenvalues of the same model.
    (tmp_path / "again.py").write_text(FRAME)
    import runpy

    runpy.run_path(str(tmp_path / "again.py"))
    expected = np.sqrt(np.array(opensees.eigen("-fullGenLapack", 4))) / (2 * np.pi)
    opensees.wipe()
    assert [m.frequency_hz for m in found.modes()[:4]] == pytest.approx(expected, rel=1e-8)
    w = 2 * np.pi * expected[0]
    assert found.modes()[0].damping_ratio == pytest.approx(0.2 / w + 1.5e-4 * w, rel=1e-6)
    assert found.influence.sum() == 4.0
    m = found.part.mass_kg.matrix().toarray()
    assert scipy.linalg.issymmetric(m)


FLOOR = """import openseespy.opensees as ops
ops.wipe()
ops.model("basic", "-ndm", 3, "-ndf", 6)
for level in range(2):
    for i, (x, y) in enumerate([(0.0, 0.0), (6.0, 0.0), (6.0, 5.0), (0.0, 5.0)]):
        ops.node(10 * level + i + 1, x, y, 3.2 * level)
        if level == 0:
            ops.fix(i + 1, 1, 1, 1, 1, 1, 1)
ops.node(19, 3.0, 2.5, 3.2)
ops.mass(19, 8e3, 7e3, 0.0, 0.0, 0.0, 5e4)
ops.fix(19, 0, 0, 1, 1, 1, 0)
ops.rigidDiaphragm(3, 19, 11, 12, 13, 14)
ops.geomTransf("Linear", 1, 1, 0, 0)
for i in range(4):
    ops.element("elasticBeamColumn", i + 1, i + 1, 11 + i, 0.02, 2e11, 8e10, 1e-5, 4e-5, 3e-5, 1)
"""
TIED = (
    FRAME
    + """
ops.mass(12, 3e3, 5e3, 7e2)
ops.equalDOF(21, 22, 1)
ops.equalDOF(11, 12, 1)
"""
)


@pytest.mark.parametrize(
    ("script", "labels", "masses_kg"),
    [
        pytest.param(
            FLOOR,
            {"19.x", "19.y", "19.rz"}
            | {f"{n}.{way}" for n in (11, 12, 13, 14) for way in ("z", "rx", "ry")},
            {"19.x": 8e3, "19.y": 7e3, "19.rz": 5e4, "11.z": 0.0, "14.rx": 0.0},
            id="a rigid floor",
        ),
        pytest.param(
            TIED,
            {f"{n}.{way}" for n in (11, 21) for way in ("x", "y", "rz")}
            | {f"{n}.{way}" for n in (12, 22) for way in ("y", "rz")},
            {"11.x": 2e3 + 3e3, "11.y": 2e3, "12.y": 5e3, "12.rz": 7e2, "21.x": 4e3, "22.rz": 0.0},
            id="nodes tied in one direction",
        ),
    ],
)  # fmt: skip
def test_nodes_that_follow_others_have_labels_only_for_what_they_do_themselves(
    opensees: Any, tmp_path: Path, script: str, labels: set[str], masses_kg: dict[str, float]
) -> None:
    """Each label's mass is the one that the script gave to that direction of that node."""
    (tmp_path / "model.py").write_text(script)
    found = openseesmodel.read(tmp_path / "model.py")
    assert set(found.labels) == labels
    diagonal = dict(zip(found.labels, found.mass_kg.matrix().diagonal().tolist(), strict=True))
    assert {name: diagonal[name] for name in masses_kg} == pytest.approx(masses_kg, abs=1e-6)
    opensees.wipe()


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("import openseespy.opensees as ops\n", "leaves no model"),
        ("x = 1\nraise ValueError('no such section')\n", "model.py:2: the script failed"),
        ("import sys\nsys.exit(3)\n", "the script ended with exit(3)"),
        ("def broken(:\n", "the script failed (SyntaxError"),
    ],
)
def test_a_script_that_leaves_no_model_is_told(
    opensees: Any, script: str, said: str, tmp_path: Path
) -> None:
    (tmp_path / "model.py").write_text(script)
    with pytest.raises(InputError) as caught:
        openseesmodel.read(tmp_path / "model.py")
    assert said in str(caught.value)


def test_a_file_that_is_not_there_is_told_before_anything_is_loaded(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        openseesmodel.read(tmp_path / "none.py")


def test_what_is_missing_is_told_with_what_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "openseespy", None)
    monkeypatch.setitem(sys.modules, "openseespy.opensees", None)
    with pytest.raises(InputError, match="openseespy is not installed"):
        openseesmodel.opensees()
