"""Settings that a test file leaves open, as derived from the rig file."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from rthyb_rt.config.lawtables import COEFFICIENTS, RESPONSE, coefficients_of
from rthyb_rt.config.numerical import Matrices
from rthyb_rt.config.rate import STANDARD_HZ, Rate
from rthyb_rt.config.rigfile import RigFile
from rthyb_rt.errors import InputError, Problem

if TYPE_CHECKING:
    from rthyb_rt.config.testfile import Controller, TestFile
    from rthyb_rt.core.laws import Parameter

PAIR_CUTOFF_HZ: Final = 10.0
"""Cut-off of the filter pair with a rolled-off lead: noise would bias beta with a higher one."""
ROLL_OFF: Final = "identified.roll_off_hz"
_WEIGHTS: Final = ("w1", "w2")
_PAIR: Final = "delay_estimator.cutoff_hz"
_CURVATURE: Final = "beta0"


def roll_off_hz(rig: RigFile) -> float | None:
    """Return the roll-off frequency of a lead, below the rig's first resonance."""
    return rig.identified.roll_off_hz if rig.identified is not None else None


def weights(roll_off_hz: float, period_s: float) -> tuple[float, float]:
    """Return W1, W2 of Eqn 2.5 that put both poles at ``rho = exp(-2 pi f h)``.

    z^2 + (W2 / W1) z + 1 / W1 = (z - rho)^2, which is stable for every f.
    """
    rho = math.exp(-2.0 * math.pi * roll_off_hz * period_s)
    return 1.0 / rho**2, -2.0 / rho


def law_settings_of_rig(
    test: TestFile, rig: RigFile, rate: Rate, problems: list[Problem]
) -> dict[str, float]:
    """Return the control law settings that the test leaves to the rig, by their keys.

    Args:
        test, rig: the files.
        rate: rate of the test.
        problems: receives errors.
    """
    controller = test.controller
    open_keys = [p for p in controller.law.parameters if p.rig_key and not _said(controller, p.key)]
    found = dict[str, float]()
    for p in open_keys:
        if p.rig_key == ROLL_OFF:
            value = None if controller.as_printed else _of_roll_off(p, test, rig, rate)
        else:
            value = _plain(p, rig)
        if value is not None:
            found[p.key] = value
    fitted = [p.key for p in open_keys if p.rig_key == RESPONSE]
    _reject_no_inverse(controller, problems)
    if fitted and controller.plc_enabled:
        table, start = fitted[0].partition(".")[0], dict[str, float]()
        try:
            if f"{table}.{COEFFICIENTS[0]}" in fitted:
                roll_off = controller.setting(f"{table}.fit_roll_off_hz") or 0.0
                # The law itself rejects a frequency that this rate does not have.
                low = roll_off < 0.5 * rate.hz
                start = _inverse(roll_off, rig, rate, controller.type) if low else {}
            else:
                key = f"{table}.roll_off_hz"
                roll_off = found.get(key) or controller.setting(key) or 0.0
                start = _lead(roll_off, rig, rate)
        except InputError as error:
            problems += error.problems
            start = dict.fromkeys((key.rpartition(".")[2] for key in fitted), math.nan)
        found |= {key: start[name] for key in fitted if (name := key.rpartition(".")[2]) in start}
    return found


def _reject_no_inverse(controller: Controller, problems: list[Problem]) -> None:
    """Reject an inverse whose given coefficients are all zero: it would compensate nothing.

    Without phase lead they are not used, and a resolved test file then has zeros.
    """
    keys = coefficients_of(controller.law)
    if not keys or not controller.plc_enabled or not all(_is_in(controller, key) for key in keys):
        return
    if not any(controller.setting(key) for key in keys):
        problems.append(
            Problem(
                f"controller.{keys[0]}",
                f"found {', '.join(COEFFICIENTS)} all 0, which is no inverse; leave all of them "
                "out, so that they are fitted to what rthyb identify has found, or use the law "
                "gain-alpha-beta, which needs no inverse",
            )
        )


def _inverse(roll_off_hz: float, rig: RigFile, rate: Rate, law: str) -> dict[str, float]:
    """Return the coefficients of the rig's inverse, by the last part of their keys."""
    # NumPy is slow to import, and most laws need no fit.
    from rthyb_rt.config import response

    inverse = response.fitted(rig, rate, roll_off_hz, law)
    return {f"b{j}": float(value) for j, value in enumerate(inverse.b)}


def _lead(roll_off_hz: float, rig: RigFile, rate: Rate) -> dict[str, float]:
    """Return the initial values of a lead with gain and curvature: from the response, or delay."""
    found = rig.identified
    if found is None:
        return {}
    if len(found.frequency_hz) < 3:
        return {"delay0_s": found.alpha / STANDARD_HZ}
    import numpy as np

    from rthyb_rt.config import response

    g = response.response(found, rate, hold=response.hold_of(rig))
    f_hz = np.asarray(found.frequency_hz)
    slow = f_hz <= response.SLOW_HZ
    start = response.fitted_lead(
        f_hz[slow], g[slow], rate.period_s, *weights(roll_off_hz, rate.period_s)
    )
    return {
        "gain0": start.gain,
        "delay0_s": start.delay_s,
        "curvature0_s2": start.curvature_s2,
    }


def rfc_of_rig(test: TestFile, rig: RigFile) -> tuple[float, float]:
    """Return the default cut-off, Hz, and lateness, s, of the force compensation.

    A force that an integrator holds over a step is half a step late, and a force used one sample
    later is one more sample late. A rig without a known resonance keeps the earlier defaults, 0 and
    0; so does the paper's controller.
    """
    roll_off = roll_off_hz(rig)
    controller = test.controller
    if roll_off is None or controller.as_printed or not controller.compensates:
        return 0.0, 0.0
    matrices, rate = test.numerical.matrices, Rate(test.test.sample_rate_hz)
    late = 0.0
    if isinstance(matrices, Matrices):
        late = matrices.force_delay_samples + (0.5 if matrices.integrator == "rk4" else 0.0)
    return min(roll_off, 0.45 * rate.hz), late * rate.period_s


def note_defaults(test: TestFile, rig: RigFile, notes: list[str]) -> None:
    """Report settings that keep earlier defaults because the rig's resonance is not known."""
    controller = test.controller
    keys = [p.key for p in controller.law.parameters if p.rig_key == ROLL_OFF]
    left = [key for key in keys if not _said(controller, key)]
    known = roll_off_hz(rig) is not None or controller.as_printed
    if not left or known or not controller.plc_enabled:
        return
    found = rig.identified
    swept = max(found.frequency_hz, default=0.0) if found is not None else 0.0
    kept = ", ".join(f"{key} = {controller.setting(key):g}" for key in left)
    from rthyb_rt.config import response

    resonance = None
    if found is not None and found.frequency_hz:
        resonance = response.resonance_of_sweep(
            tuple(found.frequency_hz), tuple(found.amplitude), tuple(found.delay_at_frequency_s)
        )
    if resonance is not None:
        notes.append(
            f'rig "{rig.rig.name}" has a resonance at {resonance:.4g} Hz but no {ROLL_OFF}, so the '
            f"lead is rolled off as before ({kept}), not below the resonance: identify the rig "
            f"again, or add roll_off_hz = {response.BELOW * resonance:.3g} to [identified]"
        )
        return
    why = f"no resonance up to {swept:g} Hz" if swept else "no identified response"
    short = swept < response.LEAST_TOP_HZ
    notes.append(
        f'rig "{rig.rig.name}" has {why}, so the lead is rolled off as before ({kept}); '
        + (f"{response.SWEEP} looks for a resonance" if short else "no action is needed")
    )


def _said(controller: Controller, key: str) -> bool:
    """Return whether the test file gives a setting, or one that belongs to it.

    The two weights belong together, with the filter pair's cut-off and the curvature. Coefficients
    of an inverse count only if all of them are given.
    """
    together: tuple[str, ...] = _WEIGHTS if key in (*_WEIGHTS, _PAIR, _CURVATURE) else ()
    table, _, last = key.rpartition(".")
    if last in COEFFICIENTS:
        return all(_is_in(controller, f"{table}.{one}") for one in COEFFICIENTS)
    return any(_is_in(controller, one) for one in (key, *together))


def _is_in(controller: Controller, key: str) -> bool:
    place: object = controller
    for part in key.split("."):
        place = getattr(place, part, None)
    return place is not None


def _of_roll_off(p: Parameter, test: TestFile, rig: RigFile, rate: Rate) -> float | None:
    """Return the value of a setting when the lead is rolled off below the rig's resonance."""
    known = roll_off_hz(rig)
    if known is None:
        return None
    if p.key == _CURVATURE:
        most = test.controller.setting("delay_estimator.alpha_max") or 0.0
        return _curvature(known, rig, rate, 0.5 * most**2)
    if p.key in _WEIGHTS:
        return weights(known, rate.period_s)[_WEIGHTS.index(p.key)]
    return PAIR_CUTOFF_HZ if p.key == _PAIR else min(max(known, p.low), p.high)


def _curvature(roll_off_hz: float, rig: RigFile, rate: Rate, most: float) -> float | None:
    """Return beta, samples^2 of 1/1024 s, for which the lead best inverts the response up to 10 Hz.

    Both poles of the roll-off add a curvature of -alpha / (pi f), as much as a rig that is a pure
    delay does; a law that does not learn beta would leave all of this uncorrected.

    Args:
        roll_off_hz: roll-off frequency of the lead.
        rig: the rig with its identified response.
        rate: rate of the test.
        most: upper bound of beta.
    """
    found = rig.identified
    if found is None:
        return None
    import numpy as np

    from rthyb_rt.config import response

    f_hz = np.asarray(found.frequency_hz)
    slow = f_hz <= response.SLOW_HZ
    if slow.sum() < 3:
        return None
    g = response.response(found, rate, hold=response.hold_of(rig))
    both = weights(roll_off_hz, rate.period_s)
    beta = response.fitted_terms(f_hz[slow], g[slow], rate.period_s, *both, (1, 2))[2]
    return min(max(beta / rate.pace**2, -most), most)


def _plain(p: Parameter, rig: RigFile) -> float | None:
    """Return the value given in the rig file itself."""
    place: object = rig
    for part in (p.rig_key or "").split("."):
        place = getattr(place, part, None)
    return float(place) if isinstance(place, (int, float)) else None
