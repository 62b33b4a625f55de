"""`rthyb jog`, `rthyb commission` and `rthyb identify --realtime` as a laboratory meets them.

Most of it goes tick by tick with a virtual drive; the last ones have processes of their own.
"""

from __future__ import annotations

import io
import json
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
import typer
from command_line import Rthyb
from commissioning_bench import COLUMN, STIFFNESS_N_PER_M
from realtime_bench import ATTEMPTS, SHORT, STALLED, Process

from rthyb_rt import config, core, report
from rthyb_rt.cli import connecting
from rthyb_rt.core import mapped_ring
from rthyb_rt.record import recording
from rthyb_rt.rig.commissioning import certificate, guide, guided_motion

pytestmark = pytest.mark.alone

NO_LINK = COLUMN.replace('[link]\nkind = "socket"\nchannel = "/nowhere"\n', "")
NO_STIFFNESS = NO_LINK.replace("elastic_stiffness_n_per_m = 1\n", "")


@pytest.fixture
def stepped(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Without a link, tick by tick with a virtual rig."""
    monkeypatch.setattr(connecting, "clock_of", lambda _: "stepped")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def rig_file(folder: Path, text: str = NO_LINK) -> Path:
    path = folder / "rig.toml"
    path.write_text(text, encoding="utf-8")
    return path


# ---- jog ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("distance", ["1 mm", "-0.5 mm", "-0.5", "0.02 in"])
def test_jog_says_where_it_led(rthyb: Rthyb, tmp_path: Path, stepped: None, distance: str) -> None:
    answer = rthyb("jog", rig_file(tmp_path, NO_STIFFNESS), distance, "--speed", "5 mm/s", "--json")
    assert answer.code == 0
    found = answer.json
    factor = 25.4e-3 if "in" in distance else 1e-3
    asked_m = float(distance.split()[0]) * factor
    assert found["schema"] == "rthyb-jog/1"
    assert found["asked_m"] == pytest.approx(asked_m)
    assert found["moved_m"] == pytest.approx(asked_m, abs=10e-6)
    assert found["stiffness_n_per_m"] == pytest.approx(STIFFNESS_N_PER_M, rel=0.02)
    assert "column: completed" in answer.err
    assert "kN/m" in answer.err


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("2 kg",), 2, 'found "2 kg" (that is a mass); must be a length from -1'),
        (("1 mm", "--speed", "0"), 2, "--speed"),
        (("1 mm", "--sped", "1"), 2, "--sped"),
        (("11 mm",), 5, "more than limits.command_position_m = 10 mm allows"),
        (("1 mm", "--speed", "50 mm/s"), 5, "at most 20 mm/s is allowed"),
        (("1 mm", "--set", "limits.force_n={ value = 1, enable = false }"), 3, "limits.force_n"),
        (("1 mm", "--set", "limits.force_n=100"), 6, "tripped: force limit"),
        ((), 2, "DISTANCE"),
    ],
)
def test_jog_refuses_or_ends_with_its_exit_code(
    rthyb: Rthyb,
    tmp_path: Path,
    stepped: None,
    arguments: tuple[str, ...],
    code: int,
    message: str,
) -> None:
    answer = rthyb("jog", rig_file(tmp_path), *arguments)
    assert answer.code == code
    assert message in " ".join((answer.out + answer.err).split())


def test_jog_names_a_wrong_sign(rthyb: Rthyb, tmp_path: Path, stepped: None) -> None:
    """The force of a negative stiffness falls, as that of a load cell that was wired backwards."""
    path = rig_file(tmp_path, NO_LINK.replace("k_n_per_m = 500000", "k_n_per_m = -500000"))
    answer = rthyb("jog", path, "1 mm", "--speed", "5 mm/s")
    assert answer.code == 8
    assert "Attention: the force falls as the displacement rises: k_e = -" in answer.out
    assert " kN/m; check the polarity of the load cell" in answer.out
    assert "force = { polarity = -1 }" in answer.out
    found = rthyb("jog", path, "1 mm", "--speed", "5 mm/s", "--json").json
    assert found["reversed"] is True
    assert found["stiffness_n_per_m"] == pytest.approx(-STIFFNESS_N_PER_M, rel=0.02)


def test_jog_too_small_to_tell_a_sign_names_none(
    rthyb: Rthyb, tmp_path: Path, stepped: None
) -> None:
    """0.1 um of a specimen as soft as this are 0.05 N in a noise of 5 N."""
    path = rig_file(tmp_path, NO_LINK.replace("k_n_per_m = 500000", "k_n_per_m = -500000"))
    answer = rthyb("jog", path, "0.0001 mm", "--json")
    assert answer.code == 0
    assert answer.json["reversed"] is False


def test_check_says_whether_the_rig_is_commissioned_as_its_file_stands(
    rthyb: Rthyb, tmp_path: Path
) -> None:
    text = COLUMN.replace("per_m = 1\n", f"per_m = {STIFFNESS_N_PER_M}\n")
    path = rig_file(tmp_path, text)
    test = config.load_test(config.builtin_test_path(), {
        "ground_motion.pga_g": "0.01", "limits": "{}", "controller.alpha0": "12",
    })  # fmt: skip
    (tmp_path / "test.toml").write_text(config.dump(test), encoding="utf-8")
    check = ("check", tmp_path / "test.toml", "--rig", path)

    def found(*arguments: str) -> dict[str, Any]:
        answer = rthyb(*check, "--json", *arguments)
        assert answer.code == 0, answer.err
        document: dict[str, Any] = answer.json["commissioning"]  # type: ignore[assignment]
        return document

    none = found()
    assert (none["demanded"], none["commissioned"]) == (True, False)
    assert "this rig has not been commissioned" in none["why_not"]
    plain = rthyb(*check).out
    assert re.search(r"^Commissioned +no ", plain, re.MULTILINE)
    assert "Warning: a test in real time will be refused: this rig has not been" in plain
    rig = config.load_rig(path)
    steps = {
        "link": certificate.CheckedStep("link", True, "2026-11-20T08:00:00+00:00"),
        "polarity": certificate.CheckedStep("polarity", False, "2026-11-20T08:01:00+00:00"),
    }
    failed = certificate.Certificate(
        "column", certificate.rig_hash(rig), False, "socket", steps=steps
    )
    certificate.write(certificate.place(path), failed)
    assert found()["commissioned"] is False
    assert "has passed: polarity FAILED, limits was not done" in found()["why_not"]
    passed = certificate.CheckedStep("polarity", True, "2026-11-21T09:30:00+00:00")
    signs_alone = failed.with_step(passed)
    certificate.write(certificate.place(path), signs_alone)
    assert found()["commissioned"] is False
    assert found()["steps"]["trip"] is None
    plain = rthyb(*check).out
    assert re.search(r"^Check of the watchdog +not done", plain, re.MULTILINE)
    assert "limits was not done, watchdog was not done, trip was not done" in plain
    whole = signs_alone
    for name in ("limits", "watchdog", "trip"):
        whole = whole.with_step(certificate.CheckedStep(name, True, "2026-11-20T08:02:00+00:00"))
    certificate.write(certificate.place(path), whole)
    good = found()
    assert (good["commissioned"], good["why_not"]) == (True, "")
    assert good["steps"]["polarity"] == {"passed": True, "date": "2026-11-21T09:30:00+00:00"}
    plain = rthyb(*check).out
    assert re.search(r"^Commissioned +yes ", plain, re.MULTILINE)
    assert re.search(r"^Check of polarity +passed +2026-11-21T09:30", plain, re.MULTILINE)
    assert re.search(r"^Check of the watchdog +passed", plain, re.MULTILINE)
    assert "will be refused" not in plain
    # Another limit is another rig.
    moved = found("--set", "rig.limits.force_n=7 kN")
    assert moved["commissioned"] is False
    assert "have changed since the rig was commissioned on 2026-11-21" in moved["why_not"]
    virtual = found("--set", "rig.link.virtual=true")
    assert (virtual["demanded"], virtual["why_not"]) == (False, "")
    certificate.place(path).write_text("{", encoding="utf-8")
    assert "is not a commissioning file" in found()["why_not"]


# ---- commission ---------------------------------------------------------------------------------


def test_commissioning_keeps_what_passed_beside_the_rig_file(
    rthyb: Rthyb, tmp_path: Path, stepped: None
) -> None:
    path = rig_file(tmp_path)
    place = tmp_path / "rig.commissioned.json"
    first = rthyb("commission", path, "--yes", "--steps", "link,polarity", "--distance", "0.5 mm")
    assert first.code == 0, first.err
    assert "polarity  passed" in first.out
    assert "watchdog  not done" in first.out
    assert set(json.loads(place.read_text())["steps"]) == {"link", "polarity"}
    second = rthyb("commission", path, "--yes", "--steps", "watchdog, trip", "--json")
    assert second.code == 0, second.err
    document = json.loads(place.read_text())
    assert set(document["steps"]) == {"link", "polarity", "watchdog", "trip"}
    assert second.json == {**document, "path": str(place)}
    assert document["steps"]["watchdog"]["figures"]["drive_ticks"] == 20
    # Another limit, and all of it begins anew.
    rig_file(tmp_path, NO_LINK.replace('"8 kN"', '"9 kN"'))
    assert rthyb("commission", path, "--yes", "--steps", "trip").code == 0
    assert set(json.loads(place.read_text())["steps"]) == {"trip"}


def test_failed_check_is_told_kept_and_leaves_with_eight(
    rthyb: Rthyb, tmp_path: Path, stepped: None
) -> None:
    path = rig_file(tmp_path, NO_LINK.replace("k_n_per_m = 500000", "k_n_per_m = -500000"))
    answer = rthyb("commission", path, "--yes", "--distance", "0.5 mm")
    assert answer.code == 8
    assert "polarity: FAILED" in answer.out
    assert "correct the fault, then start again" in answer.out
    steps = json.loads((tmp_path / "rig.commissioned.json").read_text())["steps"]
    assert steps["polarity"]["passed"] is False
    assert list(steps) == ["link", "polarity"]


def test_each_motion_is_asked_for(
    rthyb: Rthyb, tmp_path: Path, stepped: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []

    def confirm(question: str, **_: object) -> bool:
        asked.append(question)
        return len(asked) != 2

    monkeypatch.setattr(typer, "confirm", confirm)
    answer = rthyb(
        *("commission", rig_file(tmp_path), "--steps", "link,polarity,trip"),
        *("--distance", "0.5 mm"),
    )
    assert answer.code == 0
    assert len(asked) == 3
    assert "Move by 0.5 mm and back" in asked[1]
    assert "polarity: skipped" in answer.out
    steps = json.loads((tmp_path / "rig.commissioned.json").read_text())["steps"]
    assert set(steps) == {"link", "trip"}


def test_nothing_moves_where_nobody_answers(
    rthyb: Rthyb, tmp_path: Path, stepped: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    answer = rthyb("commission", rig_file(tmp_path))
    assert answer.code == 3
    assert "standard input: ended where an answer was needed" in answer.err
    assert "answer y or n in a terminal, or use --yes" in answer.err
    assert not (tmp_path / "rig.commissioned.json").exists()


def test_step_before_a_question_that_nobody_answers_is_kept(
    rthyb: Rthyb, tmp_path: Path, stepped: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("y\n"))
    answer = rthyb("commission", rig_file(tmp_path))
    assert answer.code == 3
    assert "standard input: ended where an answer was needed" in answer.err
    steps = json.loads((tmp_path / "rig.commissioned.json").read_text())["steps"]
    assert set(steps) == {"link"}


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--steps", "link,luck"), 2, 'found "luck"; the steps are link, polarity, limits'),
        (("--distance", "0"), 2, "at least 0.01 mm"),
        (("--distance", "20 mm"), 5, "limits.command_position_m = 10 mm"),
        (
            ("--set", "limits.command_position_m={ value = 1, enable = false }"),
            3,
            "does not end the motion",
        ),
    ],
)
def test_commissioning_that_cannot_be_done_is_refused(
    rthyb: Rthyb,
    tmp_path: Path,
    stepped: None,
    arguments: tuple[str, ...],
    code: int,
    message: str,
) -> None:
    answer = rthyb("commission", rig_file(tmp_path), "--yes", *arguments)
    assert answer.code == code
    assert message in " ".join(answer.err.split())


# ---- identify -----------------------------------------------------------------------------------


def test_identification_in_real_time_gives_the_rig_file_its_figures(
    rthyb: Rthyb, tmp_path: Path, stepped: None
) -> None:
    path = rig_file(tmp_path, NO_STIFFNESS)
    answer = rthyb(
        *("identify", path, "--realtime", "--amplitude", "0.5 mm", "--max-frequency", "1 Hz"),
        *("--out", tmp_path / "found.toml", "--json"),
    )
    assert answer.code == 0, answer.err
    assert answer.json["link_delay_samples"] == 0.0
    assert "of which the link" in answer.err
    found = config.load_rig(tmp_path / "found.toml")
    assert found.rig.elastic_stiffness_n_per_m == pytest.approx(STIFFNESS_N_PER_M, rel=1e-3)
    assert found.identified is not None
    assert found.identified.delay_s * core.FS_HZ == pytest.approx(12.0, abs=0.05)


def test_limit_in_an_identification_leaves_with_six_and_writes_nothing(
    rthyb: Rthyb, tmp_path: Path, stepped: None
) -> None:
    path = rig_file(tmp_path, NO_LINK.replace('"8 kN"', '"100 N"'))
    answer = rthyb("identify", path, "--realtime", "--max-frequency", "1 Hz")
    assert answer.code == 6
    assert "the sweep ended at 0.5 Hz: tripped: force limit" in answer.err
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("virtual", [False, True])
def test_rig_that_was_never_commissioned_is_not_swept(
    rthyb: Rthyb, tmp_path: Path, virtual: bool
) -> None:
    """Nobody is at its socket: who is not refused comes as far as that."""
    there = f'channel = "{tmp_path / "s"}"' + ("\nvirtual = true" if virtual else "")
    path = rig_file(tmp_path, COLUMN.replace('channel = "/nowhere"', there))
    answer = rthyb("identify", path, "--realtime", "--out", tmp_path / "found.toml")
    said = " ".join(answer.err.split())
    assert answer.code == (3 if virtual else 5), answer.err
    assert ("the socket does not exist" in said) == virtual
    assert ("this rig has not been commissioned" in said) != virtual
    assert (f"rthyb commission {path}" in said) != virtual
    assert not (tmp_path / "found.toml").exists()


def test_commissioning_that_is_interrupted_says_to_machines_what_was_written(
    rthyb: Rthyb, tmp_path: Path, stepped: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise guided_motion.StoppedError("small-motion: stopped by the operator")

    monkeypatch.setattr(guide, "commission", interrupted)
    answer = rthyb("commission", rig_file(tmp_path), "--yes", "--json")
    assert answer.code == 130
    assert json.loads(answer.out)["problems"] == [
        {
            "where": "rthyb commission",
            "message": "small-motion: stopped by the operator; nothing was written",
        }
    ]


# ---- with processes of their own ----------------------------------------------------------------


@pytest.fixture
def runtime() -> Iterator[Path]:
    memory = Path("/dev/shm")
    with TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        yield Path(folder)


class Lab:
    """A rig at a socket, in a process of its own, and commands that reach for it."""

    def __init__(self, folder: Path, runtime: Path) -> None:
        self.folder = folder
        self.env = {"XDG_RUNTIME_DIR": str(runtime), "XDG_STATE_HOME": str(folder / "state")}
        text = COLUMN.replace('"/nowhere"', f'"{folder / "s"}"')
        text = text.replace("per_m = 1\n", f"per_m = {STIFFNESS_N_PER_M}\n")
        rig_file(folder, text + "\n[identified]\nalpha = 12\ndelay_s = 0.0117\n")
        test = config.load_test(config.builtin_test_path(), SHORT | {
            "ground_motion.pga_g": "0.01", "limits": "{ ramp_in_s = 0.25, tare_s = 0.25 }",
        })  # fmt: skip
        (folder / "test.toml").write_text(config.dump(test), encoding="utf-8")

    def drive(self) -> Process:
        made = Process(self.folder, "rig", "rig.toml")
        assert made.line().strip().endswith("1024 Hz")
        return made

    def command(self, *arguments: object) -> Process:
        return Process(self.folder, *arguments, env=self.env)

    def repeated(self, *arguments: object) -> tuple[int, str, str]:
        """Run a command until it ends as it should where this machine does not stall."""
        for _ in range(ATTEMPTS):
            code, out, err = self.command(*arguments).end()
            if code == 0:
                break
        return code, out, err


@pytest.fixture
def lab(tmp_path: Path, runtime: Path) -> Lab:
    return Lab(tmp_path, runtime)


def test_test_is_refused_until_the_rig_is_commissioned(lab: Lab) -> None:
    run = ("run", "test.toml", "--rig", "rig.toml", "--realtime", "--no-report")
    drive = lab.drive()
    try:
        code, _, err = lab.command(*run, "--out", "refused").end()
        assert code == 5, err
        assert "this rig has not been commissioned" in err
        assert "rthyb commission rig.toml" in err
        assert not (lab.folder / "refused").exists()
        code, _, err = lab.repeated(
            *("commission", "rig.toml", "--yes", "--distance", "0.2 mm", "--json"),
        )
        assert code == 0, err
        document = json.loads((lab.folder / "rig.commissioned.json").read_text())
        assert document["steps"]["watchdog"]["figures"]["drive_ticks"] <= 20
        for number in range(1, ATTEMPTS + 1):
            code, _, err = lab.command(*run, "--out", f"run-{number}").end()
            rec = recording.open_run(lab.folder / f"run-{number}")
            if rec.meta["real_time"]["cause"] not in STALLED:
                break
        assert code == 0, err
    finally:
        drive.kill()
    facts = rec.meta["commissioning"]
    assert facts["demanded"] is True
    assert facts["polarity"] == document["steps"]["polarity"]["date"]
    assert facts["limits"] == document["steps"]["limits"]["date"]
    page = report.render(rec)
    assert "Polarity checked" in page
    assert facts["polarity"] in page


def test_ctrl_c_stops_a_jog_and_the_actuator_stays(lab: Lab) -> None:
    def attempt() -> bool:
        drive = lab.drive()
        try:
            jog = lab.command("jog", "rig.toml", "8 mm", "--speed", "1 mm/s", "--json")
            # 15 s of motion; whatever the machine does, it is under way in the middle of it.
            wait_until_it_runs(lab, jog)
            jog.signal(signal.SIGINT)
            code, out, err = jog.end()
        finally:
            drive.kill()
        found = json.loads(out)
        if found["cause"] != "operator":
            return False
        assert code == 0, err
        assert found["end_reason"] == "stopped by the operator"
        assert found["state"] == "IDLE"
        assert 0.0 < found["moved_m"] < 8e-3
        return True

    assert any(attempt() for _ in range(ATTEMPTS))


def wait_until_it_runs(lab: Lab, jog: Process) -> None:
    from rthyb_rt.errors import InputError
    from rthyb_rt.record import ring

    folders = [Path(lab.env["XDG_RUNTIME_DIR"]) / "rthyb", Path("/run/rthyb")]
    end = time.monotonic() + 30.0
    while time.monotonic() < end and jog.process.poll() is None:
        time.sleep(0.01)
        for path in (path for folder in folders if folder.is_dir() for path in ring.find(folder)):
            try:
                with ring.RingReader(path) as reader:
                    if reader.about["pid"] != jog.process.pid:
                        continue
                    rows = reader.read(mapped_ring.CAPACITY).samples
            except InputError:
                continue
            if (abs(rows["x_cmd_m"]) > 0.3e-3).any():
                return
