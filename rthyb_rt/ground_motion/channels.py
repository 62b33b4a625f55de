"""Selection of one channel from a file that contains several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from rthyb_rt.ground_motion.acceleration import FloatArray
from rthyb_rt.ground_motion.text import TextLines, clean


@dataclass(frozen=True)
class FileChannel:
    """Location of one channel of acceleration in its file.

    Attributes:
        number: the channel's number as given in the file, else its position, from 1.
        label: component in words (``90 Deg``, ``Up``), may be empty.
        index: index of the line that announces the data.
    """

    number: int
    label: str
    index: int

    def __str__(self) -> str:
        """Return number and component for display."""
        return f"{self.number} ({self.label})" if self.label else str(self.number)


@dataclass(frozen=True)
class Samples:
    """Result of a format's reader.

    Attributes:
        dt_s: sampling interval, s.
        values: samples in ``unit``, shape (n,).
        unit: canonical unit of the values.
        unit_from: where the unit was found, in words.
        details: provenance from the header.
    """

    dt_s: float
    values: FloatArray
    unit: str
    unit_from: str
    details: dict[str, str]


def choose_channel(
    text: TextLines, channels: Sequence[FileChannel], wanted: int | str | None
) -> FileChannel:
    """Return the channel requested by number or by part of its label.

    Raises:
        InputError: none is requested although there are several, or no channel, or more than one,
            matches.
    """
    listed = ", ".join(str(c) for c in channels[:20]) + (", ..." if len(channels) > 20 else "")
    if wanted is None:
        if len(channels) == 1:
            return channels[0]
        raise text.error(f"holds {len(channels)} channels: {listed}; choose one with `channel`")
    shown = clean(str(wanted), 40)
    if shown.isdecimal():
        fitting = [c for c in channels if c.number == int(shown)]
    else:
        fitting = [c for c in channels if shown and shown.lower() in c.label.lower()]
    if len(fitting) == 1:
        return fitting[0]
    found = "no channel" if not fitting else f"{len(fitting)} channels"
    raise text.error(f"{found} fit {shown!r}; the file holds {listed}")
