"""What a soak calls growth, and what it does not."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

_SPEC = importlib.util.spec_from_file_location("soak", Path(__file__).parent / "proof" / "soak.py")
assert _SPEC is not None
assert _SPEC.loader is not None
soak = importlib.util.module_from_spec(_SPEC)
sys.modules["soak"] = soak
_SPEC.loader.exec_module(soak)

LOOKS = np.arange(0.0, 300.0, 0.5)


def faults(memory_mb: np.ndarray, descriptors: np.ndarray) -> list[str]:
    """What is said of a recorder that was seen so, beside two processes that do not change."""
    watched = soak.Soak(300.0)
    for i, at_s in enumerate(LOOKS):
        watched.ticks.append((at_s, int(1024 * at_s), 0, int(1024 * at_s)))
        for name in soak.PARTIES:
            seen = (memory_mb[i], descriptors[i]) if name == "recorder" else (100.0, 6)
            watched.seen[name].append((at_s, *seen, 4))
    found: list[str] = watched.judge()
    return found


def wandering(seed: int) -> np.ndarray:
    """Memory of a recorder that writes a test every ten seconds: pages come and go."""
    noise = np.random.default_rng(seed).normal(0.0, 0.15, LOOKS.size)
    return 71.0 + 0.4 * (LOOKS % 10.0 > 6.0) + noise


STEADY = np.full(LOOKS.size, 7)


@pytest.mark.parametrize("at_s", [80.0, 140.0, 200.0, 250.0])
def test_pool_that_grows_once_is_no_leak(at_s: float) -> None:
    assert faults(wandering(1) + 1.2 * (at_s < LOOKS), STEADY) == []


@pytest.mark.parametrize("seed", range(5))
def test_leak_of_70_kb_a_test_is_seen(seed: int) -> None:
    found = faults(wandering(seed) + 0.07 * np.floor(LOOKS / 10.0), STEADY)
    assert len(found) == 1
    assert "recorder: memory grows" in found[0]


def test_file_that_is_open_for_a_moment_is_no_leak() -> None:
    assert faults(wandering(2), STEADY + (LOOKS == 260.0)) == []


def test_descriptor_that_stays_open_is_a_leak() -> None:
    assert faults(wandering(2), STEADY + (LOOKS > 200.0)) == [
        "recorder: descriptors grow from 7 to 8"
    ]
