"""Whether a case can be decided: what the noise lets anyone know, whatever tool they use.

Every law is a column along the true motion. Columns are weighed at each frequency by the true noise
there, so that sums of squares are chi-squared. Stated tolerances are nuisances with their prior.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from validate import laws
from validate.laws import Law

Blocks = dict[str, list[np.ndarray]]
MARGIN = {"normal": 10.0, "hard": 7.0}  # standard deviations between the truth and any rival
VISIBLE = {"normal": 25.0, "hard": 14.0}  # in the noise alone
BEYOND = {"normal": 5.0, "hard": 4.0}  # of what no stated tolerance can take up
EQUAL, APART = 9.0, 36.0  # chi-squared within which laws are one, from which they are two
FORM = 0.3  # of the least effect: what a form may depart from the plain law of its name
RICHER = {"coulomb": ("stribeck", "lugre"), "stribeck": ("lugre",), "hysteresis": ("pinching",)}


@dataclass
class Scale:
    """Weights over frequency for one channel, and the nuisances of its recording."""

    weight: np.ndarray  # sqrt of information at each frequency kept
    keep: np.ndarray
    nuisance: np.ndarray  # n columns of unit prior

    def columns(self, block: np.ndarray) -> np.ndarray:
        """Columns over time, weighed: real and imaginary parts below each other."""
        n = block.shape[0]
        spectrum = np.fft.rfft(block, axis=0)[self.keep] * np.sqrt(2.0 / n)
        spectrum = spectrum * self.weight[:, None]
        return np.concatenate((spectrum.real, spectrum.imag))

    def reduced(self, block: np.ndarray) -> np.ndarray:
        """Columns with what the nuisances can take up taken off, prior included."""
        made = np.vstack((self.columns(block), np.zeros((self.nuisance.shape[1], block.shape[1]))))
        return made - self.basis @ (self.basis.T @ made)

    def __post_init__(self) -> None:
        made = self.columns(self.nuisance)
        self.basis = np.linalg.qr(np.vstack((made, np.eye(made.shape[1]))))[0]


class Products:
    """Inner products of reduced columns, so that any set of them is fitted at no more cost."""

    def __init__(self, scale: Scale, columns: list[np.ndarray]) -> None:
        self.blocks: list[slice] = []
        at = 0
        for c in columns:
            self.blocks.append(slice(at, at + c.shape[1]))
            at += c.shape[1]
        made = scale.reduced(np.column_stack(columns))
        self.size = np.linalg.norm(made, axis=0)
        made = made / np.where(self.size > 0, self.size, 1.0)
        self.gram = made.T @ made

    def left(self, target: np.ndarray, taken: list[int], total: float) -> float:
        """Chi-squared of a target, given by its products with all columns, after some blocks."""
        at = np.concatenate([np.arange(self.gram.shape[0])[self.blocks[i]] for i in taken])
        at = at[self.size[at] > 0]
        values, vectors = np.linalg.eigh(self.gram[np.ix_(at, at)])
        good = values > 1e-10
        part = (vectors.T @ target[at])[good]
        return max(float(total - np.sum(part**2 / values[good])), 0.0)

    def of(self, column: int) -> np.ndarray:
        """Products of a column, in its full size, with all columns."""
        return self.gram[column] * self.size[column]


def _scan(laws_of: list[Law], h: float, motion: tuple[np.ndarray, ...]) -> list[np.ndarray]:
    return [row[:, None] for row in laws.along(laws_of, h, *motion)]


def _bends(reach: float, span: tuple[float, float, float]) -> Blocks:
    """Names whose shape has one place in displacement, at places over the range of the motion."""
    # Beyond these a gap takes away half the spring: nothing that is drawn here looks like that.
    places = reach * np.geomspace(0.01, 0.4, 18)
    stops = reach * np.linspace(0.1, 0.99, 24)
    low, high, corner = span
    return {
        "gap": [Law("gap", "", laws.GAP, (1.0, g)) for g in places],
        "stopper": [Law("stopper", "", laws.STOP, (1.0, g)) for g in stops],
        "hysteresis": [
            Law("hysteresis", "", laws.BOUC_WEN, (1.0, 0.0, xy, n))
            for xy in reach * np.geomspace(0.08, 1.5, 12)
            for n in (1.0, 2.0, 5.0)
        ],
        "lugre": [
            Law("lugre", "", laws.BRISTLE, (1.0, 1 / slip, 1.0, 1.0))
            for slip in reach * np.geomspace(0.02, 0.5, 8)
        ],
        "maxwell": [
            Law("maxwell", "", laws.MAXWELL, (1.0, tau)) for tau in np.geomspace(low, high, 12)
        ],
        "second_mode": [
            Law("second_mode", "", laws.SECOND_MODE, (1.0, f, 0.025))
            for f in np.geomspace(0.15 * corner, 25.0 * corner, 60)
        ],
        "degradation": [
            Law("degradation", "", laws.DEGRADE, (1.0, 1.0, travel, way))
            for way, unit in ((0.0, 1.0), (1.0, reach))
            for travel in unit * reach * np.geomspace(2.0, 400.0, 8)
        ],
    }  # fmt: skip


def force_library(
    x: np.ndarray, v: np.ndarray, a: np.ndarray, f: np.ndarray, fy: np.ndarray | None, fs: float,
    core: tuple[float, float, float] | None = None,
) -> Blocks:  # fmt: skip
    """Columns of every name of the force channel along a motion at rows; shapes are scanned."""
    t = np.arange(x.size) / fs
    reach, speed = float(np.max(np.abs(x))), float(np.max(np.abs(v)))
    motion = (x, v, a)
    corner = speed / reach / (2 * np.pi)
    sgn = np.sign(v)
    widths = speed * np.array([0.005, 0.02, 0.06])
    made: Blocks = {
        "viscous": [v[:, None]],
        "quad_damping": [(v * np.abs(v))[:, None]],
        "cubic": [(x**3)[:, None]],
        "quadratic": [(x * x)[:, None]],
        "stiffness": [x[:, None]],
        "inertia": [a[:, None]],
        "bias": [np.ones((x.size, 1))],
        "drift": [t[:, None]],
        "time_skew": [np.gradient(f, 1 / fs)[:, None]],
        "coulomb": [sgn[:, None]] + [np.tanh(v / w)[:, None] for w in widths],
        "stribeck": [
            np.column_stack((sgn, sgn * np.exp(-(np.abs(v / vs) ** e))))
            for vs in speed * np.geomspace(0.02, 0.7, 10)
            for e in (1.0, 2.0)
        ],
    }  # fmt: skip
    slips = reach * np.array([0.0005, 0.002, 0.006])
    made["coulomb"] += _scan(
        [Law("", "", laws.JENKINS, (1.0, 1.0 / s)) for s in slips], 1 / fs, motion
    )
    for name, scanned in _bends(reach, (0.3 / fs, 60.0 / corner, corner)).items():
        made[name] = _scan(scanned, 1 / fs, motion)
    if fy is not None:
        made["crosstalk"] = [fy[:, None]]
    if core is not None:
        k, alpha, xy = core
        pinched = [
            Law("", "", laws.BOUC_PINCH, (k, alpha, xy, 2.0, d, w, lock))
            for d, lock in ((0.3, 0.0), (0.6, 0.0), (0.9, 0.0), (1.0, 1.0))
            for w in (0.1, 0.2, 0.35, 0.6)
        ]
        made["pinching"] = _scan(pinched, 1 / fs, motion)
    return made


def motion_library(
    x: np.ndarray, v: np.ndarray, a: np.ndarray, fs: float, changes: dict[str, list[np.ndarray]]
) -> Blocks:
    """Columns of what an actuator may do otherwise; `changes` holds what only simulation gives."""
    return {
        "delay": [v[:, None]],
        "act_gain": [x[:, None]],
        "delay_rate": [(np.abs(v) * v)[:, None]],
        **{name: [c if c.ndim == 2 else c[:, None] for c in cs] for name, cs in changes.items()},
    }


@dataclass
class Verdict:
    """How far the truth stands from the next: all in standard deviations."""

    fair: bool
    why: str
    visible: float = 0.0
    margin: float = 0.0
    rival: str = ""


def seen(scale: Scale, y: np.ndarray) -> tuple[float, float]:
    """Standard deviations of y in the noise alone, and beyond what tolerances can take up."""
    alone = float(np.linalg.norm(scale.columns(y[:, None])))
    return alone, float(np.linalg.norm(scale.reduced(y[:, None])))


def judge_set(
    scale: Scale, library: Blocks, truth: list[tuple[str, np.ndarray]], level: str,
    shapes: list[list[np.ndarray]] | None = None,
) -> Verdict:  # fmt: skip
    """Whether each member of a set is needed, and no other single name does in its place.

    The other members are fitted with their `shapes`, what a change of each of their numbers does.
    Of one name the law in its plain form has to do better than every rival: how far a form departs
    from the plain one may not decide the name.
    """
    names = [name for name, _ in truth]
    count = len(truth)
    labels = [(name, b) for name, blocks in library.items() for b in blocks]
    changes = shapes or [[] for _ in truth]
    members = [np.column_stack((y, *c)) for (_, y), c in zip(truth, changes, strict=True)]
    made = Products(scale, members + [b for _, b in labels])
    firsts = [made.blocks[i].start for i in range(count)]
    whole = np.sum([made.of(at) for at in firsts], axis=0)
    total = float(np.sum([whole[at] * made.size[at] for at in firsts]))
    worst = Verdict(True, "", np.inf, np.inf)
    departs, least = 0.0, np.inf
    for i, name in enumerate(names):
        others = [j for j in range(count) if j != i]
        bare = made.left(whole, others, total) if others else total
        best: dict[str, float] = {}
        for at, (rival, _) in enumerate(labels):
            value = made.left(whole, [*others, count + at], total)
            best[rival] = min(value, best.get(rival, np.inf))
        own = best.pop(name, 0.0)
        worst.visible = min(worst.visible, float(np.sqrt(bare)))
        departs, least = max(departs, np.sqrt(own)), min(least, np.sqrt(bare))
        if np.sqrt(bare) < BEYOND[level]:
            return Verdict(False, f"{name} is taken up by the others and by tolerances")
        for rival, value in best.items():
            if rival in names:
                continue
            if rival in RICHER.get(name, ()):
                if value < own - EQUAL:
                    return Verdict(False, f"{rival} is nearer than the plain {name}")
                continue
            apart = float(np.sqrt(max(value - own, 0.0)))
            # What only a tolerance hides cannot be farther from a rival than from nothing.
            if apart < min(MARGIN[level], 0.8 * np.sqrt(bare)):
                return Verdict(False, f"{rival} does nearly as well as {name}")
            if apart < worst.margin:
                worst.margin, worst.rival = apart, rival
    if departs > FORM * least:
        return Verdict(False, "a form departs from the plain one by as much as an effect")
    return worst


def share_left(scale: Scale, library: Blocks, y: np.ndarray, most: int = 3) -> list[float]:
    """Share of the rms that the best one, two, three laws leave of y: steps of a greedy search."""
    made = Products(scale, [y[:, None]] + [b for bs in library.values() for b in bs])
    target, total = made.of(0), float(made.size[0] ** 2)
    taken: list[int] = []
    shares = []
    for _ in range(most):
        values = [made.left(target, [*taken, b], total) for b in range(1, len(made.blocks))]
        taken.append(1 + int(np.argmin(values)))
        shares.append(float(np.sqrt(min(values) / total)))
    return shares


def equals(
    scale: Scale, library: Blocks, y: np.ndarray, names: tuple[str, ...]
) -> tuple[dict[str, float], dict[str, float]]:
    """Names within EQUAL of y, and names neither equal nor APART, with the size that they take."""
    labels = [(n, b) for n in names for b in library[n]]
    made = Products(scale, [y[:, None]] + [b for _, b in labels])
    target, total = made.of(0), float(made.size[0] ** 2)
    rest: dict[str, tuple[float, float]] = {}
    for at, (name, _) in enumerate(labels, 1):
        value = made.left(target, [at], total)
        if value < rest.get(name, (np.inf, 0.0))[0]:
            rest[name] = value, float(target[at])
    return (
        {n: size for n, (value, size) in rest.items() if value < EQUAL},
        {n: size for n, (value, size) in rest.items() if EQUAL <= value < APART},
    )
