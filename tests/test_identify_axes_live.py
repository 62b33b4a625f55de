"""Identification of several axes over their links, tick by tick, against that in virtual time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from command_line import Rthyb
from test_axes_realtime import AXES, EITHER, LIMITED, linked, stepped
from test_axes_realtime import rig as pair_of

from rthyb_rt import config
from rthyb_rt.config import AxesRig
from rthyb_rt.core import loop
from rthyb_rt.errors import InputError
from rthyb_rt.lab import realtime
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.commissioning.guided_motion import AxesConnection, LimitError, StoppedError
from rthyb_rt.rig.identification import SweepPlan, command_of
from rthyb_rt.rig.identify_axes import AxesResult, identified_rig, identify_rig
from rthyb_rt.rig.identify_axes_live import identify_axes_live, setup_of
from rthyb_rt.rig.links import opening

__all__ = ["stepped"]

SWEEP = SweepPlan((1.0, 4.0, 10.0), 1e-3)
SHORT = SweepPlan((4.0, 10.0), 1e-3)
BOUNDED = LIMITED.replace(
    'command_position_m = "20 mm" }', 'command_position_m = "20 mm", force_n = "90 kN" }'
)


@contextmanager
def within_reach(
    given: AxesRig, faults: tuple[loop.Fault, ...] = (), **more: object
) -> Iterator[AxesConnection]:
    ours, theirs = opening.socket_pairs(given.names)
    plan = virtual_rig.RigPlan(faults=faults)
    with ours, theirs, virtual_rig.in_step(given, theirs, plan) as drives:
        yield AxesConnection(given, ours, "stepped", drives.tick, **more)  # type: ignore[arg-type]


def live(given: AxesRig, sweep: SweepPlan, *faults: loop.Fault) -> AxesResult:
    with within_reach(given, faults) as connection:
        return identify_axes_live(connection, sweep)


def assert_alike(found: AxesResult, wanted: AxesResult, share: float) -> None:
    """By size of each number, or of the largest one of its matrix."""
    for ours, theirs in zip(found.response.response, wanted.response.response, strict=True):
        assert np.abs(ours - theirs).max() < share * np.abs(theirs).max()
    assert np.abs(found.stiffness - wanted.stiffness).max() < share * wanted.stiffness.max()
    for own, other in zip(found.axes, wanted.axes, strict=True):
        assert own.alpha == pytest.approx(other.alpha, abs=0.05)
        assert own.k_e_n_per_m == pytest.approx(other.k_e_n_per_m, rel=share)


@pytest.mark.long
def test_over_links_the_matrix_of_responses_is_that_of_virtual_time() -> None:
    done: list[tuple[int, int]] = []
    with within_reach(pair_of()) as connection:
        found = identify_axes_live(connection, SWEEP, lambda *told: done.append(told))
    assert_alike(found, identify_rig(pair_of(), SWEEP), 1e-3)
    ticks, total = np.array(done).T
    assert (np.diff(ticks) >= 0).all()
    assert (ticks <= total).all()
    assert set(total) == {2 * SWEEP.ticks}


@pytest.mark.long
def test_frame_with_pins_whose_axes_feel_one_another_is_found_as_in_virtual_time() -> None:
    """Off the diagonal as well, where the matrix has up to a seventh of what is on it."""
    frame = config.load_any_rig(config.find_rig("two-axis-frame"))
    assert isinstance(frame, AxesRig)
    found, wanted = live(frame, SHORT), identify_rig(frame, SHORT)
    assert_alike(found, wanted, 0.01)
    assert abs(wanted.response.response[0][1, 0]) > 0.05


@pytest.mark.long
@pytest.mark.parametrize("rate_hz", [2048, 4096])
def test_drives_of_another_rate_give_the_matrix_that_those_of_1024_hz_give(rate_hz: int) -> None:
    """Both axes are servos that hold each command: a rig file has the hold of 1/1024 s."""
    channels = ("/left", "/right")
    given = linked(*channels, kind="socket", further=f"sample_rate_hz = {rate_hz}\n")
    assert given.rate.hz == rate_hz
    sweep = SweepPlan((1.0, 4.0), 1e-3)
    found, wanted = live(given, sweep), identify_rig(pair_of(), sweep)
    now, before = (identified_rig(given, one).identified for one in (found, wanted))
    assert now is not None
    assert before is not None
    for ours, theirs in ((now.real, before.real), (now.imaginary, before.imaginary)):
        assert np.abs(np.array(ours) - np.array(theirs)).max() < 5e-3
    assert np.abs(found.stiffness - wanted.stiffness).max() < 5e-3 * wanted.stiffness.max()


@EITHER
def test_the_station_moves_one_axis_along_the_sweep_and_no_other(axis: str) -> None:
    """The ground shakes a mass that no force moves: it goes along the path, to the nanometre."""
    given, k = pair_of(), AXES.index(axis)
    command, _ = command_of(SHORT)
    with within_reach(given) as connection:
        rec = realtime.run(
            setup_of(given, k, command),
            connection.opened,
            clock="stepped",
            before_tick=connection.before_tick,
        )
    running = rec.running()
    assert np.count_nonzero(running) == command.size
    sent, still = (rec.axis(name)["x_cmd_m"][running] for name in (axis, AXES[1 - k]))
    # Whichever tick it begins with.
    apart = min(np.abs(np.roll(sent, n) - command).max() for n in (-2, -1, 0, 1))
    assert apart < 2e-9
    assert np.abs(still).max() < 2e-9


# ---- what ends it --------------------------------------------------------------------------------


@EITHER
@pytest.mark.parametrize("kind", ["silence", "force"])
def test_what_ends_a_sweep_is_told_with_both_axes(axis: str, kind: str) -> None:
    value = 2e5 if kind == "force" else 1.0
    fault = loop.Fault(kind, 6000, 400, value, AXES.index(axis))  # type: ignore[arg-type]
    with pytest.raises(LimitError, match=rf"the sweep of axis left: tripped: .* of axis {axis}"):
        live(pair_of(), SHORT, fault)


def test_operator_ends_the_sweep() -> None:
    asked: list[Callable[[], None]] = []
    stops: list[int] = []

    @contextmanager
    def interruptible(stop: Callable[[], None]) -> Iterator[None]:
        asked.append(stop)
        yield

    def progress(done: int, _: int) -> None:
        if done > 2500 and len(stops) < 1:
            stops.append(done)
            asked[-1]()

    with (
        within_reach(pair_of(), on_interrupt=interruptible) as connection,
        pytest.raises(StoppedError, match="the sweep of axis left: stopped by the operator"),
    ):
        identify_axes_live(connection, SHORT, progress)
    assert len(asked) == 1


def test_limits_that_are_missing_or_too_narrow_are_named_by_axis_and_key() -> None:
    bare = LIMITED.replace(', force_n = "60 kN"', "").replace('force_n = "90 kN"\n', "")
    with pytest.raises(InputError) as caught:
        live(pair_of(bare), SHORT)
    where = [problem.where for problem in caught.value.problems]
    assert where == [f"axis.{name}.limits.force_n" for name in AXES]
    with pytest.raises(InputError, match="25 mm is more than the limit of 20 mm"):
        live(pair_of(), SweepPlan((1.0,), 25e-3))


def test_a_sweep_that_a_limit_of_the_command_changes_is_refused() -> None:
    slow = LIMITED.replace("[limits]\n", '[limits]\ncommand_velocity_m_per_s = "20 mm/s"\n')
    with pytest.raises(InputError, match=r"the sweep of axis left: .*limits on velocity"):
        live(pair_of(slow), SweepPlan((10.0,), 1e-3))


# ---- the command line ----------------------------------------------------------------------------


@pytest.mark.long
def test_rthyb_identify_in_real_time_writes_a_rig_file_with_the_matrix(
    rthyb: Rthyb, tmp_path: Path, stepped: None
) -> None:
    file, out = tmp_path / "pair.toml", tmp_path / "identified.toml"
    file.write_text(LIMITED, encoding="utf-8")
    done = rthyb(
        "identify", file, "--realtime", "--amplitude", "1 mm", "--max-frequency", "5 Hz",
        "--out", out, "--json",
    )  # fmt: skip
    assert done.code == 0, done.err
    filled = config.load_any_rig(out)
    assert isinstance(filled, AxesRig)
    assert filled.identified is not None
    assert filled.identified.frequency_hz[-1] == 5.0
    assert [axis.identified is not None for axis in filled.axis] == [True, True]
    assert done.json["response"]["real"] == filled.identified.real


def test_axes_that_are_not_commissioned_are_not_swept(rthyb: Rthyb, tmp_path: Path) -> None:
    real = config.dump(linked("/dev/one", "/dev/two")).replace("virtual = true", "virtual = false")
    file = tmp_path / "pair.toml"
    file.write_text(real, encoding="utf-8")
    done = rthyb("identify", file, "--realtime")
    assert done.code == 5
    assert "--axis left" in done.err.replace("\n", " ")
