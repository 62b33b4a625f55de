"""Fixtures that several test modules share."""

from __future__ import annotations

from importlib import resources

import pytest

from rthyb_rt import ground_motion, studies
from rthyb_rt.ground_motion import GroundMotion
from rthyb_rt.studies.results import Study


@pytest.fixture(scope="session")
def tcu068_first_50_s() -> GroundMotion:
    """Chi-Chi 1999, station TCU068, component EW: the first 50 s, 200 Hz, not scaled.

    The record comes from the test-time package pyslammer, whose licence does not let it be
    shipped here.
    """
    package = pytest.importorskip("pyslammer", reason="pyslammer has the TCU068 record")
    del package
    name = "Chi-Chi_1999_TCU068-090.csv"
    with resources.as_file(resources.files("pyslammer") / "sample_ground_motions" / name) as path:
        if not path.is_file():
            pytest.skip(f"this version of pyslammer does not have {name}")
        return ground_motion.read(path).window(0.0, 50.0)


@pytest.fixture(scope="session")
def paper() -> list[Study]:
    """The whole paper reproduced, once; Section 4.2 with TCU068 where pyslammer has it."""
    return studies.run()
