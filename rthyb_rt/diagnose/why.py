"""The ledger of a diagnosis: the sets considered, the gain of each, and why it was rejected.

Everything is taken from the search's result and the ledger of `decide`; nothing is decided here.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.diagnose import effects, evidence, fitted, redundant
from rthyb_rt.diagnose import force as forces
from rthyb_rt.diagnose.actuation import ActuatorFit
from rthyb_rt.diagnose.dictionary import Dictionary, Solved
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, Nuisance
from rthyb_rt.diagnose.remainder import bend, left_of
from rthyb_rt.diagnose.result import DiagnosisResult, Displacement
from rthyb_rt.diagnose.verdict import allowed, within
from rthyb_rt.diagnose.words import called, quantity, together, value_text
from rthyb_rt.numbers import number

Floats = NDArray[np.float64]
Fate = Literal["named", "as good", "lost", "dropped", "refused"]


@dataclass(frozen=True)
class Decision:
    """One set of effects and what became of it.

    Attributes:
        channel: "force" or "disp".
        effects: names as in the answer.
        fate: "dropped": a rule excluded the set before sets were compared; "refused": an effect
            that was in no set worth examining.
        params: fitted parameters in words.
        chi2: sum of squares of the residual, in units of the noise.
        price: what it had to earn, in the same units.
        left: fraction of the misfit beyond noise that remains.
        why: the reason in words.
    """

    channel: Literal["force", "disp"]
    effects: tuple[str, ...]
    fate: Fate
    params: tuple[str, ...]
    chi2: float
    price: float
    left: float
    why: str


def ledger(d: DiagnosisResult, catalogue: bool = True) -> list[Decision]:
    """Return the sets that were considered, the actuator's first, and why each was rejected.

    Args:
        d: the diagnosis.
        catalogue: whether to try the effects that were in no set once more, alone and with the
            best set, to show how much they would improve the fit; this takes a moment.
    """
    out: list[Decision] = []
    if d.disp is not None:
        out += _actuator(d.disp)
    if d.force is not None:
        sets = _force(d, d.force)
        out += sets + _dropped(d.force)
        if catalogue:
            known = {n for s in sets for n in s.effects}
            out += _refused(d.force, known)
    return out


def facts(d: DiagnosisResult) -> list[tuple[str, str]]:
    """Return the basis of the answer: noise, tolerances, rows, permitted misfit, notes."""
    rows: list[tuple[str, str]] = [("verdict", _verdict(d))]
    if d.disp is not None:
        rows += _facts_of_displacement(d, d.disp)
    if d.force is not None:
        rows += _facts_of_force(d, d.force)
    return rows + [("note", note) for note in d.notes]


def to_json(d: DiagnosisResult, catalogue: bool = True) -> dict[str, Any]:
    """Return facts and ledger as in the answer."""
    sets = [asdict(row) for row in ledger(d, catalogue)]
    for row in sets:
        row |= {k: None for k, v in row.items() if isinstance(v, float) and not np.isfinite(v)}
    return {
        "facts": [{"what": what, "says": says} for what, says in facts(d)],
        "sets": sets,
    }


TITLES = {
    "disp": "Sets of effects of the actuator, best first",
    "force": "Sets of effects on the force, best first",
    "dropped": "Sets that a rule excluded beforehand",
    "refused": "Other effects on the force, each with the best of the forms of its law that "
    "are tried "
    "first",
}


def groups(why: dict[str, Any]) -> list[tuple[str, list[dict[str, Any]]]]:
    """Return the sets from `to_json` under their titles, without empty groups."""
    out: dict[str, list[dict[str, Any]]] = {key: [] for key in TITLES}
    for row in why["sets"]:
        out[row["fate"] if row["fate"] in out else row["channel"]].append(row)
    return [(TITLES[key], rows) for key, rows in out.items() if rows]


def lines(why: dict[str, Any], width: int = 100) -> list[str]:
    """Return the result of `to_json` as lines for a terminal."""
    out = ["Why:"]
    column = max((len(row["what"]) for row in why["facts"]), default=0)

    def put(text: str, indent: int, first: str = "") -> None:
        lead = first or " " * indent
        out.extend(textwrap.wrap(text, width, initial_indent=lead, subsequent_indent=" " * indent))

    for row in why["facts"]:
        put(row["says"], column + 4, f"  {row['what']:<{column}}  ")
    for title, rows in groups(why):
        out += ["", f"{title}:"]
        for row in rows:
            if row["fate"] in ("dropped", "refused"):
                put(f"{words_of(row)}: {row['why']}", 6, "  ")
                continue
            put(f"{row['fate']}: {words_of(row)}", 6, "  ")
            for text in (*row["params"], figures(row), row["why"]):
                put(text, 8, "      ")
    return out


def words_of(row: dict[str, Any]) -> str:
    """Return the effects of a set by their common names."""
    return together(row["effects"])


def figures(row: dict[str, Any]) -> str:
    """Return the figures of a set in words; empty if there are none."""
    if row["chi2"] is None:
        return ""
    left = "" if row["left"] is None else f"; leaves {_percent(row['left'])} of the misfit"
    return f"chi-squared {count(row['chi2'])}, price {count(row['price'])}{left}"


def count(value: float) -> str:
    """Return a number in chi-squared as a whole number with separated thousands.

    From a million on, as three digits and a power of ten: more say nothing to a reader.
    """
    if abs(value) >= 1e6:
        return number(value)
    digits = 2 if abs(value) < 9.95 else 1 if abs(value) < 99.5 else 0
    return f"{value:,.{digits}f}".replace("-", "−").replace(",", "\u202f")


def _gain(value: float) -> str:
    return count(value) if value > 0.0 else "nothing"


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g} %" if share >= 5e-5 else "less than 0.01 %"


# ---- the force ----------------------------------------------------------------------------------


def _left(search: forces.Search, fit: Fit) -> float:
    """Return the fraction of the misfit beyond noise that a set leaves."""
    n = search.problem.y.size * search.problem.estimate.share
    if search.moved:
        n = float(fit.residual.size) or n
    own = float(fit.residual @ fit.residual) if fit.residual.size else fit.chi2
    excess = own * (1.0 if search.moved else search.scale) / n - 1.0
    return max(excess, 0.0) / search.excess_before if search.excess_before > 0.0 else float("nan")


def _force(d: DiagnosisResult, search: forces.Search) -> list[Decision]:
    problem, best = search.problem, search.best
    believed = d.verdict == "ambiguous" or set(best.names) <= set(d.effects)
    equal = {f.names for f in search.equal} if believed else set()
    seen: set[tuple[str, ...]] = set()
    out = []
    for fit in [best, *search.equal, *search.fits, *search.rivals]:
        if fit.names in seen or not fit.members:
            continue
        seen.add(fit.names)
        fate: Fate = "as good" if fit.names in equal else "lost"
        if fit is best and believed:
            fate = "as good" if equal else "named"
        own = fitted.cost(problem, fit)
        why = _why_force(search, fit, fate, own)
        if fit is best and not believed:
            why = f"the best set, but not named; see the verdict above ({why})"
        out.append(
            Decision(
                "force", fit.names, fate, _params(search, fit), fit.chi2, own, _left(search, fit),
                why,
            )
        )  # fmt: skip
    return out


def _params(search: forces.Search, fit: Fit) -> tuple[str, ...]:
    ctx = search.problem.ctx
    return _texts(
        [(m.name, m.effect.report(ctx, m.trial, b))
         for m, b in zip(fit.members, fit.betas, strict=True)]
    )  # fmt: skip


def _texts(values: Sequence[tuple[str, dict[str, float]]]) -> tuple[str, ...]:
    """Return the parameters of each effect in words, with its name if there are several."""
    texts = [", ".join(value_text(k, v) for k, v in params.items()) for _, params in values]
    if len(texts) == 1:
        return tuple(texts)
    return tuple(f"{called(n)}: {t}" for (n, _), t in zip(values, texts, strict=True))


def _why_force(search: forces.Search, fit: Fit, fate: Fate, own: float) -> str:
    problem, best = search.problem, search.best
    gain = search.null.chi2 - fit.chi2
    if fit is best and best.members:
        share = _percent(min(search.held_gain, 1.0))
        held = "" if search.moved else f"; {share} of that is confirmed on rows that were held out"
        return (
            f"improves chi-squared by {count(gain)}, {count(gain - own)} more than its price{held}"
        )
    if not best.members:
        return _not_enough(search, fit, gain)
    if any(r.rule == "size" and r.names == fit.names for r in search.ledger):
        return _too_small(search, fit, gain)
    unsure = next((r for r in search.ledger if (r.rule, r.names) == ("unsure", fit.names)), None)
    if unsure is not None:
        return (
            f"the size of {called(unsure.part)} beside the others may be zero: it is "
            f"{unsure.found**0.5:.2g} standard deviations, and must be {unsure.wanted**0.5:.3g}"
        )
    named = (best.chi2, fitted.cost(problem, best), best.names)
    if fate == "as good":
        more = fitted.count(problem, fit) - fitted.count(problem, best)
        return (
            f"{_apart(fit.chi2 - best.chi2)} in chi-squared with {_parameters(more)}; a "
            f"difference of {POLICY.same_evidence:g} would separate them"
        )
    return _against((fit.chi2, own, fit.names), named)


def _not_enough(search: forces.Search, fit: Fit, gain: float) -> str:
    """Return why a set is not named if none is."""
    needs = fitted.to_earn(search.problem, fit)
    if gain <= needs:
        return f"improves chi-squared by {_gain(gain)}, but must improve it by {count(needs)}"
    if fitted.size(search.problem, fit) <= POLICY.least_force:
        return _too_small(search, fit, gain)
    tiny = next((r for r in search.ledger if (r.rule, r.names) == ("beside tiny", fit.names)), None)
    if tiny is not None:
        return (
            f"improves chi-squared by {count(gain)}, but added to {together(tiny.against)} by "
            f"{_gain(tiny.found)}, and must improve it by {count(tiny.wanted)}"
        )
    left = fitted.left(search.problem, fit)
    if left > 1.0 and any(r.rule == "closer" and r.names == fit.names for r in search.ledger):
        return (
            f"improves chi-squared by {count(gain)}, but the model with it differs from the "
            f"recorded force by {_percent(left)} of what it does without it"
        )
    if not search.moved:
        held = evidence.held_out_gain(search.problem, fit)
        if held < POLICY.held_out_share:
            return (
                f"improves chi-squared by {count(gain)}, of which {_percent(max(held, 0.0))} is "
                "confirmed on rows that were held out; at least "
                f"{_percent(POLICY.held_out_share)} is required"
            )
    return (
        f"improves chi-squared by {count(gain)}; because the set before it was rejected, later "
        "sets are not considered"
    )


def _too_small(search: forces.Search, fit: Fit, gain: float) -> str:
    """Return that the force of a set is smaller than what is reported."""
    size = fitted.size(search.problem, fit)
    return (
        f"improves chi-squared by {count(gain)}, but its force is only {_percent(size)} of "
        f"the whole; less than {_percent(POLICY.least_force)} is not reported"
    )


DROPPED = {
    "needed": "{part}, added to the others, improves chi-squared by {found}, but must improve it "
    "by {wanted}",
    "share": "{part}, added to the others, improves chi-squared by {found}; up to {wanted} may "
    "be due to the form of the laws",
    "harmonic": "{part}, added to the others, improves chi-squared by {found}; at a frequency "
    "that the other forces have as well, up to {wanted} may be due to the form of the laws",
    "form": "{part}, added to the others in any form that their laws may have, improves "
    "chi-squared by {found}, but must improve it by {wanted}",
    "together": "improves chi-squared by {found} more than {against}, but must improve it by "
    "{wanted} more",
    "small": "{part}, added to the others, has a force of only {found} of the whole; less than "
    "{wanted} is not reported",
    "normal offset": "{part} is no larger than is normal between two channels",
    "off zero": "deflects the spring by no more than the possible zero error of the displacement "
    "sensor",
    "beside zero": "improves chi-squared by {found} more than the possible zero error of the "
    "displacement sensor does, but must improve it by {wanted} more",
    "slow noise": "{part} improves chi-squared by {found}, but must improve it by {wanted} to "
    "stand out among the slow noise that remains",
    "near noise": "{part} improves chi-squared by {found}, but must improve it by {wanted} to "
    "stand out among the noise near its frequency",
    "driven": "{part} improves chi-squared by {found} through the motion that the test imposes, "
    "without the noise that is in force and motion alike, but must improve it by {wanted}",
    "driven together": "its effects together improve chi-squared by {found} through the motion "
    "that the test imposes, without the noise that is in force and motion alike, but must improve "
    "it by {wanted}",
    "rounding": "the readings between two changes have a deviance of {found} with it, of at most "
    "{wanted}",
    "drift goes on": "the drift is smaller within each half of the recording",
    "drift repeats": "the motion of one half of the recording has {found} cycles, but a drift "
    "needs {wanted} in each",
    "drift or offset": "improves chi-squared by {found} more than {against}, but must improve it "
    "by {wanted} more, because the offset with which a drift begins is not known",
    "more laws": "improves chi-squared by {found} more than the best set with fewer laws, but must "
    "improve it by {wanted} more",
    "yielding": "{against} explains the same with a simpler effect",
    "plainest": "improves chi-squared by {found} more than {against}, but must improve it by "
    "{wanted} more",
}
"""Texts of the rules of `decide` that exclude a set."""
MOST = 12
"""Number of such sets that are listed."""


def _dropped(search: forces.Search) -> list[Decision]:
    """Return the sets that a rule excluded, in the order in which they were examined."""
    kept = {f.names for f in (*search.fits, *search.equal)}
    first = {r.names: r for r in reversed(search.ledger) if r.rule in DROPPED}
    nan, out = float("nan"), []
    for ruling in [first[names] for names in dict.fromkeys(r.names for r in search.ledger)
                   if names in first and names not in kept][:MOST]:  # fmt: skip
        share = ruling.rule == "small"
        why = DROPPED[ruling.rule].format(
            part=called(ruling.part) if ruling.part else "",
            found=(_percent if share else _gain)(ruling.found),
            wanted=(_percent if share else count)(ruling.wanted), against=together(ruling.against),
        )  # fmt: skip
        out.append(Decision("force", ruling.names, "dropped", (), nan, nan, nan, why))
    return out


def _against(
    own: tuple[float, float, tuple[str, ...]], named: tuple[float, float, tuple[str, ...]]
) -> str:
    """Return why one set lost to another, each given as (chi-squared, price, names)."""
    (chi2, costs, names), (best, best_costs, best_names) = own, named
    score = chi2 + costs - best - best_costs
    if set(names) > set(best_names):
        more = together(sorted(set(names) - set(best_names)))
        return (
            f"{more}, added to the best set, improves chi-squared by {_gain(best - chi2)} at a "
            f"price of {count(costs - best_costs)}"
            + ("" if score >= 0.0 else "; so small an improvement may be due to the form of a law")
        )
    if set(names) < set(best_names):
        less = together(sorted(set(best_names) - set(names)))
        return (
            f"without {less}, chi-squared is {count(chi2 - best)} higher and the price "
            f"{count(best_costs - costs)} lower"
        )
    if score < 0.0:
        return (
            f"better by {count(-score)}, including the price; this may be due to the form of a "
            "law, so the simpler set is preferred"
        )
    return f"{count(score)} worse than the best set, including the price"


def _apart(value: float) -> str:
    return f"{count(abs(value))} {'behind' if value >= 0.0 else 'ahead'}"


def _parameters(more: int) -> str:
    if more == 0:
        return "the same number of parameters"
    return f"{abs(more)} parameter{'s' if abs(more) > 1 else ''} {'more' if more > 0 else 'less'}"


def _refused(search: forces.Search, known: set[str]) -> list[Decision]:
    """Return the gain of effects that were in no set, alone and with the best set."""
    problem = search.problem
    dictionary = Dictionary(problem)
    alone = _best_of(dictionary, dictionary.singles())
    base = dictionary.reduced()[2]
    beside: dict[str, tuple[float, float]] = {}
    if search.best.members and not search.moved:
        groups = [
            (g,)
            for g, group in enumerate(dictionary.groups)
            if not set(group.member.effect.names) & set(search.best.names)
        ]
        products = dictionary.beside(search.best)
        beside = _best_of(dictionary, dictionary.sets(groups, products))
        floor = products[2]
    out = []
    n = problem.y.size * problem.estimate.share
    free = {nuisance.name for nuisance in problem.nuisances if nuisance.sigma is None}
    for name, effect in effects.catalogue().items():
        if name in known or set(effect.names) <= known:
            continue
        if name not in alone:
            why = "not tried: this kind of recording cannot reveal it"
            if name in free:
                why = "already fitted with the model, which states no tolerance for it"
            if any(e.name == name for e in problem.effects):
                why = "not tried: nothing in this recording or model suggests it"
                if effect.trials(problem.ctx):
                    why = (
                        "improves the fit in none of its forms: its force would have the wrong sign"
                    )
            nan = float("nan")
            out.append(Decision("force", (name,), "refused", (), nan, nan, nan, why))
            continue
        chi2, costs = alone[name]
        words = [f"alone it improves chi-squared by {count(max(base - chi2, 0.0))}"]
        if name in beside:
            words.append(f"added to the best set by {count(max(floor - beside[name][0], 0.0))}")
        why = f"{', '.join(words)}, at a price of {count(costs)}"
        left = max(chi2 * search.scale / n - 1.0, 0.0) / max(search.excess_before, 1e-12)
        out.append(Decision("force", (name,), "refused", (), chi2, costs, min(left, 1.0), why))
    return out


def _best_of(dictionary: Dictionary, found: Solved) -> dict[str, tuple[float, float]]:
    """Return chi-squared and price of the best shape of each effect, by name."""
    out: dict[str, tuple[float, float]] = {}
    for chi2, groups in found:
        name = dictionary.groups[groups[0]].member.name
        costs = dictionary.penalty(groups)
        if name not in out or chi2 + costs < sum(out[name]):
            out[name] = (chi2, costs)
    return out


# ---- the actuator -------------------------------------------------------------------------------


def _actuator(disp: Displacement) -> list[Decision]:
    n = max(disp.task.rows.size, 1)
    before = disp.null.chi2 / n - 1.0
    equal = {f.names for f in disp.equal}
    out: list[Decision] = []
    seen: set[tuple[str, ...]] = set()
    for fit in [disp.best, *disp.equal, *disp.rivals]:
        if fit.names in seen or not fit.effects:
            continue
        seen.add(fit.names)
        fate: Fate = "lost"
        if fit is disp.best:
            fate = "named" if disp.known else "lost"
        elif fit.names in equal:
            fate = "as good"
        params = _texts(
            [(e.name, e.report(disp.task.base, v))
             for e, v in zip(fit.effects, fit.values, strict=True)]
        )  # fmt: skip
        left = max(fit.chi2 / n - 1.0, 0.0) / before if before > 0.0 else float("nan")
        out.append(
            Decision(
                "disp", fit.names, fate, params, fit.misfit(disp.scale), disp.task.price(fit), left,
                _why_actuator(disp, fit, fate),
            )
        )  # fmt: skip
    return out


def _why_actuator(disp: Displacement, fit: ActuatorFit, fate: Fate) -> str:
    scale, best = disp.scale, disp.best
    own = disp.task.price(fit)
    gain = disp.null.misfit(scale) - fit.misfit(scale)
    if fit is best and fate == "named":
        return f"improves chi-squared by {count(gain)}, {count(gain - own)} more than its price"
    if fit is best:
        return f"the best set, but it leaves {_percent(disp.left)} of the misfit"
    if not best.effects:
        if gain <= own:
            return f"improves chi-squared by {_gain(gain)}, but must improve it by {count(own)}"
        return (
            f"improves chi-squared by {count(gain)}, but the set or one of its effects hardly "
            "changes the motion"
        )
    if fate == "as good":
        return (
            f"{_apart(fit.misfit(scale) - best.misfit(scale))} in chi-squared with "
            f"{_parameters(fit.count - best.count)}; a difference of {POLICY.same_evidence:g} "
            "would separate them"
        )
    return _against(
        (fit.misfit(scale), own, fit.names),
        (best.misfit(scale), disp.task.price(best), best.names),
    )


NAMELESS = {
    "varying": "a stiffness or damping that changes periodically with time",
    "stroke": "a second mass on a spring that hardens or softens with its stroke",
    "memory": "a force with a spectrum of relaxation times, like rubber,",
}
"""Laws outside the catalogue with which a set is compared, by the rule of `verdict`."""
TURNED = {
    "blur": "the best set is no larger than the uncertainty of the estimated motion",
    "motion": "the model alone simulates the measured motion, within its tolerances and the "
    "sensor's noise",
    "reproduced": "the best set, found in the balance of forces, does not reproduce the measured "
    "motion when it is simulated",
    "chance": "the best set is no larger than what noise of this spectrum produces by chance",
    "leftover": "the best set leaves most of a misfit that the form of an actuator effect leaves",
    "weak": "one effect of the best set may be zero: its size is below 1.96 standard deviations",
    "steady": "the parameters of the best set differ between parts of the recording",
    "curves": "the best set is the sum of three functions of the displacement, which follows "
    "almost any other, and leaves more than noise",
    **{rule: f"{law} explains more than the best set" for rule, law in NAMELESS.items()},
    "steps": "the residual of the model is that of the load cell's quantization",
}
"""Texts of the rules of `verdict` that withdraw a set."""


# ---- basis of the answer ------------------------------------------------------------------------


def _no_noise(search: forces.Search) -> str:
    """Return why the best set's residual is not noise, although its spectrum would permit it."""
    off, most = bend(search.problem, search.best), POLICY.within_tolerance
    noise = "the best set leaves what might be noise of a spectrum read from the recording"
    if not within(off, POLICY):
        return (
            f"{noise}, but moves a stated value by {off:.3g} standard deviations of its "
            f"tolerance; at most {most:g} is accepted"
        )
    return f"{noise}, but it is larger than the data sheet states, or comes in bursts"


def _leaves(search: forces.Search) -> str:
    """Return what the best set leaves that is neither noise nor the form of a law."""
    left = left_of(search)
    # Of a naive model, the form of its laws is measured in the force itself.
    if left.coloured_noise(POLICY) and not left.naive:
        return _no_noise(search)
    return (
        f"the best set leaves {_percent(left.share)} of the misfit; at most "
        f"{_percent(allowed(left, POLICY))} of the misfit can be "
        "attributed to an inexact formula of an effect"
    )


def _verdict(d: DiagnosisResult) -> str:
    search, turned = d.force, [TURNED[r.rule] for r in d.ledger]
    if d.verdict == "unknown" and "heldout_nrmse_after" in d.fit:
        before, after = d.fit["heldout_nrmse_before"], d.fit["heldout_nrmse_after"]
        if after > before:
            return (
                f"unknown: on the second recording the error grows from {_percent(before)} to "
                f"{_percent(after)}"
            )
    if d.verdict == "unknown":
        changed = next((r for r in d.ledger if r.rule == "steady"), None)
        if changed is not None:
            return (
                f"unknown: {together(changed.names)} would have different parameters in "
                f"{changed.part} than in the rest ({changed.found:.1f} standard deviations, of "
                f"which chance explains {changed.wanted:g}), and so probably stands for a law "
                "that is not known"
            )
        rival = next((r for r in d.ledger if r.rule in NAMELESS), None)
        if rival is not None:
            return (
                f"unknown: {NAMELESS[rival.rule]} explains more than {together(rival.names)}, by "
                f"{rival.found:.0f} in chi-squared including the prices of both "
                f"(the limit is {rival.wanted:g})"
            )
        if d.disp is not None and not d.disp.known:
            left = _percent(d.disp.left)
            return f"unknown: the best set of the actuator leaves {left} of the misfit"
        if search is not None and not search.best.members:
            return (
                "unknown: no set of effects improves the fit enough to justify its parameters, but "
                f"the residual of the model alone has {count(search.excess_before + 1.0)} times "
                "the power of the noise"
            )
        if search is not None:
            return f"unknown: {turned[-1] if turned else _leaves(search)}"
    if d.verdict == "none" and search is not None and search.best.members and turned:
        return f"none: {turned[-1]}"
    return {
        "none": "none: no set of effects improves the fit enough to justify its parameters, and "
        "the residual of the model alone is noise",
        "explained": "explained: one set of effects is better than all others, and what remains is "
        "noise, or is small enough to be attributed to the inexact formula of an effect",
        "ambiguous": "ambiguous: several sets fit equally well",
    }.get(d.verdict, d.verdict)


NOISE_FREE = 2.0**-24
"""A step of a 24-bit converter, relative to its range: readings with less noise are simulated."""


def _noise(
    believed: float, sheet: float | None, unit: str, coloured: bool, readings: Floats | None
) -> str:
    text = f"{quantity(believed, unit)} assumed"
    if coloured:
        text = f"coloured; for white noise, {text}"
    if not sheet:
        text = f"{text}; the model states no noise"
        if readings is not None and believed < NOISE_FREE * float(np.nanmax(np.abs(readings))):
            text += (
                ". The readings are free of noise, and the resolution of their sensor is not "
                "known: multiples of this noise are very large numbers"
            )
        return text
    return f"{text}, {quantity(sheet, unit)} stated"


def _facts_of_displacement(d: DiagnosisResult, disp: Displacement) -> list[tuple[str, str]]:
    task, fit = disp.task, disp.best
    rows = [
        (
            "noise of the displacement",
            _noise(
                task.sigma,
                d.case.model.x_std,
                "m",
                task.own is not None,
                d.case.channels.get("x_meas"),
            ),
        ),
        ("rows evaluated, actuator", f"{task.rows.size} of {d.case.t.size}"),
        (
            "misfit, actuator",
            f"{count(disp.null.chi2 / task.rows.size)} times the noise power before, "
            f"{count(fit.chi2 / task.rows.size)} after",
        ),
    ]
    if disp.scale > 1.0:
        rows.append(
            (
                "evidence, actuator",
                f"divided by {count(disp.scale)} because its rows are correlated",
            )
        )
    if fit.zero_m:
        rows.append(
            (
                "zero of the displacement",
                f"{quantity(fit.zero_m, 'm')} away from that of the command",
            )
        )
    return rows


def _facts_of_force(d: DiagnosisResult, search: forces.Search) -> list[tuple[str, str]]:
    problem, model = search.problem, d.case.model
    found = problem.estimate
    motion = "estimated from the sensors"
    if found.exact:
        motion = "simulated from the command, without noise"
    if search.moved:
        motion = "simulated with each set and compared with the measured motion"
    looked = f", using one in {problem.thin}" if problem.thin > 1 else ""
    if found.read is not None:
        looked = ", those with a force near the end of a step of the coarse load cell"
    rows = [
        (
            "noise of the force",
            _noise(found.sigma_n, model.f_std, "N", found.coloured, d.case.channels.get("f_meas")),
        ),
        ("motion", motion),
        ("rows evaluated, force", f"{int(found.rows.sum())} of {d.case.t.size}{looked}"),
        (
            "misfit, force",
            f"{count(search.excess_before + 1.0)} times the noise power before, "
            f"{count(search.excess_after + 1.0)} after",
        ),
    ]
    if search.scale > 1.0:
        rows.append(
            ("evidence, force", f"divided by {count(search.scale)} because its rows are correlated")
        )
    fit, beside, named = _adjusted(d, search)
    for b, nuisance in zip(fit.nuisance, problem.nuisances, strict=True):
        held = "adjusted freely, no tolerance stated"
        if nuisance.sigma:
            held = f"{_moved(nuisance, nuisance.sigma)} stated"
        rows.append(
            (
                f"tolerance, {nuisance.plain}",
                f"adjusted by {_moved(nuisance, float(b))}{beside}; {held}",
            )
        )
    known = redundant.witness(d.case, problem.ctx, found)
    if known is not None:
        before, after = (float(np.mean(known.left(f) ** 2)) for f in (search.null, fit))
        rows.append(
            (
                "load cell compared with m a_meas",
                f"{count(before)} times the noise power in addition to the force that moves the "
                f"body, {count(after)} with {named}: the remainder comes from the load cell itself",
            )
        )
    rows.append(
        (
            "price of a parameter",
            f"{count(problem.ln_n)}, and {POLICY.effect_price:g} for each effect",
        )
    )
    return rows


def _adjusted(d: DiagnosisResult, search: forces.Search) -> tuple[Fit, str, str]:
    """Return the set whose adjustment of the model is told, and in words whose it is.

    A law that is missing pulls the model alone as far as it can: that says nothing of the model.
    """
    if not search.best.members:
        return search.null, " without any effect", "the model adjusted"
    if d.verdict == "unknown":
        return search.best, " beside the best set, which is not named", "the best set"
    if d.verdict == "ambiguous" or set(search.best.names) <= set(d.effects):
        return search.best, "", "the effects named"
    return search.null, " without any effect", "the model adjusted"


def _moved(nuisance: Nuisance, value: float) -> str:
    if nuisance.unit == "%":
        return f"{100.0 * value:.2f} %".replace("-", "−")
    return quantity(value, nuisance.unit)
