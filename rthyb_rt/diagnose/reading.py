"""Reading a recording from a file, and rejecting unusable data.

Two kinds of files: an external table, and the program's own recording. Irregularities that can be
handled are handled and listed in the case's notes; anything that would make an answer worthless is
an `InputError`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import units
from rthyb_rt.diagnose import channel_sizes, strays
from rthyb_rt.diagnose.axes import OfAxis
from rthyb_rt.diagnose.case import CHANNELS, NO_READING, Case, Floats, Model
from rthyb_rt.diagnose.drive_clock import drive_clock, made_up
from rthyb_rt.diagnose.estimate import quasi_static
from rthyb_rt.diagnose.external_table import Lab, read_lab, time_unit
from rthyb_rt.diagnose.gaps import filled, filled_if_short
from rthyb_rt.diagnose.mapping import EXAMPLE, Wish, proposals
from rthyb_rt.diagnose.modelfile import at_rate, find_model, model_of_rig, read_model
from rthyb_rt.diagnose.noise_level import white_noise
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt.record.recording import RecordedTest

__all__ = ["find_model", "model_of_rig", "read_case", "read_model"]


# ---- the recording ----------------------------------------------------------------------------


def read_case(
    recording: Path,
    model: Model,
    judged: bool = True,
    wishes: Sequence[Wish] = (),
    beside: Case | None = None,
    of: OfAxis | None = None,
) -> Case:
    """Read a recording together with its model.

    Args:
        recording: CSV file, HDF5 file or folder of a run.
        model: from `read_model`.
        judged: whether it must be suitable for a diagnosis; False for a second recording.
        wishes: columns of the CSV file for channels, from `mapping.read_wishes`.
        beside: for a second recording, the one that is diagnosed: their sizes must be consistent.
        of: the axis, for a recording of several; its ``model`` is then used.

    Raises:
        InputError: the file cannot be read, or cannot give a reliable answer.
    """
    where = str(recording)
    own = _run(recording, of)
    lab = None
    if own is not None:
        t, channels, notes = _own(own, of)
        asked = wishes if beside is None else ()
        _take_extras(own, asked, channels, notes, of)
        t, channels = _by_the_drive(own, of, t, channels, {w.channel for w in asked}, notes)
        model = at_rate(model, own.fs_hz)
    else:
        lab = read_lab(recording, model, wishes, needed=beside is None and judged)
        t, channels, notes = lab.t, lab.channels, lab.notes
        if beside is not None:
            model = _at_its_rate(model, t, notes)
    if beside is None:
        notes += model.notes
    if model.unused:
        notes.append(f"parts of the model that are not used: {', '.join(model.unused)}")
    beyond = lab.further if lab is not None else {}
    t, whole, more = _uniform(t, {**beyond, **channels}, model.fs_hz, where, lab)
    channels = {k: whole[k] for k in channels}
    further = {k: whole[k] for k in beyond}
    notes += more
    rows = np.ones(t.size, dtype=np.bool_)
    _filled_in(channels, notes)
    channels = _usable(channels, model, where, notes, judged, lab)
    if judged:
        _spikes(channels, notes)
        _clipped(channels, where, notes)
        _fits_family(channels, model, where)
    folder = recording.resolve().parent.name
    case = Case(recording.stem, model, t, channels, rows, notes, own, folder, further)
    if own is not None and of is not None:
        case = replace(case, axis=of.name, zero_error_n=of.zero_error_n(own))
    least = POLICY.least_rows_static if quasi_static(case) else POLICY.least_rows
    if judged and t.size < least:
        raise InputError(f"has {t.size} rows; a diagnosis needs at least {least}", where)
    _of_a_size(case, where, lab, judged, beside)
    if judged:
        _means_nothing(case, where)
    return case


def _of_a_size(case: Case, where: str, lab: Lab | None, judged: bool, beside: Case | None) -> None:
    """Reject channels whose sizes are inconsistent with the model or the other recording."""
    labels = lab.labels if lab is not None else None
    stated = lab.stated if lab is not None else CHANNELS
    if beside is not None:
        channel_sizes.check_against(beside.channels, case.channels, where, labels or {})
    if case.t.size >= POLICY.least_rows:
        clean = dict(case.channels)
        if not judged:
            _spikes(clean, [])  # a stray reading must not affect the size
        turned = [k for k, source in lab.sources.items() if source.sign < 0] if lab else []
        channel_sizes.check(
            clean, case.model, where, labels, stated, turned, second=beside is not None
        )


def axes_of(path: Path) -> tuple[str, ...]:
    """Return the axes' names; (): one axis, or a recording of another program.

    Raises:
        InputError: the file cannot be read.
    """
    rec = _opened(path)
    return () if rec is None else rec.axis_names


def _opened(path: Path) -> RecordedTest | None:
    if not path.is_dir() and path.suffix not in (".h5", ".hdf5"):
        return None
    from rthyb_rt.record.recording import open_run

    return open_run(path)


def _run(path: Path, of: OfAxis | None) -> RecordedTest | None:
    """Return a recording of this program; None if the file is an external one."""
    rec = _opened(path)
    names = () if rec is None else rec.axis_names
    if of is None and names:
        raise InputError(
            f"was recorded on several axes ({', '.join(names)}); choose one of them", str(path)
        )
    if of is not None:
        of.fits(names, str(path))
    return rec


_EXTRA_OF = {"x_meas": "m", "f_meas": "N", "ag": "m/s^2"}
"""The channels that an extra channel of a rig can replace, and the kind of unit that it needs."""


def _take_extras(
    rec: RecordedTest,
    wishes: Sequence[Wish],
    channels: dict[str, Floats],
    notes: list[str],
    of: OfAxis | None,
) -> None:
    """Replace the test's own sensors by extra channels of the rig.

    On a rig of several axes, an extra channel replaces a sensor of its own axis; the ground
    acceleration, which they share, can be that of any. From a force, what the motion of the others
    causes is subtracted, as from that of the load cell.

    Raises:
        InputError: there is no such channel, its unit is of another kind, or the channel to be
            replaced was computed by the controller.
    """
    every, by_axis = {one.name: one for one in rec.extras()}, rec.extras_by_axis()
    mask = rec.running()
    for wish in wishes:
        text = wish.text.strip()
        name = text.lstrip("-").strip()
        extras = every
        if of is not None and wish.channel != "ag":
            extras = {one.name: one for one in by_axis.get(of.name, ())}
            elsewhere = [axis for axis, own in by_axis.items() if name in [one.name for one in own]]
            if name not in extras and elsewhere:
                raise InputError(
                    f"found {wish.channel}={wish.text}, an extra channel of axis {elsewhere[0]}, "
                    f"but axis {of.name} is diagnosed; its extra channels are: "
                    f"{', '.join(extras) or 'none'}. Name one of them, or diagnose axis "
                    f"{elsewhere[0]} alone",
                    wish.where,
                )
        if wish.channel not in _EXTRA_OF or name not in extras:
            known = ", ".join(extras) or "none"
            raise InputError(
                f"found {wish.channel}={wish.text}; in a recording of this program only "
                f"{', '.join(_EXTRA_OF)} can be replaced, by an extra channel of the rig; its "
                f"extra channels: {known}",
                wish.where,
            )
        channel, unit = extras[name], wish.unit or extras[name].unit
        try:
            factor = float(units.convert(f"1 {unit}", _EXTRA_OF[wish.channel]))
        except units.UnitError as error:
            raise InputError(
                f"found the unit {unit!r} of {name} ({error}); {wish.channel} needs a unit of "
                f"the same kind as {_EXTRA_OF[wish.channel]}",
                wish.where,
            ) from None
        sign = -1.0 if text.startswith("-") or wish.sign < 0 else 1.0
        values = sign * factor * rec.channel(channel.name)
        if wish.channel != "ag":
            values = values - _at_rest(rec, values)
        values = values[mask]
        if of is not None and wish.channel == "f_meas":
            values = values - of.force_of_others(rec)
        channels[wish.channel] = values
        notes.append(
            f"{wish.channel} is read from the extra channel {name} of the rig, not from its own "
            "sensor"
        )


def _at_rest(rec: RecordedTest, values: Floats) -> float:
    """Return what a sensor read at rest; 0: not known. The test's own sensors are tared."""
    from rthyb_rt.core import STATES

    before = int(np.argmax(rec.running()))
    still = np.isin(rec.samples["state"][:before], [STATES.index(n) for n in ("ZEROED", "ARMED")])
    own = values[:before][still]
    own = own[np.isfinite(own)]
    return float(own.mean()) if own.size else 0.0


def _own(rec: RecordedTest, of: OfAxis | None) -> tuple[Floats, dict[str, Floats], list[str]]:
    mask = rec.running()
    s = rec.samples[mask]
    channels = of.signals(rec) if of is not None else {
        "ag": s["ag_mps2"], "x_num": s["x_num_m"], "x_cmd": s["x_cmd_m"],
        "x_meas": s["x_meas_m"].copy(), "f_meas": s["f_meas_n"].copy(),
    }  # fmt: skip
    unknown = made_up(s)
    notes = []
    if unknown.any():
        channels["x_meas"][unknown] = channels["f_meas"][unknown] = np.nan
        notes.append(f"{int(unknown.sum())} rows were predicted during the test and are excluded")
    t = rec.time_s()[mask]
    out = {k: np.ascontiguousarray(v, dtype=np.float64) for k, v in channels.items()}
    for values in out.values():
        values[~(np.abs(values) < NO_READING)] = np.nan
    if not np.any(out["ag"]):
        del out["ag"]
    return np.ascontiguousarray(t, dtype=np.float64), out, notes


def _by_the_drive(
    rec: RecordedTest,
    of: OfAxis | None,
    t: Floats,
    channels: dict[str, Floats],
    mapped: set[str],
    notes: list[str],
) -> tuple[Floats, dict[str, Floats]]:
    """Return the recording in the time of the drive, if it is another one; ``notes`` says so.

    Args:
        rec: the recording.
        of: its axis; None: the only one.
        t: time, (n,), s.
        channels: by name, (n,) each.
        mapped: channels that were replaced by extra channels, which arrive with the pairs.
        notes: for the reader.
    """
    from rthyb_rt.core import FLAGS

    mask = rec.running()
    s, axis = rec.samples[mask], rec.axis(of.name)[mask] if of is not None else rec.samples[mask]
    numbers = (s["tick"], axis["count"], axis["echo"])
    ticks, counts, echoes = (np.asarray(a, dtype=np.int64) for a in numbers)
    sent = (s["flags"] & FLAGS["blind"]) == 0
    clock = drive_clock(ticks, counts, echoes, ~made_up(s), sent)
    if clock is None:
        return t, channels
    often = "once" if clock.shifts == 1 else f"{clock.shifts} times"
    notes.append(
        f"the drive's sample count shifted {often} against the ticks of this PC; "
        "readings and commands are placed by it"
    )
    by_pairs = {"x_meas", "f_meas", *mapped}
    placed = {
        name: clock.of_pairs(values) if name in by_pairs else clock.of_commands(values)
        for name, values in channels.items()
    }
    return t[0] + np.arange(clock.measured.size) / rec.fs_hz, placed


def _uniform(
    t: Floats, channels: dict[str, Floats], fs_hz: float, where: str, lab: Lab | None
) -> tuple[Floats, dict[str, Floats], list[str]]:
    """Return the recording on a uniform time base; rows missing in a gap become NaN."""
    bad = np.flatnonzero(~np.isfinite(t))
    if bad.size:
        raise InputError("the time is not a number", _line(where, int(bad[0]), lab))
    if t.size < 2:
        raise InputError("has only one row", where)
    steps = np.diff(t)
    back = np.flatnonzero(steps <= 0)
    if back.size:
        i = int(back[0])
        raise InputError(
            f"time does not increase: {t[i]:g} s is followed by {t[i + 1]:g} s; sort the rows, "
            "or split the recording where the clock was set",
            _line(where, i + 1, lab),
        )
    dt = float(np.median(steps))
    if abs(dt * fs_hz - 1.0) > POLICY.rate_off:
        raise InputError(
            f"rows are {dt:.6g} s apart ({1 / dt:.6g} Hz), but the model says fs_hz = {fs_hz:g}; "
            + _other_rate(dt * fs_hz, lab),
            where,
        )
    notes: list[str] = []
    # Only gaps are counted: a printed time is rounded, and a clock may be slightly wrong.
    jumps = np.where(steps > POLICY.row_missing * dt, np.round(steps / dt).astype(np.int64), 1)
    index = np.concatenate(([0], np.cumsum(jumps)))
    dt = float(t[-1] - t[0]) / float(index[-1])
    jitter = float(np.max(np.abs((t - t[0]) / dt - index)))
    if jitter > POLICY.jitter_reported:
        notes.append(
            f"the spacing of the rows varies by up to {jitter:.2f} of the period; it is treated "
            "as uniform"
        )
    if jitter > POLICY.uneven_rows:
        raise InputError(
            f"the rows are unevenly spaced, by up to {jitter:.0f} times the period; resample the "
            "recording to one rate",
            where,
        )
    missing = int(index[-1] + 1 - t.size)
    if missing == 0:
        return t, channels, notes
    if missing > t.size:
        raise InputError(
            f"more rows are missing ({missing}) than present ({t.size}); diagnose the parts "
            "between the gaps",
            where,
        )
    whole = t[0] + dt * np.arange(index[-1] + 1)
    out = {}
    for name, values in channels.items():
        full = np.full(whole.size, np.nan)
        full[index] = values
        out[name] = full
    gaps = int((jumps > 1).sum())
    notes.append(f"{gaps} gap{'s' if gaps > 1 else ''} in time, {missing} rows; not evaluated")
    return whole, out, notes


def _at_its_rate(model: Model, t: Floats, notes: list[str]) -> Model:
    """Return the model at the rate of a second recording, unless its time has another unit."""
    steps = np.diff(t[np.isfinite(t)])
    dt = float(np.median(steps)) if steps.size else 0.0
    if not dt > 0.0 or abs(dt * model.fs_hz - 1.0) <= POLICY.rate_off:
        return model
    if time_unit(dt * model.fs_hz) is not None:
        return model
    notes.append(f"rows are {dt:.6g} s apart, those of the recording {1.0 / model.fs_hz:.6g} s")
    return replace(model, fs_hz=1.0 / dt)


def _line(where: str, row: int, lab: Lab | None) -> str:
    """Return the place of a row: its line in an external file."""
    return f"{where}:{lab.lines[row] if lab is not None else row + 1}"


def _other_rate(ratio: float, lab: Lab | None) -> str:
    """Return what to do about rows that are ``ratio`` sampling periods apart."""
    unit = time_unit(ratio)
    if lab is None or "t" not in lab.labels or unit in (None, "s"):
        return "correct the one that is wrong"
    return (
        f'if the time is in {unit}, give --map t="{lab.labels["t"]} [{unit}]"; otherwise correct '
        "the one that is wrong"
    )


NEEDED: dict[str, tuple[tuple[str, ...], ...]] = {
    "drive": (("f_meas", "x_meas"), ("f_meas", "x_cmd"), ("x_cmd", "x_meas")),
    "loop": (("f_meas", "x_meas"), ("f_meas", "x_cmd"), ("x_cmd", "x_meas")),
    "ground": (("ag", "x_meas"), ("f_meas", "x_meas")),
    "forced": (("f_in", "x_meas"),),
}


def _usable(
    channels: dict[str, Floats], model: Model, where: str, notes: list[str], judged: bool,
    lab: Lab | None = None,
) -> dict[str, Floats]:  # fmt: skip
    """Remove channels without information; raise an error if one is needed."""
    out = dict(channels)
    reasons: dict[str, str] = {}
    for name, values in channels.items():
        good = values[np.isfinite(values)]
        if good.size == 0:
            reasons[name] = "contains no number"
        elif name == "f_in" and model.family == "forced" and not good.any():
            pass  # a freely decaying body: no force acts, which is valid
        elif good.size > 2 and np.all(good == good[0]):
            reasons[name] = f"is constant at {good[0] + 0.0:g} {CHANNELS[name]}"
        elif judged and good.size < POLICY.numbers_least * values.size:
            reasons[name] = (
                f"contains numbers in only {100 * good.size / values.size:.0f} % of its rows"
            )
        if name in reasons:
            del out[name]
            notes.append(f"{name} {reasons[name]} and is not used")
        elif good.size < values.size and judged:
            notes.append(f"{name}: {values.size - good.size} rows without a number; not evaluated")
    choices = NEEDED[model.family]
    if judged and not any(set(choice) <= set(out) for choice in choices):
        asked = ", or ".join(" and ".join(choice) for choice in choices)
        why = "; ".join(f"{name} {reason}" for name, reason in reasons.items())
        raise InputError(
            f"family {model.family!r} needs {asked}; "
            f"found {'only ' + ', '.join(out) if out else 'none of them'}"
            + (f" ({why})" if why else "")
            + _offers(lab, choices),
            where,
        )
    return out


def _offers(lab: Lab | None, choices: tuple[tuple[str, ...], ...]) -> str:
    """List the unassigned columns, and how to assign them."""
    if lab is None:
        return ""
    found = proposals(lab.table, lab.sources, dict.fromkeys(n for c in choices for n in c))
    if found:
        return f"; to assign a column to a channel, for example: {' '.join(found)}"
    if len(lab.sources) < len(lab.table.columns):
        return f"; to assign a column to a channel: {EXAMPLE}"
    return ""


def _fits_family(channels: dict[str, Floats], model: Model, where: str) -> None:
    """Reject a model that does not belong to such a recording."""
    family = model.family
    if family in ("ground", "forced") and "x_cmd" in channels and "ag" not in channels:
        raise InputError(
            "has x_cmd but no ag: it is a recording of a specimen that is moved by an actuator, "
            f"but the model says {family!r}",
            where,
        )
    if (family == "ground" and model.mass <= 0) or (
        family == "forced" and model.mass + model.moving_mass <= 0
    ):
        table = "numerical.m" if family == "ground" else "specimen.moving_mass"
        raise InputError(f"family {family!r} needs a mass: {table} is missing or 0", where)
    if family == "drive" and "f_in" in channels and "f_meas" not in channels:
        raise InputError(
            "has f_in, the channel of family 'forced', but the model says 'drive'", where
        )
    only_command = "x_meas" not in channels or "f_meas" not in channels
    if family in ("drive", "loop") and only_command and model.actuator is None:
        raise InputError(
            "x_meas or f_meas is missing, and the model has no [actuator] from which the "
            "missing one could be computed; add [actuator], or record both",
            where,
        )
    nothing = model.k == 0 and model.c == 0 and model.moving_mass == 0 and not model.extra
    if nothing and "f_meas" in channels:
        raise InputError("the force of the model is zero: give k, c or moving_mass", where)


def _spikes(channels: dict[str, Floats], notes: list[str]) -> None:
    """Exclude single readings far beyond all others: faulty samples."""
    for name, values in channels.items():
        rows = strays.impossible(values)
        if rows.size:
            channels[name], note = strays.without(name, values, rows)
            notes.append(note)


def _clipped(channels: dict[str, Floats], where: str, notes: list[str]) -> None:
    """Exclude rows at which a sensor was at the end of its range."""
    for name in ("x_meas", "f_meas", "a_meas", "ag", "f_in"):
        values = channels.get(name)
        if values is None or not np.nanstd(values) > 0.0:
            continue
        rows = _at_the_stops(values)
        share = float(rows.mean())
        if share == 0.0:
            continue
        if share > POLICY.clipped_rows:
            raise InputError(
                f"{name} is at the end of its range in {100 * share:.0f} % of the rows: the "
                "sensor is clipped; choose a larger range and repeat the test",
                where,
            )
        clean = values.copy()
        clean[rows] = np.nan
        channels[name] = clean
        notes.append(
            f"{name} is clipped in {int(rows.sum())} rows ({100 * share:.1f} %); not evaluated "
            "there"
        )


def _at_the_stops(values: Floats) -> NDArray[np.bool_]:
    good = np.isfinite(values)
    out = np.zeros(values.size, dtype=np.bool_)
    if np.unique(values[good]).size <= POLICY.stop_readings:
        return out  # of so coarse a converter, the last reading is one among few
    spread = float(np.nanstd(values))
    for end in (np.nanmax(values), np.nanmin(values)):
        # The residual at rest, or one level of a coarse converter, is not the end of the range.
        if abs(end - np.nanmedian(values)) < POLICY.stop_beyond * spread:
            continue
        at = good & (values == end)
        longest = _longest_run(at)
        inside = good & (values < np.nanmax(values)) & (values > np.nanmin(values))
        repeats = np.concatenate(([False], (np.diff(values) == 0))) & inside
        elsewhere = _longest_run(repeats) + 1
        if longest >= POLICY.stop_rows and longest > POLICY.stop_longer * elsewhere:
            out |= at
    return out


def _longest_run(mask: NDArray[np.bool_]) -> int:
    edges = np.flatnonzero(np.diff(np.concatenate(([0], mask.astype(np.int8), [0]))))
    return int(np.max(edges[1::2] - edges[::2], initial=0))


def _means_nothing(case: Case, where: str) -> None:
    """Reject a load cell that shows only noise while the specimen moves.

    Many laws would fit zero force: without a reading there is no answer.
    """
    f, x = case.channels.get("f_meas"), case.channels.get("x_meas")
    if f is None or x is None or not case.model.k:
        return
    spread = float(np.nanstd(f))
    if spread == 0.0 or not white_noise(f) > POLICY.dead_cell * spread:
        return
    good = np.isfinite(f) & np.isfinite(x)
    expected = case.model.spring(filled(x))[good]
    if np.std(expected) == 0.0 or np.std(expected) < spread:
        return
    if abs(float(np.corrcoef(f[good], expected)[0, 1])) < POLICY.dead_cell_follows**0.5:
        raise InputError(
            f"f_meas contains only noise ({spread:.3g} N), although the model predicts forces of "
            f"{float(np.std(expected)):.3g} N: is the load cell connected, and is this the right "
            "channel?",
            where,
        )


def _filled_in(channels: dict[str, Floats], notes: list[str]) -> None:
    """Interpolate one to three consecutive missing rows of an input.

    A command or a known input is smooth over a few milliseconds; a cubic through its neighbours is
    more accurate than the resulting motion requires. Measured channels keep their gaps.
    """
    for name in ("x_cmd", "x_num", "ag", "f_in"):
        values = channels.get(name)
        if values is None or np.isfinite(values).all() or np.isfinite(values).sum() < 8:
            continue
        clean = filled_if_short(values)
        put_in = int(np.isfinite(clean).sum() - np.isfinite(values).sum())
        if put_in:
            channels[name] = clean
            notes.append(f"{name}: {put_in} missing rows were interpolated")
