"""Courses of one axis of a test on several axes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rthyb_rt.analysis import measures, several_axes
from rthyb_rt.comparing.courses import MEASURES, Course, reference_course
from rthyb_rt.config.fields import nearest
from rthyb_rt.errors import InputError
from rthyb_rt.numbers import number

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rthyb_rt.lab.experiment import Setup
    from rthyb_rt.record.recording import RecordedTest


def number_of(names: Sequence[str], axis: str | None, where: str) -> int:
    """Return the number of the requested axis.

    Raises:
        InputError: no axis is named, or none has that name.
    """
    if axis is None:
        raise InputError(
            f"the test has several axes ({', '.join(names)}); choose the one to compare, such as "
            f"--axis {names[0]}",
            where,
        )
    if axis not in names:
        raise InputError(
            f"found --axis {axis}{nearest(axis, list(names))}; the axes are {', '.join(names)}",
            where,
        )
    return list(names).index(axis)


def recorded(rec: RecordedTest, label: str | None, axis: str | None) -> Course:
    """Return the course of an axis of a recording.

    Raises:
        InputError: no axis is named, or none has that name.
    """
    k = number_of(rec.axis_names, axis, label or "compare")
    found = several_axes.summarize(rec)
    own, signals = found.axes[k], found.signals
    measured = signals.measured_m[:, k]
    expected = signals.reference
    known: dict[str, float | None] = {
        "peak_command_m": own.peak_command_m,
        "peak_measured_m": own.peak_measured_m,
        "peak_force_n": own.peak_force_n,
        "tracking_nrmse": own.tracking_nrmse,
        "response_nrmse": None
        if expected is None
        else measures.tracking_nrmse(expected.axis_m[:, k], measured),
        "alpha_end": own.delay_samples,
    }
    known = {n: v if v is not None and math.isfinite(v) else None for n, v in known.items()}
    called = f"{label or found.test_name or 'recording'}, axis {own.name}"
    return Course(
        called,
        "recording",
        found.fs_hz,
        measured,
        signals.force_n[:, k],
        found.end_reason,
        dict.fromkeys(MEASURES) | known,
        notes=(*_lacking(called, found), *found.omitted),
        axis=own.name,
    )


def _lacking(called: str, found: several_axes.AxesSummary) -> tuple[str, ...]:
    """Return the note on lost rows, because of which the times of two courses differ."""
    first = found.signals.first
    if not found.rows or first == 0:
        return ()
    if first is None:
        return (f"{called} lacks rows of its test, and it is not known which",)
    lost_s = number(first / found.fs_hz, 4)
    return (f"{called} lacks the first {lost_s} s of its test: its time 0 is that long after",)


def simulated(rec: RecordedTest, label: str, axis: str) -> Course | None:
    """Return the reference simulation of an axis of a recording, or None.

    Args:
        rec: the recording.
        label: its name, with that of the axis.
        axis: name of the axis.
    """
    found, k = several_axes.summarize(rec), rec.axis_names.index(axis)
    reference = found.signals.reference
    if reference is None:
        return None
    called = f"{label}, reference simulation"
    x_m, f_n = reference.axis_m[:, k], reference.axis_n[:, k]
    return reference_course(x_m, f_n, found.fs_hz, called, axis)


def simulation(setup: Setup, axis: str | None) -> Course:
    """Return the reference simulation of an axis of a test.

    Raises:
        InputError: no axis is named, or none has that name.
    """
    assert setup.group is not None
    name, reference = setup.test.test.name, setup.group.reference
    k = number_of(setup.axis_names, axis, name)
    return reference_course(
        reference.axis_m[:, k],
        reference.axis_n[:, k],
        setup.derived.fs_hz,
        f"{name}, axis {axis}, reference simulation",
        setup.axis_names[k],
    )
