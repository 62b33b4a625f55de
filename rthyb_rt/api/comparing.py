"""Recordings beside one another: their measures, and how far their motions and forces differ."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.api.files import Place
from rthyb_rt.api.recordings import Plot, Recording, as_recording, extra
from rthyb_rt.api.tables import html_table
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from pandas import DataFrame

SIGNALS: Final = ("x_meas_m", "f_meas_n")
"""What is compared sample by sample."""
_MEASURES: Final = (
    "peak_command_m", "peak_measured_m", "peak_force_n", "tracking_nrmse",
    "response_nrmse", "energy_error_relative", "alpha_end",
)  # fmt: skip


class Comparison:
    """Recordings beside the first of them.

    Attributes:
        recordings: as they were given.
        labels: their names, each another one.
    """

    def __init__(self, recordings: Sequence[Recording]) -> None:
        self.recordings = tuple(recordings)
        self.labels = _labels([rec.name or "recording" for rec in recordings])

    @cached_property
    def rows(self) -> list[dict[str, Any]]:
        """A row for each recording: label, ending, measures, and how it differs from the first.

        ``x_difference_nrmse`` is rms(x - x_first) / rms(x_first) of the measured displacement over
        the samples of the test proper that both have, ``x_difference_m`` its largest magnitude;
        ``f_difference_nrmse`` and ``f_difference_n`` the same of the measured force.
        """
        first = self.recordings[0]
        rows = []
        for label, rec in zip(self.labels, self.recordings, strict=True):
            row: dict[str, Any] = {"label": label, "ending": rec.ending}
            row |= {name: rec.measures[name] for name in _MEASURES}
            for name in SIGNALS:
                nrmse, largest = _difference(_proper(first, name), _proper(rec, name))
                letter, unit = name[0], name.rsplit("_", 1)[1]
                row |= {f"{letter}_difference_nrmse": nrmse, f"{letter}_difference_{unit}": largest}
            rows.append(row)
        return rows

    def to_pandas(self) -> DataFrame:
        """Return the rows as a table by label.

        Raises:
            InputError: pandas is not installed.
        """
        table: DataFrame = extra("pandas", "to_pandas").DataFrame(self.rows).set_index("label")
        return table

    def plot(self) -> Plot:
        """Draw the measured displacements over one another, and below what differs from the first.

        Raises:
            InputError: matplotlib is not installed.
        """
        from rthyb_rt.report.html import extra_needed

        with extra_needed("a figure"):
            from rthyb_rt.report.comparison import draw_comparison
        motions = [1e3 * _proper(rec, "x_meas_m") for rec in self.recordings]
        plate = draw_comparison(self.labels, motions, self.recordings[0].fs_hz)
        return Plot(plate.key, plate.title, plate.note, plate.svg, plate.figure)

    def __repr__(self) -> str:
        return f"<Comparison of {len(self.labels)} recordings: {', '.join(self.labels)}>"

    def _repr_html_(self) -> str:
        from html import escape

        names = [name for name in self.rows[0] if name != "label"]
        rows = [[name, *(row[name] for row in self.rows)] for name in names]
        lines = [html_table(rows, ["", *self.labels])]
        try:
            lines.append(self.plot()._repr_html_())
        except InputError as error:
            lines.append(f"<p>{escape(str(error))}</p>")
        return "".join(lines)


def compare(*recordings: Recording | Place) -> Comparison:
    """Set recordings beside the first of them: two tests, or a test and its simulation.

    Args:
        recordings: two or more, or folders or files of them, of one rate; where one is longer, the
            samples that both have are compared.

    Raises:
        InputError: there are fewer than two, one cannot be read, or their rates differ.

    Examples:
        >>> short = Test("section5-T0.5", ground_motion={"duration_s": 2})
        >>> found = compare(run(short), run(short.with_({"controller.rfc.enabled": False})))
        >>> found.rows[0]["x_difference_nrmse"]
        0.0
    """
    if len(recordings) < 2:
        raise InputError(
            f"found {len(recordings)} recordings; give two or more, compare(first, second)",
            "compare",
        )
    found = [as_recording(one) for one in recordings]
    rates = [rec.fs_hz for rec in found]
    if len(set(rates)) > 1:
        told = ", ".join(f"{rate:g} Hz" for rate in rates)
        raise InputError(
            f"found recordings of {told}; samples are compared one by one, and need one rate: "
            "run both with the same test.sample_rate_hz",
            "compare",
        )
    return Comparison(found)


def _labels(names: list[str]) -> list[str]:
    """Return names of which none is there twice."""
    labels: list[str] = []
    for name in names:
        number, label = 2, name
        while label in labels:
            number, label = number + 1, f"{name} ({number})"
        labels.append(label)
    return labels


def _proper(rec: Recording, name: str) -> NDArray[np.float64]:
    """Return a signal of the test proper, (n,)."""
    return np.asarray(rec[name][rec.running], dtype=np.float64)


def _difference(
    first: NDArray[np.float64], other: NDArray[np.float64]
) -> tuple[float | None, float | None]:
    """Return rms of the difference over rms of the first, and the largest magnitude.

    None where there is nothing to compare; samples that are not finite are left out.
    """
    count = min(first.size, other.size)
    a, b = first[:count], other[:count]
    good = np.isfinite(a) & np.isfinite(b)
    a, b = a[good], b[good]
    if not a.size:
        return None, None
    scale = float(np.sqrt(np.mean(a**2)))
    gap = b - a
    nrmse = float(np.sqrt(np.mean(gap**2))) / scale if scale > 0.0 else None
    return nrmse, float(np.abs(gap).max())
