"""Whether a degree of freedom of a structure from a file is a displacement or a rotation."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from rthyb_rt.config.matrixfile import MatrixData
from rthyb_rt.core.sparse import GROUND, Term

UNKNOWN: Final = "m or rad"
"""Unit of a degree of freedom that may be a displacement or a rotation."""
UNKNOWN_FORCE: Final = "N or N m"
"""Unit of what acts on such a degree of freedom."""
_FORCES: Final = {"m": "N", "rad": "N m", UNKNOWN: UNKNOWN_FORCE}
_TURNS: Final = re.compile(r"(^|\W)r[xyz]?$")
_MOVES: Final = re.compile(r"(^|\W)[xyz]$")


@dataclass(frozen=True, eq=False)
class DofUnits:
    """What labels, directions of the interface and influence vectors tell of degrees of freedom.

    Attributes:
        data: content of the file.
        interfaces: what the actuators move.
        turns: which of these directions are rotations; empty: none.
    """

    data: MatrixData
    interfaces: Sequence[Sequence[Term]]
    turns: Sequence[bool] = ()

    def of(self, ends: Sequence[int]) -> str:
        """Return the unit of a degree of freedom, or of the difference of two, which have one."""
        return next((unit for unit in map(self._one, ends) if unit != UNKNOWN), UNKNOWN)

    def of_force(self, ends: Sequence[int]) -> str:
        """Return the unit of what acts between two of them, or between one and the ground."""
        return _FORCES[self.of([at for at in ends if at != GROUND])]

    def _one(self, at: int) -> str:
        """Return m or rad, or both if it is not known.

        The end of a label, ``7.rz``, tells first. A direction that is the degree of freedom itself,
        whatever its sign, has the same unit. The ground does not turn: what it moves is moved.
        """
        label = self.data.labels[at]
        if _TURNS.search(label):
            return "rad"
        if _MOVES.search(label):
            return "m"
        angles = self.turns or (False,) * len(self.interfaces)
        for terms, turns in zip(self.interfaces, angles, strict=True):
            if len(terms) == 1 and terms[0][0] == at and abs(terms[0][1]) == 1.0:
                return "rad" if turns else "m"
        moved = not self.data.influence or any(by[at] for by in self.data.influence.values())
        return "m" if moved else UNKNOWN
