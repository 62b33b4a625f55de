"""The poles of a linear plant, s' = a s + b u: which of them grow, and which do not decay.

Integrators in series are one pole several times, with a single eigenvector. Rounding of the
numbers in a, by a share e, splits such a k-fold pole into k poles at a distance of the order of
e^(1/k), some of them to the right of the imaginary axis; how far depends on the states in which the
plant is written. So a pole only counts as growing if no change of a by rounding explains it (Golub
& Van Loan, Matrix Computations, 4th ed., 7.2): with P the projector onto the invariant subspace of
k poles near a point c of the imaginary axis, and N the norm of a - c within this subspace, a change
E of a moves their mean by at most |P| |E|, and each of them by r with r^k <= |P| |E| N^(k-1), to
leading order.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Matrix = npt.NDArray[np.float64]
    Poles = npt.NDArray[np.complex128]

Rows = Sequence[Sequence[float]]

_ROUNDING: Final = 1e-8
"""Share of the fastest pole below which a real part is that of an integrator or of an undamped
motion: rounding of the eigenvalues, and of numbers that a file gives to eight digits."""

_DOUBLE: Final = 2.0 * 2.0**-52
"""Change of a, in shares of its norm, when its states are transformed in double precision.

In tests with transformations of conditions up to 1e4, integrators needed at most 0.6 of it. Poles
that grow by a factor of e in 100 s, real or vibrating, alone or beside up to two integrators,
needed at least 5 times as much. Those that take 1000 s needed at least 3000 times as much with
conditions up to 100. With 1e4 the least was 5 times for a real pole, about once for a vibrating
one, and less than a fifth of it beside two integrators in series: there, in one state vector of a
hundred, such a pole passes for an integrator."""

_FEW_DIGITS: Final = 1e-4
"""The same for numbers with four digits."""

_SLOW: Final = 1e-2
"""Share of the fastest pole above which a pole is not that of an integrator."""

_ON_CIRCLE: Final = 32
"""Points of a contour integral. No pole is within a factor of the square root of 2 of the circle,
so that this many give a projector to 2^-16."""


def in_words(pole: complex) -> str:
    """Return a pole as frequency and damping ratio, or, if it is real, as its rate."""
    if pole.imag == 0.0:
        return f"{pole.real:.3g} per second" if pole.real else "0 Hz"
    size = abs(pole)
    return f"{size / (2.0 * math.pi):.4g} Hz with a damping ratio of {-pole.real / size:.2g}"


def growing(a: Rows, change: float = _DOUBLE) -> list[complex]:
    """Return the poles whose motion grows, the fastest first; one of each conjugate pair.

    Args:
        a: the matrix, (n, n), 1/s where all states have the same unit.
        change: change of a, in shares of its norm, that may explain a growth.
    """
    plant = _Plant.of(a)
    found = (p for p in plant.upper() if p.real > plant.rounding and plant.place(p, change) is None)
    return sorted(found, key=lambda pole: -pole.real)


def staying(a: Rows) -> list[complex]:
    """Return the poles whose motion neither grows nor decays, apart from rounding; a as above."""
    plant = _Plant.of(a)
    places = (plant.place(p, _DOUBLE) for p in plant.upper())
    return [place for place in places if place is not None]


@dataclass(frozen=True)
class _Plant:
    """A matrix of a plant.

    Attributes:
        a: the matrix in balanced states, (n, n).
        poles: its eigenvalues, (n,), 1/s.
        rounding: what counts as zero, 1/s.
    """

    a: Matrix
    poles: Poles
    rounding: float

    @classmethod
    def of(cls, rows: Rows) -> _Plant:
        import numpy as np

        a = _balanced(np.array(rows, dtype=np.float64))
        poles = np.linalg.eigvals(a).astype(np.complex128)
        return cls(a, poles, _ROUNDING * float(np.abs(poles).max()))

    def upper(self) -> list[complex]:
        """Return the poles, one of each conjugate pair."""
        found = [complex(pole) for pole in self.poles]
        # Next to nothing beside the fastest pole, an imaginary part is rounding as well.
        real = [complex(p.real, 0.0) if abs(p.imag) <= self.rounding else p for p in found]
        return [pole for pole in real if pole.imag >= 0.0]

    def place(self, pole: complex, change: float) -> complex | None:
        """Return where on the imaginary axis a pole is apart from rounding; None if it is not."""
        if abs(pole) <= self.rounding:
            return 0j
        slow = abs(pole) <= _SLOW / _ROUNDING * self.rounding
        if slow and self._explained(pole, 0j, change):
            return 0j
        if abs(pole.real) <= self.rounding:
            return complex(0.0, pole.imag)
        if pole.real > -_SLOW * _SLOW / _ROUNDING * self.rounding:
            return next((c for c in self._near(pole) if self._explained(pole, c, change)), None)
        return None

    def _near(self, pole: complex) -> Iterator[complex]:
        """Yield points of the axis that a pole may be split from: its own, and one shared."""
        yield complex(0.0, pole.imag)
        others = sorted((complex(p) for p in self.poles), key=lambda p: abs(p - pole))
        if len(others) > 1:
            yield complex(0.0, 0.5 * (pole.imag + others[1].imag))

    def _explained(self, pole: complex, c: complex, change: float) -> bool:
        """Return whether a change of a by rounding explains that a pole is not at c."""
        import numpy as np

        apart = np.abs(self.poles - c)
        far = np.sort(apart)
        # All poles that are not clearly farther away belong together.
        k = int(np.count_nonzero(far <= (1.0 + 1e-9) * abs(pole - c)))
        while k < far.size and far[k] <= 2.0 * far[k - 1]:
            k += 1
        r = float(far[k - 1])
        radius = math.sqrt(r * far[k]) if k < far.size else 2.0 * r
        shifted = self.a - c * np.eye(far.size)
        p = _projector(shifted, radius)
        moved = change * float(np.linalg.norm(self.a, 2)) * float(np.linalg.norm(p, 2))
        within = np.linalg.svd(p)[0][:, :k]
        n = max(float(np.linalg.norm(within.conj().T @ shifted @ within, 2)), r)
        mean = float(self.poles[apart <= r].mean().real)
        return abs(mean) <= moved and (r / n) ** k <= moved / n


def _projector(shifted: Any, radius: float) -> Any:
    """Return the projector onto the invariant subspace of the eigenvalues within a circle, (n, n).

    By the trapezoidal rule for the integral of (z - a)^-1 dz / (2 pi i) along the circle.
    """
    import numpy as np

    z = radius * np.exp(2j * np.pi * (np.arange(_ON_CIRCLE) + 0.5) / _ON_CIRCLE)
    resolvents = np.linalg.inv(z[:, None, None] * np.eye(len(shifted)) - shifted)
    return np.mean(z[:, None, None] * resolvents, axis=0)


def _balanced(a: Matrix) -> Matrix:
    """Return a in units of its states, powers of 2, for which rows and columns are alike (Osborne).

    Units of very different sizes would otherwise pass for an ill-conditioned plant.
    """
    import numpy as np

    a = a.copy()
    for _ in range(20):
        before = a.copy()
        for i in range(len(a)):
            across = np.delete(np.abs(a[i]), i).sum()
            down = np.delete(np.abs(a[:, i]), i).sum()
            if across > 0.0 and down > 0.0:
                unit = 2.0 ** round(0.5 * math.log2(across / down))
                a[i] /= unit
                a[:, i] *= unit
        if np.array_equal(a, before):
            break
    return a


def fault(a: Rows) -> str | None:
    """Return what is wrong with the poles of a plant, and what can be done; None if nothing is."""
    found = growing(a)
    if not found:
        return None
    first = found[0]
    others = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    digits = (
        "; if these are integrators, write the numbers of a with all their digits"
        if not growing(a, _FEW_DIGITS)
        else ""
    )
    return (
        f"found a pole at {in_words(first)}{others}, whose motion grows by a factor of e every "
        f"{1.0 / first.real:.3g} s, whatever the command; the motion of every pole must decay. "
        "a is in continuous time, s' = a s + b u with time in s: convert the matrices of a model "
        "in discrete time. If a was identified, fit it with stable poles or with fewer states"
        f"{digits}"
    )


def note(a: Rows) -> str | None:
    """Return the note on poles that neither grow nor decay; None if there are none."""
    found = staying(a)
    if not found:
        return None
    places = ", ".join(dict.fromkeys(in_words(pole) for pole in found))
    what = (
        "a constant command can move an axis without end"
        if any(pole.imag == 0.0 for pole in found)
        else "motions at this frequency do not die out"
    )
    return f"[plant] has poles that neither decay nor grow ({places}): {what}"
