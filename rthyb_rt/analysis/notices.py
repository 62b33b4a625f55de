"""Notices about a test that must not be missed, as sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple

from rthyb_rt.core.laws import LAWS, passes
from rthyb_rt.numbers import count, delay, number, percent

if TYPE_CHECKING:
    from rthyb_rt.analysis.attention import Finding
    from rthyb_rt.analysis.summary import SummarySettings


class Notice(NamedTuple):
    """Something about a test that must not be missed.

    Attributes:
        level: "alarm" if the figures may not be what the test was meant to show, otherwise "note".
        text: one sentence.
    """

    level: Literal["alarm", "note"]
    text: str


def not_finite_notices(rows: int) -> list[Notice]:
    """Return the notice for rows with values that are not finite."""
    if not rows:
        return []
    return [
        Notice(
            "alarm",
            f"{count(rows, 'row')} with non-finite values; they are excluded from the results.",
        )
    ]


def omission_notices(omitted: Sequence[str]) -> list[Notice]:
    """Return the notices on values that the rig file omitted."""
    return [Notice("note", f"{text[0].upper()}{text[1:]}.") for text in omitted]


def flag_notices(flags: Mapping[str, int], test_samples: int, skipped_ticks: int) -> list[Notice]:
    """Return the notices for the flags of the rows.

    Args:
        flags: number of rows with each flag, by name.
        test_samples: rows of the test proper.
        skipped_ticks: ticks without a row.
    """
    found = []
    flagged = {
        "limited": "had the command reduced by a limit: the actuator was sent less than requested",
        "not_sent": "had a command that could not be sent",
        "predicted": "had predicted instead of measured feedback",
        "blind": "were skipped, without feedback and command",
        "frozen": "had the delay estimate and the stiffness frozen because feedback was missing",
    }
    for name, text in flagged.items():
        n = flags.get(name, 0)
        if name in ("not_sent", "predicted"):
            n -= flags.get("blind", 0)  # these have both flags, and a line of their own
        if n:
            share = percent(n / test_samples)
            of = f"{count(n, 'sample')} of {test_samples}"
            found.append(Notice("alarm", f"{of} ({share}) {text}."))
    if skipped_ticks:
        found.append(Notice("alarm", f"{count(skipped_ticks, 'tick')} skipped."))
    return found


def attention_in_words(one: Finding, given: SummarySettings, all_found: Sequence[Finding]) -> str:
    """Return one sentence on what has gone wrong, with the key to change.

    Args:
        one: the finding.
        given: settings of the test.
        all_found: all findings of the test, since one may be the cause of another.
    """
    beside: set[str] = {other.kind for other in all_found if other.meets(one)}
    span, allowed = _span(one), _allowed(one)
    if one.kind == "response":
        return f"{_departed('The response', one)}; {_remedy_of_response(given, beside)}."
    if one.kind == "delay":
        away = abs(one.value - (given.alpha_identified or 0.0))
        found = (
            f"Alpha departed from the identified delay of "
            f"{delay(given.alpha_identified or 0.0, given.fs_hz)}: {span} it reached "
            f"{delay(one.value, given.fs_hz)}, an error of {delay(away, given.fs_hz)}; this "
            f"structure remains stable up to an error of {delay(one.allowed, given.fs_hz, 2)}"
        )
        return f"{found}; {_remedy_of_delay(given, one.allowed)}."
    if one.kind == "damping":
        found = (
            f"Negative damping: {span} the tracking error supplied {number(one.value, 2)} times "
            "the energy that the numerical damping removed"
        )
        return f"{found}; {_remedy_of_damping(given, beside)}."
    found = (
        f"No force compensation for {percent(one.value)} of the motion ({allowed}): the tangent "
        "stiffness was zero"
    )
    return f"{found}; {_remedy_of_stiffness(given)}."


def axis_attention_in_words(axis: str, one: Finding, controller: str) -> str:
    """Return a sentence on an axis that did not follow the reference, with the remedy.

    Args:
        axis: name of the axis.
        one: the finding, of the kind "response".
        controller: ``controller.type`` of the test.
    """
    remedy = "identify the rig again, and examine the tracking error of each axis"
    if passes(controller):
        remedy = 'nothing compensates the delay: set controller.type = "matrix"'
    return f"{_departed(f'Axis {axis}', one)}; {remedy}."


def _departed(what: str, one: Finding) -> str:
    return (
        f"{what} departed from the reference simulation: {_span(one)} the rms difference was "
        f"{percent(one.value)} of the reference ({_allowed(one)})"
    )


def _span(one: Finding) -> str:
    return f"from {one.from_s:.1f} to {one.to_s:.1f} s"


def _allowed(one: Finding) -> str:
    return f"at most {100.0 * one.allowed:g} % is allowed"


def _remedy_of_response(given: SummarySettings, beside: set[str]) -> str:
    if not given.plc_enabled:
        return 'nothing compensates the delay: set controller.type = "robust"'
    if beside & {"delay", "stiffness"}:
        return "the cause is given below"
    if not given.rfc_enabled:
        return (
            "set controller.rfc.enabled = true, which corrects the remaining error of the phase "
            "lead"
        )
    if not given.estimator_enabled:
        return "update controller.alpha0 with rthyb identify, or let it adapt"
    return "update controller.alpha0 with rthyb identify, and examine the tracking error"


def _remedy_of_delay(given: SummarySettings, allowed: float) -> str:
    if not given.estimator_enabled:
        return "set controller.alpha0 to that delay, or identify the rig again"
    start, identified = given.alpha_start, given.alpha_identified
    if start is not None and identified is not None and abs(start - identified) > allowed:
        return (
            f"alpha started at {delay(start, given.fs_hz)}, the value of controller.alpha0: omit "
            "that key, so that a test starts at the identified delay; if the rig has changed, "
            "identify it again"
        )
    law = LAWS.get(given.controller or "")
    less = (law.calmer if law else None) or "review the settings of the control law"
    return f"{less}; if the rig has changed, identify it again"


def _remedy_of_damping(given: SummarySettings, beside: set[str]) -> str:
    if not given.plc_enabled:
        return 'compensate the delay: controller.type = "robust"'
    if "delay" in beside:
        return "alpha is the cause, see above"
    if not given.rfc_enabled:
        return "set controller.rfc.enabled = true"
    if "stiffness" in beside:
        return "the missing force compensation is the cause, see below"
    return "update controller.alpha0 with rthyb identify, and check noise and friction"


def _remedy_of_stiffness(given: SummarySettings) -> str:
    if given.tangent == "mean-of-ratios":
        return (
            'set controller.rfc.tangent = "least-squares", which tolerates more noise, or increase '
            "controller.rfc.window_samples"
        )
    return "increase controller.rfc.window_samples or the motion: noise hides the stiffness"
