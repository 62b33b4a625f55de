"""What a study gives back: rows with accepted bands, and panels of curves to draw."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Colour = Literal["black", "orange", "green", "blue", "red", "purple", "grey"]


@dataclass(frozen=True)
class Row:
    """One figure of a study.

    Attributes:
        quantity: what it is, in words.
        value: as computed here.
        unit: of value and band; "" for a plain number.
        low, high: accepted band, both None where none is stated.
        paper: what Chen & Tsai (2012) say about it; "" where they are silent.
    """

    quantity: str
    value: float
    unit: str = ""
    low: float | None = None
    high: float | None = None
    paper: str = ""

    @property
    def inside(self) -> bool | None:
        """Whether the value lies in its band; None without a band. NaN never does."""
        if self.low is None and self.high is None:
            return None
        low = -np.inf if self.low is None else self.low
        high = np.inf if self.high is None else self.high
        return bool(low <= self.value <= high)


@dataclass(frozen=True)
class Curve:
    """A line of a panel; ``filled`` shades the points instead of joining them."""

    label: str
    x: Floats
    y: Floats
    colour: Colour = "blue"
    dashed: bool = False
    width: float = 0.9


@dataclass(frozen=True)
class Panel:
    """One picture: curves over a common abscissa, one figure of the paper or a part of it."""

    key: str
    title: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]
    note: str = ""
    half: bool = False
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    levels: tuple[tuple[float, str], ...] = ()


@dataclass(frozen=True)
class Study:
    """A section of the paper, reproduced.

    Attributes:
        key: as on the command line ("4.1").
        title, text: what is studied and how.
        rows: figures with their bands.
        panels: pictures.
        ambiguities: what the paper leaves open, and what was assumed.
    """

    key: str
    title: str
    text: str
    rows: tuple[Row, ...]
    panels: tuple[Panel, ...]
    ambiguities: tuple[str, ...] = field(default=())

    @property
    def missed(self) -> list[Row]:
        """Rows whose value lies outside its band."""
        return [row for row in self.rows if row.inside is False]


def rms(x: Floats) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))
