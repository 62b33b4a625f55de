"""Prescribed histories: `[history]` of the test file, instead of a ground motion and a structure.

`rthyb_rt.lab.histories` computes their displacements at every sample.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final, Literal

from pydantic import GetJsonSchemaHandler
from pydantic_core import CoreSchema, PydanticCustomError

from rthyb_rt import units
from rthyb_rt.config.fields import (
    SOME_TEXT,
    Alternatives,
    Condition,
    Count,
    Range,
    Reader,
    Table,
    explained,
    written,
)
from rthyb_rt.errors import InputError

MOST_STEPS: Final = 500
MOST_CYCLES: Final = 100_000

AISC_341: Final = (
    (0.00375, 6), (0.005, 6), (0.0075, 6), (0.01, 4), (0.015, 2), (0.02, 2), (0.03, 2), (0.04, 2),
)  # fmt: skip
"""Drift angles and cycles of the beam-to-column sequence, ANSI/AISC 341, section K2.4b; after
these, `AISC_341_MORE` per step."""
AISC_341_MORE: Final = (0.01, 2)
FEMA_461_RATIO: Final = 1.4
FEMA_461_CYCLES: Final = 2
FEMA_461_FURTHER: Final = 0.3
"""FEMA 461 (2007), section 2.9.1: ratio of each amplitude to the previous one, cycles at each, and
increment of a step beyond the target, relative to the target."""

_Amplitude = Annotated[float, Range("m", 1e-6, 10, "the amplitude")]
_Frequency = Annotated[float, Range("Hz", 1e-4, 500, "the frequency")]
_From = Annotated[float, Range("Hz", 1e-4, 500, "the frequency at the start")]
_To = Annotated[float, Range("Hz", 1e-4, 500, "the frequency at the end")]
_Low = Annotated[float, Range("Hz", 1e-4, 500, "the lower end of the frequency band")]
_High = Annotated[float, Range("Hz", 1e-4, 500, "the upper end of the frequency band")]
_Duration = Annotated[float, Range("s", 0.01, 36000, "the length including the tapers")]
_Taper = Annotated[float, Range("s", 0.01, 3600, "the length of each cosine taper")]


@dataclass(frozen=True)
class Step:
    """Cycles of one amplitude.

    Attributes:
        amplitude_m: the amplitude.
        cycles: number of whole cycles.
    """

    amplitude_m: float
    cycles: int


@dataclass(frozen=True)
class Amplitudes(Reader):
    """A list of amplitudes."""

    one: ClassVar[Range] = Range("m", 1e-6, 10, "the amplitudes in order")
    form: ClassVar[str] = "list, each 1e-6 to 10"
    what: str = "the amplitudes in order"

    def read(self, value: object) -> list[float]:
        """Return the amplitudes; raise an explained error if they are invalid."""
        if not isinstance(value, list) or not 1 <= len(value) <= MOST_STEPS:
            raise explained(
                f"found {written(value)}; must be a list of 1 to {MOST_STEPS} amplitudes"
            )
        return [_numbered(self.one, item, i) for i, item in enumerate(value)]

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the list."""
        item = self.one.__get_pydantic_json_schema__(schema, handler)
        return {"type": "array", "items": item, "minItems": 1, "maxItems": MOST_STEPS}


@dataclass(frozen=True)
class CycleCounts(Reader):
    """One number of cycles for all amplitudes, or a list with one for each."""

    one: ClassVar[Count] = Count(1, 10_000, "the number of cycles at an amplitude")
    form: ClassVar[str] = "whole, 1 to 10000, or a list"
    what: str = "cycles at each amplitude, one number for all or a list"

    def read(self, value: object) -> int | list[int]:
        """Return the number or the list; raise an explained error if it is invalid."""
        if not isinstance(value, list):
            return self.one.read(value)
        if not 1 <= len(value) <= MOST_STEPS:
            raise explained(f"found {written(value)}; must be a list of 1 to {MOST_STEPS} numbers")
        return [_numbered(self.one, item, i) for i, item in enumerate(value)]

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe both forms."""
        one = self.one.__get_pydantic_json_schema__(schema, handler)
        return {"anyOf": [one, {"type": "array", "items": one, "maxItems": MOST_STEPS}]}


def _numbered(one: Range | Count, item: object, i: int) -> Any:
    try:
        return one.read(item)
    except PydanticCustomError as error:
        text = str((error.context or {})["text"])
        raise explained(f"number {i + 1}: {text}") from None


class SineHistory(Table):
    """Cycles of one amplitude and frequency between two cosine tapers of whole cycles."""

    kind: Literal["sine"]
    amplitude_m: _Amplitude
    frequency_hz: _Frequency
    cycles: Annotated[int, Count(1, MOST_CYCLES, "the number of cycles between the tapers")]
    taper_cycles: Annotated[int, Count(1, 100, "the cycles of each cosine taper")] = 2

    @property
    def title(self) -> str:
        """Short description of the history."""
        return f"sine of {self.amplitude_m * 1e3:g} mm at {self.frequency_hz:g} Hz"


def _within(duration_s: float, taper_s: float) -> str | None:
    if 2.0 * taper_s <= duration_s:
        return None
    return (
        f"found {taper_s:g} s; both tapers must fit within duration_s = {duration_s:g} s: at most "
        f"{0.5 * duration_s:g} s"
    )


class SweepHistory(Table):
    """A sine sweep between two frequencies; its velocity may be limited."""

    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("taper_s", ("duration_s", "taper_s"), _within),
    )

    kind: Literal["sweep"]
    amplitude_m: _Amplitude
    from_hz: _From
    to_hz: _To
    duration_s: _Duration
    spacing: Literal["logarithmic", "linear"] = "logarithmic"
    velocity_m_per_s: Annotated[float, Range("m/s", 1e-6, 100, "the limit on velocity")] | None = (
        None
    )
    taper_s: _Taper = 1.0

    @property
    def title(self) -> str:
        """Short description of the history."""
        return f"sweep of {self.amplitude_m * 1e3:g} mm from {self.from_hz:g} to {self.to_hz:g} Hz"


def _rising(from_hz: float, to_hz: float) -> str | None:
    if to_hz > from_hz:
        return None
    return f"found {to_hz:g} Hz; must be above from_hz = {from_hz:g} Hz"


class RandomHistory(Table):
    """Noise with a flat spectrum between two frequencies, reproducible by its seed."""

    choices: ClassVar[tuple[Alternatives, ...]] = (
        Alternatives(("peak_m", "rms_m"), required=True),
    )
    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("taper_s", ("duration_s", "taper_s"), _within),
        Condition("to_hz", ("from_hz", "to_hz"), _rising),
    )

    kind: Literal["random"]
    from_hz: _Low
    to_hz: _High
    peak_m: _Amplitude | None = None
    rms_m: Annotated[float, Range("m", 1e-6, 10, "the root mean square instead")] | None = None
    duration_s: _Duration
    seed: Annotated[int, Count(0, 2**32 - 1, "the seed")] = 1
    taper_s: _Taper = 1.0

    @property
    def title(self) -> str:
        """Short description of the history."""
        return f"random motion from {self.from_hz:g} to {self.to_hz:g} Hz, seed {self.seed}"


class CyclicHistory(Table):
    """Cycles step by step, from turning point to turning point along half a cosine.

    With ``frequency_hz`` every stroke takes half a period. With ``velocity_m_per_s`` it takes as
    long as this velocity and ``acceleration_m_per_s2`` require; if the latter is missing, that of
    slow paths in the limits of test and rig is used.
    """

    choices: ClassVar[tuple[Alternatives, ...]] = (
        Alternatives(("frequency_hz", "velocity_m_per_s"), required=True),
    )

    kind: str
    frequency_hz: _Frequency | None = None
    velocity_m_per_s: (
        Annotated[float, Range("m/s", 1e-7, 100, "the peak velocity of every stroke")] | None
    ) = None
    acceleration_m_per_s2: (
        Annotated[float, Range("m/s^2", 1e-4, 1e4, "the largest acceleration of a stroke")] | None
    ) = None

    @property
    def steps(self) -> tuple[Step, ...]:
        """The amplitudes in their order, with the cycles of each."""
        raise NotImplementedError

    @property
    def title(self) -> str:
        """Short description of the history."""
        raise NotImplementedError

    def _span(self) -> str:
        found = [1e3 * step.amplitude_m for step in self.steps]
        return f"{len(found)} amplitudes from {min(found):.4g} to {max(found):.4g} mm"


def _as_many(amplitudes: list[float] | None, cycles: int | list[int]) -> str | None:
    if amplitudes is None or isinstance(cycles, int) or len(cycles) == len(amplitudes):
        return None
    return (
        f"found {len(cycles)} numbers; amplitudes_m has {len(amplitudes)}: give one number for "
        "all, or one for each"
    )


class CyclesHistory(CyclicHistory):
    """User-defined amplitudes and cycles, from the test file or a CSV file."""

    choices: ClassVar[tuple[Alternatives, ...]] = (
        *CyclicHistory.choices,
        Alternatives(("amplitudes_m", "file"), required=True),
    )
    checks: ClassVar[tuple[Condition, ...]] = (
        Condition("cycles", ("amplitudes_m", "cycles"), _as_many),
    )

    kind: Literal["cycles"]
    amplitudes_m: Annotated[list[float], Amplitudes()] | None = None
    cycles: Annotated[int | list[int], CycleCounts()] = 2
    file: Annotated[str, SOME_TEXT] | None = None

    @property
    def steps(self) -> tuple[Step, ...]:
        """The amplitudes in their order, with the cycles of each."""
        amplitudes = self.amplitudes_m or []
        each = [self.cycles] * len(amplitudes) if isinstance(self.cycles, int) else self.cycles
        return tuple(map(Step, amplitudes, each))

    @property
    def title(self) -> str:
        """Short description of the history."""
        return f"cycles, {self._span()}"


class Fema461History(CyclicHistory):
    """Quasi-static cycles of FEMA 461 (2007), section 2.9.1.

    Two cycles at each amplitude, which increases by a factor of 1.4 up to the target deformation;
    each further step adds 0.3 of the target.
    """

    kind: Literal["fema-461"]
    target_m: Annotated[float, Range("m", 1e-5, 10, "the target deformation")]
    steps_to_target: Annotated[int, Count(2, 40, "the number of amplitudes up to the target")] = 10
    further_steps: Annotated[int, Count(0, 40, "the number of amplitudes beyond it")] = 0

    @property
    def steps(self) -> tuple[Step, ...]:
        """The amplitudes in their order, with the cycles of each."""
        up = [FEMA_461_RATIO ** (i - self.steps_to_target + 1) for i in range(self.steps_to_target)]
        up += [1.0 + FEMA_461_FURTHER * (i + 1) for i in range(self.further_steps)]
        return tuple(Step(self.target_m * share, FEMA_461_CYCLES) for share in up)

    @property
    def title(self) -> str:
        """Short description of the history."""
        return f"FEMA 461, {self._span()}"


class Aisc341History(CyclicHistory):
    """Cycles of ANSI/AISC 341, section K2.4b, by the drift angle of a beam-to-column connection."""

    kind: Literal["aisc-341"]
    height_m: Annotated[
        float, Range("m", 0.01, 1000, "the height that converts drift to displacement")
    ]
    to_drift: Annotated[float, Range("", 0.00375, 0.2, "the drift of the last step")] = 0.04

    @property
    def steps(self) -> tuple[Step, ...]:
        """The amplitudes in their order, with the cycles of each."""
        drifts = list(AISC_341)
        while drifts[-1][0] + AISC_341_MORE[0] <= self.to_drift + 1e-9:
            drifts.append((drifts[-1][0] + AISC_341_MORE[0], AISC_341_MORE[1]))
        most = self.to_drift + 1e-9
        return tuple(Step(drift * self.height_m, n) for drift, n in drifts if drift <= most)

    @property
    def title(self) -> str:
        """Short description of the history."""
        return f"AISC 341, {self._span()}"


History = (
    SineHistory | SweepHistory | CyclesHistory | Fema461History | Aisc341History | RandomHistory
)


def with_file(given: CyclesHistory, folder: Path) -> CyclesHistory:
    """Return a history with the content of its CSV file, so that the file is no longer needed.

    The file has a line ``amplitude_m, cycles`` (or ``amplitude_mm``, any unit of length, and
    ``amplitude`` in m), then a line for each step. Without ``cycles``, the test file gives them.

    Args:
        given: history of the test file, with a ``file``.
        folder: folder to which its path is relative.

    Raises:
        InputError: the errors in the file, with their lines.
    """
    path = folder / str(given.file)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"cannot be read ({error}); a relative path is relative to the folder of the test file",
            str(path),
        ) from None
    lines = [(number, [cell.strip() for cell in row]) for number, row in enumerate(rows, 1)]
    lines = [(number, row) for number, row in lines if any(row) and not row[0].startswith("#")]
    if len(lines) < 2:
        raise InputError(
            'must have the header line "amplitude_m, cycles" and one line for each step', str(path)
        )
    at, unit, counted = _columns(lines[0], path)
    amplitudes, cycles = list[float](), list[int]()
    for number, row in lines[1 : MOST_STEPS + 2]:
        amplitudes.append(_amplitude(row, at, unit, f"{path}:{number}"))
        if counted is not None:
            cycles.append(_count(row, counted, f"{path}:{number}"))
    if len(amplitudes) > MOST_STEPS:
        raise InputError(f"has more than {MOST_STEPS} steps, the maximum", str(path))
    counts = cycles if counted is not None else given.cycles
    return given.model_copy(update={"amplitudes_m": amplitudes, "cycles": counts, "file": None})


def _columns(head: tuple[int, list[str]], path: Path) -> tuple[int, str, int | None]:
    """Return the column of the amplitudes, their unit, and the column of the cycles."""
    number, names = head
    found = [i for i, name in enumerate(names) if name.lower().split("_")[0] == "amplitude"]
    counted = [i for i, name in enumerate(names) if name.lower() == "cycles"]
    if len(found) != 1 or len(counted) > 1:
        raise InputError(
            f'found the columns {", ".join(names)}; one must be called "amplitude_m", '
            '"amplitude_mm" or another unit of length, and one may be called "cycles"',
            f"{path}:{number}",
        )
    unit = names[found[0]].partition("_")[2] or "m"
    try:
        units.convert(f"1 {unit}", "m")
    except units.UnitError as error:
        raise InputError(
            f"found the unit {written(unit)} ({error}); must be a length: m, mm, in",
            f"{path}:{number}",
        ) from None
    return found[0], unit, counted[0] if counted else None


def _amplitude(row: list[str], at: int, unit: str, where: str) -> float:
    text = row[at] if at < len(row) else ""
    try:
        value = float(text)
        if not math.isfinite(value):
            raise ValueError
        return Amplitudes.one.read(f"{value!r} {unit}")
    # The error of a wrong number is itself a ValueError.
    except PydanticCustomError as error:
        raise InputError(str((error.context or {})["text"]), where) from None
    except ValueError:
        raise InputError(f"found {written(text)}; the amplitude must be a number", where) from None


def _count(row: list[str], at: int, where: str) -> int:
    text = row[at] if at < len(row) else ""
    try:
        return CycleCounts.one.read(int(text))
    except PydanticCustomError as error:
        raise InputError(str((error.context or {})["text"]), where) from None
    except ValueError:
        raise InputError(f"found {written(text)}; cycles must be a whole number", where) from None
