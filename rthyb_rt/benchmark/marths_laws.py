"""Entrants of the multi-axial benchmark: compensations of its two actuators."""

from __future__ import annotations

import functools
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.benchmark import marths_frame as frame
from rthyb_rt.config import matrix_response
from rthyb_rt.config.matrix_response import MatrixFit, MatrixResponse
from rthyb_rt.core.coupled_plant import CoupledPlant
from rthyb_rt.core.matrix_lead import MatrixInverse, MatrixLead, MatrixLeadConfig
from rthyb_rt.errors import InputError
from rthyb_rt.rig import identify_axes

Floats = NDArray[np.float64]


class Compensation(Protocol):
    """A compensation of two actuators, in m; each (2,)."""

    def lead(self, target_m: Floats) -> Floats:
        """Return the commands for these targets."""

    def observe(self, command_m: Floats, reading_m: Floats) -> None:
        """Learn from commands and the readings that were latched when they were applied."""


class Nothing:
    """No compensation: commands equal the targets."""

    def lead(self, target_m: Floats) -> Floats:
        """Return the targets."""
        return target_m

    def observe(self, command_m: Floats, reading_m: Floats) -> None:
        """Learn nothing."""


# ---- RoDeAC -------------------------------------------------------------------------------------

THETA0: Final = np.array(
    [
        [5.41470353, 1.96280665, -1.50482526, -4.9577638],
        [6.05817263, 2.19981575, -1.67459763, -5.53849986],
    ]
)
"""Initial values of the four taps of each axis (Initial_parameters.mat in its repository)."""
P0: Final = np.array(
    [
        [
            [83906.42815748, -45046.00810958, -27999.32600478, -10761.29340374],
            [-45046.00810958, 106712.78321278, -33590.12199031, -27999.85520077],
            [-27999.32600478, -33590.12199031, 106712.89471243, -45046.64880622],
            [-10761.29340374, -27999.85520077, -45046.64880622, 83907.59945956],
        ],
        [
            [64773.00944011, -51448.24376375, -21629.93049795, 8337.19145783],
            [-51448.24376375, 104560.93549403, -31474.35355889, -21630.1040093],
            [-21629.93049795, -31474.35355889, 104561.22622571, -51448.70807689],
            [8337.19145783, -21630.1040093, -51448.70807689, 64773.64757907],
        ],
    ]
)
"""Their initial uncertainty, from the same file; for signals in mm, or nothing would be learnt."""


class Rodeac:
    """Quiroz, Galmez and Fermandois (2024), Front. Built Environ. 10:1394952, reimplemented.

    Each axis separately: its command is a sum of its last four targets, with weights found by
    recursive least squares, without forgetting, from command and reading after a fourth-order
    Butterworth low-pass filter at 20 Hz.
    """

    def __init__(self) -> None:
        self._theta, self._p = THETA0.copy(), P0.copy()
        self._past, self._read = np.zeros((2, 4)), np.zeros((2, 4))
        # Command, then reading, of each axis: two second-order sections.
        self._sections = _butterworth4(20.0, frame.PERIOD_S)
        self._kept = np.zeros((len(self._sections), 2, 2, 2))

    def lead(self, target_m: Floats) -> Floats:
        """Return the commands for these targets."""
        self._past = np.column_stack([target_m, self._past[:, :3]])
        return np.asarray((self._theta * self._past).sum(axis=1))

    def observe(self, command_m: Floats, reading_m: Floats) -> None:
        """Learn from the newest pair."""
        command_mm, reading_mm = self._filtered(1e3 * np.stack([command_m, reading_m]))
        self._read = np.column_stack([reading_mm, self._read[:, :3]])
        for i, phi in enumerate(self._read):
            spread = self._p[i] @ phi
            gain = spread / (1.0 + phi @ spread)
            self._theta[i] += gain * (command_mm[i] - phi @ self._theta[i])
            self._p[i] -= np.outer(gain, spread)

    def _filtered(self, signals: Floats) -> Floats:
        for (b, a), kept in zip(self._sections, self._kept, strict=True):
            out = b[0] * signals + kept[..., 0]
            kept[..., 0] = b[1] * signals - a[0] * out + kept[..., 1]
            kept[..., 1] = b[2] * signals - a[1] * out
            signals = out
        return signals


def _butterworth4(cutoff_hz: float, period_s: float) -> list[tuple[Floats, Floats]]:
    """Return sections (b0, b1, b2), (a1, a2) of the low-pass by the bilinear transform."""
    k = np.tan(np.pi * cutoff_hz * period_s)
    sections = []
    for angle in (np.pi / 8, 3 * np.pi / 8):
        damping = 2.0 * np.sin(angle)
        norm = 1.0 / (1.0 + damping * k + k * k)
        b = norm * k * k * np.array([1.0, 2.0, 1.0])
        sections.append((b, norm * np.array([2.0 * (k * k - 1.0), 1.0 - damping * k + k * k])))
    return sections


# ---- this program's own -------------------------------------------------------------------------


class MatrixLeadLaw:
    """This program's lead for several axes, in C."""

    def __init__(self, config: MatrixLeadConfig) -> None:
        self.own = MatrixLead(config)

    def lead(self, target_m: Floats) -> Floats:
        """Return the commands for these targets."""
        return self.own.lead(target_m)[0]

    def observe(self, command_m: Floats, reading_m: Floats) -> None:
        """Learn from the newest pair."""
        self.own.observe(command_m, reading_m)


SWEEP_SEED: Final = 7000
"""Seed of the sensors' noise during the sweep of the nominal plant; no run uses it."""
ROLL_OFF_HZ: Final = 20.0


@functools.cache
def identified() -> MatrixResponse:
    """Return the result of one sweep of the noisy nominal plant: all that a lead knows."""
    rig = frame.plant(None, SWEEP_SEED)
    return identify_axes.identify_axes(lambda commands: CoupledPlant(rig).run(commands)[0], 2)


@functools.cache
def inverse() -> MatrixFit:
    """Return the inverse fitted to that sweep."""
    return matrix_response.fit(identified(), frame.PERIOD_S)


def _at_rest() -> MatrixInverse:
    """Return the inverse at the slowest tone of the sweep, which is nearly static."""
    slowest = identified().response[0]
    return MatrixInverse((), np.linalg.inv(np.real(slowest))[None])


def _config(coupled: bool, before: MatrixInverse | None, *, begins: bool) -> MatrixLeadConfig:
    found = identified()
    first = None
    if begins:
        first = matrix_response.fitted_terms(
            found, frame.PERIOD_S, ROLL_OFF_HZ, coupled=coupled, before=before
        )
    return MatrixLeadConfig(
        (float(found.rest_noise_m[0]), float(found.rest_noise_m[1])),
        before,
        coupled=coupled,
        first=first,
        roll_off_hz=ROLL_OFF_HZ,
        period_s=frame.PERIOD_S,
    )


NAMES: Final = {
    "none": "no compensation",
    "lead": "gain, delay and curvature of each axis separately",
    "lead-decoupled": "as `lead`, preceded by a matrix that removes the static coupling",
    "rodeac": "RoDeAC, reimplemented from its paper and parameters",
    "matrix": "gain, delay and curvature as matrices",
    "matrix-inverse": "the identified inverse, with matrices for the remaining error",
}
"""The entrants, with a description of each."""


def compensation(name: str) -> Compensation:
    """Return one of `NAMES` at the start of a test.

    Raises:
        InputError: there is no such compensation.
    """
    if name == "none":
        return Nothing()
    if name == "rodeac":
        return Rodeac()
    if name not in NAMES:
        raise InputError(f"found {name!r}; must be one of {', '.join(NAMES)}", "--law")
    return MatrixLeadLaw(
        {
            "lead": lambda: _config(False, None, begins=True),
            "lead-decoupled": lambda: _config(False, _at_rest(), begins=True),
            "matrix": lambda: _config(True, None, begins=True),
            "matrix-inverse": lambda: _config(True, inverse().inverse, begins=False),
        }[name]()
    )
