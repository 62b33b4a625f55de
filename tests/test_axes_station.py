"""A station of two axes under commands, faults and stalls of either axis in any order."""

from __future__ import annotations

from typing import Any

import numpy as np
from axes_bench import NAMES, Bench, H, columns, config
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from rthyb_rt import core
from rthyb_rt.core import AxisConfig

LIMITS_M, SPEEDS_M_PER_S, ACCELERATION_M_PER_S2 = (0.004, 0.003), (0.5, 0.3), 20.0
ON_ITS_WAY = ("RAMP_IN", "RUNNING", "HOLD", "RAMP_OUT")
AXIS = st.integers(0, 1)


def limited() -> core.StationConfig:
    def watches(limit_m: float) -> dict[str, core.Watch]:
        return {
            "position": core.Watch(limit_m, "ramp-out"),
            "force": core.Watch(1e4, "trip"),
            "sensor_jump": core.Watch(0.01, "ramp-out"),
        }

    axes = tuple(
        AxisConfig(name, watches=watches(limit), velocity_limit_m_per_s=speed)
        for name, limit, speed in zip(NAMES, LIMITS_M, SPEEDS_M_PER_S, strict=True)
    )
    control = {"axes": axes, "acceleration_limit_m_per_s2": ACCELERATION_M_PER_S2}
    return config(control, tare_ticks=4, ramp_in_ticks=8)


class AnyScript(RuleBasedStateMachine):
    """Commands, faults and stalls in any order."""

    def __init__(self) -> None:
        super().__init__()
        self.bench = Bench(limited())
        self.last: tuple[float, ...] | None = None
        self.blamed: tuple[str, int | None] = ("none", None)
        self.bench.step()

    def do(self, **given: Any) -> None:
        """One tick, and what must hold of it whatever was done."""
        bench, station = self.bench, self.bench.station
        before = station.state
        tick = bench.step(**given)
        blamed = (station.cause, station.cause_axis)
        if before == "TRIPPED" and station.state == "TRIPPED":
            assert blamed == self.blamed
        if before == "TRIPPED" and station.state != "TRIPPED":
            assert given.get("command") == "reset"
            assert not tick.refused
        self.blamed = blamed
        if tick.sent:
            self.judge(tick.commands_m, before, station.state)
            self.last = tick.commands_m

    def judge(self, commands: tuple[float, ...], before: str, after: str) -> None:
        last, station = self.last, self.bench.station
        assert np.isfinite(commands).all()
        if after == "TRIPPED" and last is not None:
            assert commands == last
        for k, (x, limit, speed) in enumerate(zip(commands, LIMITS_M, SPEEDS_M_PER_S, strict=True)):
            if before not in ON_ITS_WAY or after not in ON_ITS_WAY or last is None:
                continue
            assert abs(x - station._c.axis[k].tare_cmd) <= limit + 1e-12
            assert abs(x - last[k]) <= speed * H + 1e-12

    @rule(command=st.sampled_from(core.COMMANDS))
    def operator(self, command: core.Command) -> None:
        self.do(command=command)

    @rule(n=st.integers(1, 200))
    def wait(self, n: int) -> None:
        for _ in range(n):
            self.do()

    @rule()
    def full_start(self) -> None:
        for command in ("zero", *("none",) * 5, "arm", "start", *("none",) * 20):
            self.do(command=command)

    @rule()
    def hold(self) -> None:
        self.do(command="hold")
        for _ in range(150):
            self.do()
        self.do(command="resume")

    @rule(axis=AXIS, n=st.integers(1, 25))
    def lose(self, axis: int, n: int) -> None:
        for _ in range(n):
            self.do(faults={axis: {"lost": True}})

    @rule(n=st.integers(1, 40))
    def stall(self, n: int) -> None:
        self.do(skipped=n)

    @rule(axis=AXIS, value=st.sampled_from([np.nan, np.inf, -np.inf, 1e300, 0.03, -0.5]))
    def bad_displacement(self, axis: int, value: float) -> None:
        self.fault(axis, {"x_m": value}, np.isfinite(value))

    @rule(axis=AXIS, value=st.sampled_from([np.nan, np.inf, 1e300, 2e4]))
    def bad_force(self, axis: int, value: float) -> None:
        self.fault(axis, {"f_n": value}, np.isfinite(value))

    def fault(self, axis: int, reading: dict[str, float], is_number: bool) -> None:
        clean = self.bench.station.cause in ("none", "operator", "completed")
        self.do(faults={axis: reading})
        if not is_number:
            assert self.bench.station.state == "TRIPPED"
        if not is_number and clean:
            assert self.blamed == ("not_finite", axis)

    @rule(axis=AXIS, n=st.integers(1, 30))
    def clocks_apart(self, axis: int, n: int) -> None:
        for _ in range(n):
            self.do(apart=axis)
        if n >= 20:
            assert self.bench.station.state in ("IDLE", "ZEROED", "TRIPPED")

    @precondition(lambda self: self.bench.station.state != "TRIPPED")
    @rule(axis=AXIS)
    def cable(self, axis: int) -> None:
        before = self.bench.station.state
        self.do(faults={axis: {"lost": True, "link_down": True}})
        assert self.bench.station.state == "TRIPPED" or before == "IDLE"

    @invariant()
    def ticks_add_up(self) -> None:
        station = self.bench.station
        assert station.ticks == len(self.bench.records) + station.skipped

    @invariant()
    def readings_that_are_taken_are_numbers(self) -> None:
        assert np.isfinite(columns(self.bench.records[-1], "x_meas_m")).all()

    def teardown(self) -> None:
        """What came of it all comes of it again."""
        rows = self.bench.rows()
        again = core.Station(self.bench.settings, self.bench.station._ag).replay(rows)
        assert again.tobytes() == rows.tobytes()


TestAnyScript = AnyScript.TestCase
TestAnyScript.settings = settings(max_examples=40, stateful_step_count=40, deadline=None)
