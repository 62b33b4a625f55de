"""Tests on rigs of several axes over links, tick by tick: sockets and serial lines, a link for each
axis, frames of their own, faults on a named axis, and what the recording has of it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import Rthyb
from test_axes_tests import RIG, TEST

import rthyb_rt as rt
from rthyb_rt import config, core
from rthyb_rt.analysis import several_axes
from rthyb_rt.cli import connecting
from rthyb_rt.config import AxesRig
from rthyb_rt.core import loop, wire
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_experiment, realtime, virtual_time
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.lab.realtime import RefusedError
from rthyb_rt.record import recording
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.commissioning import certificate
from rthyb_rt.rig.links import opening

AXES = ("left", "right")
EITHER = pytest.mark.parametrize("axis", AXES)
SHORT = (
    TEST.replace('name = "two"', 'name = "two"\nduration_s = 3')
    + "[ground_motion]\npga_g = 0.05\nstart_s = 1\n"
)
LIMITED = RIG.replace("ramp_in_s = 1.5", "ramp_in_s = 0.25\ntare_s = 0.125")
FRAME = Path(__file__).parents[1] / "examples" / "two-actuator-frame.toml"


def rig(text: str = LIMITED) -> AxesRig:
    found = config.parse_any_rig(text, "rig.toml")
    assert isinstance(found, AxesRig)
    return found


def linked(*channels: str, kind: str = "serial", further: str = "") -> AxesRig:
    """The rig with a link for each axis; further keys for all."""
    text = LIMITED
    for name, channel in zip(AXES, channels, strict=True):
        link = f'[axis.link]\nkind = "{kind}"\nchannel = "{channel}"\nvirtual = true\n{further}'
        text = text.replace(f'name = "{name}"', f'name = "{name}"', 1)
        mark = "[kinematics]" if name == AXES[-1] else '[[axis]]\nname = "right"'
        text = text.replace(mark, f"{link}\n{mark}", 1)
    return rig(text)


def setup(given: AxesRig | None = None, test: str = SHORT) -> Setup:
    return axes_experiment.prepare(
        config.parse_test(test, "test.toml"), given or rig(), real_time=True
    )


@contextmanager
def at_pty(log_ticks: int = 0) -> Iterator[tuple[AxesRig, loop.Drives]]:
    """A rig whose axes are at a serial line each, and its drives at the other ends."""
    with ExitStack() as owned:
        lines = [virtual_rig.pty_line()[0] for _ in AXES]
        for line in lines:
            owned.callback(line.close)
        given = linked(*(line.name for line in lines))
        links = [loop.Link(line.kind, line.fd) for line in lines]
        for link in links:
            owned.callback(link.close)
        codecs = [line.codec for line in lines]
        plan = virtual_rig.RigPlan(log_ticks=log_ticks)
        yield given, virtual_rig.drives_of(given, codecs, links, plan)


def faulty(texts: Sequence[str], test: str = SHORT, given: AxesRig | None = None) -> RecordedTest:
    return virtual_rig.run_faulty(setup(given, test), virtual_rig.parse_mishaps(texts, AXES))


def assert_replays(rec: RecordedTest) -> None:
    again = realtime.replay(rec)
    assert again.identical, (again.first_row, again.field)
    assert again.rows == rec.samples.size


# ---- links ---------------------------------------------------------------------------------------


def test_a_test_over_two_serial_lines_completes_and_replays(tmp_path: Path) -> None:
    with at_pty() as (given, drives), opening.open_axes(given, "controller") as opened:
        assert [one.kind for one in opened.all] == ["stream", "stream"]
        assert opened.name.startswith("left: ")
        assert "; right: " in opened.name
        rec = realtime.run(
            setup(given), opened, clock="stepped", before_tick=drives.tick, folder=tmp_path
        )
    assert rec.meta["end_reason"] == "completed"
    assert rec.axis_names == AXES
    facts = rec.meta["real_time"]
    assert set(facts["axes"]) == set(AXES)
    for own in facts["axes"].values():
        assert own["wire"]["pairs"] > 3000
        assert own["link_delay_samples"] == 0
    both = sum(own["wire"]["pairs"] for own in facts["axes"].values())
    assert facts["wire"]["pairs"] == both
    assert_replays(rec)
    # And from the file, where the frames of both links are kept.
    recording.write(tmp_path / "recording.h5", rec)
    assert_replays(recording.read(tmp_path / "recording.h5"))


def test_over_links_the_axes_go_where_they_go_in_virtual_time() -> None:
    """All that the wire adds is its resolution and the tick of its way back."""
    rec = faulty([])
    plain = virtual_time.run(axes_experiment.prepare(config.parse_test(SHORT, "test.toml"), rig()))
    for name in AXES:
        over, within = (
            one.axis(name)["x_meas_m"][one.samples["state"] == core.RUNNING] for one in (rec, plain)
        )
        assert over.size == within.size
        assert np.abs(over - within).max() < 0.02 * np.abs(within).max()


@EITHER
def test_a_line_that_is_not_there_is_told_with_its_axis(axis: str, tmp_path: Path) -> None:
    with at_pty() as (given, _):
        channels = [own.link.channel for own in given.axis if own.link is not None]
        channels[AXES.index(axis)] = str(tmp_path / "nothing")
        with pytest.raises(InputError, match=rf"axis\.{axis}\.link"):
            opening.open_axes(linked(*channels), "controller")
        # What was open before is given back: the same lines can be had again.
        opening.open_axes(given, "controller").close()


def test_frames_of_each_axis_have_their_own_calibration_and_signs() -> None:
    own = "calibration = { displacement = { scale = 2.0, polarity = -1, offset_m = 0.01 } }"
    turned = LIMITED.replace('name = "right"\n', f'name = "right"\n{own}\n', 1)
    rec, plain = faulty([], given=rig(turned)), faulty([])
    for name in AXES:
        ours, theirs = (one.axis(name)["x_meas_m"] for one in (rec, plain))
        assert np.abs(ours - theirs).max() < 2e-5
    assert_replays(rec)


# ---- faults on a named axis ----------------------------------------------------------------------


@EITHER
@pytest.mark.parametrize(
    ("fault", "cause", "state"),
    [
        ("silence@1", "link_lost", "TRIPPED"),
        ("drop@1:0.5=0.05", "completed", "IDLE"),
        ("force@1:0.2=2e5", "rig_force", "TRIPPED"),
        ("stuck@1:1", "sensor_stuck", "TRIPPED"),
        ("not-finite@1:0.2", "not_finite", "TRIPPED"),
    ],
)
def test_fault_on_one_axis_ends_the_test_for_all_and_is_told_with_its_name(
    fault: str, cause: str, state: str, axis: str
) -> None:
    stuck = SHORT + '[limits]\nsensor_stuck_s = { value = 0.04, action = "trip" }\n'
    rec = faulty([f"{axis}.{fault}"], stuck)
    station = rec.meta["station"]
    assert (station["cause"], station["state"]) == (cause, state)
    if state == "TRIPPED":
        assert rec.meta["end_reason"].endswith(f" of axis {axis}")
    said = " ".join(one.text for one in several_axes.notices(several_axes.summarize(rec)))
    assert ("A reading that is not a number was received" in said) == (cause == "not_finite")
    assert_replays(rec)
    other = AXES[1 - AXES.index(axis)]
    running = rec.samples["state"] == core.RUNNING
    lost = {name: rec.axis(name)["missing"][running].max() for name in AXES}
    assert lost[other] == 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "drop@1",
            "starts with the name of its axis, such as left.drop@1; the axes are left, right",
        ),
        ("middle.drop@1", "found the axis middle; the axes are left, right"),
        ("left.drap@1", "no such kind of fault"),
        ("left.drop@1=2", "drop accepts 0 to 1"),
    ],
)
def test_a_fault_without_a_sound_axis_is_refused(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said.replace(".", r"\.")):
        virtual_rig.parse_faults([text], AXES)


def test_power_is_that_of_all_axes_and_a_number_is_no_axis() -> None:
    faults, cut_s = virtual_rig.parse_faults(["power-cut@3", "right.drop@2.5:0.1=0.5"], AXES)
    assert cut_s == 3.0
    assert [(one.kind, one.axis, one.value) for one in faults] == [("drop", 1, 0.5)]
    # Of one axis as ever: a point in the time is none between axis and kind.
    (fault,), _ = virtual_rig.parse_faults(["drop@2.5:0.1=0.5"])
    assert (fault.axis, fault.first) == (0, 2560)


def test_drives_take_faults_of_the_axes_that_there_are() -> None:
    given = rig()
    ours, theirs = opening.socket_pairs(given.names)
    with (
        ours,
        theirs,
        virtual_rig.in_step(given, theirs) as drives,
        pytest.raises(
            core.CoreError, match="a fault for axis number 2; the axes are numbered from 0 to 1"
        ),
    ):
        drives.schedule([loop.Fault("drop", 0, 5, 1.0, 2)])


# ---- what is refused -----------------------------------------------------------------------------


def test_rate_that_no_clock_has_is_for_virtual_time() -> None:
    with pytest.raises(InputError, match="whole number of samples per second: use 1000"):
        setup(test=SHORT.replace("duration_s = 3", "duration_s = 3\nsample_rate_hz = 1000.4"))


def test_a_rig_that_is_not_at_rest_names_the_axis() -> None:
    """The right axis shakes during the tare."""
    given = rig()
    ours, theirs = opening.socket_pairs(given.names)
    with ours, theirs, virtual_rig.in_step(given, theirs) as drives:
        shake = [loop.Fault("jump", 40 + 4 * k, 2, 4e-4, 1) for k in range(200)]
        drives.schedule(shake)
        with pytest.raises(InputError, match="displacement of axis right moved by"):
            realtime.run(setup(given), ours, clock="stepped", before_tick=drives.tick)


@EITHER
def test_a_drive_that_says_nothing_is_told_with_its_axis(axis: str) -> None:
    given = rig()
    ours, theirs = opening.socket_pairs(given.names)
    with ours, theirs, virtual_rig.in_step(given, theirs) as drives:
        drives.schedule([loop.Fault("silence", 0, 10**9, 1.0, AXES.index(axis))])
        with pytest.raises(InputError, match=f"axis {axis}: nothing arrived"):
            realtime.run(setup(given), ours, clock="stepped", before_tick=drives.tick)


def test_codecs_of_a_recording_are_of_as_many_axes() -> None:
    rec = faulty([])
    assert len(rec.replay.codec) == 2 * len(wire.can().table)
    cut = replace(rec, replay=replace(rec.replay, codec=rec.replay.codec[:-1]))
    with pytest.raises(InputError, match="not those of 2 axes"):
        realtime.replay(cut)


# ---- the command line ----------------------------------------------------------------------------


@pytest.mark.long
def test_rthyb_run_takes_faults_on_a_named_axis(rthyb: Rthyb, tmp_path: Path) -> None:
    done = rthyb(
        "run", FRAME, "--set", "ground_motion.duration_s=1", "--set", "test.duration_s=2",
        "--fault", "lower.silence:from=1", "--out", tmp_path / "out", "--json",
    )  # fmt: skip
    assert done.code == 6, done.err
    assert done.json["end_reason"] == "tripped: link lost of axis lower"  # type: ignore[index]
    assert [one["text"] for one in done.json["notices"]] == rt.open(tmp_path / "out").notices
    assert rthyb("replay", tmp_path / "out").code == 0
    bad = rthyb("run", FRAME, "--fault", "silence:from=1")
    assert bad.code == 2
    assert "upper.silence:from=1" in bad.err.replace("\n", " ")


def test_rthyb_jog_asks_which_axis_is_meant(rthyb: Rthyb) -> None:
    done = rthyb("jog", "two-axis-frame", "0.1 mm")
    assert done.code == 3
    assert "--axis upper" in done.err
    strange = rthyb("jog", "two-axis-frame", "0.1 mm", "--axis", "middle")
    assert strange.code == 3
    assert "the axes of rig" in strange.err
    one = rthyb("jog", "hydraulic-25kn", "0.1 mm", "--axis", "upper")
    assert one.code == 3
    assert "the rig has one axis" in one.err


# ---- jog, reset and commissioning, axis by axis --------------------------------------------------


@pytest.fixture
def stepped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without a link, tick by tick with a virtual rig."""
    monkeypatch.setattr(connecting, "clock_of", lambda _: "stepped")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "pair.toml"
    path.write_text(LIMITED, encoding="utf-8")
    return path


@EITHER
def test_rthyb_jog_moves_the_axis_that_is_named(
    rthyb: Rthyb, file: Path, stepped: None, axis: str
) -> None:
    done = rthyb("jog", file, "0.5 mm", "--speed", "5 mm/s", "--axis", axis, "--json")
    assert done.code == 0, done.err
    assert (done.json["rig_name"], done.json["axis"]) == ("two-storeys", axis)
    # The noise of the reading is what it can be off by.
    assert done.json["moved_m"] == pytest.approx(0.5e-3, abs=20e-6)
    assert f"two-storeys, axis {axis}: completed" in done.err


def test_rthyb_reset_tells_of_every_axis_or_of_the_one_that_is_named(
    rthyb: Rthyb, file: Path, stepped: None
) -> None:
    both = rthyb("reset", file, "--json")
    assert both.code == 0, both.err
    assert list(both.json["axes"]) == list(AXES)
    one = rthyb("reset", file, "--axis", "right", "--json")
    assert list(one.json["axes"]) == ["right"]
    assert "axis right: the drive follows" in one.err


@pytest.mark.long
def test_a_test_asks_for_the_commissioning_of_every_axis(
    rthyb: Rthyb, file: Path, stepped: None
) -> None:
    """What is commissioned is the rig as its file stands; so here it has no link, and is told to
    be a real one afterwards."""
    given = config.parse_any_rig(LIMITED, "rig.toml")
    assert isinstance(given, AxesRig)
    done = rthyb("commission", file, "--yes", "--axis", "left", "--json")
    assert done.code == 0, done.err
    assert file.with_name("pair.left.commissioned.json").exists()
    assert not file.with_name("pair.right.commissioned.json").exists()
    assert certificate.find(given.of_axis("left"), file, "left")[0] is not None
    # The certificate of one axis is none of the other, be they alike.
    assert certificate.find(given.of_axis("left"), file, "right")[0] is None

    real = linked("/dev/one", "/dev/two")
    real = real.model_copy(
        update={
            "axis": [
                own.model_copy(update={"link": own.link.model_copy(update={"virtual": False})})
                for own in real.axis
                if own.link is not None
            ]
        }
    )
    held = certificate.read(file.with_name("pair.left.commissioned.json"))
    for name in AXES:
        with pytest.raises(RefusedError, match=f"axis {name}: .*--axis {name}"):
            certificate.demand(real, file)
    for k, name in enumerate(AXES):
        own = replace(held, rig_hash=certificate.rig_hash(real.of_axis(name), name))
        certificate.write(certificate.place(file, name), own)
        if k == 0:
            with pytest.raises(RefusedError, match=r"^((?!axis left).)*axis right"):
                certificate.demand(real, file)
    known = certificate.demand(real, file)["commissioning"]
    assert known["demanded"]
    assert list(known["axes"]) == list(AXES)
