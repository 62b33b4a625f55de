"""The figures of a test on a rig with several axes: those of each axis, and the common ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from rthyb_rt.config import limits as limits_file
from rthyb_rt.config.axesfile import COMMON_LIMITS, AxesRig
from rthyb_rt.config.deriving import Derived, derive, structure_of_test
from rthyb_rt.config.fields import nearest, written
from rthyb_rt.config.limits import Limits
from rthyb_rt.config.placing import placing
from rthyb_rt.config.rate import Rate
from rthyb_rt.config.testfile import MATRIX, AxisLaw, Controller, Numerical, TestFile
from rthyb_rt.core.laws import PASSING
from rthyb_rt.core.library import CoreError
from rthyb_rt.core.pending import OwnCodeError
from rthyb_rt.errors import InputError, Problem

if TYPE_CHECKING:
    from rthyb_rt.config.numerical_structure import Mode
    from rthyb_rt.config.own_structure import OwnStructure
    from rthyb_rt.config.sparse_structure import SparseStructure

Rows = Sequence[Sequence[float]]


@dataclass(frozen=True)
class AxesDerived:
    """Resolved figures of a test on a rig of several axes.

    Attributes:
        fs_hz: sample rate.
        structure: the numerical part, its interfaces in the order of the rig's directions.
        first: the mode with the largest participation in the ground motion; for a user-defined
            part, period and damping as stated in the test.
        axis: the figures of each axis with the others at rest: control law, noise, limits, force
            compensation; its period is that of the structure.
        k_e: elastic stiffness of the specimen along the interface, (directions, directions).
        notes: information for the user that requires no action.
    """

    fs_hz: float
    structure: SparseStructure | OwnStructure
    first: Mode
    axis: tuple[Derived, ...]
    k_e: Rows
    notes: tuple[str, ...] = ()

    @property
    def rate(self) -> Rate:
        """The rate of the test."""
        return Rate(self.fs_hz)

    @property
    def limits(self) -> limits_file.Resolved:
        """The limits of the first axis, of which those of `COMMON_LIMITS` are of all."""
        return self.axis[0].limits


@placing
def derive_axes(test: TestFile, rig: AxesRig) -> AxesDerived:
    """Combine a test with a rig of several axes.

    Raises:
        InputError: with everything that is incompatible.
    """
    problems: list[Problem] = []
    test = in_order(test, rig)
    _check_laws(test, rig, problems)
    rate = Rate(test.test.sample_rate_hz)
    if problems:
        raise InputError(problems)
    found, notes = list[Derived](), _deprecated(test, rig) + rig.notes
    structure, first = _structure(test, rig, rate, notes)
    if first.frequency_hz > 0.25 * rate.hz:
        raise InputError(
            f"the mode with the largest effective mass is at {first.frequency_hz:.4g} Hz, which "
            f"is too high for a sample rate of {rate.hz:g} Hz; check the units of the masses and "
            "stiffnesses",
            "test.sample_rate_hz",
        )
    for name in rig.names:
        try:
            own = derive(of_axis(test, name, first), rig.of_axis(name), deprecations=False)
        except OwnCodeError:
            # `rthyb_rt.run` raises the user's own exception, which a list does not keep.
            raise
        except InputError as error:
            problems += [
                Problem(f"axis {name}: {one.where}", one.message) for one in error.problems
            ]
            continue
        found.append(own)
        notes += [f"axis {name}: {note}" for note in own.notes]
    if problems:
        raise InputError(problems)
    return AxesDerived(rate.hz, structure, first, tuple(found), rig.k_e, tuple(notes))


def _structure(
    test: TestFile, rig: AxesRig, rate: Rate, notes: list[str]
) -> tuple[SparseStructure | OwnStructure, Mode]:
    """Return the numerical part and its dominant mode.

    Raises:
        InputError: with everything that is incompatible.
    """
    if test.numerical.own is None:
        try:
            structure = structure_of_test(test, rig.k_e, rate.period_s, rig.kinematics.turns())
        except CoreError as error:
            raise InputError(str(error), "numerical") from error
        if (note := structure.friction_note()) is not None:
            notes.append(note)
        return structure, structure.first()
    from rthyb_rt.config.own_deriving import structure_of

    stated, problems = _stated(test.numerical), list[Problem]()
    own = structure_of(test, rig.k_e, (rate.period_s, 1.0 / stated.frequency_hz), problems, notes)
    if own is None:
        raise InputError(problems)
    return own, stated


def _stated(numerical: Numerical) -> Mode:
    """Return the dominant mode of a structure with a user-defined part, as its file states it.

    Raises:
        InputError: it states a mass or a damping coefficient, which do not determine it.
    """
    from rthyb_rt.config.numerical_structure import Mode

    problems = [
        Problem(
            f"numerical.{key}",
            f"found {getattr(numerical, key):g} {unit}; on a rig with several axes a single "
            f"{what} does not describe the structure: state period_s and damping_ratio of its "
            "dominant mode instead, with the specimen",
        )
        for key, unit, what in (
            ("mass_kg", "kg", "mass"),
            ("damping_n_s_per_m", "N s/m", "damping coefficient"),
            ("stiffness_n_per_m", "N/m", "stiffness"),
        )
        if getattr(numerical, key)
    ]
    if problems:
        raise InputError(problems)
    assert numerical.period_s is not None
    assert numerical.damping_ratio is not None
    return Mode(1.0 / numerical.period_s, numerical.damping_ratio, (), 1.0, 0.0)


def _deprecated(test: TestFile, rig: AxesRig) -> list[str]:
    """Return a note on each deprecated key of both files."""
    whole = f'rig "{rig.rig.name}"'
    places = [("test", test.limits), (whole, rig.limits)]
    places += [(f"{whole}, axis {axis.name}", axis.limits) for axis in rig.axis]
    return [f"{place}: {note}" for place, limits in places for note in limits.deprecated()]


def in_order(test: TestFile, rig: AxesRig) -> TestFile:
    """Return a test with its interfaces in the order of the rig's directions.

    Raises:
        InputError: names or numbers are incompatible, or the numerical part has no interfaces.
    """
    if test.numerical.structure is None and test.numerical.own is None:
        raise InputError(
            "a rig with several axes needs storeys, matrices from a file, or a part of your own; "
            "the short form and matrices in the test file are for one actuator",
            "numerical",
        )
    given = {one.name: one for one in test.interface}
    directions = list(rig.directions)
    problems = [
        Problem(
            f"interface.{i}.name",
            f"found {written(one.name)}{nearest(one.name, directions)}; rig "
            f'"{rig.rig.name}" has the directions {", ".join(directions)}',
        )
        for i, one in enumerate(test.interface)
        if one.name not in directions
    ]
    missing = [name for name in directions if name not in given]
    if missing and not problems:
        problems.append(
            Problem(
                "interface",
                f"found {len(given)} of {len(directions)}; the direction {written(missing[0])} of "
                f'rig "{rig.rig.name}" is missing: add [[interface]] with name = '
                f"{written(missing[0])}",
            )
        )
    for turns, name in zip(rig.kinematics.turns(), directions, strict=True):
        if name in given:
            own = given[name].limits
            wrong = ("position_m", "force_n") if turns else ("position_rad", "moment_n_m")
            problems += [
                Problem(
                    f"interface.{test.interface.index(given[name])}.limits.{key}",
                    f"the direction {name} {'turns' if turns else 'does not turn'}; it takes "
                    + ("position_rad and moment_n_m" if turns else "position_m and force_n"),
                )
                for key in wrong
                if getattr(own, key) is not None
            ]
    if problems:
        raise InputError(problems)
    return test.model_copy(update={"interface": [given[name] for name in directions]})


def _check_laws(test: TestFile, rig: AxesRig, problems: list[Problem]) -> None:
    names = list(rig.names)
    for i, law in enumerate(test.controller.axis):
        if law.name not in names:
            problems.append(
                Problem(
                    f"controller.axis.{i}.name",
                    f"found {written(law.name)}{nearest(law.name, names)}; the axes of rig "
                    f'"{rig.rig.name}" are {", ".join(names)}',
                )
            )
    matrix = test.controller.matrix
    if test.controller.type == MATRIX and rig.is_redundant:
        problems.append(
            Problem(
                "controller.type",
                f'found "{MATRIX}"; rig "{rig.rig.name}" has {len(names)} axes for '
                f"{len(rig.directions)} directions, and the axes of redundant actuators do not "
                "move independently, which leaves the matrices undetermined; use a law for each "
                'axis, such as "paper"',
            )
        )
        return
    if test.controller.type == MATRIX and rig.identified is None:
        wants = "an inverse" if matrix is None or matrix.inverse else "a beginning"
        problems.append(
            Problem(
                "controller.type",
                f'found "{MATRIX}", which needs {wants} from the matrix of frequency responses; '
                f'rig "{rig.rig.name}" has no [identified]: run `rthyb identify RIG`',
            )
        )


def law_of_axis(test: TestFile, name: str) -> Controller:
    """Return the compensation of one axis as for a rig with one axis."""
    controller = test.controller
    for law in controller.axis:
        if law.name == name:
            values = {key: getattr(law, key) for key in type(law).model_fields if key != "name"}
            return controller.model_copy(update={**values, "axis": []})
    update: dict[str, Any] = {"axis": [], "matrix": None}
    if controller.type == MATRIX:
        update["type"] = PASSING.name
    return controller.model_copy(update=update)


def of_axis(test: TestFile, name: str, first: Mode) -> TestFile:
    """Return a test as seen by one axis: an oscillator with the period of the structure."""
    numerical = Numerical(
        period_s=min(max(1.0 / first.frequency_hz, 0.01), 100.0),
        damping_ratio=min(max(first.damping_ratio, 0.0), 2.0),
        integrator="kr-alpha",
    )
    return test.model_copy(
        update={
            "numerical": numerical,
            "interface": [],
            "controller": law_of_axis(test, name),
        }
    )


def resolve_axes(test: TestFile, rig: AxesRig, derived: AxesDerived) -> TestFile:
    """Return the test with every setting of its laws and limits written out.

    Each axis gets its own law; limits that are the same for all axes are in ``[limits]``, and those
    that differ remain in the rig.
    """
    test = in_order(test, rig)
    first = derived.axis[0]
    rfc = test.controller.rfc.model_copy(
        update={
            "window_periods": None,
            "window_s": first.window_samples / first.fs_hz,
            "window_samples": None,
            "tangent": first.tangent,
            "cutoff_hz": first.rfc_cutoff_hz,
            "force_lateness_s": first.force_lateness_s,
        }
    )
    update: dict[str, Any] = {"rfc": rfc}
    if test.controller.type != MATRIX:
        laws = []
        for name, own in zip(rig.names, derived.axis, strict=True):
            given = law_of_axis(test, name).with_settings(own.law_settings)
            values = {key: getattr(given, key) for key in AxisLaw.model_fields if key != "name"}
            laws.append(AxisLaw.model_construct(**values, name=name))
        update["axis"] = laws
    common = {key: getattr(derived.limits.limits, key) for key in COMMON_LIMITS}
    own_limits = {
        key: getattr(test.limits, key) for key in Limits.model_fields if key not in COMMON_LIMITS
    }
    limits = Limits.model_construct(**{**own_limits, **common})
    return test.model_copy(
        update={"controller": test.controller.model_copy(update=update), "limits": limits}
    )
