"""Check a test without running it: errors, stability margins, expected tracking (`rthyb check`)."""

from __future__ import annotations

from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar, cast, overload

from rthyb_rt.api import files
from rthyb_rt.api.files import Place, Rig, Test, path_of
from rthyb_rt.api.recordings import Named, Plot, plot_of
from rthyb_rt.api.tables import html_table
from rthyb_rt.config import AxesRig
from rthyb_rt.documents import finite
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt.checking.checked_axes import ExaminedAxes
    from rthyb_rt.checking.examined import Examined
    from rthyb_rt.checking.examined_rig import ExaminedRig


_Found = TypeVar("_Found", bound="Examined | ExaminedAxes | ExaminedRig")


class _Result(Generic[_Found]):
    """What the check of a test and that of a rig have in common."""

    def __init__(self, found: _Found) -> None:
        self._found = found

    @property
    def warnings(self) -> list[str]:
        """Problems that should be corrected first; for a rig, what real time is refused for."""
        return list(self._found.warnings)

    @property
    def notes(self) -> list[str]:
        """Information; for a rig, what a test must provide or what is still to be identified."""
        return list(self._found.notes)

    @cached_property
    def document(self) -> dict[str, Any]:
        """The complete result, as in ``rthyb check --json``, with ``--rig`` for a rig alone.

        None stands for a number that JSON does not have: a delay margin without limit.
        """
        document: dict[str, Any] = finite(self._found.document())
        return document

    @property
    def table(self) -> list[tuple[str, str, str]]:
        """All tables of the command line in one: quantity, value, meaning."""
        return [row for rows in self._found.tables() for row in rows]

    def _repr_html_(self) -> str:
        lines = [f"<p>{escape(repr(self)[1:-1])}</p>"]
        lines += [f"<p><b>Warning:</b> {escape(text)}</p>" for text in self.warnings]
        lines += [f"<p>Note: {escape(text)}</p>" for text in self.notes]
        return "".join([*lines, html_table(self.table)])


class Check(_Result["Examined | ExaminedAxes"]):
    """Result of the check of a test that has no errors."""

    def __init__(self, found: Examined | ExaminedAxes) -> None:
        if isinstance(found, (Test, Rig, str)):
            raise InputError(f"found {files.in_words(found)}; give it to check(test)", "Check")
        super().__init__(found)

    @cached_property
    def figures(self) -> dict[str, Any]:
        """Computed figures by name, which includes the unit; None where a figure does not apply.

        For several axes: ``modes_hz``, ``modes``, and by name ``axes`` and ``directions``. A name
        that is not there raises `InputError`, with those that are.
        """
        document = self._found.document()
        figures: dict[str, Any] = document.get("figures") or {
            name: document[name] for name in ("modes_hz", "modes", "axes", "directions")
        }
        return Named(figures, "figure", where="check")

    def plots(self) -> dict[str, Plot]:
        """Plot ``stability`` (delays), ``nyquist`` (loop) and ``tracking`` (expected tracking).

        On a rig with several axes, ``tracking-0``, ``tracking-1`` and so on are those of each
        direction. With a structure given by storeys or matrices, ``modes`` are its mode shapes.

        Raises:
            InputError: matplotlib is not installed.
        """
        from rthyb_rt.report.html import extra_needed

        with extra_needed("a figure"):
            from rthyb_rt.checking.plates import plates
        drawn = {one.key: plot_of(one) for one in plates(self._found.setup)}
        return Named(drawn, "plot", where="check")

    def report(self, path: Place) -> Path:
        """Write tables, warnings, notes and figures to one HTML file.

        Raises:
            InputError: the file name does not end in .html or .htm, or matplotlib or jinja2 is not
                installed.
            RthybError: the file cannot be written.
        """
        from rthyb_rt.checking import check_page

        target = path_of(path, "report", "the page to write, check.html")
        check_page.write(self._found, target)
        return target

    def __repr__(self) -> str:
        setup = self._found.setup
        return (
            f"<Check {setup.test.test.name} on {setup.rig_file.rig.name}: no errors, "
            f"{len(self.warnings)} warnings, {len(self.notes)} notes>"
        )


class RigCheck(_Result["ExaminedRig"]):
    """Result of the check of a rig without a test, whose file has no errors."""

    def __repr__(self) -> str:
        return (
            f"<RigCheck {self._found.name}: no errors, {len(self.warnings)} warnings, "
            f"{len(self.notes)} notes>"
        )


def _check_rig(rig: Rig | Place) -> RigCheck:
    """Check a rig without a test; as on the command line, its file may lack the stiffness."""
    from rthyb_rt import config
    from rthyb_rt.checking.examined_rig import examine_rig

    on, stated = files.rig_to_identify(rig), True
    origin = files.origin_of(on)
    path = None if origin is None else Path(origin)
    if path is not None and not isinstance(rig, Rig) and not config.has_axes(path):
        stated = config.with_some_stiffness(path, {}) == {}
    return RigCheck(examine_rig(files.file_of_rig(on), path, stiffness_stated=stated))


@overload
def check(test: Rig, rig: None = None) -> RigCheck: ...
@overload
def check(test: None = None, *, rig: Rig | Place) -> RigCheck: ...
@overload
def check(test: Test | Place, rig: Rig | Place | None = None) -> Check: ...
def check(
    test: Test | Rig | Place | None = None, rig: Rig | Place | None = None
) -> Check | RigCheck:
    """Check a test without running it, or a rig without a test.

    Args:
        test: a test, or the path or name of one. Without it, or with a rig in its place, the rig is
            checked alone.
        rig: a rig, or the path or name of one; None: the rig of the test.

    Returns:
        The result; for a rig alone, a `RigCheck`: what was identified, link, commissioning,
        calibration and limits.

    Raises:
        InputError: test, rig or ground motion are invalid; the message lists all errors. Or your
            own numerical part, control law or element raised an exception, which is then the
            cause of this one; the message names its file and line.

    Examples:
        >>> round(check("section5-T0.5").figures["period_s"], 3)
        0.5
        >>> check(rig="delay-10-elastic").document["actuator"]
        'pure-delay'
    """
    from rthyb_rt.checking.checked_axes import examine_axes
    from rthyb_rt.checking.examined import examine

    if isinstance(test, Rig) and rig is None:
        return _check_rig(test)
    if test is None and rig is not None:
        return _check_rig(rig)
    if test is None:
        raise InputError(
            "found nothing (None); give a test, or the path of a test file or the name of one "
            f"that comes with the program: {', '.join(Test.names())}; or only a rig, "
            'check(rig="NAME")',
            "check: test",
        )
    # A rig in its place, with another rig beside it, is refused there.
    found = files.as_test(cast("Test | Place", test))
    on = found.rig if rig is None else files.as_rig(rig)
    file = files.file_of_rig(on)
    if isinstance(file, AxesRig):
        return Check(examine_axes(files.file_of_test(found), file))
    return Check(examine(files.file_of_test(found), file, files.origin_of(on)))
