"""What a test must know about its rig: delay, gain, initial alpha, elastic stiffness, rest noise.

The rig rests, then follows a series of sines, from slow to fast, with small amplitude and limited
velocity, without any compensation. Each sine is fitted to command, displacement and force by least
squares: over whole cycles and thousands of samples, the delay is found to a hundredth of a sample.

The rig is a virtual one, in virtual time, or a rig at the other end of a link. Either way the sweep
passes through the station, under the limits of the rig file, and rows without a new reading are
left out of every fit.
"""

from __future__ import annotations

import datetime
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.config import STANDARD, Identified, Rate, RigFile, dump, parse_rig, response
from rthyb_rt.config.deriving import omitted
from rthyb_rt.core import FLAGS, RUNNING
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.lab.realtime import Operator
from rthyb_rt.numbers import delay
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.rig.commissioning import guided_motion, polarity
from rthyb_rt.rig.commissioning.guided_motion import Connection, MotionResult

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]

REST_S = 3.0
RAMP_CYCLES = 1
SETTLE_CYCLES, SETTLE_S = 2, 1.2
"""Cycles and time that a sine is given to settle: the longest delay of a rig is 1 s."""

FIT_CYCLES = 4
FIT_SECONDS = 2.0
"""Each frequency is fitted over whole cycles that last at least this long."""

FREQUENCIES_HZ = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, 40.0, 60.0, 80.0)
HIGHEST_HZ = 100.0
LOW_FREQUENCY_HZ = 2.0
"""Delay, gain and alpha are averaged up to this frequency, where structures respond."""

STIFFNESS_NONLINEAR = 0.05
"""Share of the force that linear fit and noise may leave before k_e is reported as doubtful."""

MASS_RESOLVED = 0.02
"""Smallest share of a mass in the force at the highest frequency that exceeds rounding."""

CERTAIN = 10.0
"""An amplitude is significant from this multiple of its own standard error."""

NOISE_SCATTER = 4.0
"""Standard errors by which two estimates of the power of the same noise may differ."""

READ_SHARE = 0.8
"""Smallest share of the rows of a fit that must contain a reading."""

MOST_VELOCITY_M_PER_S = 0.05
"""Velocity of the fast sines that a small laboratory actuator follows without saturation."""

MEMORY_TICKS = 64
"""Ticks after which a substituted reading no longer affects the filters of the estimator."""

REVERSED = -0.7
"""Cosine of the phase at 0 Hz below which a displacement moves against its command."""


@dataclass(frozen=True)
class SweepPlan:
    """The excitation of an identification.

    Attributes:
        frequencies_hz: of the sines, from slow to fast.
        amplitude_m: of the slow sines.
        velocity_m_per_s: limit that reduces the amplitude of the fast sines.
    """

    frequencies_hz: tuple[float, ...] = FREQUENCIES_HZ[:9]
    amplitude_m: float = 2e-3
    velocity_m_per_s: float = MOST_VELOCITY_M_PER_S

    @classmethod
    def up_to(
        cls,
        highest_hz: float,
        amplitude_m: float = 2e-3,
        velocity_m_per_s: float = MOST_VELOCITY_M_PER_S,
    ) -> SweepPlan:
        """Return the usual frequencies up to and including ``highest_hz``."""
        below = tuple(f for f in FREQUENCIES_HZ if f < highest_hz)
        return cls((*below, highest_hz), amplitude_m, velocity_m_per_s)

    @property
    def ticks(self) -> int:
        """Samples of the complete sweep at 1024 Hz, including the rest before it."""
        return self.ticks_at(STANDARD)

    def ticks_at(self, rate: Rate) -> int:
        """Return the samples of the complete sweep at a rate, including the rest before it."""
        return int(command_of(self, rate)[0].size)

    def amplitude_at(self, frequency_hz: float) -> float:
        """Return the amplitude at one frequency, m."""
        return min(self.amplitude_m, self.velocity_m_per_s / (2 * np.pi * frequency_hz))


@dataclass(frozen=True)
class Tone:
    """Result of one sine.

    Attributes:
        frequency_hz, amplitude_m: the command.
        gain: amplitude of x_m over that of x_p.
        delay_s: phase lag as time.
        force_in_phase_n_per_m: force in phase with x_m, over its amplitude: stiffness less
            (2 pi f)^2 times the mass that the load cell feels.
        force_in_quadrature_n_per_m: the same a quarter period ahead: damping and friction.
        distortion: share of the force (rms) that is not a sine of this frequency and exceeds the
            noise at rest.
    """

    frequency_hz: float
    amplitude_m: float
    gain: float
    delay_s: float
    force_in_phase_n_per_m: float
    force_in_quadrature_n_per_m: float
    distortion: float


@dataclass(frozen=True)
class IdentificationResult:
    """Result of an identification; samples are of 1/1024 s at any rate.

    Attributes:
        tones: by frequency.
        alpha: parameter of Eqn 2.5 that best inverts this actuator up to `LOW_FREQUENCY_HZ`, used
            as the alpha0 of a test: least squares of Eqn 2.6-2.8, samples.
        alpha_with_beta, beta: the same with the curvature term and over the whole sweep, samples
            and samples^2.
        delay_s, gain: mean up to `LOW_FREQUENCY_HZ`.
        k_e_n_per_m: elastic stiffness.
        moving_mass_kg: further mass moved below the load cell; None if too small to resolve.
        rest_noise_m, rest_noise_n: standard deviations at rest.
        offset_m, offset_n: means at rest.
        resonance_hz: first resonance of actuator and specimen within the sweep, or None.
        notes: for the user.
        link_delay_samples: the link's share of the delay, from the drive's echo; None if unknown or
            without a link.
        left_out: rows of the sweep without a new reading.
        sample_rate_hz: of the sweep. The drive holds each command for one such sample, which is
            included in gains and delays.
        recording: of the sweep; None for one axis of several.
    """

    tones: tuple[Tone, ...]
    alpha: float
    alpha_with_beta: float
    beta: float
    delay_s: float
    gain: float
    k_e_n_per_m: float
    moving_mass_kg: float | None
    rest_noise_m: float
    rest_noise_n: float
    offset_m: float
    offset_n: float
    notes: tuple[str, ...]
    resonance_hz: float | None = None
    link_delay_samples: float | None = None
    left_out: int = 0
    sample_rate_hz: float = STANDARD.hz
    recording: RecordedTest | None = field(default=None, repr=False, compare=False)

    def as_json(self) -> dict[str, Any]:
        """Return everything except the recording as a JSON document."""
        found = asdict(replace(self, recording=None))
        del found["recording"]
        return found


Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class SineRows:
    """Rows of one sine: all of it, and the settled whole cycles that are fitted."""

    frequency_hz: float
    start: int
    fit: slice
    rate: Rate = STANDARD


@dataclass(frozen=True)
class _SweptSignals:
    """Signals of a sweep: each (n,); ``read`` marks the rows that contain a new reading."""

    command: Floats
    x_m: Floats
    f: Floats
    read: Mask

    @property
    def whole(self) -> bool:
        return bool(self.read.all())


def identify(
    rig: RigFile,
    sweep: SweepPlan | None = None,
    progress: Progress | None = None,
    rate: Rate = STANDARD,
) -> IdentificationResult:
    """Sweep the virtual rig of ``rig`` in virtual time and determine what a test needs.

    Args:
        rig: the rig file.
        sweep: the excitation.
        progress: called now and then with (ticks done, ticks of the sweep).
        rate: sample rate.

    Raises:
        InputError: invalid sweep, or a rig that does not follow it.
        LimitError: a limit of the rig file ended the sweep.
        RthybError: the rig did not come to rest.
    """
    sweep = sweep or SweepPlan()
    check(sweep)
    motion, parts = _motion(sweep, rate)
    setup = experiment.prescribed(rig, motion.name, motion.path_m, rate)
    return _found(rig, MotionResult(virtual_time.run(setup, progress)), parts, sweep)


def identify_live(
    connection: Connection,
    sweep: SweepPlan | None = None,
    progress: Progress | None = None,
    operator: Operator | None = None,
) -> IdentificationResult:
    """Sweep the rig at the other end of a link, in real time and within all limits of its file.

    Args:
        connection: the rig; its file need not be identified or contain the right k_e.
        sweep: the excitation.
        progress: called now and then with (ticks done, ticks of the sweep).
        operator: asks for a stop.

    Returns:
        The result; delays are those of link and actuator together, of which
        `IdentificationResult.link_delay_samples` is the link's share.

    Raises:
        InputError: invalid sweep, no feedback, or a rig that does not follow the sweep.
        LimitError: a limit or the drive ended the sweep; the message states the frequency.
        TimingError: this PC was late.
        StoppedError: the operator ended it.
        RthybError: as in `rthyb_rt.rig.commissioning.guided_motion.carry_out`.
    """
    sweep = sweep or SweepPlan()
    check(sweep)
    guided_motion.check_limits(connection.rig)
    guided_motion.check_distance(connection.rig, sweep.amplitude_m)
    motion, parts = _motion(sweep, connection.rig.rate)
    moved = guided_motion.carry_out(connection, motion, operator=operator, progress=progress)
    found = _found(connection.rig, moved, parts, sweep)
    link = _link_delay(moved)
    at = connection.rig.rate.pace
    return replace(found, link_delay_samples=None if link is None else link / at)


def _motion(sweep: SweepPlan, rate: Rate) -> tuple[guided_motion.GuidedMotion, list[SineRows]]:
    command, parts = command_of(sweep, rate)
    # The command of a row is the previous row of the path, so one more row sends the last.
    return guided_motion.GuidedMotion("identify", np.append(command, 0.0), stay=False), parts


def _found(
    rig: RigFile, moved: MotionResult, parts: list[SineRows], sweep: SweepPlan
) -> IdentificationResult:
    """Return the result of a sweep that was carried out."""
    _check_ranges(rig, moved.running)
    running = moved.running[1:]
    if moved.cause != "completed":
        raise _broken_off(moved, parts, running.size)
    check_not_limited(running, parts)
    signals = _SweptSignals(
        running["x_cmd_m"], running["x_meas_m"], running["f_meas_n"], guided_motion.fresh(running)
    )
    check_read(signals.read, parts)
    found = _result(rig, signals, parts, (moved.start_m, moved.start_n))
    left_out = int(np.count_nonzero(~signals.read))
    notes = (*found.notes, *_reduced(sweep))
    return replace(found, left_out=left_out, recording=moved.recording, notes=notes)


def result_of(
    rig: RigFile,
    command_m: Floats,
    x_m: Floats,
    f_n: Floats,
    parts: list[SineRows],
    read: Mask | None = None,
) -> IdentificationResult:
    """Return the result of a sweep.

    Args:
        rig: for messages.
        command_m, x_m, f_n: signals of the sweep, (n,) each: the reading of a row was latched when
            its command was applied.
        parts: as returned by `command_of`.
        read: which rows contain a new reading, (n,); None: all of them.

    Raises:
        InputError: the rig did not follow.
    """
    read = np.ones(command_m.size, np.bool_) if read is None else read
    return _result(rig, _SweptSignals(command_m, x_m, f_n, read), parts, (0.0, 0.0))


def _result(
    rig: RigFile, signals: _SweptSignals, parts: list[SineRows], tare: tuple[float, float]
) -> IdentificationResult:
    rest = np.zeros(signals.read.size, np.bool_)
    rate = parts[0].rate
    rest[rest_rows(rate)] = True
    rest &= signals.read
    offset_m, offset_n = float(signals.x_m[rest].mean()), float(signals.f[rest].mean())
    noise_m = float(signals.x_m[rest].std(ddof=1))
    noise_n = float(signals.f[rest].std(ddof=1))
    resting = int(np.count_nonzero(rest))
    signals = replace(signals, x_m=signals.x_m - offset_m, f=signals.f - offset_n)
    tones: list[Tone] = []
    for part in parts:
        before = tones[-1].delay_s if tones else None
        tones.append(_tone(part, signals, before, _most_noise(noise_n, resting, part)))
        _check_followed(part, tones[-1], noise_m)
    _check_direction(rig, tones)
    _check_specimen(rig, parts[0], tones[0], noise_n)
    slow = [tone for tone in tones if tone.frequency_hz <= LOW_FREQUENCY_HZ] or tones[:1]
    begin = parts[0].start
    end = parts[len(slow)].start if len(slow) < len(parts) else signals.command.size
    alpha, _ = standard_lead(
        *_inverse(signals, slice(begin, end), noise_m, rate, with_beta=False), rate
    )
    alpha_with_beta, beta = standard_lead(
        *_inverse(signals, slice(begin, None), noise_m, rate, with_beta=True), rate
    )
    stiffness, mass = _stiffness_and_mass(tones)
    return IdentificationResult(
        tones=tuple(tones),
        alpha=alpha,
        alpha_with_beta=alpha_with_beta,
        beta=beta,
        delay_s=float(np.mean([tone.delay_s for tone in slow])),
        gain=float(np.mean([tone.gain for tone in slow])),
        k_e_n_per_m=stiffness,
        moving_mass_kg=mass,
        rest_noise_m=noise_m,
        rest_noise_n=noise_n,
        offset_m=offset_m + tare[0],
        offset_n=offset_n + tare[1],
        # The file that is written says it as well, but the result may be all that is printed.
        notes=(*omitted(rig), *_notes(tones, stiffness, alpha)),
        resonance_hz=response.resonance_of_sweep(
            tuple(tone.frequency_hz for tone in tones),
            tuple(tone.gain for tone in tones),
            tuple(tone.delay_s for tone in tones),
        ),
        sample_rate_hz=rate.hz,
    )


def identified_rig(rig: RigFile, result: IdentificationResult) -> RigFile:
    """Return the rig file with k_e and the section ``identified`` filled in.

    Raises:
        InputError: a value that a rig file does not allow.
    """
    info = rig.rig.model_copy(update={"elastic_stiffness_n_per_m": rounded(result.k_e_n_per_m)})
    section = section_of(result, response.hold_of(rig))
    filled = rig.model_copy(update={"rig": info, "identified": section})
    # Parsed again, so that whatever is written is a valid rig file.
    return parse_rig(dump(filled), "identified rig")


def section_of(result: IdentificationResult, hold: str | None) -> Identified:
    """Return the section ``identified`` of a rig file; its values have not been validated.

    The frequency response is given for commands held for 1/1024 s; a sweep at another rate is
    converted. Delay and alpha are times, and remain those of the rate of the sweep.

    Args:
        result: the identification.
        hold: how the drive interpolates between commands, from `response.hold_of`.
    """
    f_hz = np.array([tone.frequency_hz for tone in result.tones])
    held = response.held_otherwise(f_hz, Rate(result.sample_rate_hz), hold)
    # Phase lag as time; the hold contributes less than half a turn.
    earlier_s = (np.angle(held) / (2.0 * np.pi * f_hz)).tolist()
    louder = abs(held).tolist()
    return Identified.model_construct(
        alpha=max(rounded(result.alpha), 0.0),
        delay_s=max(rounded(result.delay_s), 0.0),
        gain=rounded(result.gain),
        rest_noise_displacement_m=rounded(result.rest_noise_m, 3),
        rest_noise_force_n=rounded(result.rest_noise_n, 3),
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
        frequency_hz=[tone.frequency_hz for tone in result.tones],
        amplitude=[rounded(t.gain / by) for t, by in zip(result.tones, louder, strict=True)],
        delay_at_frequency_s=[
            max(rounded(tone.delay_s + by), 0.0)
            for tone, by in zip(result.tones, earlier_s, strict=True)
        ],
        force_in_phase_n_per_m=[rounded(tone.force_in_phase_n_per_m) for tone in result.tones],
        force_in_quadrature_n_per_m=[
            rounded(tone.force_in_quadrature_n_per_m) for tone in result.tones
        ],
        command_amplitude_m=[rounded(tone.amplitude_m) for tone in result.tones],
        roll_off_hz=_roll_off(result.resonance_hz),
    )


def _roll_off(resonance_hz: float | None) -> float | None:
    return None if resonance_hz is None else rounded(response.BELOW * resonance_hz, 3)


def rounded(value: float, digits: int = 4) -> float:
    """Round to the digits that a sweep can resolve; noise has fewer."""
    return float(f"{value:.{digits}g}")


def check(sweep: SweepPlan) -> None:
    """Raise ``InputError`` if a sweep is invalid."""
    bad = [f for f in sweep.frequencies_hz if not 0.05 <= f <= HIGHEST_HZ]
    if bad or not sweep.frequencies_hz:
        found = ", ".join(f"{f:g} Hz" for f in bad) or "none"
        raise InputError(
            f"found the frequencies {found}; each must be from 0.05 to {HIGHEST_HZ:g} Hz",
            "identify",
        )
    if any(np.diff(sweep.frequencies_hz) <= 0.0):
        raise InputError("the frequencies must increase from one sine to the next", "identify")
    if not (0 < sweep.amplitude_m <= 1 and 0 < sweep.velocity_m_per_s <= 10):
        raise InputError(
            f"found an amplitude of {sweep.amplitude_m:g} m at up to {sweep.velocity_m_per_s:g} "
            "m/s; both must be positive, at most 1 m and 10 m/s; start with a millimetre or two",
            "identify",
        )


def rest_rows(rate: Rate) -> slice:
    """Return the rows of a sweep before any motion, after the tare has settled."""
    return slice(int(0.2 * rate.hz), int(REST_S * rate.hz))


def standard_lead(alpha: float, beta: float, rate: Rate) -> tuple[float, float]:
    """Return alpha and beta of a rate in samples and samples^2 of 1/1024 s.

    The lead ``1 + alpha d + beta d^2`` with ``d = 1 - exp(-s h)`` is, up to the second order,
    ``1 + alpha h s + (beta - alpha / 2) h^2 s^2``, which is the same at both rates.
    """
    if rate == STANDARD:
        return alpha, beta
    standard = alpha / rate.pace
    return standard, (beta - 0.5 * alpha) / rate.pace**2 + 0.5 * standard


def command_of(sweep: SweepPlan, rate: Rate = STANDARD) -> tuple[Floats, list[SineRows]]:
    """Return x_c: a rest, then one sine after another, each with a smooth start and end."""
    pieces = [np.zeros(round(REST_S * rate.hz))]
    parts = []
    at = pieces[0].size
    for frequency in sweep.frequencies_hz:
        fitted = max(FIT_CYCLES, int(np.ceil(FIT_SECONDS * frequency)))
        ahead = RAMP_CYCLES + max(SETTLE_CYCLES, int(np.ceil(SETTLE_S * frequency)))
        cycles = ahead + fitted + RAMP_CYCLES
        n = round(cycles / frequency * rate.hz)
        turns = np.arange(n) * (frequency / rate.hz)
        envelope = np.clip(np.minimum(turns, cycles - turns) / RAMP_CYCLES, 0.0, 1.0)
        smooth = 0.5 - 0.5 * np.cos(np.pi * envelope)
        pieces.append(sweep.amplitude_at(frequency) * smooth * np.sin(2 * np.pi * turns))
        first = at + round(ahead / frequency * rate.hz)
        last = first + round(fitted / frequency * rate.hz)
        parts.append(SineRows(frequency, at, slice(first, last), rate))
        at += n
        # A pause lets the slow part of a servo's integrator decay before the next sine.
        pause = np.zeros(round(0.5 * rate.hz))
        pieces.append(pause)
        at += pause.size
    return np.concatenate(pieces), parts


def phasor(part: SineRows, signal: Floats, read: Mask) -> tuple[complex, Floats]:
    """Return the complex amplitude of the sine in a signal, and the residual of the fit."""
    w = 2 * np.pi * part.frequency_hz * part.rate.period_s
    angle = w * np.arange(part.fit.start, part.fit.stop)[read[part.fit]]
    basis = np.column_stack([np.cos(angle), np.sin(angle), np.ones_like(angle)])
    values = signal[part.fit][read[part.fit]]
    fitted, *_ = np.linalg.lstsq(basis, values, rcond=None)
    return complex(fitted[0], -fitted[1]), values - basis @ fitted


def _most_noise(noise_n: float, resting: int, part: SineRows) -> float:
    """Return the greatest power of a fit's residual force that noise alone explains, N^2.

    Args:
        noise_n: standard deviation of the noise, measured at rest.
        resting: samples of that rest.
        part: rows of the sine.
    """
    # The power of white noise in n samples has a relative standard error of sqrt(2 / n).
    scatter = np.sqrt(2.0 / resting + 2.0 / (part.fit.stop - part.fit.start))
    return noise_n**2 * (1.0 + NOISE_SCATTER * float(scatter))


def _tone(part: SineRows, signals: _SweptSignals, before_s: float | None, noise_n2: float) -> Tone:
    """Fit one sine.

    Args:
        part: its rows.
        signals: of the sweep.
        before_s: delay at the previous frequency.
        noise_n2: share of the force's power that is noise of the load cell, N^2.
    """
    f, read = signals.f, signals.read
    sent, _ = phasor(part, signals.command, read)
    moved, _ = phasor(part, signals.x_m, read)
    force, rest = phasor(part, f, read)
    ratio = moved / sent
    stiffness = force / moved if moved else complex(0)
    total = float(np.sqrt(np.mean(f[part.fit][read[part.fit]] ** 2)))
    unexplained = math.sqrt(max(float(np.mean(rest**2)) - noise_n2, 0.0))
    period = 1.0 / part.frequency_hz
    delay_s = float(-np.angle(ratio)) / (2 * np.pi) * period
    # A phase is ambiguous by whole periods: take the delay nearest to the previous one. The first
    # may be slightly negative because of noise, but not by much.
    nearest = 0.375 * period if before_s is None else before_s
    delay_s += round((nearest - delay_s) / period) * period
    return Tone(
        frequency_hz=part.frequency_hz,
        amplitude_m=abs(sent),
        gain=abs(ratio),
        delay_s=delay_s,
        force_in_phase_n_per_m=stiffness.real,
        force_in_quadrature_n_per_m=stiffness.imag,
        distortion=unexplained / total if total else 0.0,
    )


def _inverse(
    signals: _SweptSignals, part: slice, noise_m: float, rate: Rate, *, with_beta: bool
) -> tuple[float, float]:
    """Least squares of Eqn 2.6-2.8 over a part of the sweep, with the estimator of a test."""
    estimator = core.Estimator(
        core.EstimatorConfig(
            law="rls",
            estimate_beta=with_beta,
            memory_samples=1e8,
            rest_noise_m=noise_m,
            alpha_max=1000.0,
            period_s=rate.period_s,
        )
    )
    x_p, x_m = signals.command[part], signals.x_m[part]
    if signals.whole:
        estimator.run(x_p, x_m)
        return estimator.alpha, estimator.beta
    # Substituted readings keep the filters running, but are not used for the estimate.
    made_up = np.convolve(~signals.read[part], np.ones(MEMORY_TICKS))[: x_p.size] > 0.5
    for p, m, frozen in zip(x_p.tolist(), x_m.tolist(), made_up.tolist(), strict=True):
        estimator.step(p, m, frozen)
    return estimator.alpha, estimator.beta


def _stiffness_and_mass(tones: list[Tone]) -> tuple[float, float | None]:
    """Fit in-phase force over frequency, k - m w^2, weighted by the amplitude of each sine."""
    w2 = np.array([(2 * np.pi * tone.frequency_hz) ** 2 for tone in tones])
    in_phase = np.array([tone.force_in_phase_n_per_m for tone in tones])
    weight = np.array([tone.amplitude_m * tone.gain for tone in tones])
    if len(tones) < 2:
        return float(in_phase[0]), None
    basis = np.column_stack([np.ones_like(w2), -w2])
    (stiffness, mass), *_ = np.linalg.lstsq(basis * weight[:, None], in_phase * weight, rcond=None)
    resolved = mass * w2[-1] > MASS_RESOLVED * stiffness
    return float(stiffness), float(mass) if resolved else None


def _standard_error(part: SineRows, noise: float) -> float:
    """Return the standard error of a fitted amplitude in white noise."""
    return noise * float(np.sqrt(2.0 / (part.fit.stop - part.fit.start)))


def _check_ranges(rig: RigFile, rows: NDArray[np.void]) -> None:
    """Refuse a sweep that drove a sensor to the end of its range, where it saturates.

    Ranges apply to raw readings: the tare is added back, and readings that the station rejected are
    included.
    """
    displacement, force = rig.sensors.displacement.range_m, rig.sensors.force.range_n
    for name, signal, limit, unit in (
        ("displacement", rows["x_read_m"], displacement, "m"),
        ("force", rows["f_read_n"], force, "N"),
    ):
        if limit is not None and (np.abs(signal) >= limit).any():
            raise InputError(
                f"the {name} sensor reached the end of its range, {limit:g} {unit}; identify with "
                "a smaller amplitude (--amplitude), or check the sensor",
                "identify",
            )


def _check_followed(part: SineRows, tone: Tone, noise_m: float) -> None:
    moved = tone.gain * tone.amplitude_m
    if moved <= max(CERTAIN * _standard_error(part, noise_m), 1e-3 * tone.amplitude_m, 1e-12):
        raise InputError(
            f"at {tone.frequency_hz:g} Hz the displacement did not follow the command "
            f"({moved * 1e6:.3g} um of {tone.amplitude_m * 1e6:.3g} um); is the actuator on, is "
            "the sensor connected, and is the amplitude above the noise?",
            "identify",
        )


def _check_direction(rig: RigFile, tones: list[Tone]) -> None:
    """Distinguish a displacement that moves against its command from one that is late.

    Extrapolated to 0 Hz, a delay leaves no phase, but a wrong sign leaves half a turn.
    """
    if len(tones) < 2:
        return
    first, second = tones[:2]
    turns = [tone.frequency_hz * tone.delay_s for tone in (first, second)]
    apart_hz = second.frequency_hz - first.frequency_hz
    delay_s = ((turns[1] - turns[0] + 0.25) % 1.0 - 0.25) / apart_hz
    at_zero = turns[0] - first.frequency_hz * delay_s
    if np.cos(2 * np.pi * at_zero) < REVERSED:
        raise InputError(
            f"the displacement moves against the command; {polarity.displacement_remedy(rig)}",
            "identify",
        )


def check_not_limited(rows: NDArray[np.void], parts: list[SineRows]) -> None:
    """Raise ``InputError`` if a limit has altered the command of a sweep."""
    limited = np.flatnonzero(rows["flags"] & FLAGS["limited"])
    if limited.size:
        first = int(limited[0])
        before = rows["flags"][max(0, first - round(parts[0].rate.hz)) : first + 1]
        at = f"at {_frequency_at(parts, first):g} Hz"
        # The motion that skipped ticks missed is made up as fast as the limits permit.
        if np.any(before & FLAGS["blind"]):
            raise InputError(
                f"this PC skipped ticks {at}, and the command that made up for them reached the "
                "rig's limits on velocity or acceleration; identify again, and run `rthyb jitter` "
                "to see what to change on this PC",
                "identify",
            )
        raise InputError(
            f"the rig's limits on velocity or acceleration altered the command {at}; identify with "
            "a smaller amplitude (--amplitude), or up to a lower frequency (--max-frequency)",
            "identify",
        )


def check_read(read: Mask, parts: list[SineRows]) -> None:
    """Raise ``InputError`` if too many readings of a sweep were lost."""
    for part in parts:
        share = float(read[part.fit].mean())
        if share < READ_SHARE:
            raise InputError(
                f"only {100 * share:.0f} % of the samples at {part.frequency_hz:g} Hz had a "
                f"reading; at least {100 * READ_SHARE:g} % must have one; check the link, and "
                "this PC with `rthyb jitter`",
                "identify",
            )


def _frequency_at(parts: list[SineRows], row: int) -> float:
    begun = [part.frequency_hz for part in parts if part.start <= row]
    return begun[-1] if begun else parts[0].frequency_hz


def _broken_off(moved: MotionResult, parts: list[SineRows], rows: int) -> Exception:
    where = f"at {_frequency_at(parts, rows):g} Hz" if rows > parts[0].start else "before it moved"
    if moved.cause in ("operator", "signal", "none"):
        return guided_motion.StoppedError(f"the sweep was stopped {where}; there is no result")
    remedy = "identify with a smaller amplitude (--amplitude), or up to a lower frequency"
    if moved.cause in (*guided_motion.SPOILT, "link_down", "not_finite"):
        remedy = "check the link, and this PC with `rthyb jitter`"
    elif moved.cause == "drive_stopped":
        remedy = "the drive's panel shows why it stopped"
    return guided_motion.ended(moved, f"the sweep ended {where}: {moved.end_reason}; {remedy}")


def _link_delay(moved: MotionResult) -> float | None:
    """Return the mean of the link's delay over all sines, samples."""
    rows = moved.rows
    if not rows["echo"].any():
        return None
    numbers = guided_motion.command_numbers(rows, moved.facts["commands_before"])
    delay = (numbers - rows["echo"].astype(np.int64)) % 256
    motion = delay[guided_motion.fresh(rows) & (rows["state"] == RUNNING)]
    known = motion[motion < 128]
    return float(known.mean()) if known.size else None


def _check_specimen(rig: RigFile, part: SineRows, slowest: Tone, noise_n: float) -> None:
    in_phase = slowest.force_in_phase_n_per_m
    moved = slowest.gain * slowest.amplitude_m
    if abs(in_phase) * moved <= max(CERTAIN * _standard_error(part, noise_n), 1e-9):
        raise InputError(
            f"no force in phase with the displacement at {slowest.frequency_hz:g} Hz "
            f"({in_phase * moved:.3g} N); is a specimen mounted, is the load cell connected, and "
            "is the amplitude large enough?",
            "identify",
        )
    if in_phase < 0:
        raise InputError(
            f"the force falls as the displacement rises ({1e-3 * in_phase:.4g} kN/m at "
            f"{slowest.frequency_hz:g} Hz); {polarity.force_remedy(rig)}; or make sure that a "
            "specimen is mounted",
            "identify",
        )


def _reduced(sweep: SweepPlan) -> list[str]:
    """Return a note if the plan reduces the amplitude of fast sines."""
    usual_m = sweep.amplitude_m
    smaller = [f for f in sweep.frequencies_hz if sweep.amplitude_at(f) < usual_m]
    if not smaller:
        return []
    first, last = smaller[0], smaller[-1]
    return [
        f"from {first:g} Hz the amplitude is less than {usual_m * 1e3:.4g} mm, "
        f"{sweep.amplitude_at(last) * 1e3:.3g} mm at {last:g} Hz, so that no sine is faster "
        f"than {sweep.velocity_m_per_s * 1e3:.4g} mm/s: allow a higher velocity if the actuator "
        "can follow it and noise or friction hides the small motion"
    ]


def _notes(tones: list[Tone], stiffness: float, alpha: float) -> list[str]:
    """Return notes for the user."""
    notes = list[str]()
    worst = max(tones[: max(1, len(tones) // 2)], key=lambda tone: tone.distortion)
    if worst.distortion > STIFFNESS_NONLINEAR:
        notes.append(
            f"{100 * worst.distortion:.0f} % of the force at {worst.frequency_hz:g} Hz is not "
            "sinusoidal: friction, a gap or yielding; k_e is the mean slope at this amplitude"
        )
    lag = abs(tones[0].force_in_quadrature_n_per_m) / stiffness
    if lag > 0.05:
        notes.append(
            f"the load cell measures {100 * lag:.0f} % of k_e in phase with velocity at "
            f"{tones[0].frequency_hz:g} Hz: friction or damping in parallel with the specimen"
        )
    delays = [tone.delay_s for tone in tones]
    if max(delays) - min(delays) > 0.1 * abs(delays[0]) + 0.5 * core.PERIOD_S:
        notes.append(
            f"the delay ranges from {delays[0] * 1e3:.1f} ms at {tones[0].frequency_hz:g} Hz to "
            f"{delays[-1] * 1e3:.1f} ms at {tones[-1].frequency_hz:g} Hz: the actuator is a lag "
            "rather than a delay"
        )
    samples = delays[0] * core.FS_HZ
    if abs(alpha - samples) > 0.1 * samples + 0.5:
        notes.append(
            f"alpha is {delay(alpha, core.FS_HZ)}, although the delay at "
            f"{tones[0].frequency_hz:g} Hz is {delay(samples, core.FS_HZ)}: a phase lead cannot "
            "compensate this actuator"
        )
    return notes
