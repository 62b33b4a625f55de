"""The command line when somebody pulls the plug: signals, full disks, pipes, narrow terminals."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest
from command_line import Answer, Rthyb

from rthyb_rt import cli, config, ground_motion
from rthyb_rt.cli import folders, streams
from rthyb_rt.errors import InputError
from rthyb_rt.record import recording, ring

SHORT = ("run", "--no-report", "--set", "test.duration_s=3")
ROOM_OF = {"recording": "record", "summary": "analysis", "virtual_time": "lab"}
PROGRAM = Path(sys.executable).with_name("rthyb")


def python(code: str, *arguments: str, folder: Path, **environment: str) -> Answer:
    """Run the command line in a process of its own, after some lines of Python."""
    done = subprocess.run(
        [sys.executable, "-c", f"{code}\nimport sys\nfrom rthyb_rt import cli\n"
         "sys.exit(cli.main(sys.argv[1:]))", *arguments],
        cwd=folder, env={**os.environ, "FORCE_COLOR": "", **environment}, capture_output=True,
        text=True, encoding="utf-8", timeout=60, check=False,
    )  # fmt: skip
    assert "Traceback" not in done.stderr
    return Answer(done.returncode, done.stdout, done.stderr)


def signalled(module: str, name: str, signal: str) -> str:
    """Return lines that send a signal at the beginning of a function."""
    room = ROOM_OF[module]
    return (
        f"import os, signal\nfrom rthyb_rt.{room} import {module}\nreal = {module}.{name}\n"
        "def changed(*arguments, **options):\n"
        f"    os.kill(os.getpid(), signal.{signal})\n"
        "    return real(*arguments, **options)\n"
        f"{module}.{name} = changed\n"
    )


# ---- signals ------------------------------------------------------------------------------------


@pytest.mark.long
def test_ctrl_c_while_the_recording_is_written_keeps_the_recording(tmp_path: Path) -> None:
    answer = python(signalled("recording", "write", "SIGINT"), *SHORT, folder=tmp_path)
    assert answer.code == 130
    (folder,) = (tmp_path / "runs").iterdir()
    assert recording.open_run(folder).meta["end_reason"] == "completed"
    (line,) = answer.err.splitlines()
    assert line.startswith("rthyb: interrupted; written: ")
    assert f"runs/{folder.name}/recording.h5" in line
    assert "report.html" not in line


@pytest.mark.long
@pytest.mark.parametrize(
    ("signal", "code", "words"),
    [
        ("SIGINT", 130, "interrupted"),
        ("SIGTERM", 143, "ended by SIGTERM"),
        ("SIGHUP", 129, "ended by SIGHUP"),
    ],
)
def test_test_that_is_stopped_leaves_no_half_folder(
    tmp_path: Path, signal: str, code: int, words: str
) -> None:
    answer = python(signalled("virtual_time", "run", signal), *SHORT, folder=tmp_path)
    assert answer.code == code
    assert answer.err == f"rthyb: {words}; nothing was written\n"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_test_under_nohup_survives_the_closed_terminal(tmp_path: Path) -> None:
    ignore = "import signal\nsignal.signal(signal.SIGHUP, signal.SIG_IGN)\n"
    code = ignore + signalled("virtual_time", "run", "SIGHUP")
    assert python(code, *SHORT, folder=tmp_path).code == 0


@pytest.mark.long
def test_ctrl_c_that_a_library_swallows_is_obeyed_all_the_same(tmp_path: Path) -> None:
    swallow = (
        "import os, signal, weakref\nfrom rthyb_rt.lab import experiment\n"
        "real = experiment.prepare\n"
        "class Thing: pass\n"
        "def callback(_):\n    os.kill(os.getpid(), signal.SIGINT)\n    [None for _ in range(9)]\n"
        "def changed(*arguments, **options):\n"
        "    thing = Thing()\n    watch = weakref.ref(thing, callback)\n"
        "    del thing\n    return real(*arguments, **options)\n"
        "experiment.prepare = changed\n"
    )
    answer = python(swallow, *SHORT, folder=tmp_path)
    assert answer.code == 130
    assert answer.err.startswith("rthyb: interrupted; written: runs/")
    assert len(answer.err.splitlines()) == 1


def _stage(parent: Path, pid: int) -> Path:
    folder = parent / f".plate-20260301T101500Z.{pid}.part"
    folder.mkdir(parents=True)
    (folder / "recording.h5").write_text("half")
    return folder


def test_folder_of_a_killed_run_is_swept_by_the_next(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    killed, lives = _stage(tmp_path, ended.pid), _stage(tmp_path, os.getppid())
    other = tmp_path / ".holiday.part"
    other.mkdir()
    with folders.staged(tmp_path / "next"):
        assert not killed.exists()
    assert lives.exists()
    assert other.exists()


def test_folder_of_a_run_in_another_container_is_not_swept(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as ended:
        pass
    folder = _stage(tmp_path, ended.pid)
    descriptor = os.open(folder, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    with folders.staged(tmp_path / "next"):
        assert folder.exists()
    os.close(descriptor)


# ---- files that are none ------------------------------------------------------------------------


@pytest.mark.parametrize("load", [config.load_test, config.load_rig])
def test_device_pipe_or_huge_file_is_no_configuration(load: object, tmp_path: Path) -> None:
    assert callable(load)
    os.mkfifo(tmp_path / "pipe.toml")
    with (tmp_path / "huge.toml").open("wb") as file:
        file.truncate(10**7 + 1)
    for path, words in (
        ("/dev/zero", "/dev/zero: cannot be read .not a regular file"),
        (tmp_path / "pipe.toml", "pipe.toml: cannot be read .not a regular file"),
        (tmp_path / "huge.toml", "huge.toml: is larger than 10 MB"),
    ):
        with pytest.raises(InputError, match=words):
            load(path)


@pytest.mark.parametrize(
    "command",
    [("run",), ("check",), ("identify",), ("run", "--rig"), ("replay",)],
)
def test_device_in_place_of_a_file_is_refused(rthyb: Rthyb, command: tuple[str, ...]) -> None:
    answer = rthyb(*command, "/dev/zero")
    assert answer.code == 3
    assert re.fullmatch(r"rthyb: /dev/zero: .*no.* regular file.*\n", answer.err)


def test_at2_file_without_its_npts_line_is_told_so(tmp_path: Path) -> None:
    rows = "  .1000E-02  .2000E-02 -.1000E-02  .3000E-02  .1000E-02\n" * 40
    head = "PEER STRONG MOTION DATABASE RECORD\nCHI-CHI, TCU068\nACCELERATION IN UNITS OF G\n"
    (tmp_path / "a.txt").write_text(head + rows)
    (tmp_path / "b.AT2").write_text(rows)
    for name in ("a.txt", "b.AT2"):
        with pytest.raises(InputError, match="no line with NPTS and DT") as refused:
            ground_motion.read(tmp_path / name)
        assert "columns" not in str(refused.value)


def test_two_columns_in_a_file_named_at2_are_read(tmp_path: Path) -> None:
    rows = "".join(f"{0.01 * n:.2f} {0.1 * (-1) ** n}\n" for n in range(100))
    (tmp_path / "a.AT2").write_text("# time_s acc_g\n" + rows)
    assert ground_motion.read(tmp_path / "a.AT2").dt_s == pytest.approx(0.01)


# ---- the core that is rebuilt on import ---------------------------------------------------------

NO_CORE = """
import subprocess, sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "rthyb_rt._core":
            raise {fault}
sys.meta_path.insert(0, Finder())
"""


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (
            "PermissionError(13, 'Permission denied', '/lab/build/editable_rebuild.lock')",
            "no write access to its sources: run as their owner, or install the wheel",
        ),
        (
            "subprocess.CalledProcessError(1, ['cmake', '--build', '.'])",
            "the C core failed to build, see above",
        ),
    ],
)
@pytest.mark.parametrize("command", [("run",), ("--version",)])
def test_core_that_cannot_be_rebuilt_is_explained(
    tmp_path: Path, fault: str, words: str, command: tuple[str, ...]
) -> None:
    answer = python(NO_CORE.format(fault=fault), *command, folder=tmp_path)
    assert answer.code == 1
    (line,) = answer.err.splitlines()
    assert words in line
    assert "report" not in line


# ---- options ------------------------------------------------------------------------------------


def test_plain_numbers_of_identify_are_millimetres_and_hertz(rthyb: Rthyb) -> None:
    plain = rthyb(
        "identify", "delay-10-elastic", "--amplitude", "1.5", "--max-frequency", "2", "--json"
    )
    tones = json.loads(plain.out)["tones"]
    assert [tone["frequency_hz"] for tone in tones] == [0.5, 1.0, 1.5, 2.0]
    assert tones[0]["amplitude_m"] == pytest.approx(1.5e-3, rel=1e-3)


def test_word_that_is_none_of_a_choice_is_answered_with_the_choice(rthyb: Rthyb) -> None:
    for command in (("reproduce", "3"), ("schema", "rigg")):
        answer = rthyb(*command)
        assert answer.code == 2
        assert f"'{command[1]}' is not one of" in answer.err
        assert "Value error" not in answer.err


def test_full_and_short_csv_do_not_replace_each_other(rthyb: Rthyb, tmp_path: Path) -> None:
    assert rthyb(*SHORT, "--out", "x").code == 0
    assert rthyb("export", "x", "--csv").out == "x/recording.csv\n"
    assert rthyb("export", "x", "--csv", "--full").out == "x/recording-full.csv\n"
    assert rthyb("export", "x/recording.h5", "--csv", "--full").out == "x/recording-full.csv\n"
    short = (tmp_path / "x" / "recording.csv").read_text().splitlines()[0]
    assert short == "t,ag,x_num,x_cmd,x_meas,f_meas"


@pytest.mark.parametrize(
    ("setting", "example"),
    [
        ("rig.actuator.kind=pure-delay", "rig.actuator={ kind = \"pure-delay\", delay_samples ="),
        ("rig.specimen.0.element=gap", "rig.specimen.0={ element = \"gap\", k_n_per_m ="),
    ],
)  # fmt: skip
def test_new_kind_of_actuator_gets_one_hint_to_set_the_whole_table(
    rthyb: Rthyb, setting: str, example: str
) -> None:
    answer = rthyb(*SHORT, "--set", setting)
    assert answer.code == 3
    (line,) = answer.err.splitlines()
    assert f"--set '{example}" in line


def test_hinted_table_with_its_values_runs(rthyb: Rthyb) -> None:
    hint = rthyb(*SHORT, "--set", "rig.actuator.kind=pure-delay").err
    found = re.search(r"--set '(.*?)'", hint)
    assert found
    assert rthyb(*SHORT, "--set", found[1].replace("...", "3")).code == 0


def test_help_cuts_no_summary_and_has_the_code_of_an_interrupt(rthyb: Rthyb) -> None:
    text = rthyb("--help").out
    assert not [line for line in text.splitlines() if re.search(r"[a-z]\.\.\.$", line)]
    assert " 130  interrupted" in text


@pytest.mark.parametrize(
    ("command", "code", "words"),
    [
        (("run", "nowhere.toml"), 3, "no such file"),
        (("check", "nowhere.toml"), 3, "no such file"),
        (("replay", "nowhere"), 3, "does not exist"),
        (("identify", "nowhere.toml"), 3, "comes with the program"),
        (("reproduce", "4.2", "--record", "nowhere.txt"), 3, "no such file"),
        (("reproduce", "3"), 2, "is not one of"),
        (("identify", "delay-10-elastic", "--amplitude", "0"), 2, "0.01 mm to 1 m"),
    ],
)
def test_refusal_is_a_json_document_for_programs(
    rthyb: Rthyb, command: tuple[str, ...], code: int, words: str
) -> None:
    plain = rthyb(*command)
    answer = rthyb(*command, "--json")
    assert answer.code == plain.code == code
    assert plain.out == ""
    document = json.loads(answer.out)
    assert document["ok"] is False
    assert words in document["problems"][0]["message"]
    assert set(document["problems"][0]) == {"where", "message"}


# ---- streams ------------------------------------------------------------------------------------


@pytest.mark.long
def test_reader_of_the_first_line_does_not_cost_the_report(tmp_path: Path) -> None:
    done = subprocess.run(
        ["bash", "-c", f'"{PROGRAM}" run --set test.duration_s=3 --out x | head -c 1;'
         "exit ${PIPESTATUS[0]}"],
        cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "x" / "report.html").exists()


@pytest.mark.long
def test_gone_reader_is_no_error_and_the_command_goes_on(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [str(PROGRAM), *SHORT, "--set", "limits.force_n=1000", "--out", "x"],
        cwd=tmp_path, stdout=writer, stderr=subprocess.PIPE, timeout=60, check=False,
    )  # fmt: skip
    os.close(writer)
    # Code 6, the limit, is the command's own.
    assert (done.returncode, done.stderr) == (6, b"")


@pytest.mark.long
def test_full_device_behind_stdout_is_told_with_the_place_of_the_recording(tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [str(PROGRAM), "run", "--set", "test.duration_s=3", "--out", "x"],
            cwd=tmp_path, stdout=full, stderr=subprocess.PIPE, text=True, timeout=60, check=False,
        )  # fmt: skip
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith("rthyb: stdout cannot be written (No space left on device); written: ")
    assert "x/recording.h5" in line
    assert "x/report.html" in line


@pytest.mark.long
def test_home_that_cannot_be_written_is_no_news(tmp_path: Path) -> None:
    home = {"HOME": "/dev/null/nobody", "XDG_CONFIG_HOME": "", "XDG_CACHE_HOME": ""}
    answer = python("", "run", "--set", "test.duration_s=3", "--out", "x", folder=tmp_path, **home)
    assert (answer.code, answer.err) == (0, "")
    assert (tmp_path / "x" / "report.html").exists()


@pytest.mark.long
@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_terminal_without_greek_letters_reads_ascii_in_their_place(
    tmp_path: Path, encoding: str
) -> None:
    done = subprocess.run(
        [str(PROGRAM), "check", str(config.builtin_test_path().with_name("section4.2.toml"))],
        cwd=tmp_path, env={**os.environ, "PYTHONIOENCODING": encoding}, capture_output=True,
        timeout=60, check=False,
    )  # fmt: skip
    text = done.stdout.decode(encoding)
    assert "\\" not in text
    assert "|C(-1)|" in text
    squared = "^2" if encoding == "ascii" else "²"
    assert f"gamma alpha phi{squared} / (1 + phi{squared})" in text


@pytest.mark.long
def test_columns_stay_columns_without_greek_letters(tmp_path: Path) -> None:
    answer = python(
        "", "identify", "delay-10-elastic", "--max-frequency", "2", folder=tmp_path,
        PYTHONIOENCODING="ascii",
    )  # fmt: skip
    rows = answer.out[answer.out.index("alpha ") :].splitlines()[:9]
    assert "samples^2" in rows[2]
    for gap in (r"  +(?=\S)", r"  +\S.*?  +(?=\S)"):
        assert len({match.end() for row in rows if (match := re.search(gap, row))}) == 1


def test_every_sign_of_the_program_has_one_in_ascii() -> None:
    package = Path(cli.__file__).parents[1]
    sources = [
        *(package / "cli").glob("*.py"), *(package / "studies").glob("*.py"),
        package / "analysis" / "summary.py", package / "rig" / "identification.py",
        package / "lab" / "punctuality.py",
    ]  # fmt: skip
    left = {
        sign
        for source in sources
        for sign in streams.in_ascii(source.read_text(encoding="utf-8"))
        if not sign.isascii()
    }
    assert left <= {"\u00ef"}


@pytest.mark.long
def test_json_is_the_same_document_on_a_stream_without_greek_letters(tmp_path: Path) -> None:
    arguments = ("reproduce", "2.1", "--json", "--out")
    plain = python("", *arguments, "a", folder=tmp_path, PYTHONIOENCODING="ascii")
    rich = python("", *arguments, "b", folder=tmp_path)
    assert plain.out.isascii()
    assert json.loads(plain.out)["rows"] == json.loads(rich.out)["rows"]


# ---- narrow terminals ---------------------------------------------------------------------------


def on_a_terminal(columns: int, *arguments: str, folder: Path) -> str:
    """Return what a command writes to a terminal of so many columns."""
    outer, inner = pty.openpty()
    fcntl.ioctl(inner, termios.TIOCSWINSZ, struct.pack("HHHH", 30, columns, 0, 0))
    env = {k: v for k, v in os.environ.items() if k not in ("COLUMNS", "FORCE_COLOR")}
    with subprocess.Popen(
        [str(PROGRAM), *arguments], cwd=folder, stdout=inner, stderr=inner,
        env={**env, "TERM": "xterm", "NO_COLOR": "1"},
    ):  # fmt: skip
        os.close(inner)
        text = b""
        try:
            while block := os.read(outer, 65536):
                text += block
        except OSError:
            # A terminal whose other side has closed reads as an error.
            pass
    os.close(outer)
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text.decode()).replace("\r\n", "\n")


@pytest.mark.long
@pytest.mark.parametrize("columns", [40, 60, 80])
def test_progress_stays_on_one_line(tmp_path: Path, columns: int) -> None:
    shown = on_a_terminal(columns, *SHORT, folder=tmp_path).split("section5")[0]
    states = [state for state in re.split(r"[\r\n]", shown) if state.strip()]
    assert states
    for state in states:
        assert state.startswith("Testing")
        assert len(state) <= columns
        assert re.search(r"\d of 3 s", state)
        assert re.search(r"(\d|--):\S\S$", state.rstrip())


@pytest.fixture(scope="module")
def wide(tmp_path_factory: pytest.TempPathFactory) -> str:
    """What a run says where there is room."""
    return on_a_terminal(200, *SHORT, "--out", "a", folder=tmp_path_factory.mktemp("wide"))


@pytest.mark.long
@pytest.mark.parametrize("columns", [40, 60, 80])
def test_result_on_a_narrow_terminal_breaks_no_word(
    tmp_path: Path, columns: int, wide: str
) -> None:
    narrow = on_a_terminal(columns, *SHORT, "--out", "b", folder=tmp_path)
    table = narrow.split("\n\n")[1]
    assert max(len(line) for line in table.splitlines()) <= columns
    assert set(table.split()) <= set(wide.split())
    assert "Tracking, largest difference" in table


@pytest.mark.long
def test_table_of_many_columns_on_a_narrow_terminal_is_told_row_by_row(tmp_path: Path) -> None:
    text = on_a_terminal(
        40, "identify", "delay-10-elastic", "--max-frequency", "1", folder=tmp_path
    )
    assert "frequency, Hz: 0.5\n  amplitude, mm: 2.00\n  gain: " in text
    assert "  delay, samples: 10.00\n" in text


def test_closed_stdout_is_left_as_it_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    before = sys.stdout, sys.stderr
    assert cli.main(["schema", "rig"]) == 0
    assert (sys.stdout, sys.stderr) == before


# ---- an interrupt for programs ------------------------------------------------------------------


def problems(answer: Answer) -> list[dict[str, str]]:
    document = json.loads(answer.out)
    assert document["schema"] == "rthyb-problems/1"
    assert document["ok"] is False
    found: list[dict[str, str]] = document["problems"]
    return found


@pytest.mark.long
@pytest.mark.parametrize(
    ("module", "name", "signal", "code", "words"),
    [
        ("virtual_time", "run", "SIGINT", 130, "interrupted; nothing was written"),
        ("virtual_time", "run", "SIGTERM", 143, "ended by SIGTERM; nothing was written"),
        ("recording", "write", "SIGINT", 130, "interrupted; written: runs/"),
    ],
)
def test_interrupt_is_a_json_document_that_says_what_was_interrupted(
    tmp_path: Path, module: str, name: str, signal: str, code: int, words: str
) -> None:
    answer = python(signalled(module, name, signal), *SHORT, "--json", folder=tmp_path)
    assert answer.code == code
    (problem,) = problems(answer)
    assert problem["where"] == "rthyb run"
    assert problem["message"].startswith(words)


@pytest.mark.long
def test_interrupt_behind_the_result_adds_no_second_document(tmp_path: Path) -> None:
    late = (
        "import os, signal\nfrom rthyb_rt.cli import terminal\nreal = terminal.print_json\n"
        "def changed(document):\n    real(document)\n    os.kill(os.getpid(), signal.SIGINT)\n"
        "terminal.print_json = changed\n"
    )
    answer = python(late, *SHORT, "--json", folder=tmp_path)
    assert answer.code == 130
    assert json.loads(answer.out)["schema"] == "rthyb-run/1"


AT_IMPORT = """
import os, signal, sys
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "{module}":
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
"""


@pytest.mark.parametrize(
    "module",
    ["rthyb_rt.cli.program", "rthyb_rt.cli.streams", "rthyb_rt.errors", "typer", "numpy",
     "rthyb_rt._core"],
)  # fmt: skip
def test_ctrl_c_in_the_first_moments_is_answered_in_a_word(tmp_path: Path, module: str) -> None:
    answer = python(AT_IMPORT.format(module=module), *SHORT, "--json", folder=tmp_path)
    assert answer.code == 130
    assert answer.err == "rthyb: interrupted; nothing was written\n"
    assert problems(answer) == [
        {"where": "rthyb run", "message": "interrupted; nothing was written"}
    ]
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_imported_before_a_ctrl_c_is_looked_after(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c",
         "import sys\nbefore = set(sys.modules)\nimport rthyb_rt\nmiddle = set(sys.modules)\n"
         "from rthyb_rt import cli\nprint(*sorted(set(sys.modules) - middle))"],
        cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    assert done.stdout.split() == ["rthyb_rt.cli"]


LIVE = (
    *("run", "--realtime", "--clock", "stepped", "--no-report"),
    *("--set", "test.duration_s=1", "--set", "ground_motion.start_s=1.5"),
    *("--set", "limits.ramp_in_s=0.25", "--set", "limits.tare_s=0.125"),
)
THRICE = """
import os, signal
from rthyb_rt.{room} import {module}
real = {module}.{name}
def changed(*arguments, **options):
    if not str(arguments[0]).endswith(".session.h5"):
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGINT)
    return real(*arguments, **options)
{module}.{name} = changed
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("module", "name", "code"),
    [("recording", "write", 0), ("summary", "summarize", 130)],
)
def test_impatient_ctrl_c_costs_no_recording_of_a_test_in_real_time(
    tmp_path: Path, module: str, name: str, code: int
) -> None:
    """While it is written, a signal waits; behind that, the file has its place already."""
    answer = python(
        THRICE.format(room=ROOM_OF[module], module=module, name=name), *LIVE, "--out", "x",
        folder=tmp_path, XDG_RUNTIME_DIR=str(tmp_path / "rings"),
    )  # fmt: skip
    assert answer.code == code, answer.err
    assert recording.open_run(tmp_path / "x").meta["end_reason"] == "completed"
    left = [path for folder in ring.folders() for path in ring.find(folder)]
    assert [path for path in left if str(path) in answer.err] == []
    if code:
        assert "interrupted; written: x/recording.h5" in answer.err


@pytest.mark.long
def test_recording_that_finds_no_disk_leaves_its_ring_and_the_line_to_type(tmp_path: Path) -> None:
    full = (
        "import errno\nfrom rthyb_rt.record import recording\nreal = recording.write\n"
        "def changed(path, rec):\n"
        "    if str(path).endswith('.session.h5'):\n        return real(path, rec)\n"
        "    raise OSError(errno.ENOSPC, 'No space left on device', str(path))\n"
        "recording.write = changed\n"
    )
    answer = python(
        full, *LIVE, "--out", "x", "--json", folder=tmp_path,
        XDG_RUNTIME_DIR=str(tmp_path / "rings"),
    )  # fmt: skip
    assert answer.code == 1
    line = re.search(r"rthyb recover (\S+)$", answer.err.strip())
    assert line
    kept = Path(line[1])
    try:
        (problem,) = problems(answer)
        assert problem["where"].endswith("recording.h5") or problem["where"] == "."
        assert "No space left on device" in problem["message"]
        assert python("", "recover", str(kept), "--out", "y", folder=tmp_path).code == 0
        assert recording.open_run(tmp_path / "y").samples.size > 1000
    finally:
        for path in (kept, ring.session_path(kept)):
            path.unlink(missing_ok=True)


# ---- where a disk refused -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "command",
    [
        ("run", "--set", "test.duration_s=1", "--out", "file/x"),
        ("identify", "delay-10-elastic", "--max-frequency", "1", "--out", "file/x.toml"),
        ("rig", "--pty", "--seconds", "0.1", "--log", "file/x.npy"),
    ],
)
def test_disk_error_says_where_for_programs_too(
    rthyb: Rthyb, tmp_path: Path, command: tuple[str, ...]
) -> None:
    (tmp_path / "file").write_text("no folder")
    answer = rthyb(*command, "--json")
    assert answer.code == 1
    (problem,) = problems(answer)
    assert problem["where"] in ("file", command[-1])
    assert answer.err.splitlines()[-1] == f"rthyb: {problem['where']}: {problem['message']}"


def test_virtual_rig_leaves_a_file_alone_that_is_no_socket(rthyb: Rthyb, tmp_path: Path) -> None:
    path = tmp_path / "test.toml"
    path.write_text("precious")
    answer = rthyb("rig", "--socket", path, "--seconds", "0.1", "--json")
    assert answer.code == 3
    (problem,) = problems(answer)
    assert problem["where"] == str(path)
    assert problem["message"].startswith("already exists and is not a socket; choose another path")
    assert path.read_text() == "precious"


def test_disk_error_of_the_system_itself_has_its_path(
    rthyb: Rthyb, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", "/lab/record.AT2")

    monkeypatch.setattr("rthyb_rt.lab.experiment.prepare", refuse)
    answer = rthyb("check", config.builtin_test_path(), "--json")
    assert answer.code == 1
    assert problems(answer) == [{"where": "/lab/record.AT2", "message": "Permission denied"}]


@pytest.mark.parametrize(
    ("key", "table", "begins"),
    [
        ("rig.actuator", '{ kind = "pure-delay", delay_samples = -3 }', "delay_samples: found -3"),
        ("controller", '{ type = "paper", w1 = -3 }', "w1: w1 = -3"),
        ("limits", "{ force_n = { value = -2 } }", "force_n.value: found -2"),
        ("limits.force_n", '{ value = 2, acton = "trip" }', "acton: unknown key (did you mean"),
    ],
)
def test_fault_in_a_table_given_with_set_is_at_that_set(
    rthyb: Rthyb, key: str, table: str, begins: str
) -> None:
    answer = rthyb("check", config.builtin_test_path(), "--set", f"{key}={table}", "--json")
    assert answer.code == 3
    (problem,) = problems(answer)
    assert problem["where"] == f"--set {key}"
    assert problem["message"].startswith(begins)


def test_key_that_a_set_makes_necessary_is_named(rthyb: Rthyb) -> None:
    answer = rthyb(
        "check", config.builtin_test_path(), "--set", "limits.energy_error_j.action=hold", "--json"
    )
    (problem,) = problems(answer)
    assert problem["where"] == "--set limits.energy_error_j.action"
    assert problem["message"].startswith("limits.energy_error_j.value: missing; the limit must be")


def test_value_set_behind_its_table_is_blamed_itself(rthyb: Rthyb) -> None:
    answer = rthyb(
        *("check", config.builtin_test_path(), "--json"),
        *("--set", 'controller={ type = "paper" }', "--set", "controller.alpha0=-1"),
    )
    assert [problem["where"] for problem in problems(answer)] == ["--set controller.alpha0"]


# ---- words on the command line ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "line"),
    [
        (("jog",), "Error: Missing argument 'RIG'."),
        (("commission",), "Error: Missing argument 'RIG'."),
        (
            ("jog", "rig.toml", "2", "mm"),
            "Error: Got unexpected extra argument(s) (mm); write a value and its unit as one "
            'argument: "2 mm"',
        ),
        (("recover", "a", "b"), "Error: Got unexpected extra argument(s) (b)"),
        (("run", "--relatime"), "Error: No such option: --relatime (Possible options: --realtime)"),
        (
            ("jitter", "--rate", "10"),
            "Error: Invalid value for '--rate': found 10; must be at least 256",
        ),
        (
            ("sweep", "--over", "seed=1,2", "--jobs", "two"),
            "Error: Invalid value for '--jobs': found two; must be a whole number",
        ),
    ],
)
def test_command_line_that_is_not_understood_is_answered_once(
    rthyb: Rthyb, command: tuple[str, ...], line: str
) -> None:
    answer = rthyb(*command)
    assert answer.code == 2
    assert answer.err.splitlines()[-1] == line
