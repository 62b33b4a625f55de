"""What the units said stands below every scenario that fails."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from vm.systemd.lab import DRIVE, LIVE, RECORDER, SERVICE, journal


@pytest.fixture(autouse=True)
def words() -> Iterator[None]:
    before = journal(SERVICE, RECORDER, DRIVE, LIVE).count("\n")
    yield
    lines = journal(SERVICE, RECORDER, DRIVE, LIVE).splitlines()[before:]
    print("\n".join(["The journal:", *lines]))
