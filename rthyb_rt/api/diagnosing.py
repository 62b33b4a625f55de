"""Diagnosis of a recording: which physical effects a model omits (`rthyb diagnose`)."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rthyb_rt import config
from rthyb_rt.api.files import Place, Rig, Test, path_of, toml_given
from rthyb_rt.api.messages import MAP_WORDS, in_python, map_options, require_flag, require_progress
from rthyb_rt.api.recordings import Recording
from rthyb_rt.config.fields import written
from rthyb_rt.errors import InputError, RthybError

if TYPE_CHECKING:
    from rthyb_rt.diagnose.axes import OfAxis
    from rthyb_rt.diagnose.effects import Effect
    from rthyb_rt.diagnose.outcome import Outcome
    from rthyb_rt.diagnose.result import DiagnosisResult

Progress = Callable[[str], None]
"""Called with the name of the part that begins."""
_WORDS = {
    "^--model$": "diagnose: model",
    **MAP_WORDS,
    r"^--map (\w+)": r"diagnose: columns: \1",
    "--map": "columns",
    # Objects are written to files for the time of a diagnosis.
    r"^\S*/rthyb-\w+/(recording|heldout)/\S*?(?=$|: )": r"diagnose: \1",
    r"^\S*/rthyb-\w+/([\w.-]+?)\.toml(:\d+)?": r'diagnose: model "\1"',
}
"""Options of the command line in messages, and their equivalents here."""


class Diagnosis:
    """Result of a diagnosis."""

    def __init__(
        self,
        found: DiagnosisResult,
        outcome: Outcome,
        checks: list[dict[str, Any]] | None,
        model: Path,
        own: Sequence[Effect] = (),
    ) -> None:
        self._found, self._outcome, self._checks, self._model = found, outcome, checks, model
        self._own = own

    @property
    def verdict(self) -> str:
        """``none`` (no effect is missing), ``explained``, ``ambiguous`` or ``unknown``."""
        return self._found.verdict

    @property
    def effects(self) -> list[str]:
        """Names of the missing effects, as in ``rthyb effects``; empty for ``unknown``."""
        return list(self._found.effects)

    @property
    def ambiguous_with(self) -> list[list[str]]:
        """Other sets of effects that explain the recording equally well."""
        return [list(names) for names in self._found.ambiguous_with]

    @property
    def text(self) -> str:
        """The answer as text."""
        from rthyb_rt.diagnose import effects, words

        with effects.beside(self._own):
            return words.sentence(self._found, self._outcome.answer)

    @property
    def answer(self) -> dict[str, Any]:
        """The complete answer, as printed by ``rthyb diagnose --json``."""
        extra = {} if self._checks is None else {"self_check": self._checks}
        return self._outcome.answer | extra

    @property
    def notes(self) -> list[str]:
        """Assumptions made where the recording lacks information, and other remarks."""
        return list(self._found.notes)

    def report(self, folder: Place) -> list[Path]:
        """Write ``report.html``, ``diagnosis.json`` and ``augmented.toml``; return their paths.

        Raises:
            InputError: matplotlib or jinja2 is not installed.
            RthybError: a file cannot be written.
        """
        from rthyb_rt.diagnose import effects
        from rthyb_rt.diagnose.page import write_report

        with effects.beside(self._own):
            target = path_of(folder, "report", "the folder to write to")
            return write_report(target, self._found, self._outcome, self._checks, self._model)

    def __repr__(self) -> str:
        named = f": {', '.join(self.effects)}" if self.effects else ""
        return f"<Diagnosis {self._found.case.name}: {self.verdict}{named}>"

    def _repr_html_(self) -> str:
        from html import escape

        notes = "".join(f"<p>Note: {escape(note)}</p>" for note in self.notes)
        return f"<p><b>{escape(self.verdict)}</b>: {escape(self.text)}</p>{notes}"


def diagnose(
    recording: Recording | Place,
    model: Rig | Test | Place,
    *,
    columns: Mapping[str, str] | Place | None = None,
    heldout: Recording | Place | None = None,
    effects: Place | Effect | Sequence[Place | Effect] = (),
    self_check: bool = False,
    axis: str | None = None,
    progress: Progress | None = None,
) -> Diagnosis:
    """Find the physical effects in a recording that a model omits.

    The diagnosis multiplies long, narrow matrices, which takes four times as long if the linear
    algebra library distributes it over several processors. ``OPENBLAS_NUM_THREADS=1`` in the
    environment prevents this; it is set automatically unless NumPy has already been loaded.

    Args:
        recording: a recording, or the path of one, or of a CSV file from any source.
        model: the model to be examined: a rig, or the path or name of one, a test (its rig, and
            its numerical part) or the path or name of one, or a baseline file
            (``rthyb-baseline/1``).
        columns: for a CSV file: column by channel, ``{"x_meas": "LVDT 1 [mm]"}``, or a mapping
            file.
        heldout: a second recording, used to validate the answer.
        effects: your own effects, as objects or as Python files that register them; a single one
            may be given by itself.
        self_check: add known effects to the recording and test whether they are found.
        axis: name of the axis to be examined, if the recording has several; the measured motion of
            the others is then known, and the model must be the rig file of all axes.
        progress: called with the name of each step.

    Raises:
        InputError: the files contain errors, an axis is not named or does not exist, or the data
            are insufficient for a reliable answer; the message explains why.
    """
    if "numpy" not in sys.modules:
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from rthyb_rt.diagnose import effects as register
    from rthyb_rt.diagnose import engine, mapping, reading
    from rthyb_rt.diagnose.outcome import finish
    from rthyb_rt.diagnose.power import self_check as checked

    require_progress(progress, "diagnose", "one text, the name of a step: progress=print", 1)
    require_flag(self_check, "diagnose: self_check")
    try:
        own = _own_effects(effects)
        tell = progress or (lambda part: None)
        with (
            register.beside(own),
            _as_files(recording, model, heldout) as (path, model_path, second_path),
        ):
            wishes = mapping.read_wishes(map_options(columns))
            of = _of_axis(path, model_path, axis)
            own_model = reading.read_model(model_path) if of is None else of.model
            case = reading.read_case(path, own_model, wishes=wishes, of=of)
            second = None
            if second_path is not None:
                second = reading.read_case(
                    second_path, case.model, judged=False, wishes=wishes, beside=case, of=of
                )
                if not second.channels.keys() & {"x_meas", "f_meas"}:
                    raise InputError(
                        "has no x_meas, fx_meas or fy_meas to compare with the model",
                        str(second_path),
                    )
            found = engine.diagnose(case, tell)
            outcome = finish(found, second, None)
            checks = checked(found, tell) if self_check else None
    except RthybError as error:
        raise in_python(error, _WORDS) from None
    return Diagnosis(found, outcome, checks, model_path, own)


def _of_axis(path: Path, model: Path, axis: str | None) -> OfAxis | None:
    """Return the axis to diagnose; None for a recording of one axis or of another program.

    Raises:
        InputError: it is not named, or does not exist.
    """
    from rthyb_rt.diagnose import axes, reading

    names = reading.axes_of(path)
    if names and axis is None:
        raise InputError(
            f'name one axis of the recording, axis="{names[0]}"; it has {", ".join(names)}',
            "diagnose: axis",
        )
    found = axes.chosen(path, names, model, axis, "diagnose: axis")
    return found[0] if found else None


def _own_effects(given: Any) -> list[Effect]:
    """Run the files among the arguments, and return the user-defined effects.

    Raises:
        InputError: a file registers no effect, or an argument is neither a file nor an effect.
    """
    from rthyb_rt.diagnose import effects as register

    found = []
    single = isinstance(given, (str, bytes, os.PathLike)) or not isinstance(given, Iterable)
    for one in [given] if single else given:
        if isinstance(one, register.Effect):
            found.append(one)
        elif isinstance(one, (str, os.PathLike)):
            register.load(Path(one))
        else:
            name = one.__name__ if isinstance(one, type) else "Gap"
            found_here = name if isinstance(one, type) else written(one)
            raise InputError(
                f"found {found_here}; an effect is an object of a class {name}(rthyb_rt.Effect), "
                f"such as {name}(), or the path of a Python file that registers one",
                "diagnose: effects",
            )
    return found


@contextmanager
def _as_files(
    recording: Recording | Place, model: Rig | Test | Place, second: Recording | Place | None
) -> Iterator[tuple[Path, Path, Path | None]]:
    """Yield the files of the arguments, some of which exist only during the block."""
    from rthyb_rt.diagnose.reading import find_model

    with tempfile.TemporaryDirectory(prefix="rthyb-") as folder:

        def recorded(given: Recording | Place, name: str) -> Path:
            if not isinstance(given, Recording):
                what = "the folder of a run, its recording.h5, or a CSV file"
                return path_of(given, f"diagnose: {name}", what, "a recording, such as run(test)")
            if given.path is not None and given.path.exists():
                return given.path
            return given.save(Path(folder) / name / (given.name or name) / "recording.h5")

        if isinstance(model, Rig):
            model_path = Path(folder) / f"{model.name}.toml"
            model_path.write_text(toml_given(model), encoding="utf-8")
        elif isinstance(model, Test):
            rig_path = Path(folder) / "rig.toml"
            rig_path.write_text(toml_given(model.rig), encoding="utf-8")
            model_path = Path(folder) / f"{model.name}.toml"
            model_path.write_text(
                Test.from_toml(model.to_toml(), rig_path).to_toml(), encoding="utf-8"
            )
        else:
            what = "a rig, test or baseline file, or the name of a shipped one"
            given = str(path_of(model, "diagnose: model", what, "a rig, a test"))
            model_path = find_model(config.test_as_model(given))
        yield (
            recorded(recording, "recording"),
            model_path,
            None if second is None else recorded(second, "heldout"),
        )
