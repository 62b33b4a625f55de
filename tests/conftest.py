"""Fixtures shared by several test modules."""

from __future__ import annotations

import gc
import os
import signal
from collections.abc import Iterator
from importlib import resources
from pathlib import Path
from tempfile import TemporaryDirectory

# A second BLAS thread would busy-wait for the first one, and the problems in tests are small. Set
# before numpy is imported, and inherited by the processes of the tests.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
import stalls
from command_line import Answer, Rthyb

from rthyb_rt import cli, ground_motion, studies
from rthyb_rt.core import ticker
from rthyb_rt.ground_motion import GroundMotion
from rthyb_rt.studies.results import Study


def pytest_configure(config: pytest.Config) -> None:
    """Handle Ctrl-C and hang-ups, which are ignored by children of a background shell or nohup."""
    if "RTHYB_GUEST" in os.environ:
        stalls.begin_in_guest(config)
    for number, usual in (
        (signal.SIGINT, signal.default_int_handler),
        (signal.SIGHUP, signal.SIG_DFL),
    ):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, usual)


def pytest_collection_finish() -> None:
    """Exclude what the collection created, which is never freed, from garbage collection."""
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def memory_of_its_own() -> Iterator[None]:
    """Unlock memory: a real-time loop locks all of the process, which slows down later tests."""
    yield
    ticker.unlock_memory()


@pytest.fixture(scope="session")
def tcu068_first_50_s() -> GroundMotion:
    """Chi-Chi 1999, station TCU068, component EW: the first 50 s, 200 Hz, not scaled.

    The record is taken from the test dependency pyslammer, because its licence does not permit
    redistribution.
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
    """The results for the whole paper, computed once; Section 4.2 with TCU068 if available."""
    return studies.run()


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """Folder in which `rthyb ctl` looks for a service, and the service stores its rings."""
    memory = Path("/dev/shm")
    with TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        monkeypatch.setenv("RTHYB_SOCKET", str(Path(folder) / "control.sock"))
        monkeypatch.setenv("XDG_RUNTIME_DIR", folder)
        yield Path(folder)


@pytest.fixture
def rthyb(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Rthyb:
    """Run a command in this process, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("FORCE_COLOR", raising=False)

    def call(*arguments: object) -> Answer:
        capsys.readouterr()
        code = cli.main([str(argument) for argument in arguments])
        streams = capsys.readouterr()
        answer = Answer(code, streams.out, streams.err)
        assert "\x1b" not in answer.out + answer.err
        if not os.environ.get("RTHYB_TRACEBACK"):
            assert "Traceback" not in answer.out + answer.err
        return answer

    return call
