"""The test that the proofs run: a small structure, a spring, a drive with six samples' delay."""

from __future__ import annotations

import numpy as np

from rthyb_rt import core

K_N_PER_M, MASS_KG, DELAY = 666400.0, 4220.0, 6
SPEED_LIMIT_M_PER_S = 0.5


def shaking(seconds: float) -> np.ndarray:
    """Ground motion of four sines, m/s^2, (n,), so that the delay estimator always adapts."""
    t = np.arange(round(seconds * core.FS_HZ)) * core.PERIOD_S
    rise = 1.0 - np.exp(-((t / 1.0) ** 2))
    return rise * sum(
        a * np.sin(2.0 * np.pi * f * t + f)
        for a, f in ((0.12, 0.7), (0.10, 1.3), (0.08, 3.1), (0.08, 4.3))
    )


def station() -> core.StationConfig:
    """A station without its own limits; faults of link and clock end a test as always."""
    controller = core.ControllerConfig(
        law=core.LawConfig(
            "alpha-beta", {"alpha0": 7.0, "beta0": 24.0, "delay_estimator.memory_s": 4.0}
        ),
        rfc=core.RfcConfig(k_e_n_per_m=K_N_PER_M, window=51),
        motion=core.MotionConfig(
            "central-difference", mass_kg=MASS_KG, damping_n_s_per_m=2121.0, k_e_n_per_m=K_N_PER_M
        ),
        velocity_limit_m_per_s=SPEED_LIMIT_M_PER_S,
    )
    return core.StationConfig(controller, tare_ticks=64, ramp_in_ticks=256)


def rig() -> core.VirtualRig:
    """A pure delay and a spring, with a little noise of both sensors."""
    return core.VirtualRig(
        core.RigConfig(
            core.ServoConfig("pure-delay", delay_samples=DELAY),
            (core.element("stiffness", k_n_per_m=K_N_PER_M),),
            displacement=core.SensorConfig(noise_std=1e-6),
            force=core.SensorConfig(noise_std=2.0),
            seed=1,
        )
    )
