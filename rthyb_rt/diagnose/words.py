"""A diagnosis in the words of a laboratory."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from rthyb_rt.diagnose import effects
from rthyb_rt.diagnose.actuation import CATALOGUE, ActuatorEffect
from rthyb_rt.diagnose.augment import rig_toml
from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.effects.base import Effect
from rthyb_rt.diagnose.effects.sensor import QUANTISATION
from rthyb_rt.diagnose.force import Search
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.remainder import left_of
from rthyb_rt.diagnose.result import DiagnosisResult, Found

if TYPE_CHECKING:
    from rthyb_rt.diagnose.outcome import Outcome

KINDS: dict[str, str] = {
    "sweep": "a frequency sweep",
    "random": "random motion",
    "multi_frequency": "several frequencies at once",
    "multi_amplitude": "one frequency at several amplitudes",
}
"""The kinds of experiment that may be proposed."""

UNITS: dict[str, str] = {
    "N": "N", "m": "m", "kg": "kg", "s": "s", "Hz": "Hz", "N_m": "N/m", "Ns_m": "N s/m",
    "m_s": "m/s", "N_m3": "N/m³", "N_m2": "N/m²", "Ns2_m2": "N s²/m²", "N_s": "N/s",
    "s2_m": "s²/m",
}  # fmt: skip
"""Unit of a parameter, by the suffix of its name."""
PREFIXES: dict[str, tuple[tuple[float, str], ...]] = {
    "m": ((1.0, "m"), (1e-3, "mm"), (1e-6, "µm")),
    "N": ((1e6, "MN"), (1e3, "kN"), (1.0, "N")),
    "N/m": ((1e6, "MN/m"), (1e3, "kN/m"), (1.0, "N/m")),
    "N s/m": ((1e3, "kN s/m"), (1.0, "N s/m")),
    "m/s": ((1.0, "m/s"), (1e-3, "mm/s")),
    "s": ((1.0, "s"), (1e-3, "ms")),
}


def quantity(value: float, unit: str, digits: int = 3) -> str:
    """Return a value in the customary multiple of its unit: ``3.1 MN/m``."""
    scales = PREFIXES.get(unit, ((1.0, unit),))
    size = abs(value)
    scale, name = next((s for s in scales if size >= s[0]), scales[-1])
    return f"{_plain(value / scale, digits)} {name}".rstrip()


def _plain(value: float, digits: int) -> str:
    """Return a number rounded to its digits, with a power of ten only if necessary."""
    if value == 0.0 or not np.isfinite(value):
        return f"{value:g}"
    exponent = int(np.floor(np.log10(abs(value))))
    if not -3 <= exponent < 6:
        power = str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
        return f"{value / 10.0**exponent:.{digits - 1}f}·10{power}".replace("-", "−")
    decimals = digits - 1 - exponent
    return f"{round(value, decimals):.{max(decimals, 0)}f}".replace("-", "−")


def value_text(name: str, value: float) -> str:
    """Return a parameter with its unit, as ``Fc = 812 N``."""
    head, _, unit = name.partition("_")
    if UNITS.get(unit) is None:
        return f"{name.replace('_', ' ')} = {_plain(value, 4)}"
    return f"{head} = {quantity(value, UNITS[unit], 4)}"


def interval_text(name: str, ci: list[float] | None) -> str:
    """Return a 95 % interval in words, in the multiple of the unit that suits its larger end."""
    if not ci:
        return ""
    unit = UNITS.get(name.partition("_")[2], "")
    scales = PREFIXES.get(unit, ((1.0, unit),))
    size = max(abs(ci[0]), abs(ci[1]))
    scale, word = next((s for s in scales if size >= s[0]), scales[-1])
    low, high = (_plain(end / scale, 4) for end in ci)
    return f"{low} to {high} {word}".rstrip()


@dataclass(frozen=True)
class Size:
    """A parameter's value for use in a phrase: ``{xs_m}`` in its unit, without its sign.

    After a colon: ``+`` with its sign, ``%`` in per cent, a number of digits for a dimensionless
    value, ``less|more`` for one of two words by the sign.
    """

    name: str
    value: float

    def __format__(self, spec: str) -> str:
        """Return the value in the requested format."""
        less, either, more = spec.partition("|")
        if either:
            return less if self.value < 0 else more
        if spec == "%":
            return f"{_plain(100.0 * abs(self.value), 3)} %"
        if spec.isdigit():
            return _plain(self.value, int(spec))
        unit = UNITS.get(self.name.partition("_")[2], "")
        return quantity(self.value if spec == "+" else abs(self.value), unit)


def _known_effects() -> dict[str, Effect | ActuatorEffect]:
    """Return everything that an answer may name, by name."""
    own: list[Effect | ActuatorEffect] = [*CATALOGUE, QUANTISATION, *effects.catalogue().values()]
    return {e.name: e for e in own}


def called(name: str) -> str:
    """Return the common name of an effect; for an unknown one, its own name."""
    effect = _known_effects().get(name)
    return effect.plain if effect is not None and effect.plain else name


def law_text(c: Found) -> str:
    """Return the form of an effect's law, with the numbers that no parameter holds.

    Empty if its name has no other form than the equation of the catalogue.
    """
    effect = _known_effects().get(c.name)
    return "" if effect is None or c.form in ("", effect.equation) else c.form


def together(names: Iterable[str]) -> str:
    """Return effects that act together by their common names."""
    return " with ".join(called(n) for n in names)


def _phrase(c: Found) -> str:
    """Return an effect with its size in words: ``a stop at 18.2 mm with 3.1 MN/m``.

    A user-defined effect, or one without its parameters, is listed with all its values.
    """
    effect = _known_effects().get(c.name)
    if effect is not None and effect.phrase:
        try:
            return effect.phrase.format_map({k: Size(k, v) for k, v in c.params.items()})
        except KeyError:
            pass
    values = ", ".join(value_text(k, v) for k, v in c.params.items())
    return f"{called(c.name)} ({values})" if values else called(c.name)


def _phrases(found: Sequence[Found]) -> str:
    return " and ".join(_phrase(c) for c in found)


LOOP_WORDS: dict[str, str] = {
    "x_meas": "measured displacement", "x_num": "computed displacement", "f_meas": "force",
    "alpha": "delay estimate",
}  # fmt: skip


def _others(texts: dict[str, str]) -> str:
    return "; ".join(f"{LOOP_WORDS[k]} {v}" for k, v in texts.items() if k != "x_meas")


def loop_rows(answer: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return the results of the closed loop as rows of label, value and explanation."""
    rows = []
    loop = answer.get("closed_loop")
    if loop and loop["possible"]:
        before, after = loop["nrmse_before"], loop["nrmse_after"]
        # A test without a delay estimate, such as a prescribed history, has none to compare.
        known = [k for k in before if math.isfinite(before[k]) or math.isfinite(after[k])]
        label = "repeated simulation, NRMSE"
        if answer["verdict"] in ("explained", "ambiguous"):
            texts = {k: f"{100 * before[k]:.3g} → {100 * after[k]:.3g} %" for k in known}
            rows.append((label, texts["x_meas"], _others(texts)))
        else:
            # Without an effect, the adjusted parameters need not come closer than the model itself.
            for head, found in ((label, before), ("with parameters adjusted", after)):
                texts = {k: f"{100 * found[k]:.3g} %" for k in known}
                rows.append((head, texts["x_meas"], _others(texts)))
    for name, word in (("alpha", "alpha recovered"), ("k_t_n_per_m", "k_t recovered")):
        found = answer.get("recovered", {}).get(name, {})
        if found.get("possible"):
            low, high = found["range"]
            share = 100.0 * found["identified_share"]
            rows.append(
                (
                    word,
                    f"{found['median']:.4g} {found['unit']}",
                    f"median; from {low:.4g} to {high:.4g} in {share:.0f} % of the rows",
                )
            )
        elif found:
            rows.append((word, "not possible", found["why"]))
    return rows


def heldout_lines(d: DiagnosisResult) -> list[str]:
    """Return the result of validation on a second recording, or how to obtain it."""
    after = "with its parameters adjusted"
    if d.verdict in ("explained", "ambiguous"):
        after = "with the effects found"
    elif d.case.model.k_tol is not None:
        after += " within tolerance"
    given = "the model as given"
    if d.case.model.k_stated is not None:
        given = "the line's stiffness"
    out = []
    for key, word in (("force", "force"), ("disp", "displacement")):
        before = d.fit.get(f"heldout_nrmse_before_{key}")
        if before is not None:
            now = d.fit.get(f"heldout_nrmse_after_{key}", float("nan"))
            out.append(
                f"Held out: error in the second recording's {word}: {100 * before:.3g} % with "
                f"{given}, {100 * now:.3g} % {after} (NRMSE)."
            )
    if not out and d.verdict in ("explained", "ambiguous"):
        out.append("Not validated on a second recording; use --heldout FILE for that.")
    return out


def unheld(d: DiagnosisResult, outcome: Outcome) -> list[str]:
    """Return what the rig file of the augmented model cannot represent."""
    if d.verdict not in ("explained", "ambiguous"):
        return []
    lost = [*rig_toml(outcome.model)[1], *(n for n in d.effects if n == QUANTISATION.name)]
    if not lost:
        return []
    names = " and ".join(called(n) for n in dict.fromkeys(lost))
    return [
        f"A rig file cannot represent {names}; a test with augmented.toml does not include "
        f"{'it' if len(set(lost)) == 1 else 'them'}."
    ]


def driving_notes(d: DiagnosisResult) -> list[str]:
    """Return a note if the effects found would drive fast motion, which no specimen does."""
    known = effects.catalogue()
    named = [c for c in d.candidates if c.name in d.effects and c.name in known]
    dashpot = d.case.model.c + sum(
        value for c in named if known[c.name].number == "c" for value in c.params.values()
    )
    if dashpot >= 0.0 or not any(known[c.name].relaxes for c in named):
        return []
    return [
        f"Together with the model's, the dashpots are {quantity(dashpot, 'N s/m')}: motion faster "
        "than the relaxation would be driven, not damped. Do not extrapolate to such motion; check "
        "the damping of the model, and the timing of the load cell with a fast sweep."
    ]


def loop_notes(d: DiagnosisResult, answer: dict[str, Any]) -> list[str]:
    """Return notes on the repeated simulation of the loop, or the reason why there is none."""
    loop = answer.get("closed_loop")
    if not loop:
        return []
    if not loop["possible"]:
        return [f"The test could not be simulated again: {loop['why']}."]
    out = [f"With the loop closed: {note}." for note in loop["notes"]]
    before, after = loop["nrmse_before"]["x_meas"], loop["nrmse_after"]["x_meas"]
    if d.verdict in ("explained", "ambiguous") and after > max(
        POLICY.loop_met, POLICY.loop_hardly * before
    ):
        out.append(
            "With the loop closed, the effects found do not reproduce the test: the simulated "
            f"displacement differs from the measured one by {100 * before:.3g} % without them and "
            f"by {100 * after:.3g} % with them."
        )
    return out


def next_text(d: DiagnosisResult) -> str:
    """Return the next experiment in words; empty if there is none."""
    if not d.next_experiment:
        return ""
    kind, why = d.next_experiment["kind"], d.next_experiment["why"]
    for name in d.effects:
        why = why.replace(f"to confirm {name}:", f"to confirm {called(name)}:")
    return f"{KINDS.get(kind, kind.replace('_', ' '))}; {why}"


def check_rows(checks: list[dict[str, Any]] | None) -> list[tuple[str, str]]:
    """Return the results of the self-check as rows of effect and result."""
    rows = []
    for row in checks or ():
        name = called(row["effect"])
        what = "displacement" if row.get("channel") == "disp" else "force"
        if "smallest_detectable_share" in row:
            share, least = row["smallest_detectable_share"], row.get("largest_tried_share", 0.16)
            rows.append(
                (
                    name,
                    f"found down to {100 * share:.2g} % of the {what}"
                    if share
                    else f"not even found at {100 * least:.2g} % of the {what}",
                )
            )
        else:
            again = "found again" if row["found"] else "not found again"
            rows.append((name, f"as found, {100 * row['share']:.3g} % of the {what}: {again}"))
    return rows


def _when(d: DiagnosisResult) -> str:
    if not d.windows:
        return ""
    whole = float(d.case.t[-1] - d.case.t[0]) or 1.0
    covered = sum(b - a for a, b in d.windows)
    if covered > POLICY.always_reported * whole:
        return "throughout the recording"
    if len(d.windows) > 6:
        first, last = d.windows[0][0], d.windows[-1][1]
        return f"{len(d.windows)} times between {first:.1f} and {last:.1f} s"
    spans = [_span(a, b) for a, b in d.windows[:3]]
    left = len(d.windows) - 3
    if left > 0:
        spans.append("once more" if left == 1 else f"{left} more times")
    *before, last_one = spans
    return f"{', '.join(before)} and {last_one}" if before else last_one


def _span(from_s: float, to_s: float) -> str:
    """Return a time window in words; if shorter than the figures shown, as a moment."""
    first, last = f"{from_s:.1f}", f"{to_s:.1f}"
    return f"at {first} s" if first == last else f"between {first} and {last} s"


def _where(d: DiagnosisResult, signal: Floats) -> str:
    """Return where on the stroke a force acts, if it is local."""
    motion = d.estimate.motion if d.estimate is not None else None
    if motion is None or d.channel != "force":
        return ""
    size = np.abs(signal)
    acts = size > POLICY.active_rows * float(size.max())
    if not acts.any() or acts.all():
        return ""
    x, top = motion.x, float(np.max(np.abs(motion.x)))
    least = float(np.min(np.abs(x[acts])))
    if least > POLICY.local_reported * top:
        if np.all(x[acts] > 0):
            return f"x > {quantity(least, 'm')}"
        if np.all(x[acts] < 0):
            return f"x < −{quantity(least, 'm')}"
        return f"|x| > {quantity(least, 'm')}"
    return ""


def _difference(d: DiagnosisResult, signal: Floats | None) -> str:
    """Return what differs, and in which direction if that is clear."""
    channels = {c.channel for c in d.candidates if c.name in d.effects}
    if len(channels) == 2:
        return "actuator and specimen both differ from the model"
    if d.channel == "disp":
        return "the actuator moves differently from the model"
    if "f_meas" not in d.case.channels:
        return "the specimen resists differently from the model"
    ctx = d.context
    if signal is not None and ctx is not None and np.std(signal) > 0:
        together = float(signal @ ctx.total) / (
            float(np.linalg.norm(signal) * np.linalg.norm(ctx.total)) or 1.0
        )
        acts = np.abs(signal) > POLICY.active_rows * float(np.max(np.abs(signal)))
        same = np.sign(signal[acts]) == np.sign(ctx.total[acts])
        if together > 0 and np.mean(same) > POLICY.one_sided_reported:
            return "the load cell reads more than the model"
        if together < 0 and np.mean(~same) > POLICY.one_sided_reported:
            return "the load cell reads less than the model"
    return "the load cell reads differently from the model"


def _judged(d: DiagnosisResult) -> str:
    """Return the limits of a verdict that nothing is missing."""
    if d.force is None and d.disp is not None:
        return "There is no force to analyse, so this says nothing about the specimen."
    return ""


def _rest(d: DiagnosisResult) -> str:
    """Return what remains after the effects found."""
    before, after = d.fit.get("nrmse_before", 0.0), d.fit.get("nrmse_after", 0.0)
    error = f"NRMSE {100 * before:.3g} % before, {100 * after:.3g} % after"
    only_disp = d.channel == "disp" and (d.force is None or not d.force.best.members)
    left = d.disp.best.chi2 / d.disp.task.rows.size - 1.0 if only_disp and d.disp else None
    if left is None and d.force is not None:
        left = d.force.excess_after
    if left is None or left >= POLICY.excess_as_noise:
        part = _left_of_free_body(d)
        if part is not None and 2.0 * part * before**2 < after**2:
            return f"{error}, the rest is mostly noise of the acceleration"
        return error
    # A simulated motion is compared with the displacement, of which the force is no measure.
    motion = not only_disp and d.force is not None and d.force.moved
    return f"{error}, {'the motion is as measured' if motion else 'the rest is noise'}"


def _left_of_free_body(d: DiagnosisResult) -> float | None:
    """Return the fraction of a difference, beyond noise, that is left; None if a cell shows it.

    The force on a body without a load cell is that of its acceleration, whose noise may be most of
    it.
    """
    if d.channel != "force" or d.force is None or "f_meas" in d.case.channels:
        return None
    if d.force.problem.estimate.exact:
        return None
    return float(np.clip(left_of(d.force).share, 0.0, 1.0))


def _despite(d: DiagnosisResult) -> list[str]:
    """Return what is known although a force is unknown: of the actuator, and the best known set."""
    said = []
    before, after = d.fit.get("nrmse_before_disp", 0.0), d.fit.get("nrmse_after_disp", np.inf)
    lag = [c for c in d.candidates if c.channel == "disp" and c.signal is not None]
    if d.channel == "force" and lag and after < before and not (d.disp and d.disp.equal):
        known = _explained(lag, before, after)
        said.append(f"What the actuator does differently is known: {known} of it.")
    if d.channel == "force" and d.force is not None and d.force.best.members:
        said += _best_known(d.force)
    return said


def _best_known(search: Search) -> list[str]:
    """Return what the best set of known effects would leave, in words."""
    best, left = together(search.best.names), left_of(search)
    reason = "--why says why it is not named"
    if left.after < POLICY.excess_as_noise:
        return [f"The best set of known effects, {best}, would leave only noise; {reason}."]
    if not 0.0 < left.share < 1.0:
        return []
    share = f"{100.0 * left.share:.3g} %"
    return [
        f"The best set of known effects, {best}, would leave {share} of the difference; {reason}."
    ]


def _explained(found: Sequence[Found], before: float, after: float) -> str:
    """Return effects in words, and the share of a difference that they explain.

    ``before``, ``after``: rms of the difference without and with them, in any unit.
    """
    share = 100.0 * (1.0 - (after / before) ** 2) if before > 0 else 0.0
    text = f"{share:.3g} %" if share < 99.9 else "more than 99.9 %"
    return f"{_phrases(found)} {'explain' if len(found) > 1 else 'explains'} {text}"


def sentence(d: DiagnosisResult, answer: dict[str, Any]) -> str:
    """Return the verdict in one sentence, with a second one on its limits."""
    if d.verdict == "none":
        what = " in the actuator" if d.force is None else ""
        text = (
            f"Nothing is missing{what}: model and recording agree within the stated tolerances "
            "and noise."
        )
        return f"{text} {_judged(d)}".rstrip()
    sensor = "the actuator's displacement" if d.channel == "disp" else "the force"
    where = _when(d)
    if d.verdict == "unknown":
        lead = f"{where}, " if where else ""
        text = (
            f"{lead}for x from {d.x_m[0] * 1e3:.3g} to {d.x_m[1] * 1e3:.3g} mm and v from "
            f"{d.v_m_s[0] * 1e3:.3g} to {d.v_m_s[1] * 1e3:.3g} mm/s, {sensor} differs from the "
            "model in a way that no known effect explains."
        )
        return " ".join([text[:1].upper() + text[1:], *_despite(d)])
    if d.verdict == "ambiguous":
        sets = " or ".join(together(s) for s in d.ambiguous_with)
        return (
            f"An effect is missing, but this recording cannot distinguish between {sets}; each "
            f"explains {sensor} equally well."
        )
    by_name = {c.name: c for c in d.candidates}
    named = [by_name[n] for n in d.effects if n in by_name]
    signals = [c.signal for c in named if c.signal is not None and c.channel == d.channel]
    total = np.sum(signals, axis=0) if signals else None
    place = _where(d, total) if total is not None else ""
    if place:
        where = f"{where} and only where {place}" if where else f"where {place}"
    what = _difference(d, total)
    lead = f"{where} {what}" if where else what
    before, after = d.fit.get("nrmse_before", 0.0), d.fit.get("nrmse_after", 0.0)
    left = _left_of_free_body(d)
    sizes = (before, after) if left is None else (1.0, math.sqrt(left))
    said = f"{_explained(named, *sizes)} of the difference"
    if not 0.0 <= after < before:
        # A coarse load cell adds nothing to the model: it is the remainder itself.
        said = _phrases(named)
    return f"{lead[:1].upper()}{lead[1:]}: {said} ({_rest(d)})."
