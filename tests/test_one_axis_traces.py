"""A rig of one axis does to the last bit what it did before rigs had several.

``data/one_axis_traces.json`` has a hash of every field of every row of some tests, made with the
core of the commit that it names. What makes the numbers part, in intention, makes them anew:
``python tests/test_one_axis_traces.py COMMIT``, and the change log says why.

Renewed since: the five "troubles". The share of skipped ticks has been counted from START since
then; in each of them, the first row that changed had ended a test for ticks skipped before it.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, cast

import numpy as np
import pytest
from loop_bench import DELAY, K_N_PER_M, config, shaking
from loop_bench import Bench as Wired

from rthyb_rt import core
from rthyb_rt.core import loop
from rthyb_rt.core.laws import LAWS

STORED: Final = Path(__file__).parent / "data" / "one_axis_traces.json"
OFFSET_M, OFFSET_N = 0.0123, 45.0


def specimen() -> core.VirtualRig:
    """An actuator with a valve, sensors with noise, a plate that yields."""
    plate = core.element(
        "hysteresis", k_n_per_m=K_N_PER_M, post_yield_ratio=0.02, a=1, b=300, c=200, eta=1.5
    )
    return core.VirtualRig(
        core.RigConfig(
            core.ServoConfig("first-order", roll_off_hz=20.0, delay_samples=2),
            (plate,),
            displacement=core.SensorConfig(noise_std=2e-6, lsb=5e-7),
            force=core.SensorConfig(noise_std=5.0, lsb=1.0),
            seed=7,
        )
    )


def limited(settings: core.StationConfig) -> core.StationConfig:
    """With every limit of the command, and limits of the test that hold and ramp out."""
    control = replace(settings.controller, acceleration_limit_m_per_s2=6.0)
    watches = {
        "position": core.Watch(8e-3, "ramp-out"),
        "force": core.Watch(5.5e3, "hold"),
        "tracking": core.Watch(4e-3, "indicate"),
        "sensor_jump": core.Watch(2e-3, "indicate"),
        "sensor_stuck": core.Watch(60.0, "ramp-out"),
        "rig_position": core.Watch(0.05, "trip"),
    }
    return replace(settings, controller=control, watches=watches)


NEXT: Final[dict[str, core.Command]] = {
    "IDLE": "zero",
    "ZEROED": "arm",
    "ARMED": "start",
    "HOLD": "resume",
    "TRIPPED": "reset",
}


def station_trace(settings: core.StationConfig, ticks: int, seed: int | None) -> np.ndarray:
    """Rows of a station at the yielding plate; ``seed``: of what goes wrong, None: nothing does."""
    station, plant = core.Station(settings, shaking(2.0)), specimen()
    dice = np.random.Generator(np.random.PCG64(seed or 0))
    at_drive, rows = OFFSET_M, []
    for n in range(ticks):
        x, f, _ = plant.step(at_drive - OFFSET_M)
        told: dict[str, Any] = {"x_m": x + OFFSET_M, "f_n": f + OFFSET_N}
        if seed is not None:
            kind = int(dice.integers(150))
            told |= cast(
                dict[int, dict[str, Any]],
                {
                    0: {"lost": True},
                    1: {"x_m": 1e300},
                    2: {"f_n": told["f_n"] + 4e3},
                    3: {"skipped": int(dice.integers(1, 12))},
                    4: {"x_m": told["x_m"] + 5e-3},
                },
            ).get(kind, {})
            if kind == 5 and dice.integers(8) == 0:
                told["drive_stopped"] = True
        command = NEXT.get(station.state, "none") if n % 90 == 3 else "none"
        tick = station.tick(command=command, **told)
        rows.append(tick.records)
        if tick.sent:
            at_drive = tick.x_cmd_m
    return np.concatenate(rows)


def law_trace(name: str) -> np.ndarray:
    given = {p.key: float(DELAY) for p in LAWS[name].parameters if p.default is None}
    return station_trace(config(law=core.LawConfig(name, given)), 3000, None)


def troubled_trace(name: str, seed: int) -> np.ndarray:
    given = {p.key: float(DELAY) for p in LAWS[name].parameters if p.default is None}
    return station_trace(limited(config(law=core.LawConfig(name, given))), 6000, seed)


def loop_trace(kind: loop.FaultKind, value: float) -> np.ndarray:
    """Rows of a loop whose drive has a fault now and then, over a wire."""
    with Wired(watches={"sensor_jump": core.Watch(5e-3, "trip")}) as bench:
        bench.running(100)
        for ticks in (1, 5, 40):
            bench.fault(kind, ticks, value)
            bench.steps(120)
        rows = bench.rows()
    for name in ("due_ns", "wake_late_ns", "sent_late_ns"):
        rows[name] = 0
    return rows


def traces() -> dict[str, Callable[[], np.ndarray]]:
    found: dict[str, Callable[[], np.ndarray]] = {
        f"law {name}": partial(law_trace, name) for name in sorted(LAWS)
    }
    for seed, name in enumerate(("paper", "robust", "alpha-beta", "inverse", "ats")):
        found[f"troubles {seed}, {name}"] = partial(troubled_trace, name, seed)
    for kind, value in (("drop", 0.3), ("delay", 3.0), ("jump", 2e-2), ("corrupt", 1.0)):
        found[f"wire {kind}"] = partial(loop_trace, kind, value)  # type: ignore[arg-type]
    return found


def digest(rows: np.ndarray) -> str:
    """Of the values of every field that a row of one axis has had since, by name."""
    whole = hashlib.sha256()
    for name in FIELDS:
        whole.update(np.ascontiguousarray(rows[name]).tobytes())
    return whole.hexdigest()


FIELDS: Final = (
    *("tick", "state", "flags", "generation", "code", "cause", "ag_mps2", "x_num_m", "x_plc_m"),
    *("alpha", "beta", "k_t_n_per_m", "energy_error_j", "tracking_indicator_m2", "x_cmd_m"),
    *("x_meas_m", "f_meas_n", "x_read_m", "f_read_n", "missing", "echo", "count"),
)


def last_digits() -> str:
    """A hash of what the C library's functions come to here: their last digits differ by version
    and processor, and so would the traces."""
    x = np.linspace(-4.0, 4.0, 801)
    functions = (math.sin, math.cos, math.exp, math.tanh, math.expm1)
    values = [[f(v) for f in functions] for v in x]
    values += [
        [math.log(a), math.log1p(a), math.pow(a, 1.5), math.atan2(a, 0.3)] for a in abs(x) + 0.1
    ]
    return hashlib.sha256(np.concatenate(values).tobytes()).hexdigest()


TRACES: Final = traces()
_KEPT: Final[dict[str, Any]] = json.loads(STORED.read_text()) if STORED.exists() else {}


@pytest.mark.long
@pytest.mark.parametrize("name", TRACES)
def test_one_axis_does_what_it_did(name: str) -> None:
    if _KEPT["last_digits"] != last_digits():
        pytest.skip("the C library's sin, exp and the like have other last digits here")
    rows = TRACES[name]()
    assert digest(rows) == _KEPT["traces"][name], (
        f"{name} is not what it was at commit {_KEPT['commit']}: {summary(rows)}"
    )


@pytest.mark.long
def test_the_traces_are_worth_keeping() -> None:
    """Between them they have every state, lost pairs, gaps, limits of the command and trips."""
    rows = [TRACES[name]() for name in TRACES if name.startswith(("troubles", "wire"))]
    states = {int(state) for one in rows for state in one["state"]}
    assert states == set(range(len(core.STATES)))
    flags = np.bitwise_or.reduce(np.concatenate([one["flags"] for one in rows]))
    for flag in ("predicted", "frozen", "blind", "limited", "lost", "stopped"):
        assert flags & core.FLAGS[flag], flag


def summary(rows: np.ndarray) -> str:
    last = rows[-1]
    return (
        f"{rows.size} rows, last state {core.STATES[last['state']]}, largest command "
        f"{abs(rows['x_cmd_m']).max():.17g} m, alpha {last['alpha']:.17g}"
    )


def make(commit: str) -> None:
    kept = {
        "commit": commit,
        "last_digits": last_digits(),
        "traces": {name: digest(run()) for name, run in TRACES.items()},
    }
    STORED.write_text(json.dumps(kept, indent=1) + "\n")


if __name__ == "__main__":
    make(sys.argv[1])
