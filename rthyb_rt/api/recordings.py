"""Recordings as objects: named arrays with units, measures, figures, tables."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Iterator, Mapping
from copy import deepcopy
from functools import cached_property
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.api.files import Place, Rig, Test, in_words, path_of
from rthyb_rt.api.messages import in_python, require_flag
from rthyb_rt.api.tables import html_table
from rthyb_rt.config.fields import nearest, with_extension, written
from rthyb_rt.errors import InputError
from rthyb_rt.record import recording as files
from rthyb_rt.record import signal_units

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame
    from xarray import Dataset

    from rthyb_rt.analysis.balance import EnergyBalance
    from rthyb_rt.analysis.several_axes import AxesSummary
    from rthyb_rt.analysis.spectra import FrequencyResponse
    from rthyb_rt.analysis.summary import Summary
    from rthyb_rt.report.drawing import Plate

TIME: Final = "t_s"
_SHOWN: Final = count(1)
_IDENTITY: Final = ("test_name", "end_reason", "ended_by", "attention", "setup")
_SUFFIXES: Final = (".csv", ".mat")
_EXPORT_WORDS: Final = {
    r"--axis ([\w.-]+)": r'axis="\1"',
    "--full": "whole=True",
    "^--axis$": "export: axis",
    "omit the option": "omit it",
}


class Named(dict[str, Any]):
    """Values by name; a name that is not there is refused with those that are.

    Args:
        values: the values.
        what: what each is, for messages: "measure".
        hint: where else a value may be found.
        where: what they belong to, for messages.
    """

    def __init__(
        self, values: Mapping[str, Any], what: str, hint: str = "", where: str = "recording"
    ) -> None:
        super().__init__(values)
        self._what, self._hint, self._where = what, hint, where

    if not TYPE_CHECKING:  # otherwise every attribute would be known to mypy

        def __getattr__(self, name: str) -> Any:
            """Refuse a name written like an attribute, with how it is read."""
            raise AttributeError(
                f'{self._what}s are read by their names in brackets, ["{name}"]'
                if name in self
                else f"no attribute {name}{nearest(name, list(self))}"
            )

    def __missing__(self, name: object) -> Any:
        raise _absent(name, list(self), self._what, self._hint, self._where)


def _absent(
    name: object, names: list[str], what: str, hint: str = "", where: str = "recording"
) -> InputError:
    """Return the error for a name that is not there, with those that are."""
    return InputError(
        f"no {what} {written(name)}{nearest(str(name), names)}; {what}s are: "
        f"{', '.join(names) or 'none'}{hint}",
        where,
    )


class Plot:
    """A figure of the report.

    Attributes:
        key: name, as in `Plots`.
        title: title.
        note: remark on the figure; if there is nothing to plot, the reason.
        svg: the figure as an SVG element; empty if there is nothing to plot.
        figure: the matplotlib figure, which may be changed and saved; None if there is nothing to
            plot.
    """

    def __init__(self, key: str, title: str, note: str, svg: str, figure: Figure | None) -> None:
        self.key, self.title, self.note, self.svg, self.figure = key, title, note, svg, figure

    def save(self, path: Place) -> Path:
        """Write the figure in the format given by the file extension: svg, pdf or png.

        Raises:
            InputError: there is nothing to plot, or the format is unknown.
            RthybError: the file cannot be written.
        """
        path = path_of(path, "plot.save", "the file to write, plot.svg")
        if self.figure is None:
            raise InputError(f"there is no figure to save: {self.note}", f"plot.{self.key}")
        from matplotlib.backend_bases import FigureCanvasBase

        known = sorted(FigureCanvasBase.get_supported_filetypes())
        kind = path.suffix.removeprefix(".")
        if kind not in known:
            raise InputError(
                f"found the file name extension {written(path.suffix)}; must be one of "
                f"{', '.join(known)}",
                str(path),
            )
        with files.replacing(path) as temporary:
            self.figure.savefig(temporary, format=kind)
        return path

    def __repr__(self) -> str:
        return f"<Plot {self.key}: {self.title}>"

    def _repr_html_(self) -> str:
        # A notebook shows many figures on one page, so ids must be unique.
        own = f"{self.key}-{next(_SHOWN)}-"
        svg = re.sub(rf'( id="|#){re.escape(self.key)}-', rf"\g<1>{own}", self.svg)
        width = "" if self.figure is None else f"max-width:{self.figure.get_figwidth():.1f}in"
        caption = f"<figcaption>{self.title}. {self.note}</figcaption>"
        return f'<figure style="{width}">{svg}{caption}</figure>'


class _Chart(Plot):
    """The interactive figure of the report, in place of a figure that needs matplotlib."""

    def __init__(self, key: str, title: str, page: str) -> None:
        super().__init__(key, title, "Drag across the chart to zoom in.", "", None)
        self._page = page

    def save(self, path: Place) -> Path:
        """Write the chart as a page of its own.

        Raises:
            InputError: the file name does not end in .html or .htm.
            RthybError: the file cannot be written.
        """
        from rthyb_rt.report.html import PAGE_NAMES, write_page

        target = path_of(path, "plot.save", "the file to write, plot.html")
        if target.suffix not in PAGE_NAMES:
            raise InputError(
                f"found the file name extension {written(target.suffix)}; without matplotlib this "
                "figure is a page, .html or .htm; images need pip install 'rthyb-rt[report]'",
                str(target),
            )
        write_page(target, lambda: self._page)
        return target

    def _repr_html_(self) -> str:
        from html import escape

        # In a frame, so that the ids of several charts on one page do not interfere.
        return (
            f'<iframe title="{escape(self.title)}" srcdoc="{escape(self._page)}" '
            'style="width:100%;height:34em;border:0"></iframe>'
        )


def plot_of(plate: Plate) -> Plot:
    """Return a figure of the report as a `Plot`."""
    return Plot(plate.key, plate.title, plate.note, plate.svg, plate.figure)


class Plots:
    """The figures of the report; each is created when its method is called.

    Every method returns a `Plot`, and raises `InputError` if matplotlib is not installed. Only
    `displacement` can do without: it is then the interactive chart of the report, which a notebook
    shows and which `Plot.save` writes as a page.
    """

    def __init__(self, recording: Recording) -> None:
        self._of = recording

    def _drawn(self, key: str) -> Plot:
        from rthyb_rt.report.html import extra_needed

        if self._of.axis_names:
            raise InputError(
                f"the test ran on several axes ({', '.join(self._of.axis_names)}), whose figures "
                "are drawn together: report(path) or report_files(folder); balance() alone is "
                "also drawn by itself",
                f"plot.{key}",
            )
        try:
            with extra_needed("a figure"):
                from rthyb_rt.report.figures import draw_one
        except InputError as error:
            chart = self._interactive(key)
            if chart is None:
                raise InputError(
                    f"{error.problems[0].message}; without it, plot.displacement() alone is drawn, "
                    "for tests on one axis",
                    f"plot.{key}",
                ) from None
            return chart
        plate = draw_one(self._of.raw, self._of.summary, key)
        if plate is None:
            return Plot(key, key, "The recording has no reference simulation.", "", None)
        return plot_of(plate)

    def _interactive(self, key: str) -> Plot | None:
        """Return the chart of the report that is drawn in the browser; None: not this figure."""
        from rthyb_rt.report import zoom

        if key != zoom.KEY:
            return None
        of = self._of
        made = zoom.parts(of.raw, of.summary, (float("nan"), float("nan")))
        title = "Displacement"
        return None if made is None else _Chart(key, title, zoom.page(f"{of.name}: {title}", made))

    def displacement(self) -> Plot:
        """Plot ground acceleration, command, compensated command and measured displacement."""
        return self._drawn("displacement")

    def peak(self) -> Plot:
        """Plot the same around the largest command."""
        return self._drawn("peak")

    def hysteresis(self) -> Plot:
        """Plot measured force over measured displacement."""
        return self._drawn("hysteresis")

    def tracking(self) -> Plot:
        """Plot the tracking error: measured displacement minus command."""
        return self._drawn("tracking")

    def synchronisation(self) -> Plot:
        """Plot measured displacement over command: the synchronisation subspace."""
        return self._drawn("synchronisation")

    def transfer(self) -> Plot:
        """Plot gain, delay and coherence from command to measured displacement over frequency."""
        return self._drawn("transfer")

    def force(self) -> Plot:
        """Plot the measured force and the force of the reference simulation."""
        return self._drawn("force")

    def response(self) -> Plot:
        """Plot measured displacement, reference simulation, and their difference."""
        return self._drawn("response")

    def accumulated(self) -> Plot:
        """Plot the accumulated error relative to the reference simulation (Eqn 4.3)."""
        return self._drawn("accumulated")

    def energy(self) -> Plot:
        """Plot energy error and tracking indicator."""
        return self._drawn("energy")

    def balance(self) -> Plot:
        """Plot the energy balance: how the input energy is stored and dissipated."""
        if not self._of.axis_names:
            return self._drawn("balance")
        from rthyb_rt.report.html import extra_needed

        with extra_needed("a figure"):
            from rthyb_rt.report.axes_report import draw_balance

            return plot_of(draw_balance(self._of.raw, self._of._of_axes))

    def spectra(self) -> Plot:
        """Plot the spectra of command and measured displacement."""
        return self._drawn("spectra")

    def response_spectrum(self) -> Plot:
        """Plot response spectra of the ground, and of the floor (commanded and measured)."""
        return self._drawn("response_spectrum")

    def recorded(self, *names: str) -> Plot:
        """Plot recorded quantities over time, such as ``x_3`` or ``drift_2``.

        Args:
            names: their names in the recording, which the test file gives in ``record``; none: all
                additional channels of the recording.

        Raises:
            InputError: a name is not among them, or matplotlib is not installed.
        """
        from rthyb_rt.report.html import extra_needed

        channels = {one.name: one for one in self._of.raw.channels}
        for name in names:
            if name not in channels:
                raise _absent(name, list(channels), "recorded quantity", where="plot.recorded")
        shown = [channels[name] for name in dict.fromkeys(names)] or list(channels.values())
        if not shown:
            return Plot("recorded", "Recorded quantities", "None were recorded.", "", None)
        with extra_needed("a figure"):
            from rthyb_rt.report.figures import draw_recorded
        return plot_of(draw_recorded(self._of.raw, shown))

    def delay(self) -> Plot:
        """Plot the delay estimate with its bounds."""
        return self._drawn("delay")

    def stiffness(self) -> Plot:
        """Plot the tangent stiffness of the restoring-force compensator."""
        return self._drawn("stiffness")

    if not TYPE_CHECKING:  # otherwise every attribute would be known to mypy

        def __getattr__(self, name: str) -> Any:
            """Refuse a name that is not a figure, with those that are."""
            names = [one for one in vars(type(self)) if not one.startswith("_")]
            raise AttributeError(
                f"no figure {name}{nearest(name, names)}; figures: {', '.join(names)}"
            )

    def __repr__(self) -> str:
        names = [name for name in vars(type(self)) if not name.startswith("_")]
        return f"<Plots: {', '.join(names)}>"


class Recording(Mapping[str, NDArray[Any]]):
    """A recorded hybrid test: a mapping from names to signals with one value per sample.

    Names and units are those in the file, such as ``x_meas_m`` in m and ``f_meas_n`` in N,
    including the channels of the control law. ``x_ref_m``, ``v_ref_mps`` and ``f_ref_n`` are those
    of the reference simulation, and are NaN outside the state RUNNING; with several axes, those of
    the second direction of the interface end with ``_1``. The time ``t_s`` is zero at the first
    sample of that state.

    Attributes:
        path: file of the recording; None: not saved.
        notes: remarks from the preparation of the test; only for a test run in this process.
    """

    def __init__(
        self, raw: files.RecordedTest, path: Path | None = None, notes: tuple[str, ...] = ()
    ) -> None:
        if not isinstance(raw, files.RecordedTest):
            raise InputError(
                f"found {in_words(raw)}; a recording is made by run(test), or read by open(path)",
                "Recording",
            )
        self._raw, self.path, self.notes = raw, path, notes

    # ---- signals --------------------------------------------------------------------------------

    @property
    def units(self) -> dict[str, str]:
        """Unit of each signal by name; ``1`` for a dimensionless signal. A copy."""
        return Named(self._units, "signal")

    @cached_property
    def _units(self) -> dict[str, str]:
        raw = self._raw
        known = signal_units.of_samples(raw)
        own = {name: known.get(name, "") for name in raw.samples.dtype.names or ()}
        return {TIME: "s", **own, **signal_units.of_reference(raw)}

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a signal in its unit, shape (n,): one value per sample of the recording.

        The array cannot be written to, because it is the recording's own; copy it to change it.

        Raises:
            InputError: there is no signal of that name; the message lists those that exist.
        """
        raw = self._raw
        if not isinstance(name, str):
            raise InputError(
                f"found {_array_in_words(name)}; a signal is chosen by its name, "
                f"recording[{written(TIME)}], and its rows by an index of that; signals are: "
                f"{', '.join(self._units)}",
                "recording",
            )
        if name == TIME:
            return _protected(raw.time_s())
        if any(one.name == name for one in raw.channels):
            return _protected(raw.channel(name))
        if name in (raw.samples.dtype.names or ()):
            return _protected(np.asarray(raw.samples[name]))
        if raw.reference is not None and name in self._units:
            values = np.full(len(raw.samples), np.nan)
            rows = np.flatnonzero(raw.running())[: len(raw.reference)]
            values[rows] = raw.reference[name][: rows.size]
            return _protected(values)
        raise _absent(name, list(self._units), "signal")

    if not TYPE_CHECKING:  # otherwise every attribute would be known to mypy

        def __getattr__(self, name: str) -> Any:
            """Refuse an unknown attribute; the name of a signal or measure, with how it is read."""
            if name.startswith("_"):  # asked for by copy, pickle and notebooks
                raise AttributeError(name)
            from rthyb_rt.analysis.summary import Summary

            if name in self:
                raise AttributeError(f'a signal is read by its name, recording["{name}"]')
            if name in Summary.__dataclass_fields__:
                raise AttributeError(f'a measure is read by its name, recording.measures["{name}"]')
            known = [*(one for one in dir(type(self)) if one[0] != "_"), *self]
            raise AttributeError(f"a recording has no attribute {name}{nearest(name, known)}")

    def get(self, name: str, default: Any = None) -> Any:
        """Return a signal, or ``default`` if there is none of that name."""
        # The one inherited expects a KeyError, and would raise the error for an unknown name.
        found = default
        if name in self:
            found = self[name]
        return found

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and name in self._units

    def __iter__(self) -> Iterator[str]:
        return iter(self._units)

    def __len__(self) -> int:
        return len(self._units)

    def __eq__(self, other: object) -> bool:
        return self is other

    __hash__ = object.__hash__

    @property
    def running(self) -> NDArray[np.bool_]:
        """Mask of the samples in state RUNNING, shape (n,)."""
        return self._raw.running()

    @property
    def fs_hz(self) -> float:
        """Sample rate, Hz."""
        return self._raw.fs_hz

    def to_pandas(self, *, whole: bool = False) -> DataFrame:
        """Return the signals as a DataFrame indexed by time in s; ``attrs["units"]`` has the units.

        Args:
            whole: include all samples; False: only those in state RUNNING.

        Raises:
            InputError: pandas is not installed.
        """
        pandas = extra("pandas", "to_pandas")
        rows = slice(None) if whole else self.running
        columns = {name: self[name][rows] for name in self if name != TIME}
        index = pandas.Index(self[TIME][rows], name=TIME)
        table: DataFrame = pandas.DataFrame(columns, index=index)
        table.attrs = {"name": self.name, "fs_hz": self.fs_hz, "units": dict(self._units)}
        return table

    def to_xarray(self, *, whole: bool = False) -> Dataset:
        """Return the signals as a Dataset over ``t_s``; each has the attribute ``units``.

        Args:
            whole: include all samples; False: only those in state RUNNING.

        Raises:
            InputError: xarray is not installed.
        """
        xarray = extra("xarray", "to_xarray")
        rows = slice(None) if whole else self.running
        signals = {
            name: (TIME, self[name][rows].copy(), {"units": unit})
            for name, unit in self._units.items()
            if name != TIME
        }
        time = (TIME, self[TIME][rows].copy(), {"units": "s"})
        about = {"name": self.name, "fs_hz": self.fs_hz, "verdict": self.verdict}
        found: Dataset = xarray.Dataset(signals, coords={TIME: time}, attrs=about)
        return found

    # ---- results
    # ------------------------------------------------------------------------------------

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Names of the axes if the rig has several; otherwise ()."""
        return self._raw.axis_names

    def axis(self, name: str) -> dict[str, NDArray[Any]]:
        """Return the signals of one axis, shape (n,) each, under the names of a rig with one axis.

        Raises:
            InputError: there is no such axis; the message lists those that exist.
        """
        rows = self._raw.axis(name)
        return {field: _protected(np.asarray(rows[field])) for field in rows.dtype.names or ()}

    @cached_property
    def summary(self) -> Summary:
        """All results in the report, as an internal object; `measures` has only the numbers.

        Raises:
            InputError: the rig has several axes.
        """
        from rthyb_rt.analysis.summary import summarize

        if self.axis_names:
            raise InputError(
                f"the test ran on several axes ({', '.join(self.axis_names)}), but "
                "summary supports one axis only; use measures, table, verdict or report",
                "recording",
            )
        return summarize(self._raw)

    @cached_property
    def _of_axes(self) -> AxesSummary | None:
        """The summary for several axes; None if the rig has one axis or the test never ran."""
        from rthyb_rt.analysis import several_axes

        if not self.axis_names or not self.running.any():
            return None
        return several_axes.summarize(self._raw)

    @property
    def measures(self) -> dict[str, Any]:
        """Measures of the test by name, as in ``rthyb run --json``: SI units and fractions.

        Names include the unit. A measure is None if the recording does not contain it. With several
        axes, the measures of each axis are under ``axes``, and those of each direction under
        ``directions``. A copy.
        """
        hint = ""
        if self.axis_names and self._measures:
            hint = f'; those of an axis are in measures["axes"][{written(self.axis_names[0])}]'
        return Named(deepcopy(self._measures), "measure", hint)

    @cached_property
    def _measures(self) -> dict[str, Any]:
        if self.axis_names:
            return {} if self._of_axes is None else dict(self._of_axes.as_json())
        found = self.summary.as_json()
        return {name: value for name, value in found.items() if name not in _IDENTITY}

    if not TYPE_CHECKING:  # otherwise every attribute would be known to mypy

        def __setattr__(self, name: str, value: Any) -> None:
            """Refuse what a recording does not have: a signal or a measure is never changed."""
            if not (name.startswith("_") or name in ("path", "notes")):
                raise AttributeError(
                    f"recording.{name} cannot be set, because a recording never changes; copy a "
                    f"signal to change it, values = recording[{written(TIME)}].copy()"
                )
            super().__setattr__(name, value)

    @property
    def table(self) -> list[tuple[str, str, str]]:
        """The table that ``rthyb run`` prints: measure, value, formula."""
        from rthyb_rt.analysis import several_axes, summary

        if self.axis_names:
            rows = [] if self._of_axes is None else several_axes.table(self._of_axes)
        else:
            rows = summary.table(self.summary)
        return [(row.label, row.value, row.formula) for row in rows]

    @property
    def name(self) -> str:
        """Name of the test."""
        return str(self._raw.meta.get("test_name", ""))

    @property
    def completed(self) -> bool:
        """Whether the test was completed."""
        return self._end_reason == "completed"

    @property
    def _end_reason(self) -> str:
        if self.axis_names:
            return str(self._raw.meta.get("end_reason", "unknown"))
        return self.summary.end_reason

    @property
    def ending(self) -> str:
        """``completed``, or the cause that ended the test, with its values."""
        if self.completed:
            return "completed"
        return ("" if self.axis_names else self.summary.ending) or self._end_reason

    @property
    def verdict(self) -> str:
        """The result in one sentence."""
        from rthyb_rt.analysis import several_axes, summary

        if not self.axis_names:
            return summary.verdict(self.summary)
        if self._of_axes is None:
            return f"The test did not complete: {self._end_reason}."
        return several_axes.verdict(self._of_axes)

    @property
    def notices(self) -> list[str]:
        """Important remarks, the most serious first."""
        from rthyb_rt.analysis import several_axes, summary

        if not self.axis_names:
            return [notice.text for notice in summary.notices(self.summary)]
        return (
            []
            if self._of_axes is None
            else [one.text for one in several_axes.notices(self._of_axes)]
        )

    @property
    def meta(self) -> dict[str, Any]:
        """Metadata of the recording: versions, clock, date."""
        return dict(self._raw.meta)

    @cached_property
    def test(self) -> Test:
        """The test as it was run, including all defaults, on `rig`.

        Raises:
            InputError: another version wrote it, with keys that this version does not have.
        """
        return Test.from_toml(self._raw.test_toml, self.rig, "test of the recording")

    @cached_property
    def rig(self) -> Rig:
        """The rig as it was used; raises the same errors as `test`."""
        return Rig.from_toml(self._raw.rig_toml, "rig of the recording")

    @property
    def plot(self) -> Plots:
        """The figures of the report by name."""
        return Plots(self)

    @property
    def raw(self) -> files.RecordedTest:
        """The internal recording object; not part of the stable interface."""
        return self._raw

    def frequency_response(
        self, given: str = "x_num_m", answer: str = "x_meas_m", *, segment_s: float | None = None
    ) -> FrequencyResponse:
        """Return the frequency response between two signals in state RUNNING, by Welch's method.

        Args:
            given: input signal; with ``x_cmd_m``, the response excludes the delay compensation.
            answer: output signal.
            segment_s: length of a segment, s; its inverse is the frequency resolution in Hz. None:
                a length that gives eight segments, at most 4 s.

        Raises:
            InputError: there is no such signal, the segment has fewer than 8 samples or is longer
                than the test, or the input is constant.

        Examples:
            >>> rec = run(Test("section5-T0.5", ground_motion={"duration_s": 10}))
            >>> found = rec.frequency_response("x_cmd_m")
            >>> bool(found.delay_s[found.frequency_hz == 2.0][0] > 0.01)
            True
        """
        from rthyb_rt.analysis import spectra

        rows = self.running
        count = int(np.count_nonzero(rows))
        if segment_s is not None and not (
            isinstance(segment_s, (int, float)) and math.isfinite(segment_s)
        ):
            raise InputError(
                f"found {_array_in_words(segment_s)}; give the length of a segment in s as a "
                "number, or None",
                "frequency_response: segment_s",
            )
        segment = None if segment_s is None else round(segment_s * self.fs_hz)
        if segment is not None and not 8 <= segment <= count:
            raise InputError(
                f"found {segment_s:g} s; must be from {8 / self.fs_hz:.3g} s to the test's "
                f"{count / self.fs_hz:.4g} s",
                "frequency_response: segment_s",
            )
        x, y = (np.asarray(self[name][rows], dtype=np.float64) for name in (given, answer))
        found = spectra.frequency_response(x, y, self.fs_hz, segment)
        if found is None:
            raise InputError(
                f"{given} or {answer} is too short, is constant, or has too few finite values",
                "frequency_response",
            )
        return found

    def energy_balance(self) -> EnergyBalance:
        """Return the energy balance at each row: how the input energy was stored and dissipated.

        With several degrees of freedom or axes, the balance is that of the whole structure; it is
        computed by running the numerical part again along the recorded motion.

        Raises:
            InputError: a prescribed history, a test that is too short, or a recording that does not
                contain enough data on its structure.

        Examples:
            >>> found = run(Test("section5-T0.5", ground_motion={"duration_s": 8})).energy_balance()
            >>> bool(found.gap < 1e-3)
            True
        """
        from rthyb_rt.analysis import balance, structure_balance

        if self.axis_names:
            known = self._of_axes
            found = structure_balance.of_axes(self._raw, known.structure) if known else None
        else:
            found = balance.of_recording(self._raw, self.summary.setup)
        if found is None:
            raise InputError(
                "the recording has no mass, damping and stiffness for the recorded motion, or too "
                "few rows in RUNNING; an energy balance needs a test that reached RUNNING, with a "
                "numerical part, recorded by this version",
                "energy_balance",
            )
        return found

    # ---- files ----------------------------------------------------------------------------------

    def report(self, path: Place) -> Path:
        """Write the report to one HTML file.

        Raises:
            InputError: the file name does not end in .html or .htm, or matplotlib or jinja2 is not
                installed.
            RthybError: the file cannot be written.
        """
        from rthyb_rt.report import write_report

        target = path_of(path, "report", "the page to write, report.html")
        write_report(self._raw, target)
        return target

    def report_files(self, folder: Place) -> list[Path]:
        """Write every figure of the report as SVG and PDF, and its table as LaTeX and CSV.

        Args:
            folder: output folder; existing files of the same names are replaced.

        Returns:
            Paths of the files.

        Raises:
            InputError: the folder is named like a file, or matplotlib is not installed.
            RthybError: a file cannot be written.
        """
        from rthyb_rt.report.publication import write_files

        target = path_of(folder, "report_files", "the folder to write to")
        if target.suffix in (".html", ".htm", ".pdf", ".svg", ".csv", ".tex"):
            raise InputError(
                "is the name of one file, but several are written: give a folder, or use "
                "report(path) for the report as one page",
                str(target),
            )
        return write_files(self._raw, target)

    def save(self, path: Place) -> Path:
        """Write the recording to an HDF5 file, which can be read with `open`.

        Raises:
            InputError: the file name does not end in .h5 or .hdf5.
            RthybError: the file cannot be written.
        """
        target = with_extension(
            path_of(path, "save", "the file to write, recording.h5"), (".h5", ".hdf5")
        )
        files.write(target, self._raw)
        return target

    def export(self, path: Place, *, whole: bool = False, axis: str | None = None) -> Path:
        """Export the signals in the format given by the file extension: ``.csv`` or ``.mat``.

        Args:
            path: file to write.
            whole: for a CSV file, True writes all samples and signals; False writes only the
                columns that `diagnose` reads, in state RUNNING, with a `UserWarning` if the rig
                has extra channels. A MAT file always contains everything.
            axis: for these columns of a test on several axes: the name of the axis. The part of
                its force that is due to the other axes is subtracted, and the rig file of that
                axis, the model for a diagnosis, is written beside it.

        Raises:
            InputError: the format is unknown, an axis is not named or does not exist, or ``.mat``
                was requested and scipy is not installed.
            RthybError: the file cannot be written.
        """
        from rthyb_rt.record import axis_export, mat_csv

        require_flag(whole, "export: whole")
        path = path_of(path, "export", "the file to write, signals.csv")
        if path.suffix not in _SUFFIXES:
            raise InputError(
                f"found the file name extension {written(path.suffix)}; must be one of "
                f"{', '.join(_SUFFIXES)}",
                str(path),
            )
        if axis is not None and (whole or path.suffix == ".mat"):
            raise InputError(
                f"found {written(axis)}; a file with every signal has those of all axes: omit "
                "axis, or write a .csv file without whole=True",
                "export: axis",
            )
        try:
            if axis is not None:
                axis_export.to_csv(self._raw, path, axis)
            elif path.suffix == ".mat":
                mat_csv.to_mat(self._raw, path)
            else:
                mat_csv.to_csv(self._raw, path, full=whole)
        except InputError as error:
            raise in_python(error, _EXPORT_WORDS) from None
        note = "" if whole or path.suffix == ".mat" else mat_csv.without_extras(self._raw)
        if note:
            warnings.warn(f"{path}: {note}; whole=True writes all signals", stacklevel=2)
        return path

    # ---- interactive display
    # ------------------------------------------------------------------------

    def __repr__(self) -> str:
        from rthyb_rt.numbers import percent

        if self.axis_names:
            axes = ", ".join(self.axis_names)
            return f"<Recording {self.name}: {self.ending}, axes {axes}, at {self.fs_hz:g} Hz>"
        found = self.summary
        errors = f"tracking {percent(found.tracking_nrmse)}"
        if found.response_nrmse is not None:
            errors += f", response {percent(found.response_nrmse)}"
        return (
            f"<Recording {self.name}: {self.ending}, {found.duration_s:.4g} s at "
            f"{self.fs_hz:g} Hz, {errors}>"
        )

    def _figure(self) -> Plot:
        """Return the response; the displacement if there is no reference, or no matplotlib."""
        try:
            plot = self.plot.response()
        except InputError:
            return self.plot.displacement()
        return plot if plot.svg else self.plot.displacement()

    def _repr_html_(self) -> str:
        """Return verdict, notices, table and figure for a notebook."""
        from html import escape

        parts = [f"<p><b>{escape(self.name)}</b>: {escape(self.verdict)}</p>"]
        parts += [f"<p>{escape(text)}</p>" for text in self.notices]
        try:
            parts.append(self._figure()._repr_html_())
        except InputError as error:
            parts.append(f"<p>{escape(str(error))}</p>")
        return "".join([*parts, html_table(self.table)])


def _array_in_words(given: object) -> str:
    """Return what was given instead of a name: an array by its shape."""
    if isinstance(given, np.ndarray):
        return f"an array of shape {given.shape}"
    return written(given)


def _protected(values: NDArray[Any]) -> NDArray[Any]:
    """Return a view of values that cannot be written to."""
    seen = values.view()
    seen.flags.writeable = False
    return seen


def extra(package: str, what: str) -> Any:
    """Import an optional package.

    Raises:
        InputError: it is not installed.
    """
    from importlib import import_module

    try:
        return import_module(package)
    except ImportError as error:
        raise InputError(
            f"needs {package}; install it with pip install 'rthyb-rt[data]'", what
        ) from error


def open_recording(path: Place) -> Recording:
    """Open the recording of a run; `rthyb_rt.open` is this function.

    Args:
        path: folder of a run, or its ``recording.h5``.

    Raises:
        InputError: there is no recording, or it cannot be read; the message explains why.
    """
    found = path_of(path, "open", "the folder of a run, or its recording.h5")
    return Recording(files.open_run(found), found)


def as_recording(given: Recording | Place, where: str = "open") -> Recording:
    """Return a recording given as an object or a path; raises the same errors as `open_recording`.

    ``where`` is the calling function, for messages.
    """
    if isinstance(given, Recording):
        return given
    what = "the folder of a run, or its recording.h5"
    return open_recording(path_of(given, where, what, "a recording, such as run(test)"))
