"""Channels with the wrong sign: a specimen resists motion, and a force on a body does work on it.

A diagnosis would explain a reversed load cell by laws that no specimen has: negative stiffness with
a gap, or a negative mass. What is passive gives back no more energy than it was given. Channels
that are a few milliseconds apart seem to break this rule a little, and are allowed for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rthyb_rt.diagnose.case import Floats, Model
from rthyb_rt.diagnose.gaps import filled
from rthyb_rt.diagnose.policy import POLICY

SHIFTS = 5
"""Number of shifts in time by which a force is tried, the largest either way included."""
_DIRECTIONS = {
    "f_meas": "the displacement and the force that resists it",
    "f_in": "the displacement and the force on the body",
    "ag": "the acceleration of the ground and the displacement relative to it",
}


@dataclass(frozen=True)
class SignFault:
    """A channel whose sign, or that of x_meas, is wrong.

    Attributes:
        channel: its name.
        seen: what shows it, and which directions must agree.
        otherwise: what is to be done, or must be so, if the sign is right all the same.
    """

    channel: str
    seen: str
    otherwise: str


def fault(channels: dict[str, Floats], model: Model) -> SignFault | None:
    """Return a channel with the wrong sign; None if no sign is wrong for certain.

    Args:
        channels: each (n,), SI.
        model: model with which they are compared.
    """
    known = {k: v for k, v in channels.items() if 2 * np.isfinite(v).sum() >= v.size}
    if "x_meas" not in known:
        return None
    x = filled(known["x_meas"])
    return _of_a_drive(x, known, model) or _of_a_specimen(x, known, model)


def _of_a_drive(x: Floats, channels: dict[str, Floats], model: Model) -> SignFault | None:
    """Return the force on a body, or the ground that moves it, if it takes what the body gains."""
    pushed = push_of(channels, model)
    if pushed is None:
        return None
    name, push, mass = pushed
    gain, rows, v = energy_gained(x, model, mass + model.moving_mass)
    if gain == 0.0:
        return None
    apart_s = min(POLICY.channels_apart_s, np.pi / 4.0 / max(pace(x, model.fs_hz), 1e-300))
    t = np.arange(x.size) / model.fs_hz
    for shift_s in np.linspace(-apart_s, apart_s, SHIFTS):
        work = float(np.interp(t + shift_s, t, push)[rows] @ v) / model.fs_hz
        if not work < -POLICY.energy_taken * gain:
            return None
    return _told(
        name, f"{name} takes energy from the body while the body gains it",
        "if the sign is right, another force moves the body",
    )  # fmt: skip


def _of_a_specimen(x: Floats, channels: dict[str, Floats], model: Model) -> SignFault | None:
    """Return the force of a specimen if it drives the motion."""
    if "f_meas" not in channels:
        return None
    f = filled(channels["f_meas"])
    if not drives(x, f, model):
        return None
    along_v, along_x = correlations(x, f)
    lag_deg = -np.degrees(np.arctan2(along_v, along_x))
    return _told(
        "f_meas",
        f"f_meas lags behind x_meas by about {lag_deg:.0f} degrees and so drives the motion "
        "instead of resisting it",
        "if the specimen is driven, state a negative damping (c) in the model",
    )


def _told(name: str, shown: str, otherwise: str) -> SignFault:
    seen = (
        f"{shown}: probably a wrong sign of {name} or x_meas; {_DIRECTIONS[name]} must be positive "
        "in the same direction"
    )
    return SignFault(name, seen, otherwise)


def correlations(x: Floats, f: Floats) -> tuple[float, float]:
    """Return the correlation of a force, (n,), with velocity and with displacement, (n,).

    For a sine, the sine and cosine of the angle by which the force leads the displacement.
    """
    step, middle = np.diff(x), 0.5 * (f[1:] + f[:-1])
    middle, place, force = middle - middle.mean(), x - x.mean(), f - f.mean()

    def alike(a: Floats, b: Floats) -> float:
        norms = float(np.linalg.norm(a) * np.linalg.norm(b))
        return float(a @ b) / norms if norms > 0.0 else 0.0

    return alike(middle, step), alike(force, place)


def drives(x: Floats, f: Floats, model: Model) -> bool:
    """Return whether a force drives the motion of a specimen that cannot.

    The force of springs, dampers and friction leads the displacement by 0 to 90 degrees, inertia by
    up to 180, and a channel that is late changes the lead. None of them lags by more than 60
    degrees; nor below resonance by more than 120, however weakly it dissipates.
    """
    step, middle = np.diff(x), 0.5 * (f[1:] + f[:-1])
    # A specimen with an element of its own may be driven by it; and a specimen that softens along a
    # path that does not return has the correlations, but not the work, of one that drives.
    if model.c < 0.0 or model.k < 0.0 or model.extra or not float(middle @ step) < 0.0:
        return False
    along_v, along_x = correlations(x, f)
    apart = float(np.sin(min(pace(x, model.fs_hz) * POLICY.channels_apart_s, 0.5 * np.pi)))
    clearly = POLICY.shape_alike
    if along_v < -max(clearly, apart) and along_x < clearly:
        return True
    against = along_v < -max(POLICY.against_motion, apart) and along_x < -clearly
    return against and below_resonance(x, model)


def pace(x: Floats, fs_hz: float) -> float:
    """Return the angular frequency of a sine with the speed and the size of a motion, rad/s."""
    return float(np.std(np.diff(x))) * fs_hz / (float(np.std(x)) or 1.0)


def below_resonance(x: Floats, model: Model) -> bool:
    """Return whether the stated spring, not the mass that moves with it, determines the force."""
    k = max(abs(model.k), 1e-300)
    return model.moving_mass * pace(x, model.fs_hz) ** 2 < POLICY.spring_rules * k


def push_of(
    channels: dict[str, Floats], model: Model
) -> tuple[Literal["f_in", "ag"], Floats, float] | None:
    """Return what moves a free body: the channel, its force, (n,), N, and the mass it acts on, kg.

    The mass is 0 for a force that is measured. None if nothing is recorded that moves a body.
    """
    if model.family == "forced" and "f_in" in channels:
        return "f_in", filled(channels["f_in"]), 0.0
    if model.family == "ground" and model.mass and "ag" in channels:
        return "ag", filled(channels["ag"]) * -model.mass, model.mass
    return None


def energy_gained(x: Floats, model: Model, mass: float) -> tuple[float, slice, Floats]:
    """Return the energy that a body gained, J, the rows until then, and its velocity there, m/s.

    The gain is 0 if the body gains none to speak of, as in a free decay or a steady state.
    """
    h = min(max(1, round(model.fs_hz / 200.0)), (x.size - 1) // 4)
    v = (x[2 * h :] - x[: -2 * h]) * (model.fs_hz / (2 * h))
    stored = 0.5 * model.k * x[h:-h] ** 2 + 0.5 * mass * v**2
    last = int(np.argmax(stored))
    gain = float(stored[last] - np.max(stored[: max(2, stored.size // 50)]))
    if not gain > POLICY.energy_gained * float(stored[last]) > 0.0:
        gain = 0.0
    return gain, slice(h, h + last), v[:last]
