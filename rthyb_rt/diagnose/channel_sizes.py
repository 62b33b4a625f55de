"""Sizes of channels compared with the others and the model, to find units and unit errors.

A wrong unit preserves the shape of a signal and changes its size, by 1000, 9.81 or similar. Missing
physics changes both, and seldom the size by much: a specimen may be 30 times softer than its model
(because it yielded, or a play never closes), and is then diagnosed. `Policy.wrong_unit` is as far
above this factor as it is below a factor of 1000 with a model that is wrong by ten.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import SimulationError, actuator
from rthyb_rt.diagnose import channel_signs
from rthyb_rt.diagnose.case import CHANNELS, Floats, Model
from rthyb_rt.diagnose.column_units import USUAL, read_unit
from rthyb_rt.diagnose.estimate import nominal_time
from rthyb_rt.diagnose.gaps import filled
from rthyb_rt.diagnose.noise_level import white_noise
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.errors import InputError

Channels = dict[str, Floats]

LEAST = 64
"""Number of rows for determining a size; of more than twice as many, half must be present."""

PARTS = 8
"""Number of parts of the band, of equal width, of which the quietest shows the noise: of the fewest
rows, each has four lines."""

_FACTORS: tuple[tuple[float, str], ...] = (
    (1000.0, "1000 (milli or kilo)"),
    (9.81, "9.81 (g or kgf)"),
    (9810.0, "9810 (kN and kgf)"),
)
_SAID = {
    "x_cmd": "x_num", "x_meas": "x_cmd", "f_meas": "the model's force", "f_in": "the model",
    "ag": "the model", "x_num": "the model", "a_meas": "the other channels", "fy_meas": "f_meas",
}  # fmt: skip


_GAINED = "the energy that the body gains"


@dataclass(frozen=True)
class Relation:
    """A channel's size relative to its expected size.

    Attributes:
        channel: its name.
        ratio: found over expected; negative if the sign is opposite.
        alike: correlation of the two, 0 to 1.
        of: the channels from which the expectation is computed.
        bound: the expectation is an upper bound: a ratio below one is no evidence.
        exact: a size within `unit_near` of a conversion factor between units is evidence of it.
        than: description of the reference, if it is not the usual one.
    """

    channel: str
    ratio: float
    alike: float
    of: tuple[str, ...]
    bound: bool = False
    exact: bool = False
    than: str = ""


def check(
    channels: Channels, model: Model, where: str, labels: dict[str, str] | None,
    stated: dict[str, str] | None = None, turned: Collection[str] = (), second: bool = False,
) -> None:  # fmt: skip
    """Reject channels whose size is wrong by a conversion factor, or whose sign is wrong.

    Args:
        channels: each (n,), SI as far as is known.
        model: model with which they are compared.
        where: the file, for the message.
        labels: column of each channel in an external table; None for a recording of this program.
        stated: unit of each channel whose unit the file or the user states: a factor of 9.81 is
            then accepted.
        turned: channels that the user has inverted already.
        second: whether it is a second recording, with the columns of the first.

    Raises:
        InputError: with the ratio found, the likely unit and the option that corrects it.
    """
    for r in relations(channels, model):
        size = abs(r.ratio)
        if not math.isfinite(size) or size == 0.0:
            continue
        factors = _FACTORS if r.channel not in (stated or {}) else _FACTORS[:1]
        said = next(
            (
                words
                for factor, words in factors
                for f in (factor, 1.0 / factor)
                if _converted(r, factor) and abs(r.ratio / f - 1.0) < POLICY.unit_near
            ),
            "",
        )
        if said or _far(r):
            raise InputError(_message(r, said, model, labels), where)
        if abs(r.ratio + 1.0) < POLICY.unit_near and _opposed(r, channels, model):
            text = (
                f"{r.channel} has the opposite sign to {r.than or _SAID[r.channel]} (ratio "
                f"{r.ratio:.4g}): probably a wrong sign; a command, the displacement and the force "
                "that resists it must be positive in the same direction; "
            )
            raise InputError(text + _inverted(r.channel, labels, stated, turned, second), where)
    wrong = channel_signs.fault(channels, model)
    if wrong is not None:
        way = _inverted(wrong.channel, labels, stated, turned, second)
        raise InputError(f"{wrong.seen}; {way}; {wrong.otherwise}", where)


def _converted(r: Relation, factor: float) -> bool:
    """Return whether a ratio that equals a conversion factor is evidence of a wrong unit.

    A specimen that yields may be softer than its model by any factor up to `wrong_unit`, but then
    its force no longer has the shape of the model's; a unit preserves it.
    """
    return r.exact and (factor > POLICY.wrong_unit or r.alike > POLICY.shape_clearly)


def _far(r: Relation) -> bool:
    """Return whether a channel's size is too far off for a model error.

    If its shape only resembles the model's (a play that is hardly closed), its unit is wrong only
    if the ratio is near a power of 1000.
    """
    size = abs(r.ratio)
    if r.bound:
        return size > POLICY.wrong_unit
    power = math.log(size, 1000.0)
    near = abs(power - round(power)) < math.log(POLICY.unit_near_1000, 1000.0)
    alike = r.alike > (POLICY.shape_alike if near else POLICY.shape_clearly)
    return alike and not 1.0 / POLICY.wrong_unit <= size <= POLICY.wrong_unit


def _clear(r: Relation) -> bool:
    return r.alike > POLICY.shape_clearly and r.ratio != 0.0


def likely(channel: str, ratio: float) -> str:
    """Return the unit of a column whose values are too large by this factor in SI."""
    units = USUAL[CHANNELS[channel]]
    off = [abs(math.log(ratio * _factor(unit))) for unit in units]
    best = units[int(np.argmin(off))]
    return best if min(off) < math.log(POLICY.unit_guessed) else ""


def _factor(unit: str) -> float:
    found = read_unit(unit)
    assert found is not None
    return float(found.factor)


def _mend(channel: str, unit: str, labels: dict[str, str]) -> str:
    return f'--map {channel}="{labels.get(channel, channel)} [{unit}]"'


def _message(r: Relation, said: str, model: Model, labels: dict[str, str] | None) -> str:
    size = "large" if abs(r.ratio) > 1 else "small"
    times = said or f"{max(abs(r.ratio), 1 / abs(r.ratio)):.4g}"
    text = (
        f"{r.channel} is {times} times too {size} for {r.than or _SAID[r.channel]} "
        f"(ratio {r.ratio:.4g}): probably a wrong unit; channels are in SI units, {r.channel} in "
        f"{CHANNELS[r.channel]}"
    )
    if labels is None:
        return f"{text}: correct the model"
    ways = []
    unit = likely(r.channel, abs(r.ratio))
    if r.channel == "fy_meas" or r.than == _GAINED:
        # No law gives the size more accurately.
        unit = "kN" if abs(r.ratio) < 1.0 and CHANNELS[r.channel] == "N" else ""
    if unit and unit != CHANNELS[r.channel]:
        ways.append(f"if the column is in {unit}, give {_mend(r.channel, unit, labels)}")
    for other in r.of:
        # An error in one channel also appears as its inverse in the reference.
        unit = likely(other, 1.0 / abs(r.ratio))
        same = CHANNELS[other] == CHANNELS[r.channel] or other.startswith("x_")
        if unit and same and unit != CHANNELS[other]:
            ways.append(f"if {other} is in {unit}, give {_mend(other, unit, labels)}")
    return f"{text}; {'; '.join([*ways, 'otherwise convert the column, or correct the model'])}"


def _inverted(
    channel: str, labels: dict[str, str] | None, stated: dict[str, str] | None,
    turned: Collection[str], second: bool,
) -> str:  # fmt: skip
    """Return how to invert a channel."""
    if labels is None:
        return f"correct the sign of {channel} in the rig file of the test, or the model"
    if second:
        return "invert the column in this file, because --map applies to both recordings"
    unit = (stated or {}).get(channel)
    label = labels.get(channel, channel) + (f" [{unit}]" if unit else "")
    return f'give --map {channel}="{"" if channel in turned else "-"}{label}"'


def _opposed(r: Relation, channels: Channels, model: Model) -> bool:
    """Return whether a channel equals the other with opposite sign.

    A force may oppose the displacement above resonance, where mass dominates over the spring. The
    ground is compared with what a balance of forces leaves for it.
    """
    if r.channel == "x_meas":
        return True
    if r.channel == "ag" and "x_num" in r.of:
        return r.alike > POLICY.shape_balanced
    if r.channel != "f_meas" or not model.k or "x_meas" not in channels:
        return False
    x, f = filled(channels["x_meas"]), filled(channels["f_meas"])
    if np.corrcoef(f, model.spring(x))[0, 1] > -POLICY.shape_simulated:
        return False
    return channel_signs.below_resonance(x, model)


def check_against(first: Channels, second: Channels, where: str, labels: dict[str, str]) -> None:
    """Reject an input of a second recording whose size is unrelated to that of the first.

    The result of one test does not apply to a test that is `other_test` times smaller, below the
    noise of the first, or as many times larger.

    Raises:
        InputError: with the likely unit and the option that corrects it.
    """
    for name in set(first) & set(second):
        a, b = (float(np.nanstd(_finite(channels[name]))) for channels in (first, second))
        if a <= 0.0 or b <= 0.0 or 1.0 / POLICY.other_test < b / a < POLICY.other_test:
            continue
        unit = likely(name, b / a)
        way = f"give {_mend(name, unit, labels)}, or " if unit and unit != CHANNELS[name] else ""
        raise InputError(
            f"{name} is {max(b / a, a / b):.4g} times too {'large' if b > a else 'small'} for "
            f"the recording from which the answer was derived: probably a wrong unit; {name} "
            f"must be in {CHANNELS[name]}; {way}convert the column",
            where,
        )


def _finite(values: Floats) -> Floats:
    good = values[np.isfinite(values)]
    return good if good.size else np.zeros(1)


# ---- unstated units -----------------------------------------------------------------------------


def guess(
    channel: str, values: Floats, known: Channels, model: Model
) -> tuple[str, Relation] | None:
    """Return the one usual unit in which a column is consistent with the known channels.

    None if no unit, or more than one, is consistent.
    """
    found = []
    # Compared with the known channels, which must not be judged by it.
    for r in relations({**known, channel: values}, model):
        if r.channel != channel and channel in r.of and len(r.of) == 1 and not r.bound:
            r = Relation(channel, 1.0 / r.ratio if r.ratio else 0.0, r.alike, (r.channel,))
        if r.channel == channel and not r.bound and _clear(r):
            fitting = [
                unit
                for unit in USUAL[CHANNELS[channel]]
                if 1.0 / POLICY.unit_sure < abs(r.ratio) * _factor(unit) < POLICY.unit_sure
            ]
            found.append((fitting, r))
    if not found:
        return None
    units = set.intersection(*(set(fitting) for fitting, _ in found))
    return (units.pop(), found[0][1]) if len(units) == 1 else None


# ---- expected size of each channel --------------------------------------------------------------


def relations(channels: Channels, model: Model) -> Iterator[Relation]:
    """Yield channels with their size relative to that expected from the others and the model."""
    c = {k: v for k, v in channels.items() if np.isfinite(v).sum() >= max(LEAST, v.size / 2)}
    found = [
        *_displacements(c, model),
        *_force(c, model),
        *_accelerations(c, model),
        *_inputs(c, model),
        *_orthogonal(c, model),
    ]
    yield from found
    referenced = [r for r in found if r.alike > POLICY.shape_alike and not r.bound]
    yield from _noises(c, model, {name for r in referenced for name in (r.channel, *r.of)})


def _displacements(c: Channels, model: Model) -> Iterator[Relation]:
    if "x_num" in c and "x_cmd" in c:
        yield _relation("x_cmd", filled(c["x_cmd"]), filled(c["x_num"]), ("x_num",))
    if "x_meas" in c and "x_cmd" in c:
        u = _moved(filled(c["x_cmd"]), model)
        yield _relation("x_meas", filled(c["x_meas"]), u, ("x_cmd",), exact=True)


def _moved(command: Floats, model: Model) -> Floats:
    """Return the motion of the model's actuator along a command."""
    if model.actuator is None:
        return command
    try:
        return actuator(model.actuator, command, model.fs_hz).x
    except SimulationError as error:
        raise InputError(f"{error}", where="actuator") from error


def _force(c: Channels, model: Model) -> Iterator[Relation]:
    if "f_meas" not in c:
        return
    f = filled(c["f_meas"])
    name = "x_meas" if "x_meas" in c else "x_cmd"
    if name in c:
        x = filled(c[name]) if name == "x_meas" else _moved(filled(c[name]), model)
        if model.k and name == "x_meas":
            yield _relation("f_meas", f, model.spring(x), (name,), exact=True)
        band = _Band(x, model.fs_hz)
        if band.whole:
            omega = 1j * band.omega
            # Beyond its linear range a yielding spring has no transfer function: its own force is
            # used.
            spring = _spectrum(model.spring(x)) if model.k else np.zeros_like(band.x)
            rest = (model.c * omega + model.moving_mass * omega**2) * band.x
            yield band.held("f_meas", f, spring + rest, (name,), whole=True)


def _accelerations(c: Channels, model: Model) -> Iterator[Relation]:
    ground = model.family == "ground"
    if ground and {"f_meas", "ag", "a_meas"} <= set(c) and model.mass:
        expected = -filled(c["f_meas"]) / model.mass
        yield _relation("a_meas", filled(c["a_meas"]), expected, ("f_meas",), exact=True)
    if "a_meas" in c and "x_meas" in c and (not ground or "ag" in c):
        band = _Band(filled(c["x_meas"]), model.fs_hz)
        if band.whole:
            total = -(band.omega**2) * band.x
            of: tuple[str, ...] = ("x_meas",)
            if ground:
                total = total + _spectrum(filled(c["ag"]))
                of = ("x_meas", "ag")
            yield band.held("a_meas", filled(c["a_meas"]), total, of, exact=True)
    if model.family == "loop" and {"ag", "x_num", "f_meas"} <= set(c) and model.mass:
        band = _Band(filled(c["x_num"]), model.fs_hz)
        if band.whole:
            omega = 1j * band.omega
            inner = (model.mass * omega**2 + model.c_num * omega) * band.x
            needed = -(inner + _spectrum(filled(c["f_meas"]))) / model.mass
            r = band.held("ag", filled(c["ag"]), needed, ("x_num", "f_meas"), exact=True)
            r = replace(r, than="what x_num and f_meas leave for it")
            # Compensated forces satisfy the balance less well: the shape must agree.
            if r.alike > POLICY.shape_balanced:
                yield r


def _inputs(c: Channels, model: Model) -> Iterator[Relation]:
    """Yield the force on a free body: simulated, from the balance, and its upper bound."""
    pushed = channel_signs.push_of(c, model) if "x_meas" in c else None
    if pushed is None:
        return
    name, push, mass = pushed
    x = filled(c["x_meas"])
    if model.k:
        yield _simulated(name, push, mass, x, model)
    yield from _energy(name, push, x, model, mass + model.moving_mass)
    band = _Band(x, model.fs_hz)
    if not band.whole:
        return
    omega = band.omega
    inertia = -(mass + model.moving_mass) * omega**2 * band.x
    parts = [model.k * band.x, 1j * model.c * omega * band.x, inertia]
    if "f_meas" in c and mass:
        # A load cell measures the specimen's force better than the model predicts it.
        parts = [_spectrum(filled(c["f_meas"])), inertia]
    sizes = [float(np.linalg.norm(part[band.rows])) for part in parts]
    most = sum(sizes)
    balance = np.sum(parts, axis=0)
    # At resonance the terms cancel, and the remainder is the error of the model or the sensors.
    least = POLICY.balance_cell if "f_meas" in c and mass else POLICY.balance_model
    if np.linalg.norm(balance[band.rows]) > least * most > 0.0:
        r = band.held(name, push, balance, ("x_meas",), exact=True)
        if r.alike > POLICY.shape_balanced:
            yield r
    found = float(np.linalg.norm(_spectrum(push)))
    yield Relation(name, found / most if most > 0.0 else 0.0, 1.0, ("x_meas",), bound=True)


def _energy(name: str, push: Floats, x: Floats, model: Model, mass: float) -> Iterator[Relation]:
    """Yield the work of a force relative to the energy that a body gained, or 1 if it is more.

    A specimen may absorb energy but cannot supply any; this also holds at resonance, where forces
    are inconclusive.
    """
    gain, rows, v = channel_signs.energy_gained(x, model, mass)
    if gain > 0.0:
        work = float(np.sum(np.abs(push[rows] * v))) / model.fs_hz
        yield Relation(name, min(work / gain, 1.0), 1.0, ("x_meas",), than=_GAINED)


def _simulated(name: str, push: Floats, mass: float, x_meas: Floats, model: Model) -> Relation:
    """Return the inverse of measured over simulated displacement; 1 if they differ in shape.

    Near resonance, size alone is no evidence of units: it depends on damping.
    """
    from rthyb_rt.diagnose.predict import Augmented

    nothing = Relation(name, 1.0, 0.0, ("x_meas",))
    bare = Augmented(model, model, (), (), None, None)
    t = np.arange(push.size) / model.fs_hz
    try:
        x = bare.moved_by(push, mass, t, {}).x
    except (SimulationError, core.CoreError):
        return nothing
    if np.std(x) == 0 or np.std(x_meas) == 0:
        return nothing
    if np.corrcoef(x, x_meas)[0, 1] < POLICY.shape_simulated:
        return nothing
    slope = max(_slope(x_meas, x), 1e-12)
    return Relation(name, 1.0 / slope, 1.0, ("x_meas",), exact=True)


def _orthogonal(c: Channels, model: Model) -> Iterator[Relation]:
    """Yield the orthogonal force: no law determines it, except by crosstalk of the load cell.

    At `wrong_unit` times the measured force, the crosstalk of a good load cell (one per cent) would
    equal that force. A crosstalk above `wrong_unit` is implausible.
    """
    if "fy_meas" not in c or "f_meas" not in c:
        return
    f, fy = filled(c["f_meas"]), filled(c["fy_meas"])
    spread = float(np.std(f))
    if spread > 0.0:
        yield Relation("fy_meas", float(np.std(fy)) / spread, 1.0, ("f_meas",), bound=True)
    if "x_meas" in c and np.std(fy) > 0.0:
        x = filled(c["x_meas"])
        columns = np.column_stack([x, np.gradient(x), np.ones(x.size), fy])
        scale = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
        whole, part = (
            np.linalg.lstsq((columns / scale)[:, :n], f, rcond=None)[0] / scale[:n] for n in (4, 3)
        )
        left = f - columns[:, :3] @ part
        gained = 1.0 - float(np.sum((f - columns @ whole) ** 2)) / max(float(left @ left), 1e-300)
        if gained > POLICY.fy_explains and whole[3] != 0.0:
            ratio = 1.0 / abs(float(whole[3]))
            yield Relation(
                "fy_meas", min(ratio, 1.0), 1.0, ("f_meas",), bound=ratio > 1.0 / POLICY.wrong_unit
            )


def _noises(c: Channels, model: Model, referenced: set[str]) -> Iterator[Relation]:
    """Yield the noise of channels without any other reference, relative to the data sheet.

    For channels with a reference, only if all have a hundred times their stated noise.

    Filtered readings have less noise than the data sheet states, and none has a hundred times more,
    see `_noise`.
    An orthogonal force that is `wrong_unit` times smaller than the measured one, with noise smaller
    than a load cell's by the same factor, is in other units.

    None if time is nominal: rows are then as far apart as the test moved between them, which is no
    noise.
    """
    if nominal_time(model):
        return
    sheet = {"x_meas": model.x_std, "f_meas": model.f_std, "f_in": model.f_std,
             "a_meas": model.a_std}  # fmt: skip
    noises = {k: _noise(c[k]) / std for k, std in sheet.items() if std and k in c}
    # Channels that agree with one another may all be wrong: metres and meganewtons.
    together = len(noises) > 1 and min(noises.values()) > POLICY.wrong_unit
    for name, noise in noises.items():
        # A force that is applied may be as random as noise, over the whole band.
        if together or (name not in referenced and name != "f_in"):
            yield Relation(name, noise, 1.0, (), bound=True, than="the noise that the model states")
    if "fy_meas" in c and model.f_std and "fy_meas" not in referenced:
        noise = white_noise(c["fy_meas"]) / model.f_std
        alone = "f_meas" not in c
        spread = 1.0 if alone else float(np.std(filled(c["f_meas"]))) or 1.0
        ratio = float(np.std(filled(c["fy_meas"]))) / spread
        than = "the noise of a load cell" if alone else "f_meas, and so is its noise,"
        if (
            alone or ratio < 1.0 / POLICY.wrong_unit
        ) and 1.0 / POLICY.wrong_unit**2 < noise < 1.0 / POLICY.wrong_unit:
            yield Relation("fy_meas", noise if alone else ratio, 1.0, (), than=than)
        if alone or ratio > POLICY.fy_larger:
            noise = _noise(c["fy_meas"]) / model.f_std
            yield Relation("fy_meas", noise, 1.0, (), bound=True, than=than)


# ---- sizes --------------------------------------------------------------------------------------


def _noise(values: Floats) -> float:
    """Return the standard deviation of a channel's noise, or less if that cannot be told.

    Fourth differences of fast motion, sampled at few rows a cycle, are as large as the motion.
    White noise is also in the quietest part of the band, but there a filter may have removed it:
    that part is asked only where the differences are too large for the noise of a sensor.
    """
    noise, y = white_noise(values), filled(values)
    if not noise > POLICY.noise_of_sensor * float(np.std(y)):
        return noise
    window = np.hanning(y.size)
    power = np.abs(np.fft.rfft((y - np.mean(y)) * window)[1:]) ** 2
    # Each line of white noise is distributed exponentially: its median is ln 2 of its mean.
    least = min(float(np.median(part)) for part in np.array_split(power, PARTS)) / math.log(2.0)
    return min(noise, math.sqrt(least / float(window @ window)))


class _Band:
    """A displacement at the frequencies at which it is above its noise.

    Attributes:
        x, omega: spectrum and angular frequency, (n // 2 + 1,).
        rows: where it is above the noise, (n // 2 + 1,).
        whole: whether there are such frequencies.
    """

    def __init__(self, x: Floats, fs_hz: float) -> None:
        self.x = _spectrum(x)
        self.omega = 2.0 * np.pi * np.fft.rfftfreq(x.size, 1.0 / fs_hz)
        size = np.abs(self.x)
        self.rows: NDArray[np.bool_] = size > POLICY.motion_lines * np.median(size)
        self.rows &= self.omega > 0.0
        # Derivatives amplify the remaining noise: only frequencies of the motion count.
        self.rows &= size > POLICY.motion_lines_least * np.max(size, initial=0.0)
        self.whole = bool(self.rows.sum() >= 2)

    def held(
        self, name: str, values: Floats, expected: NDArray[np.complex128], of: tuple[str, ...],
        exact: bool = False, whole: bool = False,
    ) -> Relation:  # fmt: skip
        """Return the size of a channel relative to its expectation, at these frequencies.

        ``whole``: content at other frequencies counts as a difference in shape.
        """
        spectrum = _spectrum(values)
        found, wanted = spectrum[self.rows], expected[self.rows]
        power = float(np.vdot(wanted, wanted).real)
        joint = np.vdot(wanted, found)
        norms = math.sqrt(power) * float(np.linalg.norm(spectrum if whole else found))
        if norms == 0.0:
            return Relation(name, 1.0, 0.0, of)
        alike = float(abs(joint)) / norms
        return Relation(
            name, float(joint.real) / power, alike, of, exact=exact and alike > POLICY.shape_clearly
        )


def _spectrum(values: Floats) -> NDArray[np.complex128]:
    return np.fft.rfft((values - values.mean()) * np.hanning(values.size))


def _relation(
    name: str, found: Floats, expected: Floats, of: tuple[str, ...], exact: bool = False
) -> Relation:
    norms = float(np.std(found) * np.std(expected))
    if norms == 0.0:
        return Relation(name, 1.0, 0.0, of)
    joint = float(np.mean((found - found.mean()) * (expected - expected.mean())))
    return Relation(name, _slope(found, expected), abs(joint) / norms, of, exact=exact)


def _slope(found: Floats, expected: Floats) -> float:
    expected = expected - expected.mean()
    power = float(expected @ expected)
    return float((found - found.mean()) @ expected) / power if power > 0 else 1.0
