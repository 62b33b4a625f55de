"""Common helpers for tests of the C core: numbers in a kernel's memory, signals, tracking runs."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from rthyb_rt._core import ffi

from rthyb_rt import core

Floats = NDArray[np.float64]

FS_HZ = 1024.0
H = 1.0 / FS_HZ
G = 9.80665

# Actuator of Section 5, with measured values.
HYDRAULIC: dict[str, Any] = {
    "kind": "servo-hydraulic",
    "kp_per_s": 63.5,
    "ki_per_s2": 6.0,
    "valve_time_constant_s": 0.0018,
    "stall_force_n": 16000.0,
    "flow_limit_m_per_s": 1.0,
    "oil_stiffness_n_per_m": 2e7,
    "oil_damping_n_s_per_m": 1.2e4,
    "moving_mass_kg": 45.0,
    "friction_n": 80.0,
    "friction_width_m_per_s": 5e-4,
    "viscous_n_s_per_m": 600.0,
    "delay_samples": 0,
}
K_PLATE = 666400.0


@cache
def _double_offsets(ctype: Any) -> tuple[int, ...]:
    """Byte offsets of every double in a C type."""
    if ctype.kind == "primitive":
        return (0,) if ctype.cname == "double" else ()
    if ctype.kind == "array":
        size = ffi.sizeof(ctype.item)
        inner = _double_offsets(ctype.item)
        return tuple(i * size + o for i in range(ctype.length) for o in inner)
    if ctype.kind not in ("struct", "union"):
        return ()  # pointers and enumerations
    return tuple(f.offset + o for _, f in ctype.fields for o in _double_offsets(f.type))


def doubles(kernel: Any) -> Floats:
    """Copy of every double in a kernel's memory, including its configuration."""
    struct = kernel._c
    offsets = np.asarray(_double_offsets(ffi.typeof(struct).item))
    return np.frombuffer(bytes(ffi.buffer(struct)), np.float64)[offsets // 8]


def time_s(duration_s: float) -> Floats:
    """The instants t_n of a test."""
    return np.arange(round(duration_s * FS_HZ)) / FS_HZ


def rms(x: Floats) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


def smooth_motion(duration_s: float, seed: int = 0, peak_m: float = 0.01) -> Floats:
    """A sum of seven sines up to 8 Hz that starts at rest."""
    rng = np.random.default_rng(seed)
    t = time_s(duration_s)
    x = sum(
        rng.normal() * np.sin(2 * np.pi * f * t + rng.uniform(0, 2 * np.pi))
        for f in rng.uniform(0.3, 8.0, 7)
    )
    x = x * (1.0 - np.exp(-((t / 0.3) ** 3)))
    return np.asarray(x * peak_m / np.max(np.abs(x)))


def law_of(
    estimator: core.EstimatorConfig, w1: float = 3.0, w2: float = 2.0, **more: float
) -> core.LawConfig:
    """The control law that compensates with an estimator with these settings."""
    own = {
        "fixed": ("paper", {}),
        "gradient": (
            "paper",
            {"gain_per_mm2_per_sample": estimator.gain / (estimator.reference_m / 1e-3) ** 2},
        ),
        "robust": ("robust", {"rate_per_sample": estimator.gain}),
        "rls": ("alpha-beta", {"memory_s": estimator.memory_samples * estimator.period_s}),
    }
    name, settings = own[estimator.law]
    settings |= {
        "alpha_min": estimator.alpha_min,
        "alpha_max": estimator.alpha_max,
        "reference_displacement_m": estimator.reference_m,
    }
    if name != "paper":
        settings |= {"cutoff_hz": estimator.cutoff_hz, "gate_factor": estimator.gate_factor}
    lead = {"w1": w1, "w2": w2, "alpha0": estimator.alpha0, "beta0": estimator.beta0}
    return core.LawConfig(
        name,
        lead | {f"delay_estimator.{key}": value for key, value in settings.items()} | more,
        adapts=estimator.law != "fixed",
        rest_noise_m=estimator.rest_noise_m,
    )


def controller(
    motion: core.MotionConfig,
    *,
    k_e: float = K_PLATE,
    estimator: core.EstimatorConfig | None = None,
    law: core.LawConfig | None = None,
    rfc: dict[str, Any] | None = None,
    **settings: Any,
) -> core.Controller:
    """A controller, without adaptation unless requested."""
    return core.Controller(
        core.ControllerConfig(
            law=law or law_of(estimator or core.EstimatorConfig()),
            rfc=core.RfcConfig(**({"k_e_n_per_m": k_e} | (rfc or {}))),
            motion=motion,
            **settings,
        )
    )


def run_virtual(
    controller: core.Controller, rig: core.VirtualRig, excitation: Floats, ticks: int | None = None
) -> Any:
    """The records of a test with a rig, as many as were written."""
    records = np.zeros(excitation.size if ticks is None else ticks, core.RECORD_DTYPE)
    done, _ = controller.run_virtual(rig, excitation, records)
    return records[:done]


def track(command_m: Floats, servo: core.ServoConfig, estimator: core.EstimatorConfig) -> Any:
    """The records of a prescribed motion through the compensator and an unloaded actuator."""
    motion = core.MotionConfig("prescribed")
    c = controller(motion, k_e=1.0, estimator=estimator, rfc={"enabled": False})
    return run_virtual(c, core.VirtualRig(core.RigConfig(servo)), command_m)


def resonance(sequence: Floats, order: int) -> NDArray[np.complex128]:
    """Poles of the linear recurrence of given order that a free decay satisfies (Prony)."""
    columns = [sequence[order - 1 - i : sequence.size - 1 - i] for i in range(order)]
    a = np.column_stack(columns)
    scale = np.max(np.abs(sequence))
    coefficients = np.linalg.lstsq(a / scale, sequence[order:] / scale, rcond=None)[0]
    return np.asarray(np.roots(np.concatenate([[1.0], -coefficients])), dtype=np.complex128)


def damping_ratio(pole: complex) -> float:
    """The damping ratio that corresponds to a discrete pole."""
    s = np.log(pole)
    return float(-s.real / abs(s))


def opensees() -> Any:
    """OpenSees, or a skip that says what is missing."""
    pytest.importorskip("openseespy", reason="openseespy is not installed")
    try:
        import openseespy.opensees as found
    except (ImportError, RuntimeError) as error:
        pytest.skip(
            f"openseespy cannot be loaded ({error}); on Debian it needs libblas3, liblapack3"
        )
    return found
