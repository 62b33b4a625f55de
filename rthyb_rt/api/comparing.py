"""Comparison of recordings: their measures, and the differences of motions and forces."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rthyb_rt.api.files import Place, Test, in_words, path_of
from rthyb_rt.api.messages import MAP_WORDS, in_python, map_options, require_flag
from rthyb_rt.api.recordings import Plot, Recording, extra, plot_of
from rthyb_rt.api.running import prepared
from rthyb_rt.api.sweeping import Sweep
from rthyb_rt.api.tables import html_table
from rthyb_rt.comparing import comparison_page, courses
from rthyb_rt.comparing.overlay import Overlay
from rthyb_rt.config.fields import written
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pandas import DataFrame

    from rthyb_rt.lab.experiment import Setup
    from rthyb_rt.record import recording as raw

_WORDS = MAP_WORDS | {
    r"^--map (\w+)": r"compare: columns: \1",
    "--map": "columns",
    r'campaign\.keep = "all" \(rthyb sweep --keep all\)': 'sweep(..., keep="all")',
    r"--axis ([\w.-]+)": r'axis="\1"',
    r"^--axis$": "compare: axis",
}


class Comparison:
    """Comparison of recordings, simulations and CSV files with the first of them."""

    def __init__(self, found: Overlay) -> None:
        if not isinstance(found, Overlay):
            raise InputError(
                f"found {in_words(found)}; a comparison is made by compare(first, second)",
                "Comparison",
            )
        self._found = found

    @property
    def labels(self) -> list[str]:
        """Unique label of each recording."""
        return self._found.labels

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """One row per recording: label, ending, measures, and differences from the first.

        ``x_difference_nrmse`` is rms(x - x_first) / rms(x_first) of the displacement, over the
        samples of state RUNNING that all recordings have in common; ``x_difference_m`` is the
        largest absolute difference. ``f_difference_nrmse`` and ``f_difference_n`` are the same for
        the force. ``lag_s`` is the lag behind the first recording, found by maximum correlation, in
        s, and ``lag_samples`` the same in sampling periods of the lowest rate.
        Unknown values are None.
        """
        return self._found.rows

    @property
    def notes(self) -> list[str]:
        """What was adjusted for the comparison: rates, lengths, units, shifts."""
        return list(self._found.notes)

    def to_pandas(self) -> DataFrame:
        """Return the rows as a DataFrame, indexed by label.

        Raises:
            InputError: pandas is not installed.
        """
        table: DataFrame = extra("pandas", "to_pandas").DataFrame(self.rows).set_index("label")
        return table

    def plot(self) -> Plot:
        """Plot all displacements in one diagram, and below it their differences from the first.

        Raises:
            InputError: matplotlib is not installed.
        """
        from rthyb_rt.report.html import extra_needed

        with extra_needed("a figure"):
            from rthyb_rt.comparing.comparison_figures import displacement
        plate = displacement(self._found)
        return plot_of(plate)

    def report(self, path: Place) -> Path:
        """Write the table and all figures to one HTML file.

        Raises:
            InputError: the file name does not end in .html or .htm, or matplotlib or jinja2 is not
                installed.
            RthybError: the file cannot be written.
        """
        target = path_of(path, "report", "the page to write, comparison.html")
        comparison_page.write(self._found, target)
        return target

    def __repr__(self) -> str:
        return f"<Comparison of {len(self.labels)} recordings: {', '.join(self.labels)}>"

    def _repr_html_(self) -> str:
        from html import escape

        lines = [f"<p>{escape(note)}</p>" for note in self.notes]
        heads, rows = comparison_page.table(self._found)
        lines.append(html_table(rows, heads))
        try:
            lines.append(self.plot()._repr_html_())
        except InputError as error:
            lines.append(f"<p>{escape(str(error))}</p>")
        return "".join(lines)


def _given(one: Recording | Test | Sweep | Place) -> raw.RecordedTest | Setup | Path:
    """Return what is to be compared: a recording, a prepared test, or a path.

    Raises:
        InputError: it is none of these, or the test has errors.
    """
    if isinstance(one, Recording):
        return one.raw
    if isinstance(one, Test):
        return prepared(one, None)
    if isinstance(one, Sweep):
        return one.folder
    what = "the folder of a run, a sweep or a campaign, a test file, or a CSV file"
    return path_of(one, "compare", what, "a recording, a test, a sweep")


def compare(
    *recordings: Recording | Test | Sweep | Place,
    columns: Mapping[str, str] | Place | None = None,
    align: bool = False,
    axis: str | None = None,
) -> Comparison:
    """Compare recordings, simulations and CSV files with the first of them.

    Lengths and rates may differ: the part common to all is compared at the lowest rate, and
    `Comparison.notes` states this.

    Args:
        recordings: two to ten recordings, or one to be compared with its own reference simulation.
            Each is a recording; a test, which stands for its reference simulation; a sweep, which
            stands for its kept recordings; or the path of one of these, of a campaign, or of a CSV
            file from any source.
        columns: for CSV files: column by channel, ``{"x_meas": "LVDT 1 [mm]"}``, or a mapping file.
        axis: name of the axis to compare, for tests on several axes.
        align: shift each recording in time to best match the displacement of the first.

    Raises:
        InputError: there is nothing to compare, a file cannot be read, a unit is missing, or an
            axis is not named or does not exist.

    Examples:
        >>> short = Test("section5-T0.5", ground_motion={"duration_s": 2})
        >>> found = compare(run(short), run(short.with_({"controller.rfc.enabled": False})))
        >>> found.rows[0]["x_difference_nrmse"]
        0.0
    """
    for one in recordings:
        if isinstance(one, (list, tuple)):
            raise InputError(
                f"found {written(one)}; give each recording, or its path, by itself: "
                "compare(*recordings)",
                "compare",
            )
    require_flag(align, "compare: align")
    try:
        given = [_given(one) for one in recordings]
        found = courses.read(given, map_options(columns), axis)
        return Comparison(Overlay.of(found, align=align))
    except InputError as error:
        raise in_python(error, _WORDS) from None
