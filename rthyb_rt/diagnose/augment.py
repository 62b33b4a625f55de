"""The augmented model as a rig file for ``rthyb run --rig``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import ActuatorModel, ComputedMotion
from rthyb_rt.diagnose.actuation import CATALOGUE
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.modulation import Modulated
from rthyb_rt.diagnose.predict import Augmented

if TYPE_CHECKING:
    from rthyb_rt.config import RigFile

DESCRIPTION = "model with what the diagnosis found in it"


@dataclass(frozen=True)
class Specimen:
    """Specimen and load cell of a rig.

    Attributes:
        elements: elements of the core, the whole specimen.
        bias_n: zero of the load cell.
        lost: names of effects that a rig cannot represent.
    """

    elements: list[core.ElementConfig]
    bias_n: float
    lost: list[str]


def specimen(model: Augmented) -> Specimen:
    """Return the specimen of a model with its effects: elements, and sensor settings."""
    lost: list[str] = []
    base = model.model
    ctx = Context(
        model.base,
        ComputedMotion(np.zeros(2), np.zeros(2), np.zeros(2)),
        np.arange(2.0) / base.fs_hz,
        np.zeros(2),
        {},
        model.ranges or (1.0, 1.0, 1.0),
    )
    elements: list[core.ElementConfig] = base.elements()
    replaced_spring: list[core.ElementConfig] | None = None
    bias = 0.0
    if base.moving_mass > 0:
        elements.append(core.element("inertia", m_kg=base.moving_mass))
    for member, beta in zip(model.members, model.betas, strict=True):
        if member.effect.zero:
            bias += float(beta[0])
            continue
        own = None if member.effect.sensor else member.effect.elements(ctx, member.trial, beta)
        added = member.effect.mass_kg(beta)
        if own is None and added is not None:
            # Negative mass is no element, but is subtracted from the mass present.
            own = [core.element("inertia", m_kg=added)]
        if isinstance(member.effect, Modulated):
            # A rig's laws depend on the motion only: the law is used at the channel's mean.
            own = member.effect.at_mean(ctx, member.trial, beta)
            lost.append(member.effect.in_words())
            elements += own or []
        elif own is None:
            lost.append(member.name)
        elif member.effect.replaces_spring:
            anew = _stiffer(own, base.k / model.base.k if model.base.k else 0.0)
            if replaced_spring is not None or anew is None:  # one spring is replaced once
                lost.append(member.name)
                continue
            replaced_spring = anew
        else:
            elements += own
    if replaced_spring is not None:
        elements = [*replaced_spring, *elements[1:]]
    return Specimen(elements, bias, lost)


MOST_LOST = 1.2
"""Loss of a spring, as a share of it, that passes for all of it, as where laws are fitted."""


def _stiffer(loops: list[core.ElementConfig], ratio: float) -> list[core.ElementConfig] | None:
    """Return loops of the model's stiffness as those of the fitted stiffness, with the same loss.

    What is lost is relative to the stiffness as given, and so is the work with which it is lost.
    None if the fitted stiffness has not that much to lose.
    """
    if ratio <= 0.0:
        return None
    scales = {"k_n_per_m": ratio, "work_j": ratio, "loss": 1.0 / ratio, "depth": 1.0 / ratio}
    out = []
    for item in loops:
        named = zip(core.ELEMENT_PARAMS[item.kind], item.params, strict=True)
        values = {key: value * scales.get(key, 1.0) for key, value in named}
        for key in {"loss", "depth"} & values.keys():
            if values[key] > MOST_LOST:
                return None
            values[key] = min(values[key], 1.0)
        out.append(replace(item, params=tuple(values.values())))
    return out


def rig_toml(model: Augmented, name: str = "augmented") -> tuple[str, list[str]]:
    """Return a rig file's text, and what it cannot represent.

    Effects with an onset are present throughout. The specimen's effects become elements; those of
    sensors become sensor settings if there are any; all others are listed.
    """
    model = model.lasting()
    made, base = specimen(model), model.model
    elements, bias, lost = made.elements, made.bias_n, list(made.lost)
    lag = model.actuator
    if lag is not None:
        lost += [e.name for e in CATALOGUE if not e.in_rig_file and e.acts(lag)]
    lines = [f"# {word}: a rig file cannot represent it; see diagnosis.json" for word in lost]
    if base.rig is not None:
        body = _within(base.rig, model, elements, bias, name)
    else:
        body = _on_its_own(model, elements, bias, name)
    return "\n".join([*lines, body, *_specimen(elements, base.rig), ""]), lost


def _specimen(elements: list[core.ElementConfig], rig: RigFile | None) -> list[str]:
    lines = []
    beside = beside_table(elements, rig)
    if rig is not None:
        beside, _ = mass_off_table(beside, rig)
    for item in beside:
        lines += ["", "[[specimen]]", f'element = "{item.kind}"']
        lines += [
            f"{key} = {value:.9g}"
            for key, value in zip(core.ELEMENT_PARAMS[item.kind], item.params, strict=True)
            if value != 0.0 or key not in core.ELEMENT_ABSENT.get(item.kind, ())
        ]
    return lines


def _on_its_own(
    model: Augmented, elements: list[core.ElementConfig], bias: float, name: str
) -> str:
    base = model.model
    lines = [
        'schema = "rthyb-rig/1"',
        "",
        "[rig]",
        f'name = "{name}"',
        f'description = "{DESCRIPTION}"',
        f"elastic_stiffness_n_per_m = {_stiffness(elements):.9g}",
        'load_cell = "specimen"',
        f'command_hold = "{base.hold}"',
        "",
        *_actuator(model),
        "",
        "[sensors.displacement]",
        f"noise_std_m = {base.x_std or 0.0:.6g}",
        "",
        "[sensors.force]",
        f"noise_std_n = {base.f_std or 0.0:.6g}",
        f"bias_n = {bias:.6g}",
    ]
    return "\n".join(lines)


def _within(
    rig: RigFile, model: Augmented, elements: list[core.ElementConfig], bias: float, name: str
) -> str:
    """Return the rig file from which the model was made, with its parameters, without specimen.

    Its actuator is unchanged unless something was found in it.
    """
    from rthyb_rt import config

    force = rig.sensors.force.model_copy(update={"bias_n": rig.sensors.force.bias_n + bias})
    head: dict[str, Any] = {
        "name": name,
        "description": DESCRIPTION,
        "elastic_stiffness_n_per_m": _stiffness(elements),
    }
    changes: dict[str, Any] = {
        "specimen": [],
        "sensors": rig.sensors.model_copy(update={"force": force}),
    }
    lag = model.actuator
    if lag is not None and replace(lag, shift_s=0.0) != model.base.actuator:
        from rthyb_rt.config.rigfile import SecondOrder

        head["command_shift_s"] = 0.0
        changes |= {
            "actuator": SecondOrder.model_construct(**_second_order(lag)),
            "identified": None,
        }
    _, mass_kg = mass_off_table(beside_table(elements, rig), rig)
    if rig.actuator.kind == "servo-hydraulic" and mass_kg != rig.actuator.moving_mass_kg:
        changes["actuator"] = rig.actuator.model_copy(update={"moving_mass_kg": mass_kg})
    changes["rig"] = rig.rig.model_copy(update=head)
    text = config.dump(rig.model_copy(update=changes))
    return "\n".join(line for line in text.splitlines() if line != "specimen = []")


def beside_table(
    elements: list[core.ElementConfig], rig: RigFile | None
) -> list[core.ElementConfig]:
    """Return the elements in a rig file, in addition to those of its table."""
    return _merged([*elements, *(_opposite(rig) if rig is not None else ())])


def _opposite(rig: RigFile) -> list[core.ElementConfig]:
    """Return elements that cancel the forces of the table in a rig's own actuator."""
    from rthyb_rt.lab.experiment import table_elements

    return [
        replace(item, params=(-item.params[0], *item.params[1:])) for item in table_elements(rig)
    ]


def mass_off_table(
    elements: list[core.ElementConfig], rig: RigFile
) -> tuple[list[core.ElementConfig], float]:
    """Return the elements without negative mass, and the table's mass reduced by it, kg."""
    table = rig.actuator
    own = table.moving_mass_kg if table.kind == "servo-hydraulic" else 0.0
    less = sum(e.params[0] for e in elements if e.kind == "inertia" and e.params[0] < 0.0)
    if own + less <= 0.0:
        return elements, own
    return [e for e in elements if e.kind != "inertia" or e.params[0] > 0.0], own + less


SPRINGS = (
    "stiffness", "hysteresis", "pinching", "degradation", "gap", "gap_friction", "iwan",
    "menegotto_pinto", "chaboche", "rc_column", "takeda", "rocking",
)  # fmt: skip
"""Elements whose first parameter is an initial stiffness."""


def _stiffness(elements: list[core.ElementConfig]) -> float:
    total = 0.0
    for item in elements:
        if item.kind in SPRINGS:
            total += item.params[0]
        elif item.kind == "pendulum":
            total += item.params[0] / item.params[1]
        elif item.kind == "peak_oriented":
            up, down, reach, _, backbone, start = item.params
            total += max(up, down) * (start / reach) ** (backbone - 1.0)
    return max(total, 1e-3)


def _merged(elements: list[core.ElementConfig]) -> list[core.ElementConfig]:
    """Merge springs, dashpots, masses and friction of the same form; remove zero elements."""
    sums: dict[tuple[str, tuple[float, ...]], float] = {}
    rest = []
    for item in elements:
        if item.kind in ("stiffness", "viscous", "inertia", "coulomb"):
            key = (item.kind, item.params[1:])
            sums[key] = sums.get(key, 0.0) + item.params[0]
        else:
            rest.append(item)
    plain = [
        core.ElementConfig(kind, (value, *others))
        for (kind, others), value in sums.items()
        if value != 0.0
    ]
    out = plain + rest
    return out or [core.element("stiffness", k_n_per_m=0.0)]


def _actuator(model: Augmented) -> list[str]:
    lag = model.actuator
    if lag is None:
        return ["[actuator]", 'kind = "pure-delay"', "delay_samples = 0"]
    values = _second_order(lag)
    return [
        "[actuator]",
        f'kind = "{values.pop("kind")}"',
        *(f"{key} = {value:.9g}" for key, value in values.items()),
    ]


def _second_order(lag: ActuatorModel) -> dict[str, Any]:
    return {
        "kind": "second-order",
        "natural_frequency_hz": min(lag.f_hz, 500.0),
        "damping_ratio": min(lag.zeta, 10.0),
        "gain": lag.gain,
        "delay_s": max(lag.delay_s + lag.shift_s, 0.0),
    }
