"""The motion behind a recording, and how sure it is.

Where a command and an actuator model reproduce the measured displacement, the simulated motion is
free of noise and is taken. Else displacement, accelerometer and load cell are joined in the
frequency domain, each weighed by its noise (a Wiener smoother); its remaining error, carried
through the specimen's impedance, gives the noise of the force residual, which need not be white.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core.diagnosis_models import Motion
from rthyb_rt.diagnose import noise
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.policy import POLICY

Complex = NDArray[np.complex128]
Rows = NDArray[np.int64]
Mask = NDArray[np.bool_]
Denoiser = Callable[[Floats], Floats]
"""Takes white noise off a signal of shape (n,), outside the signal's band; `Whitener` makes noise
that has a colour white."""
SHIFT_S = 0.025
GAP_S = 0.4
"""A simulated motion has forgotten a gap of its command after so long."""
EDGE_S = 0.5
"""At either end of a recording the smoother has half its data; such rows are not judged."""
MOVING_EDGE_S = 1.5
"""The same where a recording begins or ends in full motion."""
TURN_ROWS = 20
"""Rows at either end of a quasi-static recording in which a turn would not be seen."""


def white_noise(signal: Floats) -> float:
    """Return the standard deviation of a signal's white noise from its fourth differences."""
    fourth = np.diff(signal, 4)
    fourth = fourth[np.isfinite(fourth)]
    if fourth.size < 16:
        # Of a channel that is read less often than the others, those of its own rows.
        good = signal[np.isfinite(signal)]
        if good.size < 16:
            return float("nan")
        fourth = np.diff(good, 4)
    return float(1.4826 * np.median(np.abs(fourth - np.median(fourth))) / np.sqrt(70.0))


def noise_of(signal: Floats | None, sheet: float | None) -> float:
    """Return the noise of a channel: as measured, held within the data sheet's belief."""
    found = white_noise(signal) if signal is not None else float("nan")
    if sheet is None or not sheet > 0.0:
        scale = float(np.nanstd(signal)) if signal is not None else 1.0
        return found if found > 0.0 else 1e-6 * (scale or 1.0)
    if not np.isfinite(found):
        return sheet
    return float(np.clip(found, sheet / POLICY.noise_held, sheet * POLICY.noise_held))


def step_of(f_meas: Floats | None, f_std: float | None) -> float:
    """Return the step of a coarse load cell, N: few distinct readings, all on one grid; else 0."""
    if f_meas is None or f_std is None:
        return 0.0
    good = np.isfinite(f_meas)
    values = np.unique(f_meas[good])
    if values.size < 3 or values.size > POLICY.coarse_readings * good.sum():
        return 0.0
    steps = np.diff(values)
    lsb = float(np.median(steps[steps < 1.5 * steps.min()]))
    at = values / lsb
    mean = np.mean(np.exp(2j * np.pi * at))
    away = np.abs(np.exp(2j * np.pi * at) - mean / (abs(mean) or 1.0))
    return (
        lsb if lsb >= f_std and np.mean(away < POLICY.coarse_near) >= POLICY.coarse_on_grid else 0.0
    )


def force_noise(f_meas: Floats | None, f_std: float | None) -> float:
    """Return the standard deviation of a load cell's noise, with that of its steps, N."""
    step = step_of(f_meas, f_std)
    if step > 0.0 and f_std is not None:
        return float(np.hypot(f_std, step / np.sqrt(12.0)))
    return noise_of(f_meas, f_std)


def force_sheet(f_meas: Floats | None, f_std: float | None) -> float | None:
    """Return the noise that a data sheet states, with that of the load cell's steps, N."""
    if not f_std:
        return None
    return float(np.hypot(f_std, step_of(f_meas, f_std) / np.sqrt(12.0)))


def filled(signal: Floats) -> Floats:
    """Return a signal with a straight line over its gaps, and a cubic over those of few rows."""
    good = np.isfinite(signal)
    if good.all():
        return signal
    rows = np.arange(signal.size)
    out = np.interp(rows, rows[good], signal[good])
    short = _within_short_gaps(signal)
    if short.any() and good.sum() >= 4:
        out[short] = _cubic(rows[good], signal[good], rows[short])
    return out


def filled_if_short(signal: Floats) -> Floats:
    """Return a signal with a cubic over its gaps of few rows, and the others as they are."""
    return np.where(_within_short_gaps(signal), filled(signal), signal)


def _gaps(signal: Floats) -> Iterable[tuple[int, int]]:
    """Give the first row of each gap and the first one behind it."""
    lost = ~np.isfinite(signal)
    edges = np.flatnonzero(np.diff(np.concatenate(([0], lost.astype(np.int8), [0]))))
    return zip(map(int, edges[::2]), map(int, edges[1::2]), strict=True)


def _within_short_gaps(signal: Floats) -> Mask:
    out = np.zeros(signal.size, dtype=np.bool_)
    for a, b in _gaps(signal):
        if b - a <= POLICY.short_gap and a > 0 and b < signal.size:
            out[a:b] = True
    return out


def _cubic(at: Rows, y: Floats, wanted: Rows) -> Floats:
    """Return values between rows by the cubic through the two neighbours to either side."""
    right = np.clip(np.searchsorted(at, wanted), 2, at.size - 2)
    index = right[:, None] + np.array([-2, -1, 0, 1])
    x, f = at[index].astype(np.float64), y[index]
    out = np.zeros(wanted.size)
    for i in range(4):
        term = f[:, i].copy()
        for j in range(4):
            if i != j:
                term *= (wanted - x[:, j]) / (x[:, i] - x[:, j])
        out += term
    return out


@dataclass(frozen=True)
class Blur:
    """What the estimate of a motion adds to the noise of a force.

    Attributes:
        power: of that at each frequency of the transform, N^2 a row, (m,).
        band: how much of each frequency is judged, 0 to 1, (m,).
        sigma_n: standard deviation of the force channel's own noise where it is white, N.
    """

    power: Floats
    band: Floats
    sigma_n: float


@dataclass(frozen=True)
class Estimate:
    """A motion and the force that the specimen showed along it.

    Attributes:
        motion: x, v, a, each (n,).
        force: the force that a specimen model has to give, (n,), N.
        rows: rows to be judged, (n,).
        whiten: makes the noise of a force residual white with unit variance; linear.
        sigma_n: standard deviation of the force residual's noise where it is white, N.
        share: part of the band that is judged: what a row of whitened noise has for variance.
        exact: whether the motion is simulated, so that it has no noise.
        pieces: whitens pieces of a long residual alone, from their first rows (m,) and their
            length, to (m, length); None where whitening looks at no row but its own.
        scatter: relative standard deviation of the noise's rms over such a recording, where it has
            a colour of its own, fitted to what a set leaves; 0: the noise is white.
        blur: what the estimate of the motion adds to it; None where nobody knows, or it is exact.
    """

    motion: Motion
    force: Floats
    rows: NDArray[np.bool_]
    whiten: Callable[[Floats], Floats]
    sigma_n: float
    exact: bool
    share: float = 1.0
    pieces: Callable[[Floats, Rows, int], Floats] | None = None
    scatter: float = 0.0
    blur: Blur | None = None

    @property
    def coloured(self) -> bool:
        """Whether the noise has a colour of its own."""
        return self.scatter > 0.0


def _extended(signal: Floats, pad: int, odd: bool) -> Floats:
    head, tail = signal[pad:0:-1], signal[-2 : -pad - 2 : -1]
    if odd:
        head, tail = 2.0 * signal[0] - head, 2.0 * signal[-1] - tail
    out = np.concatenate((head, signal, tail))
    # The ends of the extension meet in the transform: both are led to zero without a corner.
    ramp = np.clip(np.arange(pad) / max(0.75 * pad, 1.0), 0.0, 1.0)
    smooth = ramp**4 * (35.0 - 84.0 * ramp + 70.0 * ramp**2 - 20.0 * ramp**3)
    out[:pad] *= smooth
    out[-pad:] *= smooth[::-1]
    return out


def _smooth_spectrum(power: Floats, width: int) -> Floats:
    kernel = np.hanning(2 * width + 3)[1:-1]
    kernel /= kernel.sum()
    return np.convolve(np.pad(power, width, mode="reflect"), kernel, mode="valid")


def _above_noise(spectrum: Complex, rows: int, noise_power: Floats | float) -> Floats:
    """Return the power of a signal where it stands out of its noise, else 0."""
    power = _smooth_spectrum(np.abs(spectrum) ** 2 / rows, 12)
    return np.where(power > POLICY.motion_clear * noise_power, power - noise_power, 0.0)


def _envelope(power: Floats, omega: Floats) -> Floats:
    """Return the least power above the given one that never rises and falls no faster than w^-6.

    A filter that is cut off more sharply rings: an end of the record would be felt seconds away.
    """
    w6 = omega**6
    falling = np.maximum.accumulate(power * w6) / np.maximum(w6, w6[1] if w6.size > 1 else 1.0)
    standing = np.maximum.accumulate(power[::-1])[::-1]
    return np.asarray(np.maximum(falling, standing))


def _smooth_number(value: int) -> bool:
    for factor in (2, 3, 5, 7):
        while value % factor == 0:
            value //= factor
    return value == 1


def fast_length(least: int) -> int:
    """Return the next length whose transform is fast: one of small factors only."""
    while not _smooth_number(least):
        least += 1
    return least


@dataclass(frozen=True)
class _Spectral:
    pad: int
    n: int
    omega: Floats

    @classmethod
    def of(cls, n: int, fs_hz: float) -> _Spectral:
        pad = int(min(n - 2, max(4.0 * fs_hz, 64)))
        # A length of small factors only: the transform of another takes ten times as long.
        while pad > 64 and not _smooth_number(n + 2 * pad):
            pad -= 1
        f_hz = np.asarray(np.fft.rfftfreq(n + 2 * pad, 1.0 / fs_hz), dtype=np.float64)
        return cls(pad, n, 2.0 * np.pi * f_hz)

    def forward(self, signal: Floats, odd: bool = False) -> Complex:
        return np.fft.rfft(_extended(signal, self.pad, odd))

    def back(self, spectrum: Complex) -> Floats:
        return np.fft.irfft(spectrum, self.n + 2 * self.pad)[self.pad : self.pad + self.n]


@dataclass(frozen=True)
class _Knowledge:
    """Of a displacement at each frequency: variance as estimated and as measured (m^2 a row), and
    how much of a signal stood out of the noise there, 0 to 1."""

    variance: Floats
    measured: Floats
    seen: Floats


@dataclass(frozen=True)
class Sensor:
    """A channel of a motion, (n,); its noise: standard deviation, were it white, and colour."""

    signal: Floats
    sigma: float
    colour: noise.Colour | None = None

    def power(self, omega: Floats) -> Floats:
        """Return the power of its noise at frequencies in rad/s, in its unit squared a row."""
        level = np.ones(omega.size) if self.colour is None else self.colour.at(omega / (2 * np.pi))
        return self.sigma**2 * level


def smoothed(
    case: Case, accelerations: list[Sensor], colour: noise.Colour | None = None
) -> tuple[Motion, _Knowledge, _Spectral]:
    """Join displacement and accelerations, each with its noise, into one motion.

    Args:
        case: the recording.
        accelerations: of the specimen.
        colour: of the displacement's noise.

    Returns the motion, how well it is known at each frequency, and the frequencies.
    """
    x_meas = case.channels["x_meas"]
    place = Sensor(filled(x_meas), noise_of(x_meas, case.model.x_std), colour)
    s = _Spectral.of(place.signal.size, case.fs_hz)
    rows = place.signal.size + 2 * s.pad
    # A straight line between the ends carries no frequency: it goes round the transform.
    spectrum = s.forward(place.signal, odd=True)
    w2 = s.omega**2
    own = place.power(s.omega)
    information = 1.0 / own
    joined = spectrum / own
    prior = _above_noise(spectrum, rows, own)
    band = s.omega > 2 * np.pi * POLICY.accelerometer_from_hz
    safe = np.where(band, w2, 1.0)
    for sensor in accelerations:
        other, level = s.forward(filled(sensor.signal), odd=True), sensor.power(s.omega)
        prior = np.maximum(prior, np.where(band, _above_noise(other, rows, level) / safe**2, 0.0))
        joined = joined + np.where(band, -w2 * other / level, 0.0)
        information = information + np.where(band, w2**2 / level, 0.0)
    # Where anything at all was seen to move, for those who weigh residuals by it.
    seen = np.maximum.accumulate(prior[::-1])[::-1]
    seen = seen / (seen + 4.0 / information)
    prior = _envelope(prior, s.omega)
    variance = 1.0 / (information + 1.0 / np.maximum(prior, 1e-12 * place.sigma**2))
    best = joined * variance
    x_hat = s.back(best)
    v_hat = s.back(1j * s.omega * best)
    a_hat = s.back(-w2 * best)
    return Motion(x_hat, v_hat, a_hat), _Knowledge(variance, 1.0 / information, seen), s


def aligned(case: Case, parts: list[Floats], sigma: float) -> Floats:
    """Return the sum of signals that make up the acceleration, each moved onto the time of x_meas.

    Channels may be a fraction of a row apart; the offset of each is what best turns their sum into
    the second derivative of the displacement.
    """
    x = filled(case.channels["x_meas"])
    s = _Spectral.of(x.size, case.fs_hz)
    w = s.omega
    sigma_x = noise_of(x, case.model.x_std)
    wanted = -(w**2) * s.forward(x, odd=True)
    spectra = [s.forward(part, odd=True) for part in parts]
    gap = np.sum(spectra, axis=0) - wanted
    seen = w > 2 * np.pi * POLICY.motion_from_hz
    weight = np.where(seen, 1.0 / np.sqrt(sigma**2 + w**4 * sigma_x**2), 0.0)
    columns = np.column_stack([-1j * w * c * weight for c in spectra])
    gap = gap * weight
    matrix = np.concatenate((columns.real, columns.imag))
    right = np.concatenate((gap.real, gap.imag))
    late, *_ = np.linalg.lstsq(matrix, right, rcond=None)
    late = np.clip(late, -5e-4, 5e-4)
    return np.asarray(
        np.sum(
            [
                part + tau * np.gradient(part) * case.fs_hz
                for part, tau in zip(parts, late, strict=True)
            ],
            axis=0,
        )
    )


def band_of(signal: Floats, fs_hz: float, sigma: float) -> Denoiser:
    """Return the filter (Wiener's) that takes white noise off a signal of shape (n,)."""
    s = _Spectral.of(signal.size, fs_hz)
    spectrum = s.forward(signal, odd=True)
    power = _envelope(_above_noise(spectrum, signal.size + 2 * s.pad, sigma**2), s.omega)
    gain = power / (power + sigma**2)
    return lambda other: s.back(gain * s.forward(other, odd=True))


def quiet(signal: Floats, fs_hz: float, sigma: float) -> Floats:
    """Return a signal without the noise outside its band, (n,)."""
    return band_of(signal, fs_hz, sigma)(signal)


def low_passed(signal: Floats, fs_hz: float, cut_hz: float) -> Floats:
    """Return a signal up to a frequency, (n,); an eighth-order roll-off, which delays nothing."""
    s = _Spectral.of(signal.size, fs_hz)
    gain = 1.0 / (1.0 + (s.omega / (2.0 * np.pi * cut_hz)) ** 8)
    return s.back(gain * s.forward(signal, odd=True))


def _edges(rows: NDArray[np.bool_], fs_hz: float, x: Floats) -> NDArray[np.bool_]:
    out = rows.copy()
    head = max(int(0.1 * fs_hz), 2)
    loud = 0.02 * float(np.max(np.abs(x - np.median(x))))
    for at, span in ((0, slice(None, head)), (-1, slice(-head, None))):
        rest = float(np.max(np.abs(x[span] - x[at]))) < loud
        cut = int(min((EDGE_S if rest else MOVING_EDGE_S) * fs_hz, rows.size / 12))
        if cut:
            out[slice(None, cut) if at == 0 else slice(-cut, None)] = False
    return out


def _impedance(case: Case, omega: Floats, mass: float) -> Floats:
    m = case.model
    return np.abs(m.k - mass * omega**2 + 1j * m.c * omega)


def _coloured(s: _Spectral, power: Floats, band: Floats) -> Callable[[Floats], Floats]:
    gain = band / np.sqrt(power)

    def whiten(signal: Floats) -> Floats:
        return s.back(gain * s.forward(signal))

    return whiten


MARGIN = 512
"""Rows to either side of a piece that are whitened with it: a filter's memory."""


def _in_pieces(
    s: _Spectral, power: Floats, band: Floats, fs_hz: float
) -> Callable[[Floats, Rows, int], Floats]:
    """Return the same filter for pieces of a recording."""
    gain = band / np.sqrt(power)

    def whiten(signal: Floats, first: Rows, length: int) -> Floats:
        size = length + 2 * MARGIN
        rows = first[:, None] - MARGIN + np.arange(size)
        ramp = np.ones(size)
        ramp[: MARGIN // 2] = np.sin(np.linspace(0.0, np.pi / 2, MARGIN // 2)) ** 2
        ramp[-(MARGIN // 2) :] = ramp[: MARGIN // 2][::-1]
        omega = 2.0 * np.pi * np.fft.rfftfreq(size, 1.0 / fs_hz)
        part = np.fft.rfft(ramp * signal[np.clip(rows, 0, signal.size - 1)], axis=1)
        clean = np.fft.irfft(part * np.interp(omega, s.omega, gain), size, axis=1)
        return np.asarray(clean[:, MARGIN:-MARGIN])

    return whiten


@dataclass(frozen=True)
class Whitener:
    """What makes the noise of a channel white with unit variance.

    Attributes:
        whiten: all of a signal, (n,) to (n,); linear.
        pieces: stretches of it, see `Estimate`.
        scatter: relative standard deviation of the noise's rms over such a recording.
    """

    whiten: Callable[[Floats], Floats]
    pieces: Callable[[Floats, Rows, int], Floats]
    scatter: float


def likelihood(
    residual: Floats,
    rows: NDArray[np.bool_],
    velocity: Floats,
    fs_hz: float,
    sigma: float,
    sheet: float | None,
    blur: Blur | None = None,
    lines: noise.Lines | None = None,
) -> tuple[float, Whitener | None]:
    """Return -2 ln of the likelihood of what a set of effects leaves, in noise of its colour.

    Up to a constant, with the price of the colour's numbers. The noise is as large as fits best
    within the data sheet. None instead of a filter where the noise is white.

    Args:
        residual: what is left of a channel, (n,), in its unit.
        rows: which of them count, (n,).
        velocity: of the motion, (n,), m/s.
        fs_hz: rows per second.
        sigma: standard deviation of the noise were it white, in the channel's unit.
        sheet: the same as the data sheet states it.
        blur: what the estimate of the motion adds to that noise, whatever its colour.
        lines: of these rows, where they are known.
    """
    stated = sheet / sigma if sheet else 1.0
    lines = lines or noise.Lines(rows, fs_hz)
    power = lines.power(residual / sigma) if sheet else None
    colours = (
        noise.colour_of(lines, power, velocity, sheet and stated),
        noise.red_of(lines, power, sheet and stated),
    )
    found = [_in_colour(c, residual, rows, fs_hz, sigma, blur) for c in colours if c is not None]
    # Where its colour is seen beside the motion, white it is not.
    if colours[0] is None:
        found.append(
            _in_white(residual[rows] / sigma, stated)
            if blur is None
            else _in_colour(None, residual, rows, fs_hz, sigma, blur)
        )
    return min(found, key=lambda f: f[0])


def _in_white(white: Floats, stated: float) -> tuple[float, None]:
    """Return -2 ln of the likelihood in white noise as large as fits best within the sheet."""
    size = float(np.sqrt(np.mean(white**2)))
    level = float(np.clip(size, stated / POLICY.sheet_factor, stated * POLICY.sheet_factor))
    return float(white @ white) / level**2 + 2.0 * white.size * float(np.log(level)), None


def _in_colour(
    colour: noise.Colour | None,
    residual: Floats,
    rows: NDArray[np.bool_],
    fs_hz: float,
    sigma: float,
    blur: Blur | None,
) -> tuple[float, Whitener | None]:
    """Return the same in noise of one colour and the blur, with what makes that white."""
    count = int(rows.sum())
    s = _Spectral.of(residual.size, fs_hz)
    power = np.ones(s.omega.size) if colour is None else colour.at(s.omega / (2.0 * np.pi))
    band = np.ones(power.size) if blur is None else blur.band
    if blur is not None:
        power = power + blur.power / sigma**2
    cost = count * float(np.mean(band**2 * np.log(power)))
    power = sigma**2 * power
    made = Whitener(
        _coloured(s, power, band),
        _in_pieces(s, power, band, fs_hz),
        0.0 if colour is None else colour.scatter(count, fs_hz),
    )
    own = made.whiten(residual)[rows]
    cost += float(own @ own)
    if colour is None:
        return cost, None
    return cost + colour.count * float(np.log(count)), made


def likeliest(
    tried: Iterable[tuple[Floats, Floats, float]],
    rows: NDArray[np.bool_],
    fs_hz: float,
    sigma: float,
    sheet: float | None,
    blur: Blur | None = None,
) -> Whitener | None:
    """Return the filter for the noise that the likeliest of some sets leaves; None: it is white.

    Of those sets that leave no more than the data sheet allows, if any does: slow noise of any size
    would explain what a drift leaves out, at frequencies where no line of a spectrum shows it.

    Args:
        tried: of each set what it leaves of a channel, (n,), in its unit; the velocity of its
            motion, (n,), m/s; and its price.
        rows, fs_hz, sigma, sheet, blur: see `likelihood`.
    """
    lines = noise.Lines(rows, fs_hz)
    told: list[tuple[bool, float, Whitener | None]] = []
    for left, velocity, price in tried:
        cost, own = likelihood(left, rows, velocity, fs_hz, sigma, sheet, blur, lines)
        # What the estimate of the motion adds has no sheet.
        bounded = bool(sheet) and blur is None
        scatter = own.scatter if own is not None else 0.0
        beyond = bounded and not within_sheet(left[rows], sheet or 0.0, scatter)
        told.append((beyond, cost + price, own))
    return min(told, key=lambda t: t[:2])[2]


def within_sheet(rest: Floats, sheet: float, scatter: float) -> bool:
    """Return whether what is left of a channel, (n,), is as small as its data sheet allows.

    The rms of one recording of slow noise has a relative ``scatter`` about what the sheet states.
    """
    return float(np.sqrt(np.mean(rest**2))) < POLICY.sheet_factor * sheet * (1.0 + scatter)


def away_from_gaps(
    signal: Floats, fs_hz: float, before_s: float, after_s: float, bridged: bool = False
) -> NDArray[np.bool_]:
    """Return the rows that a missing stretch of a signal does not reach, (n,).

    Of one that is ``bridged`` a gap of few rows, over which `filled` is as good as its neighbours,
    reaches only as far as it is long.
    """
    out = np.ones(signal.size, dtype=np.bool_)
    for a, b in _gaps(signal):
        before, after = int(before_s * fs_hz), int(after_s * fs_hz)
        if bridged and b - a <= POLICY.short_gap:
            before, after = min(before, b - a), min(after, b - a)
        out[max(0, a - before) : b + after] = False
    return out


def at_its_time(force: Floats, sigma: float, fs_hz: float) -> Mask:
    """Return the rows in which a force is known though its channel is a little early or late, (n,).

    A normal offset in time stands in the problem as a straight line over the force's rate, and that
    rate is a difference of rows. At the corner of a stiff drive's command a mass makes a peak two
    or three rows wide: there neither holds, by many times the noise.

    Args:
        force: as the model has it along a motion without noise, (n,), N.
        sigma: standard deviation of the noise of a row, N.
        fs_hz: rows per second.
    """
    late = 2.0 * POLICY.offset_prior_s * fs_hz
    bent = np.zeros(force.size)
    bent[1:-1] = 0.5 * late**2 * np.abs(np.diff(force, 2))
    # Of the central difference the first term that is left out.
    third = late / 6.0 * np.abs(np.diff(force, 3))
    bent[1:-2] = np.maximum(bent[1:-2], third)
    bent[2:-1] = np.maximum(bent[2:-1], third)
    return np.asarray(bent < POLICY.abrupt_model * sigma)


def along(case: Case, motion: Motion, exact_from: int) -> Estimate | None:
    """Return the estimate for a simulated motion, judged from row ``exact_from`` on."""
    f_meas = case.get("f_meas")
    if f_meas is None:
        return None
    sigma = force_noise(f_meas, case.model.f_std)
    rows = case.rows & np.isfinite(f_meas)
    rows = rows.copy()
    rows[:exact_from] = False
    if "x_cmd" in case.channels:
        rows &= away_from_gaps(case.channels["x_cmd"], case.fs_hz, 0.01, GAP_S)
    # A force moved in time has no rows beyond the ends.
    ends = int(min(SHIFT_S * case.fs_hz, rows.size / 50))
    if ends:
        rows[:ends] = rows[-ends:] = False
    sure = rows & at_its_time(case.model.force(motion.x, motion.v, motion.a), sigma, case.fs_hz)
    if sure.sum() > POLICY.abrupt_rows * rows.sum():
        rows = sure
    return Estimate(motion, filled(f_meas), rows, lambda y: y / sigma, sigma, True)


def _in_colour_each(
    case: Case, accelerations: list[Sensor]
) -> tuple[list[Sensor], noise.Colour | None]:
    """Return the accelerations, and the displacement's colour, each with that of its noise."""
    from rthyb_rt.diagnose.moving import sensor_colour

    x_meas, model = case.channels["x_meas"], case.model
    forces = ("f_in",) if model.family == "forced" else ("f_meas", "x_cmd")
    beside = [filled(case.channels[n]) for n in forces if n in case.channels]
    x, sigma = filled(x_meas), noise_of(x_meas, model.x_std)
    felt = [a.signal for a in accelerations]
    colour = sensor_colour(x, [*felt, *beside], case.fs_hz, sigma, model.x_std)
    heard = [
        replace(a, colour=sensor_colour(a.signal, [x, *beside], case.fs_hz, a.sigma, model.a_std))
        for a in accelerations
    ]
    return heard, colour


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
        # On moving ground an accelerometer feels the ground as well.
        parts = [filled(a_meas), -filled(ag)] if ground and ag is not None else [filled(a_meas)]
        sigma = noise_of(a_meas, model.a_std)
        accelerations.append(Sensor(aligned(case, parts, sigma), sigma))
    accelerations, colour = _in_colour_each(case, accelerations)
    motion, known, s = smoothed(case, accelerations, colour)
    mass = model.moving_mass
    rows = case.rows & away_from_gaps(channels["x_meas"], case.fs_hz, 0.1, 0.1, bridged=True)
    for name in ("a_meas", "ag"):
        if name in channels:
            rows = rows & away_from_gaps(channels[name], case.fs_hz, 0.1, 0.1, bridged=True)
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
        # Near resonance a small force moves much: nothing is known better than a few parts in 1000.
        sigma = max(sigma, POLICY.force_accuracy * float(np.sqrt(np.mean(force[rows] ** 2))))
    z2 = _impedance(case, s.omega, mass) ** 2
    power = sigma**2 + z2 * known.variance
    # Where displacement is nothing but noise, force laws evaluated on it are: no band to judge in.
    band = np.maximum(sigma**2 / (sigma**2 + z2 * known.measured), known.seen)
    rows = _edges(rows, case.fs_hz, filled(channels["x_meas"]))
    share = float(np.mean(band**2))
    measured = model.family == "forced" or f_meas is not None
    return Estimate(
        motion, force, rows, _coloured(s, power, band), sigma, False, max(share, 1e-3),
        _in_pieces(s, power, band, case.fs_hz),
        blur=Blur(power - channel**2, band, channel) if measured else None,
    )  # fmt: skip


def quasi_static(case: Case) -> bool:
    """Return whether time is nominal: no rate in the model and rows too far apart to have one."""
    m = case.model
    rateless = m.family == "drive" and m.c == 0 and m.moving_mass == 0
    return rateless and m.fs_hz <= POLICY.static_hz


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
    """Return a rate with one value for each stroke that is straight within its noise, and where.

    A rate with noise would favour laws that bend least over it.
    """
    sigma = white_noise(x)
    out, straight = v.copy(), np.zeros(x.size, dtype=np.bool_)
    turns = np.flatnonzero(np.diff(np.sign(v)) != 0)
    for first, last in pairwise([0, *(turns + 1), x.size]):
        # The turn itself lies somewhere about the change of sign; one near an end is not seen.
        part = x[first + (5 if first else TURN_ROWS) : last - (5 if last < x.size else TURN_ROWS)]
        if part.size < 24:
            continue
        at = np.arange(part.size) - 0.5 * (part.size - 1)
        slope = float(part @ at / (at @ at))
        rest = part - part.mean() - slope * at
        # Straight: no more than its noise, neither on the whole nor bent over a third of it.
        thirds = [float(np.mean(p)) for p in np.array_split(rest, 3)]
        bent = POLICY.stroke_bent * sigma * np.sqrt(3.0 / part.size)
        if np.std(rest) < POLICY.stroke_straight * sigma and max(map(abs, thirds)) < bent:
            rests = abs(slope) < POLICY.stroke_rests * sigma / np.sqrt(at @ at)
            out[first:last] = 0.0 if rests else slope * fs_hz
            straight[first:last] = True
    return out, straight


def _plainly_moving(x: Floats, v: Floats, sigma: float) -> NDArray[np.bool_]:
    """Return the rows whose neighbours are farther apart than noise makes them, the way of v.

    There the direction is not in doubt, however near a turn is: of a coarse recording of cycles the
    rows around the turns are those that show what the specimen bears.
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
            # A slow sweep or random motion bends within any span that averages its noise.
            v = smoothed(case, [])[0].v
        # In which row exactly it turns is not known: those are not judged.
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
        Motion(x, v, np.zeros_like(x)), filled(f_meas), rows, lambda y: y / sigma, sigma, False
    )
