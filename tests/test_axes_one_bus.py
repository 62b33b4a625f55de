"""Two axes on one CAN bus, each with identifiers of its own from a DBC file, tick by tick."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from realtime_bench import until
from test_axes_files import OWN
from test_axes_realtime import AXES, LIMITED, assert_replays, setup

from rthyb_rt import config
from rthyb_rt.config import AxesRig
from rthyb_rt.core import loop
from rthyb_rt.errors import InputError
from rthyb_rt.lab import realtime
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.links import locks, opening

pytest.importorskip("cantools")
FIRST = {"left": 0x100, "right": 0x200}


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Path:
    """The rig file, both of whose axes are at one bus of python-can, of this test alone."""
    (tmp_path / "locks").mkdir()
    monkeypatch.setattr(locks, "SHARED_FOLDER", tmp_path / "locks")
    text = LIMITED
    for name, first in FIRST.items():
        given = OWN.format(command=first, reading=first + 1)
        (tmp_path / f"{name}.dbc").write_text(given, encoding="utf-8")
        link = (
            f'[axis.link]\nkind = "python-can"\ninterface = "virtual"\ndbc = "{name}.dbc"\n'
            f'channel = "{request.node.name}"\nbitrate = 1000000\nvirtual = true\n'
        )
        mark = "[kinematics]" if name == AXES[-1] else '[[axis]]\nname = "right"'
        text = text.replace(mark, f"{link}\n{mark}", 1)
    path = tmp_path / "rig.toml"
    path.write_text(text, encoding="utf-8")
    return path


def until_came(exchange: dict[str, int], sent: int) -> None:
    until(lambda: exchange["to_core"] >= sent, "a pair")


@pytest.mark.long
def test_a_test_of_two_axes_on_one_bus_completes_and_no_axis_hears_the_other(file: Path) -> None:
    given = config.load_any_rig(file)
    assert isinstance(given, AxesRig)
    with ExitStack() as owned:
        theirs = owned.enter_context(opening.open_axes(given, "drive"))
        ours = owned.enter_context(opening.open_axes(given, "controller"))
        links = [loop.Link(one.kind, one.fd) for one in theirs.all]
        for link in links:
            owned.callback(link.close)
        drives = virtual_rig.drives_of(
            given, [one.codec for one in theirs.all], links, virtual_rig.RigPlan()
        )

        def tick() -> None:
            # Frames pass through threads of Python, which are given the time that they need.
            time.sleep(0.0002)
            drives.tick()
            for name, link in zip(AXES, links, strict=True):
                until_came(ours.facts[f"{name}.exchange"], link.counters()["pieces_out"])

        rec = realtime.run(setup(given), ours, clock="stepped", before_tick=tick)
    assert rec.meta["end_reason"] == "completed"
    running = rec.running()
    facts = rec.meta["real_time"]["axes"]
    for k, name in enumerate(AXES):
        own, other = (rec.axis(one)[running] for one in (name, AXES[1 - k]))
        assert facts[name]["wire"]["pairs"] > 3000
        # It goes where it is told, a few samples late, and not where the other one is told.
        left_over = [
            float(np.std(own["x_meas_m"][20:] - one["x_cmd_m"][8:-12])) for one in (own, other)
        ]
        assert left_over[0] < 0.5 * left_over[1]
    assert_replays(rec)


def test_a_bus_without_room_for_both_is_refused_with_its_load(file: Path) -> None:
    text = file.read_text(encoding="utf-8").replace("bitrate = 1000000", "bitrate = 500000")
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"4 frames, .* load the bus to \d{3} %, and at most 80 %"):
        config.load_any_rig(file)
