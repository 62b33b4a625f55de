"""Signs that a test should not be relied on although it was completed, in figures.

Everything is judged over windows of 2 s: long enough for the periods of structures, and short
enough that a quiet end does not dilute a strong beginning. Rows are summed up in eighths of a
second as they arrive, so that a running test is judged exactly as a past one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rthyb_rt.analysis import measures

Floats = NDArray[np.float64]
Kind = Literal["response", "delay", "damping", "stiffness"]

WINDOW_S: Final = 2.0
BLOCKS_PER_S: Final = 8
MOVES: Final = 0.02
"""Share of the peak: an rms above it is motion, below it is the quiet end of a test."""
RESPONSE_OFF: Final = 0.2
"""Difference from the reference over the reference, both as rms of 2 s."""
WITHOUT_STIFFNESS: Final = 0.25
"""Share of the motion with a tangent stiffness of zero, hence without force compensation."""
FED: Final = 1.0
"""Energy fed by the tracking error over that removed by the numerical damping: 1 cancels it."""

SIGNALS: Final = ("x_num_m", "x_meas_m", "f_meas_n", "k_t_n_per_m", "alpha")
_WINDOW: Final = round(WINDOW_S * BLOCKS_PER_S)
_SENSELESS: Final = 1e100


@dataclass(frozen=True)
class Subject:
    """What must be known about a test to judge it; None disables the checks that need it.

    Attributes:
        fs_hz: rows per second.
        peak_m: of the reference simulation; None: that of the command so far.
        damping_n_s_per_m: of the numerical part.
        k_e_n_per_m: elastic stiffness of the specimen.
        rfc_enabled: whether force compensation is on.
        delay_samples: identified delay of the rig; None also if nothing compensates it.
        margin_samples: error of alpha at which the structure is still stable
            (`margins.delay_margin`).
    """

    fs_hz: float
    peak_m: float | None = None
    damping_n_s_per_m: float | None = None
    k_e_n_per_m: float | None = None
    rfc_enabled: bool = False
    delay_samples: float | None = None
    margin_samples: float | None = None


@dataclass(frozen=True)
class Finding:
    """Something that went wrong.

    Attributes:
        kind: "response": rms difference from the reference over its rms; "delay": alpha where its
            error is greatest; "damping": energy fed by the tracking error over that removed by the
            numerical damping; "stiffness": share of the motion with a tangent stiffness of zero.
        value: the worst value, a fraction; for "delay" in samples.
        allowed: greatest allowed value; for "delay" the allowed error, in samples.
        from_s, to_s: when it occurred, from the first sample of the test proper.
    """

    kind: Kind
    value: float
    allowed: float
    from_s: float
    to_s: float

    def meets(self, other: Finding) -> bool:
        """Return whether both occurred at the same time."""
        return self.from_s < other.to_s and other.from_s < self.to_s


class Judge:
    """Sums up the rows of the test proper as they arrive, and reports what is wrong so far.

    Args:
        subject: what is known of the test.
    """

    def __init__(self, subject: Subject) -> None:
        self._subject = subject
        self._rows = max(1, round(subject.fs_hz / BLOCKS_PER_S))
        self._rest = np.zeros((len(SIGNALS) + 1, 0))
        self._sums: list[Floats] = []
        self._peak_m = 0.0

    def add(
        self, rows: NDArray[np.void] | Mapping[str, Floats], x_ref_m: ArrayLike | None = None
    ) -> None:
        """Add rows of the test proper, in order.

        Args:
            rows: fields as in `recording.UNITS`, shape (n,) each.
            x_ref_m: reference displacement at these rows, (m,) with m <= n; the others have none.
        """
        size = rows["x_meas_m"].size
        if not size:
            return
        # Each block begins with the previous row, for differences between two rows.
        before = self._rest.shape[1] or 1
        joined = np.empty((len(SIGNALS) + 1, before + size))
        for signal, name in zip(joined, SIGNALS, strict=False):
            signal[before:] = rows[name]
        joined[-1, before:] = np.nan
        if x_ref_m is not None:
            reference = np.asarray(x_ref_m, dtype=np.float64)
            joined[-1, before : before + reference.size] = reference
        joined[:, :before] = self._rest if self._rest.shape[1] else joined[:, 1:2]
        blocks = (joined.shape[1] - 1) // self._rows
        if blocks:
            self._sums.append(self._sum_up(joined[:, : blocks * self._rows + 1], blocks))
        self._rest = joined[:, blocks * self._rows :].copy()

    def _sum_up(self, signals: Floats, blocks: int) -> Floats:
        """Return the quantities that are judged, one column per block."""
        s = self._subject
        with np.errstate(invalid="ignore"):
            signals = np.where(np.abs(signals) < _SENSELESS, signals, np.nan)
        x_num, x_meas, f, k_t, alpha, x_ref = signals
        self._peak_m = max(self._peak_m, float(np.nanmax(np.abs(x_num), initial=0.0)))
        edges = np.arange(0, blocks * self._rows + 1, self._rows)
        used_k_t = k_t if s.rfc_enabled else np.zeros_like(k_t)
        fed = measures.fed_energy(f, x_num, x_meas, used_k_t, s.k_e_n_per_m or 0.0)
        damped = measures.damping_energy(x_num, s.damping_n_s_per_m or 0.0, s.fs_hz)

        def summed(values: Floats) -> Floats:
            total: Floats = np.nansum(values[1:].reshape(blocks, self._rows), axis=1)
            return total

        return np.stack(
            [
                summed(np.square(x_meas - x_ref)),
                summed(np.square(x_ref)),
                summed(np.square(x_num)),
                np.diff(fed[edges]),
                np.diff(damped[edges]),
                summed((k_t <= 0.0).astype(np.float64)),
                summed(alpha),
            ]
        )

    def findings(self, *, over: bool = True) -> list[Finding]:
        """Return what is wrong, the most serious first; nothing in the first eighth of a second.

        Args:
            over: whether the test is over. Otherwise at least 2 s must have passed, and a delay
                estimate that is still converging to the rig's delay is not judged yet.
        """
        if not self._sums:
            return []
        sums = np.concatenate(self._sums, axis=1)
        count = sums.shape[1]
        if not over and count < _WINDOW:
            return []
        error, reference, command, fed, damped, without, alpha = sums
        size = min(_WINDOW, count)
        found = [
            self._response(error, reference, size),
            self._delay(alpha, size, over),
            self._damping(fed, damped, command, size),
            self._stiffness(without, command),
        ]
        return [finding for finding in found if finding is not None]

    @property
    def _moves2(self) -> float:
        """Sum of squares of a block above which there is motion."""
        peak_m = self._subject.peak_m or self._peak_m
        return (MOVES * peak_m) ** 2 * self._rows

    def _moving(self, squares: Floats, size: int) -> NDArray[np.bool_]:
        """Return which windows contain motion in both halves, so that no quiet half is judged."""
        half = max(1, size // 2)
        moves = _windows(squares, half) > half * self._moves2
        both: NDArray[np.bool_] = moves[: squares.size - size + 1] & moves[size - half :]
        return both

    def _at(self, kind: Kind, value: float, allowed: float, first: int, blocks: int) -> Finding:
        length_s = self._rows / self._subject.fs_hz
        return Finding(kind, value, allowed, first * length_s, (first + blocks) * length_s)

    def _response(self, error: Floats, reference: Floats, size: int) -> Finding | None:
        ratio = _ratio(_windows(error, size), _windows(reference, size))
        ratio = np.sqrt(np.where(self._moving(reference, size), ratio, 0.0))
        worst = int(np.argmax(ratio))
        if not ratio[worst] > RESPONSE_OFF:
            return None
        return self._at("response", float(ratio[worst]), RESPONSE_OFF, worst, size)

    def _delay(self, alpha: Floats, size: int, over: bool) -> Finding | None:
        delay, margin = self._subject.delay_samples, self._subject.margin_samples
        if delay is None or margin is None:
            return None
        away = np.abs(_windows(alpha, size) / (size * self._rows) - delay)
        near = np.flatnonzero(away <= margin)
        if not near.size and not over:
            return None
        # An estimate that starts elsewhere is given time to converge.
        begun = int(near[0]) if near.size else 0
        off = begun + np.flatnonzero(away[begun:] > margin)
        if not off.size:
            return None
        first, last = int(off[0]), int(off[-1]) + size
        there = alpha[first:last] / self._rows
        worst = float(there[np.argmax(np.abs(there - delay))])
        return self._at("delay", worst, margin, first, last - first)

    def _damping(self, fed: Floats, damped: Floats, command: Floats, size: int) -> Finding | None:
        if not self._subject.damping_n_s_per_m or not self._subject.k_e_n_per_m:
            return None
        whole = _ratio(np.array([fed.sum()]), np.array([damped.sum()]))
        if whole[0] > FED:
            return self._at("damping", float(whole[0]), FED, 0, fed.size)
        ratio = _ratio(_windows(fed, size), _windows(damped, size))
        ratio = np.where(self._moving(command, size), ratio, 0.0)
        worst = int(np.argmax(ratio))
        if not ratio[worst] > FED:
            return None
        return self._at("damping", float(ratio[worst]), FED, worst, size)

    def _stiffness(self, without: Floats, command: Floats) -> Finding | None:
        moves = command > self._moves2
        if not self._subject.rfc_enabled or np.count_nonzero(moves) < min(_WINDOW, moves.size):
            return None
        share = float(without[moves].sum() / (np.count_nonzero(moves) * self._rows))
        if not share > WITHOUT_STIFFNESS:
            return None
        at = np.flatnonzero(moves)
        return self._at(
            "stiffness", share, WITHOUT_STIFFNESS, int(at[0]), int(at[-1]) + 1 - int(at[0])
        )


class AxesJudge:
    """The same for several axes: whether each follows the reference simulation.

    Args:
        names: of the axes.
        fs_hz: rows per second.
        peak_m: of the reference simulation, over all axes: an axis that moves by less than
            ``MOVES`` times this is at rest, and its noise is not judged.
    """

    def __init__(self, names: Sequence[str], fs_hz: float, peak_m: float) -> None:
        self._judges = {name: Judge(Subject(fs_hz, peak_m=peak_m)) for name in names}

    def add(self, rows: NDArray[np.void], axis_m: Floats | None = None) -> None:
        """Add rows of the test proper, in order.

        Args:
            rows: of the recording, shape (n,).
            axis_m: reference displacements of the axes at these rows, (m, axes) with m <= n.
        """
        if axis_m is None:
            return
        rest = dict.fromkeys(SIGNALS, np.zeros(rows.size))
        for i, judge in enumerate(self._judges.values()):
            measured = rows[f"x_meas_m.{i}" if i else "x_meas_m"]
            judge.add(rest | {"x_meas_m": measured}, axis_m[:, i])

    def findings(self, *, over: bool = True) -> list[tuple[str, Finding]]:
        """Return name and finding of each axis that does not follow, see `Judge.findings`."""
        return [
            (name, found)
            for name, judge in self._judges.items()
            for found in judge.findings(over=over)
        ]


def _windows(values: Floats, size: int) -> Floats:
    """Return the sums of ``size`` neighbouring values, shape (n - size + 1,)."""
    # Not by differences of running sums, in which one huge block would swamp the others.
    return np.asarray(np.lib.stride_tricks.sliding_window_view(values, size).sum(axis=1))


def _ratio(part: Floats, whole: Floats) -> Floats:
    """Return part / whole, or 0 where whole is 0."""
    return np.divide(part, whole, out=np.zeros_like(part), where=whole > 0.0)
