"""Results of a test on a rig with several axes: each axis, each direction of the interface."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import config
from rthyb_rt.analysis import measures, summary
from rthyb_rt.analysis.attention import AxesJudge, Finding
from rthyb_rt.analysis.notices import (
    Notice,
    axis_attention_in_words,
    flag_notices,
    not_finite_notices,
    omission_notices,
)
from rthyb_rt.analysis.summary import Live, Summary, SummaryRow, live, live_notices, live_rows
from rthyb_rt.config import AxesRig, lonesensors
from rthyb_rt.config.axes_reference import AxesReference, reference_of
from rthyb_rt.config.deriving_axes import derive_axes
from rthyb_rt.config.own_structure import OwnStructure
from rthyb_rt.config.sparse_structure import SparseStructure
from rthyb_rt.config.testfile import MATRIX
from rthyb_rt.core import FLAGS, RUNNING, STATES
from rthyb_rt.errors import InputError
from rthyb_rt.numbers import number, percent, quantity
from rthyb_rt.record.motion_rows import first_instant
from rthyb_rt.record.recording import RecordedTest

Floats = NDArray[np.float64]

NOT_COMPUTED: Final = (
    "critical delay, margins of the delay estimator and energy of the tracking error are "
    "defined for one axis only, and are not computed for several"
)
NO_ROWS: Final = (
    "The test proper never began, or none of its rows was recorded: there is nothing to evaluate."
)


@dataclass(frozen=True)
class AxisRows:
    """One axis over the rows of the test proper.

    Attributes:
        name: of the axis.
        tracking_nrmse: rms(x_meas - command of the numerical part) / rms of that command.
        tracking_peak_m: greatest of these differences.
        peak_command_m, peak_measured_m, peak_force_n: greatest magnitudes.
        delay_samples: last value reported by its control law; None: a law without, or matrices.
        peak_opposing_n: greatest magnitude of the part of its force that balances those of other
            redundant actuators, and does not act on the specimen; None: no redundant actuators.
    """

    name: str
    tracking_nrmse: float
    tracking_peak_m: float
    peak_command_m: float
    peak_measured_m: float
    peak_force_n: float
    delay_samples: float | None
    peak_opposing_n: float | None = None


@dataclass(frozen=True)
class OfDirection:
    """One direction of the interface, m or rad.

    Attributes:
        name, turns: its name, and whether it is a rotation.
        peak: of the command of the numerical part.
        tracking_nrmse: rms(measured - command) / rms(command).
        response_nrmse: rms(measured - reference) / rms(reference); None: no reference.
        response_peak: greatest of these differences; None: no reference.
        reference_peak: of the reference; None: no reference.
    """

    name: str
    turns: bool
    peak: float
    tracking_nrmse: float
    response_nrmse: float | None
    response_peak: float | None
    reference_peak: float | None


@dataclass(frozen=True)
class OfSensor:
    """One sensor without an actuator, m or N.

    Attributes:
        name: its name.
        of_force: whether it is a load cell.
        peak: of its readings.
        residual: greatest difference of a reading from the one that the pose, or the force along
            the interface, measured by all sensors together would give.
    """

    name: str
    of_force: bool
    peak: float
    residual: float


@dataclass(frozen=True, eq=False)
class Signals:
    """Signals over the n rows of the test proper.

    Attributes:
        time_s: from the first row on, (n,).
        first: instant of the first row, in samples from the start of the ground motion; more than 0
            if the first rows of the test are lost; None: it cannot be found.
        wanted_m, command_m, measured_m, force_n: of the axes, (n, axes) each.
        opposing_n: the part of ``force_n`` without resultant, (n, axes); None: no redundant
            actuators.
        x_num, x_meas: along the interface, (n, directions) each.
        reference: at the same rows; None: it is not known which rows of the reference these are.
        sensors: values of the sensors without an actuator, and those that would follow from pose
            and force along the interface, (2, n, sensors); displacements first.
    """

    time_s: Floats
    wanted_m: Floats
    command_m: Floats
    measured_m: Floats
    force_n: Floats
    x_num: Floats
    x_meas: Floats
    first: int | None
    reference: AxesReference | None
    opposing_n: Floats | None = None
    sensors: Floats = field(default_factory=lambda: np.empty((2, 0, 0)))


@dataclass(frozen=True, eq=False)
class AxesSummary:
    """Results of a test.

    Attributes:
        test_name, description, rig_name, controller: from the files.
        end_reason, final_state: as recorded.
        rows, lost: rows of the test proper, and how many of them lack a pair on some axis. Without
            any, the results have no values, and the signals are those of rest and ramps.
        flags: rows of the test proper with each flag, by name.
        skipped_ticks: ticks without a row.
        not_finite_rows: rows with a value that is not finite.
        attention: axes that did not follow the reference simulation, with what was found.
        fs_hz: sample rate.
        axes, directions: results of each.
        live: how the test went in real time; None: in virtual time.
        signals: the underlying signals.
        structure: the numerical part.
        sensors: results of each sensor without an actuator.
        omitted: notes on values that the rig file omitted.
    """

    test_name: str
    description: str
    rig_name: str
    controller: str
    end_reason: str
    final_state: str
    rows: int
    lost: int
    flags: dict[str, int]
    skipped_ticks: int
    not_finite_rows: int
    attention: tuple[tuple[str, Finding], ...]
    fs_hz: float
    axes: tuple[AxisRows, ...]
    directions: tuple[OfDirection, ...]
    live: Live | None
    signals: Signals
    structure: SparseStructure | OwnStructure
    sensors: tuple[OfSensor, ...] = ()
    omitted: tuple[str, ...] = ()

    def as_json(self) -> dict[str, Any]:
        """Return the figures as plain values: nan, which JSON does not have, becomes None."""
        sensors = {one.name: asdict(one) for one in self.sensors}
        found = ({"sensors": sensors} if sensors else {}) | {
            "axes": {one.name: asdict(one) for one in self.axes},
            "directions": {one.name: asdict(one) for one in self.directions},
            "rows": self.rows,
            "lost": self.lost,
            "flags": self.flags,
            "skipped_ticks": self.skipped_ticks,
            "not_finite_rows": self.not_finite_rows,
            "attention": [{"axis": name, **asdict(one)} for name, one in self.attention],
            "fs_hz": self.fs_hz,
            "live": None if self.live is None else asdict(self.live),
            "not_computed": NOT_COMPUTED,
        }
        return {key: summary.json_value(value) for key, value in found.items()}


def summarize_any(rec: RecordedTest) -> Summary | AxesSummary:
    """Return the results of a recording, of one axis or of several; see both `summarize`."""
    return summarize(rec) if rec.axis_names else summary.summarize(rec)


def summarize(rec: RecordedTest) -> AxesSummary:
    """Return the results of a recording of several axes.

    Raises:
        InputError: it is of one axis, its files are of another version, or the test never ran.
    """
    rig, test = files(rec)
    structure = derive_axes(test, rig).structure
    whole = reference_of(test, rig, structure, rec.ag_mps2)
    signals = _signals(rec, rig, whole)
    samples = rec.samples[rec.running()]
    by_law = test.controller.type != MATRIX
    axes = tuple(_of_axis(rec, signals, i, name, by_law) for i, name in enumerate(rig.names))
    directions = tuple(
        _of_direction(signals, j, name, turns)
        for j, (name, turns) in enumerate(zip(rig.directions, rig.kinematics.turns(), strict=True))
    )
    states = rec.samples["state"]
    judge = axes_judge(rig, whole, rec.fs_hz)
    judge.add(samples, None if signals.reference is None else signals.reference.axis_m)
    found = AxesSummary(
        test.test.name,
        test.test.description,
        rig.rig.name,
        test.controller.type,
        str(rec.meta.get("end_reason", "unknown")),
        STATES[int(states[-1])] if states.size else "IDLE",
        samples.size,
        int(np.count_nonzero(samples["flags"] & FLAGS["lost"])),
        {name: int(np.count_nonzero(samples["flags"] & bit)) for name, bit in FLAGS.items()},
        rec.replay.skipped_ticks,
        _not_finite_rows(rec, len(rig.axis)),
        tuple(judge.findings()),
        rec.fs_hz,
        axes,
        directions,
        live(rec),
        signals,
        structure,
        tuple(
            OfSensor(
                one.name,
                one.kind == "force",
                _peak(signals.sensors[0, :, k]),
                _peak(signals.sensors[0, :, k] - signals.sensors[1, :, k]),
            )
            for k, one in enumerate(rig.lone_sensors)
        ),
        summary.omitted(rec),
    )
    return found if (states == RUNNING).any() else _bare(found)


def _bare(found: AxesSummary) -> AxesSummary:
    """Return the summary of a recording without the test proper: no figures of rest and ramps."""
    nan = math.nan
    return replace(
        found,
        rows=0,
        lost=0,
        flags=dict.fromkeys(found.flags, 0),
        attention=(),
        axes=tuple(AxisRows(one.name, nan, nan, nan, nan, nan, None) for one in found.axes),
        directions=tuple(
            OfDirection(one.name, one.turns, nan, nan, None, None, None) for one in found.directions
        ),
        signals=replace(found.signals, first=None, reference=None),
        sensors=tuple(replace(one, peak=nan, residual=nan) for one in found.sensors),
    )


def files(rec: RecordedTest) -> tuple[AxesRig, config.TestFile]:
    """Return rig and test file from a recording of several axes.

    Raises:
        InputError: it is of one axis, or its files are of another version.
    """
    rig = config.parse_any_rig(rec.rig_toml, "recording: rig")
    if not isinstance(rig, AxesRig):
        raise InputError("found a rig of one axis", "recording: rig")
    return rig, config.parse_test(rec.test_toml, "recording: test")


def axes_judge(rig: AxesRig, reference: AxesReference, fs_hz: float) -> AxesJudge:
    """Return the judge of the axes of a rig, given a reference simulation."""
    peak_m = float(np.max(np.abs(reference.axis_m), initial=0.0))
    return AxesJudge(rig.names, fs_hz, peak_m)


def reference(rec: RecordedTest, rig: AxesRig, test: config.TestFile) -> AxesReference:
    """Return the reference simulation over the ground motion of a recording."""
    return reference_of(test, rig, derive_axes(test, rig).structure, rec.ag_mps2)


def _not_finite_rows(rec: RecordedTest, axes: int) -> int:
    fine = np.ones(len(rec.samples), dtype=bool)
    for i in range(axes):
        own = rec.axis(i)
        for name in ("x_cmd_m", "x_meas_m", "f_meas_n"):
            fine &= np.isfinite(own[name])
    return int(np.count_nonzero(~fine))


def _signals(rec: RecordedTest, rig: AxesRig, whole: AxesReference) -> Signals:
    running = rec.running()
    n = int(np.count_nonzero(running))
    if n == 0:
        raise InputError(
            f"the test never ran ({rec.meta.get('end_reason', 'unknown')}); there is nothing to "
            "measure",
            "recording",
        )
    first = first_instant(rec)
    samples = rec.samples[running]
    x_num = np.column_stack(
        [samples["x_num_m"], *(samples[f"x_num_m_{j}"] for j in range(1, len(rig.directions)))]
    )
    columns = {
        key: np.column_stack([rec.axis(i)[key][running] for i in range(len(rig.axis))])
        for key in ("x_cmd_m", "x_meas_m", "f_meas_n")
    }
    tie = rig.core_kinematics()
    wanted, _ = tie.axes(x_num)
    read = lonesensors.values_of(rig.lone_sensors, samples)
    given = read
    if tie.sensors:
        pose = tie.measured_pose(columns["x_meas_m"], read)
        given = tie.readings(pose, tie.measured_forces(columns["f_meas_n"], read))
    else:
        pose, _ = rig.core_kinematics().pose(columns["x_meas_m"])
    return Signals(
        np.arange(n) / rec.fs_hz,
        wanted,
        columns["x_cmd_m"],
        columns["x_meas_m"],
        columns["f_meas_n"],
        x_num,
        pose,
        first,
        None if first is None else whole.rows(first, n),
        _opposing(rig, columns["f_meas_n"]) if rig.is_redundant else None,
        np.stack([read, given]),
    )


def _opposing(rig: AxesRig, force_n: Floats) -> Floats:
    """Return forces less the smallest ones that have the same resultant, (n, axes)."""
    tie = rig.core_kinematics()
    return force_n - tie.pushes(tie.resultants(force_n))


def _peak(values: Floats) -> float:
    """Return the greatest magnitude, ignoring the unknown commands of skipped ticks."""
    return float(np.nanmax(np.abs(values)))


def _of_axis(rec: RecordedTest, signals: Signals, i: int, name: str, by_law: bool) -> AxisRows:
    wanted, measured = signals.wanted_m[:, i], signals.measured_m[:, i]
    running = rec.running()
    alpha = rec.samples["alpha"] if i == 0 else rec.samples[f"alpha_{i}"]
    last = float(alpha[running][-1])
    return AxisRows(
        name,
        measures.tracking_nrmse(wanted, measured),
        _peak(measured - wanted),
        _peak(signals.command_m[:, i]),
        _peak(measured),
        _peak(signals.force_n[:, i]),
        last if by_law and np.isfinite(last) else None,
        None if signals.opposing_n is None else _peak(signals.opposing_n[:, i]),
    )


def _of_direction(signals: Signals, j: int, name: str, turns: bool) -> OfDirection:
    asked, measured = signals.x_num[:, j], signals.x_meas[:, j]
    response: tuple[float | None, float | None, float | None] = (None, None, None)
    if signals.reference is not None:
        expected = signals.reference.x[:, j]
        nrmse = measures.tracking_nrmse(expected, measured)
        response = (nrmse, _peak(measured - expected), _peak(expected))
    tracking = measures.tracking_nrmse(asked, measured)
    return OfDirection(name, turns, _peak(asked), tracking, *response)


def size_of(value: float | None, turns: bool) -> str:
    """Return a displacement or a rotation with its unit."""
    return quantity(value, "mrad" if turns else "mm", 1e3)


def table(s: AxesSummary) -> list[SummaryRow]:
    """Return the results as rows: label, value, definition."""
    rows = [
        SummaryRow(
            "Rows of the test", f"{s.rows} ({number(s.rows / s.fs_hz, 4)} s)", f"{s.lost} lost"
        )
    ]
    for one in s.directions:
        rows += [
            SummaryRow(f"{one.name}: peak", size_of(one.peak, one.turns), "of the command"),
            SummaryRow(f"{one.name}: tracking, NRMSE", percent(one.tracking_nrmse),
                "rms(measured − command) / rms(command)"),
            *_response_rows(one),
        ]  # fmt: skip
    for axis in s.axes:
        rows += [
            SummaryRow(f"Axis {axis.name}: tracking, NRMSE", percent(axis.tracking_nrmse),
                "rms(x_meas − command) / rms(command)"),
            SummaryRow(f"Axis {axis.name}: peak, compensated command",
                quantity(axis.peak_command_m, "mm", 1e3),
                f"measured {quantity(axis.peak_measured_m, 'mm', 1e3)}"),
            SummaryRow(f"Axis {axis.name}: peak of the force",
                quantity(axis.peak_force_n, "kN", 1e-3), "at its load cell"),
        ]  # fmt: skip
        if axis.peak_opposing_n is not None:
            opposing = quantity(axis.peak_opposing_n, "kN", 1e-3)
            rows.append(
                SummaryRow(f"Axis {axis.name}: peak of the opposing force", opposing,
                    "balanced by other axes, not acting on the specimen")
            )  # fmt: skip
        if axis.delay_samples is not None:
            delay = axis.delay_samples
            rows.append(
                SummaryRow(f"Axis {axis.name}: delay estimate",
                    quantity(delay, "samples", digits=4),
                    f"{number(delay / s.fs_hz * 1e3, 3)} ms at the end")
            )  # fmt: skip
    for sensor in s.sensors:
        unit, factor = ("kN", 1e-3) if sensor.of_force else ("mm", 1e3)
        what = "force at the interface" if sensor.of_force else "position"
        rows.append(
            SummaryRow(f"Sensor {sensor.name}: peak", quantity(sensor.peak, unit, factor),
                f"within {quantity(sensor.residual, unit, factor)} of what the {what} measured by "
                "all sensors gives")
        )  # fmt: skip
    return rows + live_rows(s.live)


def _response_rows(one: OfDirection) -> list[SummaryRow]:
    if one.response_nrmse is None:
        return [SummaryRow(f"{one.name}: response", "no reference simulation", "")]
    return [
        SummaryRow(f"{one.name}: response, NRMSE", percent(one.response_nrmse),
            "rms(measured − reference) / rms(reference)"),
        SummaryRow(f"{one.name}: largest difference", size_of(one.response_peak, one.turns),
            f"of a reference of {size_of(one.reference_peak, one.turns)}"),
    ]  # fmt: skip


def _placing_notices(s: AxesSummary) -> list[Notice]:
    """Return a notice about lost rows of the test proper, which the results do not contain."""
    first = s.signals.first
    if not s.rows:
        text = NO_ROWS
    elif first is None:
        text = (
            "The recording lacks rows of the test, and its ground motion does not tell which: the "
            "response is not compared with the reference simulation, and all other results are "
            "those of the rows that it has."
        )
    elif first:
        text = (
            f"The recording lacks the first {number(first / s.fs_hz, 4)} s of the test: all "
            "results are those of the rest, whose time begins at 0. Its ground motion shows which "
            "part of the reference simulation belongs to it."
        )
    else:
        return []
    return [Notice("alarm", text)]


def notices(s: AxesSummary) -> list[Notice]:
    """Return the notices, the most serious first."""
    found = []
    if s.end_reason != "completed":
        found.append(Notice("alarm", f"The test did not complete: {s.end_reason}."))
        if s.live is not None and s.live.remedy:
            found.append(Notice("note", s.live.remedy))
    found += _placing_notices(s)
    found += not_finite_notices(s.not_finite_rows)
    found += [
        Notice("alarm", axis_attention_in_words(name, one, s.controller))
        for name, one in s.attention
    ]
    found += flag_notices(s.flags, s.rows, s.skipped_ticks)
    return found + live_notices(s.live) + omission_notices(s.omitted)


def verdict(s: AxesSummary) -> str:
    """Return one sentence on how the test ended and how close it came to the reference."""
    if s.end_reason != "completed":
        return f"The test did not complete: {s.end_reason}."
    if not s.rows:
        return NO_ROWS
    if s.signals.reference is None:
        return (
            "The test was completed; there is no reference simulation to compare the measured "
            "response with."
        )
    worst = max(s.directions, key=lambda one: one.response_nrmse or 0.0)
    return (
        "The test was completed; the measured response differs from the reference simulation by "
        f"at most {percent(worst.response_nrmse)} (NRMSE, direction {worst.name})."
    )
