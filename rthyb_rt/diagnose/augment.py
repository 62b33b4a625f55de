"""The model with what was found in it, as a rig file that ``rthyb run --rig`` loads."""

from __future__ import annotations

from typing import Any

import numpy as np

from rthyb_rt import core
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.predict import Augmented
from rthyb_rt.diagnose.simulate import Motion

SUBSTEPS = 16


def rig_toml(model: Augmented, name: str = "augmented") -> tuple[str, list[str]]:
    """Return a rig file's text, and what it cannot hold.

    The specimen's effects become elements; those of sensors become sensor settings where there are
    such; the rest is named.
    """
    lost: list[str] = []
    base = model.model
    ctx = Context(
        model.base,
        Motion(np.zeros(2), np.zeros(2), np.zeros(2)),
        np.arange(2.0) / base.fs_hz,
        np.zeros(2),
        {},
        model.ranges or (1.0, 1.0, 1.0),
    )
    elements: list[core.ElementConfig] = base.elements()
    replaced_spring: list[core.ElementConfig] | None = None
    bias = lsb = 0.0
    if base.moving_mass > 0:
        elements.append(core.element("inertia", m_kg=base.moving_mass))
    for member, beta in zip(model.members, model.betas, strict=True):
        if member.name == "bias":
            bias += float(beta[0])
            continue
        own = None if member.effect.sensor else member.effect.elements(ctx, member.trial, beta)
        if own is None:
            lost.append(member.name)
        elif member.name in ("pinching", "degradation"):
            replaced_spring = own
        else:
            elements += own
    if replaced_spring is not None:
        elements = [*replaced_spring, *elements[1:]]
    lines = ['schema = "rthyb-rig/1"', ""]
    lines += [f"# {word}: a rig file cannot hold it; see diagnosis.json" for word in lost]
    hold = model.model.hold
    lines += [
        "[rig]",
        f'name = "{name}"',
        'description = "model with what the diagnosis found in it"',
        f"elastic_stiffness_n_per_m = {_stiffness(elements):.9g}",
        'load_cell = "specimen"',
        f'command_hold = "{hold}"',
        "",
    ]
    lines += _actuator(model)
    for item in _merged(elements):
        lines += ["", "[[specimen]]", f'element = "{item.kind}"']
        lines += [
            f"{key} = {value:.9g}"
            for key, value in zip(core.ELEMENT_PARAMS[item.kind], item.params, strict=True)
        ]
    noise = base.x_std or 0.0, base.f_std or 0.0
    lines += ["", "[sensors.displacement]", f"noise_std_m = {noise[0]:.6g}"]
    lines += ["", "[sensors.force]", f"noise_std_n = {noise[1]:.6g}", f"bias_n = {bias:.6g}"]
    if lsb:
        lines.append(f"lsb_n = {lsb:.6g}")
    return "\n".join(lines) + "\n", lost


def _stiffness(elements: list[core.ElementConfig]) -> float:
    total = 0.0
    for item in elements:
        if item.kind in ("stiffness", "hysteresis", "pinching", "degradation", "gap"):
            total += item.params[0]
    return max(total, 1e-3)


def _merged(elements: list[core.ElementConfig]) -> list[core.ElementConfig]:
    """Join springs and dashpots into one each; what is nothing goes."""
    sums: dict[str, float] = {}
    rest = []
    for item in elements:
        if item.kind in ("stiffness", "viscous", "inertia"):
            sums[item.kind] = sums.get(item.kind, 0.0) + item.params[0]
        else:
            rest.append(item)
    plain = [core.ElementConfig(kind, (value,)) for kind, value in sums.items() if value != 0.0]
    out = plain + rest
    return out or [core.element("stiffness", k_n_per_m=0.0)]


def _actuator(model: Augmented) -> list[str]:
    lag: Any = model.actuator
    if lag is None:
        return ["[actuator]", 'kind = "pure-delay"', "delay_samples = 0"]
    return [
        "[actuator]",
        'kind = "second-order"',
        f"natural_frequency_hz = {min(lag.f_hz, 500.0):.9g}",
        f"damping_ratio = {min(lag.zeta, 10.0):.9g}",
        f"gain = {lag.gain:.9g}",
        f"delay_s = {max(lag.delay_s + lag.shift_s, 0.0):.9g}",
    ]
