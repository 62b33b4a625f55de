"""Which cases a proof holds: the mix of kinds, and the wish for each case by seed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from prove import cases, effects, folders
from prove.prepare import Redraw, Wanted

Rng = np.random.Generator

# Shares of the kinds in a proof.
MIX = {
    "single": 110, "pair": 40, "cancel": 26, "null": 30, "dormant": 16, "ambiguous": 20,
    "unknown": 30, "no_cell": 16, "faint": 16, "onset": 16,
}  # fmt: skip
NOISES, NOISE_ODDS = ("low", "mid", "high"), (0.35, 0.4, 0.25)
ATTEMPTS = 16


def schedule(seed: int, count: int, kinds: list[str] | None = None) -> list[Wanted]:
    """The wishes of all cases: kinds by their shares, effects and families in turn."""
    rng = np.random.default_rng([seed, 0xCA5E])
    chosen = {k: MIX[k] for k in (kinds or MIX)}
    total = sum(chosen.values())
    wishes: list[Wanted] = []
    for kind, share in chosen.items():
        number = round(count * share / total)
        wishes += list(WISHES[kind](number, rng))
    while len(wishes) < count:
        wishes += list(WISHES["single" if "single" in chosen else next(iter(chosen))](1, rng))
    order = rng.permutation(len(wishes))[:count]
    return [wishes[i] for i in order]


def dress(w: Wanted, rng: Rng) -> Wanted:
    """Noise and excitation where the wish leaves them open."""
    options = effects.EXCITATIONS["quasi_static" if w.quasi_static else w.family]
    if any(n in effects.BROAD for n in w.names) and not w.quasi_static:
        options = tuple(o for o in options if o in ("sweep", "random", "earthquake"))
    steady = w.kind in ("single", "null") and w.family == "drive" and not w.groups
    if (
        steady
        and set(w.names) <= set(effects.STEADY)
        and not w.quasi_static
        and rng.random() < 0.15
    ):
        options = ("sine",)
    return replace(
        w,
        noise="low" if w.tier == "faint" else str(rng.choice(NOISES, p=NOISE_ODDS)),
        excitation=w.excitation or str(rng.choice(options)),
    )


def combinations() -> list[tuple[str, str]]:
    return [(family, n) for family, names in effects.WHERE.items() for n in names]


def singles(number: int, rng: Rng) -> Iterator[Wanted]:
    grid = combinations()
    order = rng.permutation(len(grid))
    for i in range(number):
        family, name = grid[order[i % len(grid)]]
        slow = family == "quasi_static"
        yield Wanted(
            "single", "drive" if slow else family, (name,), tier=_tier(rng), quasi_static=slow
        )


def nulls(number: int, rng: Rng) -> Iterator[Wanted]:
    for i in range(number):
        family = ("drive", "loop", "ground", "forced")[i % 4]
        yield Wanted("null", family, groups=("offset",) if rng.random() < 0.5 else ())


def _fits(a: str, b: str) -> bool:
    """Whether two effects may be together in one rig of this generator."""
    together = {a, b}
    if a == b or together <= set(effects.DRY) or together <= {"gap", "pinching"}:
        return False
    return not together <= set(effects.SENSOR)


def pairs(number: int, rng: Rng) -> Iterator[Wanted]:
    families = ("drive", "loop", "drive", "loop", "ground", "forced")
    for i in range(number):
        family = families[i % len(families)]
        names = effects.WHERE[family]
        while True:
            a, b = (str(n) for n in rng.choice(names, 2, replace=False))
            if _fits(a, b):
                break
        yield Wanted("pair", family, (a, b))


CANCELLING = (
    ("coulomb", "viscous"), ("lugre", "viscous"), ("quad_damping", "viscous"),
    ("maxwell", "viscous"), ("cubic", "stiffness"), ("inertia", "stiffness"),
    ("gap", "stiffness"), ("stopper", "stiffness"),
    ("hysteresis", "stiffness"), ("degradation", "stiffness"), ("coulomb", "time_skew"),
    ("delay", "oil_column"), ("pinching", "stiffness"),
)  # fmt: skip


def cancels(number: int, rng: Rng) -> Iterator[Wanted]:
    order = rng.permutation(len(CANCELLING))
    for i in range(number):
        names = CANCELLING[order[i % len(CANCELLING)]]
        options = ["drive", "loop"]
        if names[1] == "stiffness" and names[0] != "inertia":
            options.append("ground")
        yield Wanted("cancel", str(rng.choice(options)), names)


def dormants(number: int, rng: Rng) -> Iterator[Wanted]:
    for i in range(number):
        name = ("stopper", "hysteresis", "rate_limit", "local_bump")[i % 4]
        families = (
            ("drive", "loop") if name == "rate_limit" else ("drive", "loop", "ground", "forced")
        )
        yield Wanted("dormant", str(rng.choice(families)), (name,), excitation="small")


def ambiguities(number: int, rng: Rng) -> Iterator[Wanted]:
    plans = (
        ("spring_or_mass", "drive"), ("damper_or_late_cell", "drive"), ("spring_or_mass", "forced"),
        ("damper_or_late_cell", "drive"), ("rate_unknown", "quasi_static"),
    )  # fmt: skip
    for i in range(number):
        group, family = plans[i % len(plans)]
        slow = family == "quasi_static"
        yield Wanted(
            "ambiguous", "drive" if slow else family, (group,), quasi_static=slow,
            excitation="quasi_static_steady" if slow else "sine",
        )  # fmt: skip


def unknowns(number: int, rng: Rng) -> Iterator[Wanted]:
    for i in range(number):
        name = effects.UNKNOWN[i % len(effects.UNKNOWN)]
        if name == "stroke_ripple":
            family = str(rng.choice(["drive", "loop"]))
        else:
            family = str(
                rng.choice(["drive", "loop", "ground", "forced"], p=[0.35, 0.3, 0.2, 0.15])
            )
        yield Wanted("unknown", family, (name,))


def without_cell(number: int, rng: Rng) -> Iterator[Wanted]:
    order = rng.permutation(len(effects.FREE_CELL))
    for i in range(number):
        name = effects.FREE_CELL[order[i % len(order)]]
        yield Wanted("single", "ground", (name,), groups=("no_cell",), tier=_tier(rng))


FAINT = (
    "coulomb", "gap", "cubic", "quadratic", "stopper", "bias", "hum", "lugre", "delay",
    "delay_rate", "crosstalk", "quad_damping", "drift",
)  # fmt: skip


def faint(number: int, rng: Rng) -> Iterator[Wanted]:
    for i in range(number):
        name = FAINT[i % len(FAINT)]
        family = str(
            rng.choice([f for f in ("drive", "loop", "ground") if name in effects.WHERE[f]])
        )
        yield Wanted("single", family, (name,), tier="faint", groups=("faint",))


ONSET = (
    "coulomb",
    "viscous",
    "gap",
    "cubic",
    "quadratic",
    "stopper",
    "lugre",
    "quad_damping",
    "maxwell",
)


def onsets(number: int, rng: Rng) -> Iterator[Wanted]:
    for i in range(number):
        name = ONSET[i % len(ONSET)]
        yield Wanted(
            "single",
            ("drive", "loop", "ground")[i % 3],
            (name,),
            tier=_tier(rng),
            groups=("onset",),
        )


def _tier(rng: Rng) -> str:
    return str(rng.choice(["weak", "medium", "strong"], p=[0.3, 0.4, 0.3]))


WISHES = {
    "single": singles, "null": nulls, "pair": pairs, "cancel": cancels, "dormant": dormants,
    "ambiguous": ambiguities, "unknown": unknowns, "no_cell": without_cell, "faint": faint,
    "onset": onsets,
}  # fmt: skip


def build(seed: int, index: int, wish: Wanted, out: Path) -> tuple[str, str]:
    """Draw until the case is a fair one, write it, and return its name and what it is.

    A wish that cannot be met (an effect that this family never shows clearly at the wished size) is
    replaced by another of its kind.
    """
    name = f"p{seed % 100000:05d}_{index:03d}"
    if (out / name / "answer.json").exists():  # it is written last
        return name, "made before"
    reasons: list[str] = []
    for round_ in range(4):
        for attempt in range(ATTEMPTS):
            rng = np.random.default_rng([seed, index, round_, attempt])
            w = dress(wish, rng)
            if attempt >= ATTEMPTS // 2 and w.tier == "weak":
                w = replace(w, tier="medium")
            try:
                case = cases.KINDS[w.kind](w, rng)
            except Redraw as why:
                reasons.append(str(why))
                continue
            case.answer["attempts"] = round_ * ATTEMPTS + attempt + 1
            folders.write(case, out / name, name)
            what = "+".join(m.name for m in case.missing) or "nothing"
            return name, f"{w.kind} {w.family} {what} ({case.answer['attempts']})"
        wish = another(wish, np.random.default_rng([seed, index, round_]))
    raise RuntimeError(f"case {index}, {wish}: no fair draw: {reasons[-5:]}")


def another(wish: Wanted, rng: Rng) -> Wanted:
    """A wish of the same kind and group."""
    group = next((g for g in wish.groups if g in WISHES), wish.kind)
    return list(WISHES[group](40, rng))[int(rng.integers(40))]
