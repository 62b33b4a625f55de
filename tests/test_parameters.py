"""Parameters that change while a test runs: whole sets, at the edge of a tick, without waiting."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from loop_bench import FLAGS, STATE, Bench, H

from rthyb_rt import core

pytestmark = pytest.mark.alone

WATCHABLE = core.WATCHABLE
TESTS = Path(__file__).parent


def changed(bench: Bench, **changes: Any) -> core.Parameters:
    return dataclasses.replace(core.Parameters.of(bench.config), **changes)


def in_force(bench: Bench) -> core.Parameters:
    """What the station has, read back field by field."""
    c = bench.station._c
    watches = {
        name: core.Watch(slot.value, core.REACTIONS[slot.reaction])
        for name, slot in ((n, c.cfg.watch[core.CAUSES.index(n)]) for n in WATCHABLE)
        if slot.value or slot.reaction
    }
    for config in (c.cfg.controller, c.controller.cfg):
        limit = c.cfg.controller.axis[0].velocity_limit_m_per_s
        assert config.axis[0].velocity_limit_m_per_s == limit
        assert config.estimate_held == c.cfg.controller.estimate_held
    return core.Parameters(
        watches,
        c.controller.cfg.axis[0].velocity_limit_m_per_s,
        c.controller.cfg.axis[0].acceleration_limit_m_per_s2,
        c.cfg.path_velocity_m_per_s,
        c.cfg.path_acceleration_m_per_s2,
        not c.controller.cfg.estimate_held,
        c.cfg.brake_acceleration_m_per_s2,
    )


# ---- at the edge of a tick ----------------------------------------------------------------------


def test_the_next_tick_has_the_new_set_and_its_record_says_so() -> None:
    with Bench() as bench:
        bench.running()
        assert set(bench.rows()["generation"]) == {0}
        assert bench.loop.set_parameters(changed(bench)) == 1
        bench.step(skipped=2)
        np.testing.assert_array_equal(bench.records[-1]["generation"], [1, 1, 1])
        assert bench.loop.set_parameters(changed(bench)) == 2
        assert bench.loop.set_parameters(changed(bench)) == 3
        bench.step()
        assert bench.records[-1]["generation"] == [3]
        assert bench.loop.counters()["parameters"] == 2


def test_same_set_again_changes_nothing() -> None:
    with Bench() as bench, Bench() as plain:
        for each in (bench, plain):
            each.running(100)
            if each is bench:
                each.loop.set_parameters(core.Parameters.of(each.config))
            each.until("RAMP_OUT")
        ours, theirs = bench.rows(), plain.rows()
        for name in core.RECORD_DTYPE.names or ():
            if name != "generation":
                np.testing.assert_array_equal(ours[name], theirs[name])


def test_velocity_limit_holds_from_the_next_command_on() -> None:
    with Bench() as bench:
        bench.running(700)
        bench.loop.set_parameters(changed(bench, velocity_limit_m_per_s=0.003))
        before = bench.rows().size
        bench.steps(300)
        steps = np.abs(np.diff(bench.rows()["x_cmd_m"]))
        assert steps[before - 200 : before].max() > 0.003 * H
        assert steps[before:].max() <= 0.003 * H + 2e-9


def test_alpha_and_beta_stand_still_while_adaptation_is_off_and_go_on_afterwards() -> None:
    law = core.LawConfig("alpha-beta", {"alpha0": 4.0, "beta0": 8.0})
    with Bench(seconds=4.0, law=law) as bench:
        bench.running(1500)
        assert np.ptp(bench.rows()["alpha"][-200:]) > 0.0
        bench.loop.set_parameters(changed(bench, adapt=False))
        bench.steps(400)
        held = bench.rows()[-399:]
        assert np.ptp(held["alpha"]) == np.ptp(held["beta"]) == 0.0
        assert not np.any(held["flags"] & FLAGS["frozen"]), "the stiffness goes on"
        bench.loop.set_parameters(changed(bench))
        bench.steps(400)
        assert np.ptp(bench.rows()["alpha"][-399:]) > 0.0


def test_position_limit_drawn_in_takes_the_test_off_its_course_without_a_jump() -> None:
    with Bench() as bench:
        bench.running(0)
        while abs(bench.records[-1]["x_cmd_m"][-1]) < 2e-3:
            bench.step()
        before = bench.rows().size
        limit = 1e-3
        watches = {"position": core.Watch(limit, "ramp-out")}
        bench.loop.set_parameters(changed(bench, watches=watches, velocity_limit_m_per_s=0.2))
        bench.step()
        assert bench.loop.state == "RAMP_OUT"
        assert bench.loop.cause == "position"
        bench.until("IDLE")
        bench.step()
        rows = bench.rows()
        commands = np.abs(rows["x_cmd_m"][before:])  # the first one had left already
        assert np.abs(np.diff(rows["x_cmd_m"][before:])).max() <= 0.2 * H + 2e-9
        assert commands[0] > limit
        assert commands.max() <= commands[0] + 1e-9
        assert rows["x_num_m"][-1] == 0.0


def test_what_was_set_holds_for_the_next_test_as_well() -> None:
    with Bench(seconds=0.5) as bench:
        bench.running(50)
        wanted = changed(bench, velocity_limit_m_per_s=0.02, adapt=False)
        generation = bench.loop.set_parameters(wanted)
        bench.until("IDLE")
        bench.running(50)
        assert in_force(bench) == wanted
        assert bench.records[-1]["generation"] == [generation]
        running = bench.records[-1]["state"] == STATE["RUNNING"]
        assert running.all()


def test_path_limits_are_for_the_next_path() -> None:
    with Bench() as bench:
        bench.running(700)
        bench.loop.set_parameters(changed(bench, path_acceleration_m_per_s2=0.02))
        bench.step()
        bench.step("stop")
        bench.until("IDLE", 60000)
        out = bench.rows()[bench.rows()["state"] == STATE["RAMP_OUT"]]
        assert np.abs(np.diff(out["x_num_m"][2:], 2)).max() / H**2 <= 0.02 * 1.02


# ---- what is refused ----------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [-1.0, math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize(
    "name",
    [
        "velocity_limit_m_per_s",
        "acceleration_limit_m_per_s2",
        "path_velocity_m_per_s",
        "path_acceleration_m_per_s2",
        "brake_acceleration_m_per_s2",
        "force",
    ],
)
def test_senseless_value_is_refused_and_the_set_before_stays(name: str, bad: float) -> None:
    with Bench() as bench:
        bench.running()
        good = changed(bench, velocity_limit_m_per_s=0.25)
        bench.loop.set_parameters(good)
        bench.step()
        wrong = {"watches": {"force": core.Watch(bad, "trip")}} if name == "force" else {name: bad}
        with pytest.raises(core.CoreError, match="must be from"):
            bench.loop.set_parameters(changed(bench, **wrong))
        bench.step()
        assert in_force(bench) == good
        assert bench.records[-1]["generation"] == [1]
        assert bench.loop.set_parameters(good) == 2


@pytest.mark.parametrize("name", ["path_velocity_m_per_s", "path_acceleration_m_per_s2"])
def test_path_without_velocity_or_acceleration_is_refused(name: str) -> None:
    with Bench() as bench, pytest.raises(core.CoreError, match="must be from"):
        bench.loop.set_parameters(changed(bench, **{name: 0.0}))


@pytest.mark.parametrize("name", ["completed", "link_down", "speed"])
def test_watch_on_nothing_is_refused(name: str) -> None:
    with (
        Bench() as bench,
        pytest.raises(core.CoreError, match=f"no quantity to watch is called {name}"),
    ):
        bench.loop.set_parameters(changed(bench, watches={name: core.Watch(1.0, "trip")}))


# ---- all or nothing -----------------------------------------------------------------------------

numbers = st.floats(1e-6, 1e3)
sets = st.builds(
    core.Parameters,
    st.dictionaries(
        st.sampled_from(WATCHABLE),
        st.builds(core.Watch, st.floats(1e-6, 1e12), st.sampled_from(core.REACTIONS)),
        max_size=9,
    ),
    numbers,
    numbers,
    numbers,
    numbers,
    st.booleans(),
    st.one_of(st.just(0.0), numbers),
)


@given(st.lists(sets, min_size=1, max_size=6))
@settings(max_examples=60, deadline=None)
def test_any_set_arrives_as_it_was_given(wanted: list[core.Parameters]) -> None:
    with Bench(tare_ticks=4, ramp_in_ticks=8) as bench:
        bench.steps(2)
        for generation, one in enumerate(wanted, start=1):
            assert bench.loop.set_parameters(one) == generation
            bench.step()
            assert in_force(bench) == one


def test_set_that_is_half_written_is_left_for_the_tick_after(tmp_path: Path) -> None:
    core_sources, program = TESTS.parent / "csrc", tmp_path / "handover"
    sources = [TESTS / "handover.c", core_sources / "parameters.c"]
    subprocess.run(
        ["gcc", "-std=c11", f"-I{core_sources}", *sources, "-lm", "-o", program], check=True
    )
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert done.stdout == "0\n"


def test_no_tick_ever_has_half_of_one_set_and_half_of_another() -> None:
    with Bench(seconds=0.1) as bench:
        bench.steps(8)
        over = threading.Event()

        def publish() -> None:
            n = 0
            while not over.is_set():
                n += 1
                value = float(n % 1000 + 1)
                watches = {name: core.Watch(value, "none") for name in WATCHABLE}
                one = core.Parameters(watches, value, value, value, value, n % 2 == 0, value)
                assert bench.loop.set_parameters(one) == n

        publisher = threading.Thread(target=publish)
        # Two threads that both want Python all the time take turns in short pieces.
        turns = sys.getswitchinterval()
        sys.setswitchinterval(1e-5)
        publisher.start()
        seen = set()
        try:
            # A busy machine lets the publisher get a word in less often.
            for step in range(50_000):
                if step >= 1500 and len(seen) > 10:
                    break
                bench.step()
                found = in_force(bench)
                if not bench.records[-1]["generation"][-1]:
                    continue
                value = found.velocity_limit_m_per_s
                seen.add(value)
                n = int(bench.records[-1]["generation"][-1])
                assert value == n % 1000 + 1
                assert found.adapt == (n % 2 == 0)
                others = {watch.value for watch in found.watches.values()} | {
                    found.acceleration_limit_m_per_s2,
                    found.path_velocity_m_per_s,
                    found.path_acceleration_m_per_s2,
                    found.brake_acceleration_m_per_s2,
                }
                assert others == {value}
        finally:
            over.set()
            publisher.join()
            sys.setswitchinterval(turns)
        generations = bench.rows()["generation"].astype(np.int64)
        assert np.all(np.diff(generations) >= 0)
        assert len(seen) > 10
