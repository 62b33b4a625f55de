"""Names that Python writes out for the type checker, against the enumerations of the C headers."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any, get_args

import pytest

from rthyb_rt import core
from rthyb_rt.core import (
    diagnosis_models,
    group,
    kinematics,
    loop,
    settings,
    sparse,
    station,
    ticker,
)
from rthyb_rt.core.library import members, options
from rthyb_rt.rig.virtual_rig import rig_plan

CORE = Path(core.__file__).parent
WHOLE = {
    "loop.Kind": (loop.Kind, "rthyb_link_kind", "RTHYB_LINK_"),
    "loop.Clock": (loop.Clock, "rthyb_clock", "RTHYB_CLOCK_"),
    "settings.EstimatorLaw": (settings.EstimatorLaw, "rthyb_estimator_law", "RTHYB_LAW_"),
    "settings.Tangent": (settings.Tangent, "rthyb_tangent", "RTHYB_TANGENT_"),
    "settings.Divisor": (settings.Divisor, "rthyb_divisor", "RTHYB_DIVISOR_"),
    "settings.ServoKind": (settings.ServoKind, "rthyb_servo_kind", "RTHYB_"),
    "settings.Hold": (settings.Hold, "rthyb_hold", "RTHYB_"),
    "settings.ExtraKind": (settings.ExtraKind, "rthyb_extra_kind", "RTHYB_EXTRA_"),
    "loop.FaultKind": (loop.FaultKind, "rthyb_drive_fault", "RTHYB_FAULT_"),
    "ticker.Payload": (ticker.Payload, "rthyb_payload", "RTHYB_PAYLOAD_"),
    "kinematics.Coordinate": (
        kinematics.Coordinate,
        "rthyb_coordinate",
        "RTHYB_COORDINATE_",
    ),
    "station.Command": (station.Command, "rthyb_command", "RTHYB_CMD_"),
    "group.Reaction": (group.Reaction, "rthyb_reaction", "RTHYB_REACT_"),
    "diagnosis_models.Hold": (diagnosis_models.Hold, "rthyb_hold", "RTHYB_"),
}
"""Literals that have every name of an enumeration."""
INTEGRATORS = ("rthyb_integrator", "RTHYB_")
PARTS: dict[str, tuple[Any, tuple[str, str], set[str]]] = {
    "settings.Integrator": (settings.Integrator, INTEGRATORS, {"rk4"}),
    "settings.DenseIntegrator": (
        settings.DenseIntegrator,
        INTEGRATORS,
        {"central-difference", "forward-euler", "kr-alpha", "prescribed"},
    ),
    "sparse.SparseIntegrator": (
        sparse.SparseIntegrator,
        INTEGRATORS,
        {"forward-euler", "prescribed", "rk4"},
    ),
    "ticker.Clock": (ticker.Clock, ("rthyb_clock", "RTHYB_CLOCK_"), {"link"}),
}
"""Those that have some of the names, with those that they leave out."""


@pytest.mark.parametrize("name", WHOLE)
def test_type_checker_and_header_know_the_same_names(name: str) -> None:
    literal, enum, prefix = WHOLE[name]
    assert sorted(get_args(literal)) == sorted(options(enum, prefix))


@pytest.mark.parametrize("name", PARTS)
def test_type_checker_knows_every_name_of_the_header_that_applies(name: str) -> None:
    literal, (enum, prefix), others = PARTS[name]
    assert set(get_args(literal)) | others == set(options(enum, prefix))
    assert not set(get_args(literal)) & others


def test_the_load_cell_is_at_one_of_the_two_ends_of_the_header() -> None:
    ends = options("rthyb_load_cell", "RTHYB_")
    known = settings._OPTIONS["load_cell"]
    assert {name.removesuffix("-end"): value for name, value in known.items()} == {
        name.removesuffix("-end"): value for name, value in ends.items()
    }
    assert set(get_args(settings.LoadCell)) == set(known)


@pytest.mark.parametrize(
    ("names", "enum", "prefix"),
    [
        (loop.LINK_FAULTS, "rthyb_link_fault", "RTHYB_LINK_"),
        (loop.PHASES, "rthyb_drive_phase", "RTHYB_DRIVE_"),
    ],
)
def test_names_that_are_looked_up_by_number_stand_at_their_number(
    names: tuple[str, ...], enum: str, prefix: str
) -> None:
    for name, value in members(enum, prefix).items():
        assert names[value].replace("-", "_").upper() == name
    assert len(names) == len(members(enum, prefix))


def test_a_virtual_rig_can_have_every_fault_of_the_drive_and_a_power_cut() -> None:
    faults = options("rthyb_drive_fault", "RTHYB_FAULT_")
    assert sorted(rig_plan.FAULT_KINDS) == sorted([*faults, rig_plan.POWER_CUT])


def test_every_name_that_the_core_writes_out_is_held_to_a_header() -> None:
    """An enumeration written out as a Literal at the top of a module of the core."""
    written = {
        f"{path.stem}.{target.id}"
        for path in CORE.glob("*.py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        if isinstance(node, ast.Assign) and ast.unparse(node.value).startswith("Literal[")
        for target in node.targets
        if isinstance(target, ast.Name)
    }
    assert written == {*WHOLE, *PARTS, "settings.LoadCell"}
