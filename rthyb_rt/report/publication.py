"""Files for publications: figures as SVG and PDF, the table as LaTeX and CSV."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from rthyb_rt.analysis import several_axes
from rthyb_rt.analysis import summary as of
from rthyb_rt.documents import flat
from rthyb_rt.record.recording import RecordedTest, replacing
from rthyb_rt.report.html import extra_needed

KINDS: Final = ("svg", "pdf")
_UNDATED: Final = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}
"""Without a date, files from the same recording are identical."""
_LATEX: Final = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_",
    "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "<": r"\textless{}", ">": r"\textgreater{}", "|": r"\textbar{}",
    "−": r"\ensuremath{-}", "·": r"\ensuremath{\cdot}", "∞": r"\ensuremath{\infty}",
    "√": r"\ensuremath{\surd}", "∫": r"\ensuremath{\int}", "Σ": r"\ensuremath{\Sigma}",
    "α": r"\ensuremath{\alpha}", "β": r"\ensuremath{\beta}", "γ": r"\ensuremath{\gamma}",
    "ζ": r"\ensuremath{\zeta}", "µ": r"\ensuremath{\mu}", "½": r"\ensuremath{\frac12}",
    "≤": r"\ensuremath{\le}", "≥": r"\ensuremath{\ge}", "–": "--", "\u00a0": "~",
}  # fmt: skip
_POWERS: Final = str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")
_RAISED: Final = re.compile("[⁻⁰¹²³⁴⁵⁶⁷⁸⁹]+")


def write_files(rec: RecordedTest, folder: Path) -> list[Path]:
    """Write every figure of the report as SVG and PDF, its table as LaTeX and CSV.

    Args:
        rec: the recording.
        folder: output folder; existing files of the same names are replaced.

    Returns:
        The files: ``displacement.svg``, ``displacement.pdf`` and so on by the figures' keys,
        ``table.tex``, ``table.csv``, and ``measures.csv``, the figures in SI units by name.

    Raises:
        InputError: matplotlib is not installed.
        RthybError: a file cannot be written.
    """
    with extra_needed("a figure"):
        from rthyb_rt.report import axes_report, figures
    paths, found = list[Path](), several_axes.summarize_any(rec)
    if isinstance(found, of.Summary):
        plates, table = figures.draw_all(rec, found), of.table(found)
    else:
        plates, table = axes_report.draw_all(rec, found), several_axes.table(found)
    for plate in plates:
        for kind in KINDS if plate.figure is not None else ():
            paths.append(folder / f"{plate.key}.{kind}")
            save(plate.figure, paths[-1], kind)
    rows = [(row.label, row.value, row.formula) for row in table]
    heads = ("what", "value", "definition")
    known = {k: v for k, v in found.as_json().items() if k not in ("live", "setup")}
    measures = [(name, v) for name, v in flat(known) if isinstance(v, (int, float))]
    written: tuple[tuple[str, Callable[[Path], object]], ...] = (
        ("table.tex", lambda path: path.write_text(latex(rows), encoding="utf-8")),
        ("table.csv", lambda path: _csv(path, heads, rows)),
        ("measures.csv", lambda path: _csv(path, ("name", "value"), measures)),
    )
    for name, write in written:
        paths.append(folder / name)
        with replacing(paths[-1]) as temporary:
            write(temporary)
    return paths


def save(figure: Any, path: Path, kind: str) -> None:
    """Write a figure as a standalone file.

    Raises:
        RthybError: the file cannot be written.
    """
    from matplotlib import rc_context

    from rthyb_rt.report.drawing import STYLE

    # Type 42: text in the PDF remains text, as publishers require.
    with replacing(path) as temporary, rc_context({**STYLE, "pdf.fonttype": 42}):
        figure.savefig(temporary, format=kind, metadata=_UNDATED.get(kind))


def latex(rows: Sequence[Sequence[str]]) -> str:
    """Return a table as a ``tabular`` for the package booktabs, without the definitions."""
    lines = [r"% \usepackage{booktabs}", r"\begin{tabular}{ll}", r"\toprule"]
    lines += [rf"{escaped(label)} & {escaped(value)} \\" for label, value, *_ in rows]
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def escaped(text: str) -> str:
    """Return a text with LaTeX's special characters escaped."""
    whole = "".join(_LATEX.get(letter, letter) for letter in text)
    return _RAISED.sub(lambda m: rf"\textsuperscript{{{m[0].translate(_POWERS)}}}", whole)


def _csv(path: Path, heads: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(heads)
        writer.writerows(rows)
