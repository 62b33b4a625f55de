"""User-defined parts of a test on a rig: loaded, tried out, and compared with stated values."""

from __future__ import annotations

from rthyb_rt.config.own_structure import OwnStructure, Rows, build, period_note
from rthyb_rt.config.own_tables import PythonClass
from rthyb_rt.config.rigfile import RigFile
from rthyb_rt.config.testfile import TestFile
from rthyb_rt.core import CoreError, own
from rthyb_rt.core.pending import OwnCodeError
from rthyb_rt.errors import InputError, Problem


def check_classes(test: TestFile, rig: RigFile) -> None:
    """Import the user-defined classes before they are used.

    Raises:
        InputError: with everything that cannot be loaded.
    """
    classes = [("controller.python", test.controller.python, "ControlLaw")]
    for i, one in enumerate(rig.specimen):
        if isinstance(one, PythonClass):
            classes.append((f"specimen.{i}", one, "Element"))
            if test.test.time_scale != 1.0:
                raise InputError(
                    f"found {test.test.time_scale:g}, but how {one.class_}, a class in Python, "
                    "behaves in stretched time is not known; remove one of the two",
                    "test.time_scale",
                )
    problems = []
    for place, given, kind in classes:
        try:
            if given is not None:
                given.own.made(getattr(own, kind))
        except CoreError as error:
            problems.append(Problem(f"{place}.{own.key_of(error)}", str(error)))
    if problems:
        raise InputError(problems)


def structure_of(
    test: TestFile,
    k_e_n_per_m: float | Rows,
    periods_s: tuple[float, float],
    problems: list[Problem],
    notes: list[str],
) -> OwnStructure | None:
    """Return a user-defined numerical part.

    Args:
        test: the test.
        k_e_n_per_m: elastic stiffness of the rig's specimen; with several axes its rows, in the
            order of the interfaces.
        periods_s: sampling period; stated period of the whole structure.
        problems, notes: receive what is found.

    Raises:
        OwnCodeError: a class in Python raised an exception.
    """
    step_s, stated_s = periods_s
    given = test.numerical.own
    assert given is not None
    if test.test.time_scale != 1.0:
        problems.append(
            Problem(
                "test.time_scale",
                f"found {test.test.time_scale:g}; the time of your own numerical part cannot be "
                "stretched from outside: remove the key and scale the part itself: multiply masses "
                "by the square of the time scale, and damping coefficients by the time scale",
            )
        )
        return None
    try:
        structure = build(given, k_e_n_per_m, step_s, test.interface)
    except OwnCodeError:
        # `rthyb_rt.run` raises the user's own exception, which a list of problems does not keep.
        raise
    except InputError as error:
        problems += error.problems
        return None
    if 0.01 <= stated_s <= 100:
        note = period_note(structure, stated_s)
        notes += [] if note is None else [note]
    return structure
