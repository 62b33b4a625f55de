"""Courses to be compared: displacement and force over the time of a test, from any source."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.errors import InputError, Problem

if TYPE_CHECKING:
    from rthyb_rt.diagnose.mapping import Wish
    from rthyb_rt.lab.experiment import Setup
    from rthyb_rt.record.recording import RecordedTest

Floats = NDArray[np.float64]

MOST: Final = 10
"""Maximum of curves in one figure."""
MEASURES: Final = (
    "peak_command_m", "peak_measured_m", "peak_force_n", "tracking_nrmse",
    "response_nrmse", "energy_error_relative", "alpha_end",
)  # fmt: skip
"""Measures of a recording that are reported for each course."""
_COMPARED: Final = ("t", "x_meas", "f_meas")
"""Channels of a table that are compared."""
_TABLES: Final = (".csv", ".txt", ".dat", ".tsv")
_UNEVEN: Final = 0.5
"""Maximum deviation of a row of a table from its place, as a part of the sampling period."""
_PRINTED: Final = 1e-6
"""Relative error of a rate that may be due to the rounding of printed times."""


@dataclass(frozen=True)
class Course:
    """The course of a test, for comparison.

    Attributes:
        label: its name.
        kind: ``recording``, ``simulation`` or ``table``.
        fs_hz: sampling rate, Hz.
        x_m: displacement of the specimen from the first sample of the test proper, (n,), m.
        f_n: force of the specimen, (n,), N; None if unknown.
        ending: ``completed``, or what ended it; "" if unknown.
        measures: values of `MEASURES`; None if unknown.
        notes: notes on how its file was read.
        axis: name of the axis, for a test on several axes.
    """

    label: str
    kind: str
    fs_hz: float
    x_m: Floats
    f_n: Floats | None
    ending: str = ""
    measures: dict[str, float | None] = field(default_factory=lambda: dict.fromkeys(MEASURES))
    notes: tuple[str, ...] = ()
    axis: str = ""

    @property
    def duration_s(self) -> float:
        """Length of the test proper, s."""
        return self.x_m.size / self.fs_hz


def read(
    given: Sequence[RecordedTest | Setup | str | Path],
    options: Sequence[str] = (),
    axis: str | None = None,
) -> list[Course]:
    """Return the courses of recordings, simulations and tables.

    Args:
        given: each a recording, or the folder or file of one; the folder of a campaign or sweep,
            for the recordings that it kept; a prepared test or a test file, for its reference
            simulation, or the name of a test that comes with the program; or a table of another
            laboratory (CSV). A single recording is compared with its reference simulation.
        options: columns of the tables, as for `mapping.read_wishes`.
        axis: axis to be compared, for tests on several axes.

    Raises:
        InputError: one of them cannot be read, there is nothing to compare, or an axis is not named
            or does not exist.
    """
    from rthyb_rt import config
    from rthyb_rt.diagnose.mapping import read_wishes
    from rthyb_rt.lab.experiment import Setup

    wishes = read_wishes(options)
    found: list[Course] = []
    missed: list[dict[str, Problem]] = []
    for one in given:
        label: str | None = None
        what: RecordedTest | list[Course]
        if isinstance(one, Setup):
            what = [simulation_of(one, axis)]
        elif isinstance(one, (str, Path)):
            place = Path(one)
            if not place.exists():
                place = config.shipped("test").get(str(one), place)
            what, label = _at(place, wishes, axis, missed), _place_name(place)
        else:
            what = one
        if isinstance(what, list):
            found += what
            continue
        course = recorded(what, label, axis)
        found += beside_reference(what, course) if len(given) == 1 else [course]
    _refuse_unused(wishes, missed)
    if axis is not None and not any(course.axis for course in found):
        raise InputError(
            f"found {axis}, but none of the recordings has several axes; omit it", "--axis"
        )
    return found


def _refuse_unused(wishes: Sequence[Wish], missed: Sequence[dict[str, Problem]]) -> None:
    """Refuse columns that were assigned in vain.

    Args:
        wishes: the assignments.
        missed: for each table, the assigned columns that it does not have.

    Raises:
        InputError: there is no table, no table has the column, or none of the channels is compared.
    """
    problems = []
    # The assignments for a diagnosis, of which a comparison needs a part, may be given to both.
    compared = any(wish.channel in _COMPARED for wish in wishes)
    for wish in wishes:
        if not missed:
            what = "none of the recordings is a CSV file, whose columns it could assign; omit it"
        elif all(wish.channel in one for one in missed):
            problems += [one[wish.channel] for one in missed]
            continue
        elif not compared:
            what = f"only {', '.join(_COMPARED)} of a CSV file are compared; assign one of them"
        else:
            continue
        problems.append(Problem(wish.where, f"found {wish.channel}={wish.text}; {what}"))
    if problems:
        raise InputError(problems)


def _place_name(place: Path) -> str | None:
    """Return the name of a run's folder, as its label; None for the current folder."""
    return (place.name if place.is_dir() else place.parent.name) or None


def beside_reference(rec: RecordedTest, course: Course) -> list[Course]:
    """Return a recording after its own reference simulation.

    Raises:
        InputError: it has no reference simulation.
    """
    reference = simulated(rec, course.label, course.axis)
    if reference is None:
        raise InputError(
            "has no reference simulation to compare with; give a second recording",
            course.label,
        )
    return [reference, course]


def _at(
    place: Path, wishes: Sequence[Wish], axis: str | None, missed: list[dict[str, Problem]]
) -> RecordedTest | list[Course]:
    from rthyb_rt.campaign.book import PLAN
    from rthyb_rt.record.recording import open_run

    if place.is_dir() and (place / PLAN).is_file():
        return _kept(place, axis)
    if place.suffix == ".toml":
        return [simulation(place, axis)]
    if place.suffix.lower() in _TABLES:
        missed.append({})
        return [table(place, wishes, missed[-1])]
    return open_run(place)


def recorded(rec: RecordedTest, label: str | None = None, axis: str | None = None) -> Course:
    """Return the course of a recording, or of a named axis.

    Raises:
        InputError: it has several axes, and none is named.
    """
    from rthyb_rt.analysis.summary import summarize
    from rthyb_rt.comparing import of_axis

    if rec.axis_names:
        return of_axis.recorded(rec, label, axis)

    found = summarize(rec)
    rows = rec.running()
    measures = found.as_json()
    return Course(
        label or found.test_name or "recording",
        "recording",
        rec.fs_hz,
        np.asarray(rec.samples["x_meas_m"][rows], np.float64),
        np.asarray(rec.samples["f_meas_n"][rows], np.float64),
        "completed" if found.end_reason == "completed" else found.ending or found.end_reason,
        {name: measures[name] for name in MEASURES},
        notes=found.setup.omitted,
    )


def simulated(rec: RecordedTest, label: str, axis: str = "") -> Course | None:
    """Return the reference simulation of a recording, or None."""
    from rthyb_rt.comparing import of_axis

    if axis:
        return of_axis.simulated(rec, label, axis)
    if rec.reference is None or not len(rec.reference):
        return None
    return _reference(rec.reference, rec.fs_hz, f"{label}, reference simulation")


def simulation(path: Path, axis: str | None = None) -> Course:
    """Return the reference simulation of a test file, or of a named axis.

    Raises:
        InputError: with the errors of test and rig, or because no axis is named.
    """
    from rthyb_rt.config import load_any_both
    from rthyb_rt.lab import axes_experiment

    return simulation_of(axes_experiment.prepare_any(*load_any_both(path, None, ())), axis)


def simulation_of(setup: Setup, axis: str | None = None) -> Course:
    """Return the reference simulation of a prepared test, or of a named axis.

    Raises:
        InputError: no axis is named.
    """
    from rthyb_rt.comparing import of_axis
    from rthyb_rt.config import omitted

    if setup.group is not None:
        course = of_axis.simulation(setup, axis)
    else:
        label = f"{setup.test.test.name}, reference simulation"
        course = _reference(setup.reference, setup.derived.fs_hz, label)
    return replace(course, notes=(*course.notes, *omitted(setup.rig_file)))


def _reference(rows: NDArray[np.void], fs_hz: float, label: str) -> Course:
    x, f = (np.asarray(rows[name], np.float64) for name in ("x_ref_m", "f_ref_n"))
    return reference_course(x, f, fs_hz, label)


def reference_course(x: Floats, f: Floats, fs_hz: float, label: str, axis: str = "") -> Course:
    """Return the course of a reference simulation with displacement, m, and force, N, (n,)."""
    measures: dict[str, float | None] = dict.fromkeys(MEASURES)
    measures["peak_command_m"] = measures["peak_measured_m"] = float(np.abs(x).max(initial=0.0))
    measures["peak_force_n"] = float(np.abs(f).max(initial=0.0))
    return Course(label, "simulation", fs_hz, x, f, "completed", measures, axis=axis)


def _kept(folder: Path, axis: str | None) -> list[Course]:
    """Return the recordings that a campaign or sweep kept.

    Raises:
        InputError: it kept none, or more than a figure can show.
    """
    from rthyb_rt.campaign.book import ROWS
    from rthyb_rt.record.recording import open_run

    rows = []
    if (folder / ROWS).is_file():
        lines = (folder / ROWS).read_text(encoding="utf-8").splitlines()
        rows = [json.loads(line) for line in lines if line.endswith("}")]
    rows = sorted((row for row in rows if row.get("folder")), key=lambda row: int(row["case"]))
    if not rows:
        raise InputError(
            'the campaign kept no recordings; run it with campaign.keep = "all" (rthyb sweep '
            "--keep all)",
            str(folder),
        )
    if len(rows) > MOST:
        cases = ", ".join(str(row["folder"]) for row in rows[:3])
        raise InputError(
            f"the campaign kept {len(rows)} recordings, but a figure shows at most {MOST}; give "
            f"the folders of the ones you want: {cases} ...",
            str(folder),
        )
    return [recorded(open_run(folder / row["folder"]), _chosen(row), axis) for row in rows]


def _chosen(row: dict[str, Any]) -> str:
    """Return the values that distinguish a run from the others of its campaign."""
    chosen = itertools.takewhile(lambda key: key not in ("drawn", "repeat"), row)
    parts = [f"{key.rsplit('.', 1)[-1]} {row[key]}" for key in chosen if key != "case"]
    if row.get("drawn", -1) > 0:
        parts.append(f"plant {row['drawn']}")
    if row.get("repeat"):
        parts.append(f"noise {row['repeat'] + 1}")
    return ", ".join(parts) or f"run {row['case']}"


# ---- tables of other labs -----------------------------------------------------------------------


def table(path: Path, wishes: Sequence[Wish], missed: dict[str, Problem] | None = None) -> Course:
    """Return a table of another laboratory in SI units; there is no model to infer units from.

    ``missed`` receives the errors for assigned columns that it does not have, by channel.

    Raises:
        InputError: it cannot be read, or a required column or its unit is not named.
    """
    from rthyb_rt.diagnose.external_table import stated

    unmet: dict[str, Problem] = {} if missed is None else missed
    t, channels, notes = stated(path, wishes, _COMPARED, ("t", "x_meas"), unmet)
    notes += [
        f"{n} is read from the column of that name, not from the one that was assigned, which "
        "the file does not have"
        for n in unmet
        if n == "t" or n in channels
    ]
    steps = np.diff(t)
    if t.size < 2 or not np.all(steps > 0.0):
        raise InputError("time does not increase from row to row; sort the rows", str(path))
    step = float(t[-1] - t[0]) / (t.size - 1)
    uneven = float(np.abs(t - t[0] - step * np.arange(t.size)).max()) / step
    if uneven > _UNEVEN:
        notes.append("rows are not equally spaced; they were interpolated to a uniform rate")
        even = t[0] + step * np.arange(t.size)
        channels = {name: np.interp(even, t, values) for name, values in channels.items()}
    if t[0] != 0.0:
        notes.append(f"time begins at {t[0]:g} s; it is counted from there")
    x, f = channels["x_meas"], channels.get("f_meas")
    measures: dict[str, float | None] = dict.fromkeys(MEASURES)
    measures["peak_measured_m"] = _largest(x)
    measures["peak_force_n"] = None if f is None else _largest(f)
    labelled = tuple(f"{path.name}: {note}" for note in notes)
    return Course(path.stem, "table", _rate(step), x, f, "", measures, labelled)


def _rate(step_s: float) -> float:
    """Return the rate of rows, in whole hertz if it differs only by the rounding of times."""
    rate = 1.0 / step_s
    return float(round(rate)) if abs(rate - round(rate)) < _PRINTED * rate else rate


def _largest(values: Floats) -> float:
    return float(np.abs(values[np.isfinite(values)]).max(initial=0.0))


def named_apart(courses: Sequence[Course]) -> list[Course]:
    """Return the courses with labels that are all different."""
    labels: list[str] = []
    for course in courses:
        number, label = 2, course.label
        while label in labels:
            number, label = number + 1, f"{course.label} ({number})"
        labels.append(label)
    return [replace(one, label=label) for one, label in zip(courses, labels, strict=True)]
