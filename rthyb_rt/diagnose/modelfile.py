"""The laboratory's model from a file: ``rthyb-baseline/1``, a rig file, or a test with its rig."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import ActuatorModel
from rthyb_rt.diagnose.case import Model, ModelBoucWen
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt.config import BaselineFile


def find_model(name_or_path: str) -> Path:
    """Return the file of a model, given by its path or by the name of a shipped rig.

    Raises:
        InputError: neither exists; the message lists the names.
    """
    from rthyb_rt import config
    from rthyb_rt.config.fields import nearest

    path = Path(name_or_path)
    if path.is_dir():
        raise InputError(
            "is a folder; a model is a baseline file (rthyb-baseline/1), a rig file, a test file "
            "or the name of a shipped rig or test",
            str(path),
        )
    try:
        return config.find_rig(name_or_path)
    except InputError as error:
        message = (
            error.problems[0]
            .message.replace(
                "give the path of a rig file", "give the path of a baseline, rig or test file"
            )
            .replace("no rig of that name", "no rig or test of that name")
        )
        tests = list(config.shipped("test"))
        if "did you mean" not in message:
            close = nearest(name_or_path, tests)
            message = message.replace("of that name;", f"of that name{close};")
        raise InputError(
            f"{message}; the tests are {', '.join(tests) or 'none'}", "--model"
        ) from None


def read_model(path: Path) -> Model:
    """Read ``rthyb-baseline/1``, a rig file, or a test file with the rig that it names.

    Raises:
        InputError: with all errors, each with its line and what is allowed there.
    """
    from rthyb_rt import config

    text = config.read_text(path, "model")
    schema = config.schema_of(text, str(path))
    if isinstance(schema, str) and schema.startswith(("rthyb-rig/", "rthyb-test/")):
        return _from_rig(path, schema)
    if isinstance(schema, str) and schema.startswith("rthyb-baseline/"):
        file, strange = config.parse_baseline(text, str(path))
        return _of_baseline(file, tuple(strange))
    raise InputError(
        f'found schema = {schema!r}; a model starts with schema = "rthyb-baseline/1", or is a rig '
        'file ("rthyb-rig/1") or a test file ("rthyb-test/1")',
        str(path),
    )


def _of_baseline(file: BaselineFile, strange: tuple[str, ...]) -> Model:
    s, c, noise = file.specimen, file.controller, file.noise
    lag = file.actuator
    weights = (c.plc_w1, c.plc_w2) if c.plc_w1 is not None and c.plc_w2 is not None else None
    bouc_wen = s.bouc_wen
    return Model(
        family=file.family,
        fs_hz=file.fs_hz,
        k=s.k,
        c=s.c,
        moving_mass=s.moving_mass,
        k_tol=s.k_tol,
        c_tol=s.c_tol,
        bouc_wen=ModelBoucWen(**bouc_wen.model_dump()) if bouc_wen is not None else None,
        actuator=None
        if lag is None
        else ActuatorModel(
            lag.delay_s + file.command_shift_s, lag.f_hz, lag.zeta, lag.gain,
            hold=file.command_hold, delay_tol_s=lag.delay_tol_s, f_tol=lag.f_tol,
            zeta_tol=lag.zeta_tol, gain_tol=lag.gain_tol,
        ),
        mass=file.numerical.m,
        c_num=file.numerical.c,
        x_std=noise.x_std,
        f_std=noise.f_std,
        a_std=noise.a_std,
        plc=weights,
        rfc=c.rfc,
        unused=strange,
    )  # fmt: skip


def _from_rig(path: Path, schema: str) -> Model:
    from rthyb_rt import config

    test = None
    if schema.startswith("rthyb-test/"):
        test = config.load_test(path)
        rig = config.load_rig(config.find_rig(test.rig))
    else:
        rig = config.load_rig(path)
    return model_of_rig(rig, test, core.FS_HZ if test is None else test.test.sample_rate_hz)


@dataclass(frozen=True)
class _Plain:
    """A rig's specimen and table as the numbers of a model, see `Model`.

    Attributes:
        k, c, moving_mass: N/m, N s/m, kg.
        bouc_wen: the yielding spring with elastic stiffness ``k``; None: there is none.
        extra: elements that these numbers cannot represent.
    """

    k: float
    c: float
    moving_mass: float
    bouc_wen: ModelBoucWen | None
    extra: tuple[core.ElementConfig, ...]


def _plain_of(rig: Any) -> _Plain:
    """Return the numbers that represent the elements of a rig's specimen and table.

    Raises:
        InputError: one of them is a user-defined class.
    """
    from rthyb_rt.lab.experiment import specimen_elements, table_elements

    k = yielding_k = c = mass = 0.0
    bouc_wen = None
    extra: list[core.ElementConfig] = []
    for item in (*specimen_elements(rig), *table_elements(rig)):
        if item.own is not None:
            raise InputError(
                f"the element {item.own.name} is a class in Python, which the diagnosis cannot "
                "fit; describe the specimen by elements of the catalogue (rthyb effects)",
                "specimen",
            )
        p = dict(zip(core.ELEMENT_PARAMS[item.kind], item.params, strict=True))
        if item.kind == "stiffness":
            k += p["k_n_per_m"]
        elif item.kind == "viscous":
            c += p["c_n_s_per_m"]
        elif item.kind == "inertia":
            mass += p["m_kg"]
        elif (
            item.kind == "hysteresis" and bouc_wen is None and p["a"] == 1.0 and p["b"] + p["c"] > 0
        ):
            bouc_wen, yielding_k = _yielding(p), p["k_n_per_m"]
        else:
            extra.append(item)
    if bouc_wen is not None:
        if k:
            extra.append(core.element("stiffness", k_n_per_m=k))
        k = yielding_k
    return _Plain(k, c, mass, bouc_wen, tuple(extra))


def _yielding(p: dict[str, float]) -> ModelBoucWen:
    """Return the yielding of a hysteretic element with these parameters."""
    xy, eta = (p["b"] + p["c"]) ** (-1.0 / p["eta"]), p["eta"]
    return ModelBoucWen(p["post_yield_ratio"], xy, eta, p["c"] * xy**eta, p["b"] * xy**eta)


def model_of_rig(rig: Any, test: Any = None, fs_hz: float = core.FS_HZ) -> Model:
    """Return the model of a rig file and, for the numerical part, of a test file.

    Args:
        rig, test: the files.
        fs_hz: rows per second of simulations with it.
    """
    from rthyb_rt import config

    plain = _plain_of(rig)
    numerical_m = numerical_c = 0.0
    if test is not None:
        # In laboratory time, like everything recorded.
        slow = test.test.time_scale
        numerical_m = slow**2 * float(test.numerical.mass_kg or 0.0)
        numerical_c = slow * float(test.numerical.damping_n_s_per_m or 0.0)
    sensors = rig.sensors
    return Model(
        family="loop",
        fs_hz=fs_hz,
        k=plain.k,
        c=plain.c,
        moving_mass=plain.moving_mass,
        k_tol=POLICY.model_k_tol,
        c_tol=POLICY.model_c_tol,
        bouc_wen=plain.bouc_wen,
        actuator=_rig_actuator(rig, fs_hz),
        mass=numerical_m,
        c_num=numerical_c,
        x_std=sensors.displacement.noise_std_m or None,
        f_std=sensors.force.noise_std_n or None,
        extra=plain.extra,
        rig=rig,
        plc=_weights(test) if test is not None else None,
        rfc=test.controller.rfc.enabled if test is not None else None,
        notes=tuple(config.omitted(rig)),
    )


def at_rate(model: Model, fs_hz: float) -> Model:
    """Return a rig file's model for rows at a given rate, which the file does not state."""
    if model.rig is None or model.fs_hz == fs_hz:
        return model
    return replace(model, fs_hz=fs_hz, actuator=_rig_actuator(model.rig, fs_hz))


def _weights(test: Any) -> tuple[float, float] | None:
    """Return W1 and W2 of a test's control law; None if it has no such weights."""
    w1, w2 = test.controller.setting("w1"), test.controller.setting("w2")
    leads = test.controller.law.parameter("w1") is not None or not test.controller.compensates
    return (w1, w2) if leads and w1 is not None and w2 is not None else None


def _rig_actuator(rig: Any, fs_hz: float) -> ActuatorModel | None:
    """Return a rig's actuator as a second-order lag; None if it is not of that kind."""
    # Samples in the file are of 1/1024 s, whatever the rate of the rows.
    a, h = rig.actuator, core.PERIOD_S
    hold, shift = rig.rig.command_hold, rig.rig.command_shift_s
    if a.kind == "second-order":
        return ActuatorModel(
            a.delay_s + shift, a.natural_frequency_hz, a.damping_ratio, a.gain, hold=hold,
            delay_tol_s=a.delay_tol_s, f_tol=a.natural_frequency_tol,
            zeta_tol=a.damping_ratio_tol, gain_tol=a.gain_tol,
        )  # fmt: skip
    # Poles so fast that their lag is negligible: a time offset that compensated for it would shift
    # the steps of a held command, and its velocity, between the rows.
    fast = 4e6
    if a.kind == "pure-delay":
        # Half a row earlier, because a held command represents the middle of its row.
        late = a.delay_samples * h - (0.5 / fs_hz if hold == "zoh" else 0.0)
        return ActuatorModel(late + shift, 1e5, 1.0, 1.0, hold=hold, jumps=True)
    if a.kind == "first-order":
        f = float(np.sqrt(a.roll_off_hz * fast))
        return ActuatorModel(
            a.extra_delay_samples * h + shift, f, (a.roll_off_hz + fast) / (2.0 * f), 1.0, hold=hold
        )
    return None
