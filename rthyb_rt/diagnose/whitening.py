"""Noise of the force residual: its likelihood, and the filter that makes it white.

It has two parts: that of the load cell, within its data sheet, and what the error of an estimated
motion contributes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import noise
from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.gaps import Rows
from rthyb_rt.diagnose.moving import gain2
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.spectral import Spectrum, filter_of_pieces, whitening_filter


@dataclass(frozen=True)
class Blur:
    """The contribution of the estimated motion to the noise of a force.

    Attributes:
        power: its power at each frequency of the transform, N^2 per row, (m,).
        accuracy: part of it that is the limited accuracy of a model near resonance, N^2 per row.
        band: weight of each frequency in the evaluation, 0 to 1, (m,).
        seen: fraction of the motion above its noise, 0 to 1; 1 at a hum of the load cell, (m,).
        sigma_n: standard deviation of the force channel's own noise where it is white, N.
        omega: those frequencies, rad/s, (m,).
        error: a possible error of the estimated motion, drawn from it, each (n,).
        direct: what that error does to the model's force, (n,), N.
        more: what a set of effects adds to the power, N^2 per row, (m,).
    """

    power: Floats
    accuracy: float
    band: Floats
    seen: Floats
    sigma_n: float
    omega: Floats
    error: ComputedMotion
    direct: Floats
    more: Floats | float = 0.0

    @property
    def rms(self) -> float:
        """Standard deviation of the contribution to a force, N, without the model's accuracy."""
        return float(np.sqrt(np.mean(np.maximum(self.power - self.accuracy + self.more, 0.0))))

    def behind(self, changes: Iterable[Floats], fs_hz: float) -> list[Blur]:
        """Return the contribution for each of some sets of effects that are added to the model.

        A missing mass that is as large as the stated one doubles what an error of the acceleration
        does to the force.

        Args:
            changes: by how much the force of each set changes with the error, (n,), N.
            fs_hz: rows per second.
        """
        if not self.direct.any():
            return [self for _ in changes]
        before = gain2(self.error.x, self.direct, fs_hz, self.omega)
        return [self._behind(change, before, fs_hz) for change in changes]

    def _behind(self, change: Floats, before: Floats, fs_hz: float) -> Blur:
        if not np.isfinite(change).all():
            return self
        # Of a law that diverges it is not finite.
        with np.errstate(over="ignore", invalid="ignore"):
            now = gain2(self.error.x, self.direct + change, fs_hz, self.omega)
            through = self.power - self.accuracy
            more = through * (now / np.maximum(before, 1e-300) - 1.0)
        # Less than the scatter of the noise itself cannot be seen.
        whole = self.sigma_n**2 + self.power
        visible = np.abs(more) * self.band**2 > np.sqrt(2.0 / change.size) * whole
        return replace(self, more=more) if np.isfinite(more).all() and visible.any() else self


@dataclass(frozen=True)
class Whitener:
    """Whitens the noise of a channel to unit variance.

    Attributes:
        whiten: an entire signal, (n,) to (n,); linear.
        pieces: parts of it, see `estimate.Estimate`.
        scatter: relative standard deviation of the noise's rms over such a recording.
        share: fraction of the band that is evaluated, see `estimate.Estimate`.
    """

    whiten: Callable[[Floats], Floats]
    pieces: Callable[[Floats, Rows, int], Floats]
    scatter: float
    share: float


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
    """Return -2 ln of the likelihood of a set's residual, for noise with its colour.

    Up to a constant, including the price of the colour's parameters. The noise level is the best
    fit within the data sheet. The filter is None if the noise is white and the motion exact.

    Args:
        residual: residual of a channel, (n,), in its unit.
        rows: which of them count, (n,).
        velocity: of the motion, (n,), m/s.
        fs_hz: rows per second.
        sigma: standard deviation of the noise if white, in the channel's unit.
        sheet: the same according to the data sheet.
        blur: contribution of the estimated motion to that noise, whatever its colour.
        lines: of these rows, if already known.
    """
    stated = sheet / sigma if sheet else 1.0
    lines = lines or noise.Lines(rows, fs_hz)
    power = lines.power(residual / sigma) if sheet else None
    colours = (
        noise.colour_of(lines, power, velocity, sheet and stated),
        noise.red_of(lines, power, sheet and stated),
    )
    found = [_in_colour(c, residual, rows, fs_hz, sigma, blur) for c in colours if c is not None]
    # If its colour can be seen beside the motion, it is not white.
    if colours[0] is None:
        found.append(
            _in_white(residual[rows] / sigma, stated)
            if blur is None
            else _in_colour(None, residual, rows, fs_hz, sigma, blur)
        )
    return min(found, key=lambda f: f[0])


def _in_white(white: Floats, stated: float) -> tuple[float, None]:
    """Return -2 ln of the likelihood for white noise with the best level within the sheet."""
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
    """Return the same for noise of one colour and the blur, with its whitening filter."""
    count = int(rows.sum())
    s = Spectrum.of(residual.size, fs_hz)
    power = np.ones(s.omega.size) if colour is None else colour.at(s.omega / (2.0 * np.pi))
    band = np.ones(power.size) if blur is None else blur.band
    if blur is not None:
        power = power + (blur.power + blur.more) / sigma**2
    cost = count * float(np.mean(band**2 * np.log(power)))
    power = sigma**2 * power
    changed = blur is not None and bool(np.any(blur.more))
    scatter = np.sqrt(0.5 / count) if changed else 0.0
    if colour is not None:
        scatter = colour.scatter(count, fs_hz)
    made = Whitener(
        whitening_filter(s, power, band),
        filter_of_pieces(s, power, band, fs_hz),
        scatter,
        max(float(np.mean(band**2)), 1e-3),
    )
    own = made.whiten(residual)[rows]
    cost += float(own @ own)
    if colour is None:
        return cost, made
    return cost + colour.count * float(np.log(count)), made


def _in_one_band(blurs: list[Blur]) -> list[Blur]:
    """Return the contributions, weighted alike: where no motion was seen, by the largest of them.

    There a law has only the noise of the sensors to act on, and a set would be preferred for
    passing less of it.
    """
    first = blurs[0]
    most = np.max([b.power + b.more - b.accuracy for b in blurs], axis=0)
    floor = first.sigma_n**2 + first.accuracy
    band = np.maximum(np.minimum(first.band, floor / (floor + most)), first.seen)
    return [replace(b, band=band) for b in blurs]


def likeliest(
    tried: Sequence[tuple[Floats, Floats, float]],
    rows: NDArray[np.bool_],
    fs_hz: float,
    sigma: float,
    sheet: float | None,
    blurs: list[Blur] | None = None,
) -> Whitener | None:
    """Return the filter for the noise of the likeliest of some sets; None: it is as assumed.

    Of those sets whose residual is within the data sheet, if any: slow noise of arbitrary size
    would explain what a drift leaves, at frequencies where no spectral line shows it.

    Args:
        tried: for each set, its residual in a channel, (n,), in its unit; the velocity of its
            motion, (n,), m/s; and its price.
        rows, fs_hz, sigma, sheet: see `likelihood`.
        blurs: for each set, the contribution of the estimated motion; None: the motion is exact.
    """
    lines = noise.Lines(rows, fs_hz)
    behind: Sequence[Blur | None] = _in_one_band(blurs) if blurs else [None] * len(tried)
    candidates: list[tuple[bool, float, Whitener | None]] = []
    for (left, velocity, price), blur in zip(tried, behind, strict=True):
        cost, own = likelihood(left, rows, velocity, fs_hz, sigma, sheet, blur, lines)
        # No data sheet covers the contribution of the estimated motion.
        bounded = bool(sheet) and blur is None
        scatter = own.scatter if own is not None else 0.0
        beyond = bounded and not within_sheet(left[rows], sheet or 0.0, scatter)
        candidates.append((beyond, cost + price, own if scatter > 0.0 else None))
    return min(candidates, key=lambda t: t[:2])[2]


def within_sheet(rest: Floats, sheet: float, scatter: float) -> bool:
    """Return whether a channel's residual, (n,), with its mean, is as small as the sheet permits.

    The rms of one recording of slow noise has a relative ``scatter`` about the data sheet value.
    """
    return float(np.sqrt(np.mean(rest**2))) < POLICY.sheet_factor * sheet * (1.0 + scatter)
