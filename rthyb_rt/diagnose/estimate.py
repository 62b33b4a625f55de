"""The motion behind a recording, and its accuracy.

If a command and an actuator model reproduce the measured displacement, the simulated motion, which
is free of noise, is used. Otherwise displacement, accelerometer and load cell are combined, see
`spectral`; the remaining error, multiplied by the specimen's impedance, gives the noise of the
force residual, which need not be white, see `whitening`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import coarse, mains, noise
from rthyb_rt.diagnose.case import Case, Floats, Model
from rthyb_rt.diagnose.gaps import Mask, Rows, away_from_gaps, filled, filled_if_short
from rthyb_rt.diagnose.moving import sensor_colour
from rthyb_rt.diagnose.noise_level import force_noise, noise_of, step_of, white_noise
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.spectral import (
    Sensor,
    aligned,
    drawn_error,
    filter_of_pieces,
    smooth_ramp,
    smoothed,
    whitening_filter,
    without_edges,
)
from rthyb_rt.diagnose.whitening import Blur

SHIFT_S = 0.025
"""Time at either end in which a force that is shifted in time is not known."""
GAP_S = 0.4
"""Time after which a gap in the command no longer affects a simulated motion."""
CORNER = 3
"""Rows on either side of a corner that a smoother rounds."""
TURN_ROWS = 20
"""Rows at either end of a quasi-static recording in which a reversal would not be detected."""


@dataclass(frozen=True)
class Estimate:
    """A motion and the specimen's force along it.

    Attributes:
        motion: x, v, a, each (n,).
        force: the force that a specimen model must reproduce, (n,), N.
        rows: rows to evaluate, (n,).
        whiten: whitens the noise of a force residual to unit variance; linear.
        sigma_n: standard deviation of the force residual's noise where it is white, N; of a coarse
            load cell without its rounding, but with the contribution of an estimated motion.
        share: fraction of the band that is evaluated: the variance of a row of whitened noise.
        exact: whether the motion is simulated and therefore free of noise.
        pieces: whitens pieces of a long residual only, from their first rows (m,) and their
            length, to (m, length); None if whitening uses no other rows.
        scatter: relative standard deviation of the noise's rms over such a recording, if it was
            determined together with a set of effects; 0: the noise is as assumed beforehand.
        blur: contribution of the estimated motion; None if unknown, or the motion is exact.
        begins: first row at which the motion and its history are known, see `begun`.
        read: rows with a reading of a coarse load cell that is evaluated only where it changes its
            reading, see `coarse`; None: of any other one.
        step_n: the step of its readings, N.
    """

    motion: ComputedMotion
    force: Floats
    rows: NDArray[np.bool_]
    whiten: Callable[[Floats], Floats]
    sigma_n: float
    exact: bool
    share: float = 1.0
    pieces: Callable[[Floats, Rows, int], Floats] | None = None
    scatter: float = 0.0
    blur: Blur | None = None
    begins: int = 0
    read: NDArray[np.bool_] | None = None
    step_n: float = 0.0

    @property
    def coloured(self) -> bool:
        """Whether the noise was determined together with a set of effects."""
        return self.scatter > 0.0

    def begun(self, signal: Floats, fs_hz: float) -> Floats:
        """Return a force, (n,), N, faded out before the first row that is known.

        A motion that is simulated from a command in mid-course begins with a jump from rest. A
        filter for coloured noise has a memory of seconds: without this, the jump would also be in
        the rows that are evaluated, differently for each law.
        """
        if self.begins == 0:
            return signal
        reach = min(int(noise.FADE_S * fs_hz), self.begins)
        weight = np.ones(signal.size)
        weight[: self.begins] = 0.0
        weight[self.begins - reach : self.begins] = smooth_ramp(np.arange(reach) / reach)
        return weight * signal

    def beginning(self, first: int, fs_hz: float) -> Estimate:
        """Return the estimate evaluated, and known, from a row on only."""
        after, read = np.arange(self.rows.size) >= first, self.read
        later = replace(self, begins=max(first, self.begins), rows=self.rows & after)
        later = replace(later, read=None if read is None else read & after)
        return later.whitened(self.whiten, self.pieces, fs_hz) if first else later

    def whitened(
        self,
        whiten: Callable[[Floats], Floats],
        pieces: Callable[[Floats, Rows, int], Floats] | None,
        fs_hz: float,
    ) -> Estimate:
        """Return the estimate with another filter for its noise, which sees known rows only."""

        def of_pieces(signal: Floats, first: Rows, length: int) -> Floats:
            assert pieces is not None
            return pieces(self.begun(signal, fs_hz), first, length)

        return replace(
            self,
            whiten=lambda signal: whiten(self.begun(signal, fs_hz)),
            pieces=None if pieces is None else of_pieces,
        )


def _impedance(case: Case, omega: Floats, mass: float) -> Floats:
    m = case.model
    return np.abs(m.k - mass * omega**2 + 1j * m.c * omega)


def at_its_time(force: Floats, sigma: float, fs_hz: float) -> Mask:
    """Return the rows in which a force is known despite a small time offset, (n,).

    A normal time offset is represented as a straight line over the force's rate, which is a
    difference of rows. At a corner of a stiff drive's command, a mass causes a peak two or three
    rows wide, for which neither is accurate, by many times the noise.

    Args:
        force: the model's force along a motion without noise, (n,), N.
        sigma: standard deviation of the noise of a row, N.
        fs_hz: rows per second.
    """
    late = 2.0 * POLICY.offset_prior_s * fs_hz
    bent = np.zeros(force.size)
    bent[1:-1] = 0.5 * late**2 * np.abs(np.diff(force, 2))
    # The first neglected term of the central difference.
    third = late / 6.0 * np.abs(np.diff(force, 3))
    bent[1:-2] = np.maximum(bent[1:-2], third)
    bent[2:-1] = np.maximum(bent[2:-1], third)
    return np.asarray(bent < POLICY.abrupt_model * sigma)


def along(case: Case, motion: ComputedMotion, exact_from: int) -> Estimate | None:
    """Return the estimate for a simulated motion, evaluated from row ``exact_from`` on."""
    f_meas = case.get("f_meas")
    if f_meas is None:
        return None
    sigma = force_noise(f_meas, case.model.f_std)
    rows = case.rows & np.isfinite(f_meas)
    rows = rows.copy()
    rows[:exact_from] = False
    if "x_cmd" in case.channels:
        rows &= away_from_gaps(case.channels["x_cmd"], case.fs_hz, 0.01, GAP_S)
    # A force shifted in time has no rows beyond the ends.
    ends = int(min(SHIFT_S * case.fs_hz, rows.size / 50))
    if ends:
        rows[:ends] = rows[-ends:] = False
    expected = case.model.force(motion.x, motion.v, motion.a)
    sheet, step = case.model.f_std, step_of(f_meas, case.model.f_std)
    steps = sheet is not None and step > 0.0 and coarse.is_rounded(step, sheet)
    sure = rows & at_its_time(expected, sheet if steps and sheet else sigma, case.fs_hz)
    if sure.sum() > POLICY.abrupt_rows * rows.sum():
        rows = sure
    found = Estimate(
        motion, filled(f_meas), rows, lambda y: y / sigma, sigma, True, begins=exact_from
    )
    return where_it_changes(case, found, expected) or found


def where_it_changes(case: Case, found: Estimate, expected: Floats) -> Estimate | None:
    """Return the estimate evaluated where a coarse load cell changes its reading.

    Args:
        case: recording and model.
        found: the estimate as evaluated in every row.
        expected: the force by the model, (n,), N.

    Returns:
        None if the load cell is not coarse, or changes too rarely or too often.
    """
    f_meas, sheet_n = case.channels["f_meas"], case.model.f_std
    step_n = step_of(f_meas, sheet_n)
    blur_n = found.blur.rms if found.blur is not None else 0.0
    noise_n = float(np.hypot(sheet_n or 0.0, blur_n))
    if case.model.family in ("forced", "ground"):
        # As without steps: near resonance, a small force causes a large motion.
        rms_n = float(np.sqrt(np.mean(found.force[found.rows] ** 2)))
        noise_n = max(noise_n, POLICY.force_accuracy * rms_n)
    if step_n == 0.0 or not coarse.is_rounded(step_n, noise_n):
        return None
    exact = coarse.changes(filled(f_meas), np.isfinite(f_meas), step_n, noise_n, expected)
    changed = int(np.count_nonzero(found.rows & exact.rows))
    often = changed > POLICY.coarse_change * found.rows.sum()
    if often or changed < POLICY.least_rows_force:
        return None
    now = replace(found, sigma_n=noise_n, share=1.0, blur=None, read=found.rows, step_n=step_n)
    return _exact(case, now, exact)


def by_intervals(case: Case, found: Estimate, best: Floats) -> Estimate:
    """Return the estimate of a coarse load cell with its readings as intervals.

    As it is if too few of them are near an end of their step.

    Args:
        case: recording and model.
        found: the estimate as evaluated where the reading changes.
        best: the force by the model with the effects that were found in it, (n,), N.
    """
    f_meas = case.channels["f_meas"]
    exact = coarse.intervals(filled(f_meas), np.isfinite(f_meas), found.step_n, found.sigma_n, best)
    near = _exact(case, replace(found, share=coarse.SHARE), exact)
    return near if near.rows.sum() >= POLICY.least_rows_force else found


def as_read(case: Case, found: Estimate) -> Estimate:
    """Return the estimate of a coarse load cell with its readings in all rows, rounding as noise.

    To be shown; any other estimate as it is.
    """
    if found.read is None:
        return found
    f_meas = case.channels["f_meas"]
    sigma = force_noise(f_meas, case.model.f_std)
    plain = replace(found, force=filled(f_meas), rows=found.read, sigma_n=sigma, read=None)
    return plain.whitened(lambda y: y / sigma, None, case.fs_hz)


def _exact(case: Case, found: Estimate, exact: coarse.Exact) -> Estimate:
    assert found.read is not None
    now = replace(found, force=exact.force, rows=found.read & exact.rows)
    return now.whitened(exact.seen, None, case.fs_hz)


def _in_colour_each(
    case: Case, accelerations: list[Sensor]
) -> tuple[list[Sensor], noise.Colour | None]:
    """Return the accelerations, and the displacement's colour, each with that of its noise."""
    x_meas, model = case.channels["x_meas"], case.model
    forces = ("f_in",) if model.family == "forced" else ("f_meas", "x_cmd")
    beside = [filled(case.channels[n]) for n in forces if n in case.channels]
    x, sigma = filled(x_meas), noise_of(x_meas, model.x_std)
    felt = [a.signal for a in accelerations]
    colour = sensor_colour(
        x, [*felt, *beside], case.fs_hz, sigma, model.x_std, np.isfinite(filled_if_short(x_meas))
    )
    coloured = [
        replace(
            a,
            colour=sensor_colour(a.signal, [x, *beside], case.fs_hz, a.sigma, model.a_std, a.known),
        )
        for a in accelerations
    ]
    return coloured, colour


def from_sensors(case: Case) -> Estimate | None:
    """Return the estimate from displacement, accelerometer and load cell; None without a force."""
    model, channels = case.model, case.channels
    f_meas, a_meas, ag = channels.get("f_meas"), channels.get("a_meas"), channels.get("ag")
    if "x_meas" not in channels:
        return None
    if quasi_static(case):
        return _static(case)
    accelerations: list[Sensor] = []
    ground = model.family == "ground"
    if a_meas is not None:
        # On moving ground an accelerometer also measures the ground.
        parts = [a_meas, -ag] if ground and ag is not None else [a_meas]
        sigma = noise_of(a_meas, model.a_std)
        known_rows = np.all([np.isfinite(filled_if_short(part)) for part in parts], axis=0)
        whole = aligned(case, [filled(part) for part in parts], sigma)
        accelerations.append(Sensor(whole, sigma, known=known_rows))
    accelerations, colour = _in_colour_each(case, accelerations)
    motion, known, s = smoothed(case, accelerations, colour)
    mass = model.moving_mass
    rows = case.rows & away_from_gaps(channels["x_meas"], case.fs_hz, 0.1, 0.1, bridged=True)
    for name in ("a_meas", "ag"):
        if name in channels:
            rows = rows & away_from_gaps(channels[name], case.fs_hz, 0.1, 0.1, bridged=True)
    rows = rows & ~_around_corners(
        filled(channels["x_meas"]), noise_of(channels["x_meas"], model.x_std)
    )
    if model.family == "forced":
        force, sigma = filled(channels["f_in"]), noise_of(channels["f_in"], model.f_std)
        sigma = min(sigma, model.f_std) if model.f_std else sigma
        rows = rows & np.isfinite(channels["f_in"])
    elif f_meas is not None:
        force, sigma = filled(f_meas), force_noise(f_meas, model.f_std)
        rows = rows & np.isfinite(f_meas)
    elif ground and ag is not None:
        force = -model.mass * (motion.a + filled(ag))
        mass += model.mass
        sigma = 1e-4 * float(np.std(force))
        rows = rows & np.isfinite(ag)
    else:
        return None
    channel = sigma
    if model.family in ("forced", "ground"):
        # Near resonance a small force causes a large motion: accuracy is limited to some per
        # thousand.
        # Without a force, the spring's and the mass's balance.
        balanced = force if force[rows].any() else model.k * motion.x
        sigma = max(sigma, POLICY.force_accuracy * float(np.sqrt(np.mean(balanced[rows] ** 2))))
    measured = model.family == "forced" or f_meas is not None
    z2 = _impedance(case, s.omega, mass) ** 2
    power = sigma**2 + z2 * known.variance
    # If displacement is only noise, so are force laws evaluated on it: no band to evaluate.
    seen = known.seen
    if f_meas is not None:
        # The load cell itself may hum elsewhere.
        moved = model.force(motion.x, motion.v, motion.a)
        line_hz = mains.hum_hz(force - moved, moved, case.dt)
        if line_hz is not None:
            seen = np.maximum(seen, mains.window(s.omega / (2.0 * np.pi), line_hz))
    band = np.maximum(sigma**2 / (sigma**2 + z2 * known.measured), seen)
    rows = without_edges(rows, case.fs_hz, filled(channels["x_meas"]))
    share = float(np.mean(band**2))
    error = drawn_error(s, known.variance, force.size)
    return Estimate(
        motion, force, rows, whitening_filter(s, power, band), sigma, False, max(share, 1e-3),
        filter_of_pieces(s, power, band, case.fs_hz),
        blur=Blur(
            power - channel**2, sigma**2 - channel**2, band, seen, channel, s.omega, error,
            model.k * error.x + model.c * error.v + mass * error.a,
        ) if measured else None,
    )  # fmt: skip


def _around_corners(x: Floats, sigma: float) -> Mask:
    """Return the rows next to a corner that the rows do not resolve, (n,).

    Such as the reversals of a triangle wave: in which row the velocity is the new one, and by how
    much a smoother rounds the corner, decides what friction seems to do there.
    """
    bent = np.abs(np.diff(x, 2, prepend=x[0], append=x[-1]))
    bent[[0, -1]] = 0.0
    beside = np.zeros(x.size)
    for away in (-3, -2, 2, 3):
        beside = np.maximum(beside, np.roll(bent, away))
    corner = (bent > POLICY.corner_isolated * beside) & (bent > POLICY.corner_noise * sigma)
    return np.asarray(np.convolve(corner, np.ones(2 * CORNER + 1), mode="same") > 0.0)


def quasi_static(case: Case) -> bool:
    """Return whether time is nominal: the model has no rate, and rows are too far apart for one."""
    return nominal_time(case.model)


def nominal_time(model: Model) -> bool:
    """Return whether recordings for a model have a nominal time, see `quasi_static`."""
    rateless = model.family == "drive" and model.c == 0 and model.moving_mass == 0
    return rateless and model.fs_hz <= POLICY.static_hz


def _rate(x: Floats, fs_hz: float, span: int = 34) -> Floats:
    """Return the rate of a noisy ramp, (n,): the slope of the straightest stretch at each row."""
    span = min(span, x.size - 1)
    at = np.arange(span + 1.0) - span / 2.0
    parts = np.lib.stride_tricks.sliding_window_view(x, span + 1)
    slope = parts @ at / float(at @ at)
    rest = parts - parts.mean(axis=1)[:, None] - slope[:, None] * at
    bent = np.sum(rest**2, axis=1)
    first = np.arange(x.size)[:, None] - np.array([span, span // 2, 0])
    first = np.clip(first, 0, slope.size - 1)
    best = np.argmin(bent[first], axis=1)
    return np.asarray(slope[first[np.arange(x.size), best]] * fs_hz)


def _legs(x: Floats, v: Floats, fs_hz: float) -> tuple[Floats, NDArray[np.bool_]]:
    """Return a rate that is constant along each straight stroke, and where that holds.

    A noisy rate would favour the laws that are least sensitive to it.
    """
    sigma = white_noise(x)
    out, straight = v.copy(), np.zeros(x.size, dtype=np.bool_)
    turns = np.flatnonzero(np.diff(np.sign(v)) != 0)
    for first, last in pairwise([0, *(turns + 1), x.size]):
        # The reversal is somewhere near the change of sign; near an end it is not detected.
        part = x[first + (5 if first else TURN_ROWS) : last - (5 if last < x.size else TURN_ROWS)]
        if part.size < 24:
            continue
        at = np.arange(part.size) - 0.5 * (part.size - 1)
        slope = float(part @ at / (at @ at))
        rest = part - part.mean() - slope * at
        # Straight: deviations no larger than noise, neither overall nor over a third of it.
        thirds = [float(np.mean(p)) for p in np.array_split(rest, 3)]
        bent = POLICY.stroke_bent * sigma * np.sqrt(3.0 / part.size)
        if np.std(rest) < POLICY.stroke_straight * sigma and max(map(abs, thirds)) < bent:
            rests = abs(slope) < POLICY.stroke_rests * sigma / np.sqrt(at @ at)
            out[first:last] = 0.0 if rests else slope * fs_hz
            straight[first:last] = True
    return out, straight


def _plainly_moving(x: Floats, v: Floats, sigma: float) -> NDArray[np.bool_]:
    """Return the rows whose neighbours differ by more than noise, in the direction of v.

    There the direction is certain, however near a reversal: in a coarse recording of cycles, the
    rows around reversals show the capacity of the specimen.
    """
    across = np.zeros(x.size)
    across[1:-1] = x[2:] - x[:-2]
    apart = np.abs(across) > POLICY.static_apart * np.sqrt(2.0) * sigma
    return np.asarray(apart & (np.sign(across) == np.sign(v)))


def _static(case: Case) -> Estimate | None:
    f_meas = case.get("f_meas")
    if f_meas is None:
        return None
    x = filled(case.channels["x_meas"])
    v = np.gradient(x) * case.fs_hz
    sure = np.ones(x.size, dtype=np.bool_)
    unsure = (case.model.x_std or 0.0) * case.fs_hz
    if unsure > POLICY.static_rate_noise * float(np.median(np.abs(v))):
        v, straight = _legs(x, _rate(x, case.fs_hz), case.fs_hz)
        bent = bool(np.mean(straight) < POLICY.static_straight)
        if bent:
            # A slow sweep or random motion is curved within any span that averages its noise.
            v = smoothed(case, [])[0].v
        # The exact row of the reversal is unknown: such rows are not evaluated.
        turns = np.flatnonzero(np.diff(np.sign(v)) != 0)
        for reach in range(-5, 7):
            sure[np.clip(turns + reach, 0, x.size - 1)] = False
        sure[-TURN_ROWS:] = False
        if bent:
            sure |= _plainly_moving(x, v, noise_of(case.channels["x_meas"], case.model.x_std))
    sigma = case.model.f_std or noise_of(f_meas, None)
    sigma = float(np.hypot(sigma, abs(case.model.k) * (case.model.x_std or 0.0)))
    rows = case.rows & np.isfinite(f_meas) & np.isfinite(case.channels["x_meas"])
    if (rows & sure).sum() > POLICY.static_rows * rows.sum():
        rows = rows & sure
    return Estimate(
        ComputedMotion(x, v, np.zeros_like(x)),
        filled(f_meas),
        rows,
        lambda y: y / sigma,
        sigma,
        False,
    )
