"""These tests need a kernel with SocketCAN, and are left out where `guest.py` did not start them.

Nothing may be skipped in the guest: what cannot run there runs nowhere.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator

import pytest

IN_GUEST = "RTHYB_GUEST" in os.environ

collect_ignore_glob = [] if IN_GUEST else ["test_*.py"]


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    skipped = reporter.stats.get("skipped", []) if reporter else []
    if IN_GUEST and skipped and session.exitstatus == pytest.ExitCode.OK:
        reporter.ensure_newline()
        reporter.write_line(f"{len(skipped)} skipped in the guest: a failure")
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture
def interface() -> Iterator[str]:
    """A vcan of the test's own, which it may take down and remove."""
    name = "rig0"
    ip("link", "add", name, "type", "vcan")
    ip("link", "set", name, "up")
    yield name
    subprocess.run(["ip", "link", "delete", name], check=False, capture_output=True)


def ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)
