"""`rthyb live` as a process, and a service at real-time pace, for tests in a browser."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from realtime_bench import process, until
from service_bench import await_state, served, short_test, status

from rthyb_rt import config
from rthyb_rt.lab import experiment
from rthyb_rt.service import daemon
from rthyb_rt.service.control import Client
from rthyb_rt.service.daemon import Daemon, record_of
from rthyb_rt.service.rig_engine import TURN_S

LONG = {
    "test.duration_s": "60",
    "ground_motion.start_s": "1",
    "controller.type": "alpha-beta",
}


@contextmanager
def live(*arguments: object, folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the output of `rthyb live --json` while it runs."""
    with process(folder, "live", *arguments, "--port", "0", "--json") as made:
        said = ""
        while not said.endswith("}\n"):
            line = made.line()
            assert line, made.end()
            said += line
        yield json.loads(said)


@contextmanager
def paced(folder: Path) -> Iterator[Daemon]:
    """Yield a daemon on the stepped clock at real-time pace, which is insensitive to stalls."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(daemon, "_STEPPED_S", TURN_S)
        with served(folder) as made:
            yield made


def load(folder: Path, changes: dict[str, str] | None = None) -> str:
    """Load a test; return its digest."""
    test = short_test(LONG | (changes or {}))
    until(lambda: status(folder)["follows"], "a drive that follows")
    with Client(folder / "control.sock") as client:
        record = record_of(experiment.load_motion(test))
        digest = client.call("Load", test_toml=config.dump(test), record=record)["digest"]
        return str(digest)


def start(folder: Path, changes: dict[str, str] | None = None) -> None:
    """Bring a test to RUNNING."""
    digest = load(folder, changes)
    with Client(folder / "control.sock") as client:
        client.call("Zero")
        await_state(folder, "ZEROED")
        client.call("Start", token=client.call("Arm", digest=digest)["token"])
    await_state(folder, "RUNNING")
