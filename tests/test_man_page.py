"""`man rthyb` and the Tab key say what the command line takes."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import typer.main

from rthyb_rt.cli import commands

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "docs" / "tools"))

import man_page  # noqa: E402

PROGRAM = Path(sys.executable).with_name("rthyb")


def test_the_manual_page_is_that_of_the_parser() -> None:
    current = man_page.PAGE.read_text(encoding="utf-8") == man_page.page()
    assert current, "the help of a command has changed: run `make man` and commit systemd/rthyb.1"


def test_man_shows_every_command_without_a_complaint() -> None:
    if shutil.which("man") is None or shutil.which("groff") is None:
        pytest.skip("man and groff are not on this machine")
    shown = subprocess.run(
        ["man", "--warnings", "-l", str(man_page.PAGE)],
        env={**os.environ, "MANWIDTH": "100", "LC_ALL": "C.UTF-8"},
        capture_output=True,
        text=True,
        check=True,
    )
    assert shown.stderr == ""
    text = re.sub(".\b", "", shown.stdout)
    for name in typer.main.get_command(commands.app).commands:  # type: ignore[attr-defined]
        assert f"   rthyb {name}" in text


def completed(shell: str, **given: str) -> str:
    env = {**os.environ, "_RTHYB_COMPLETE": f"complete_{shell}", **given}
    ran = subprocess.run([PROGRAM], env=env, capture_output=True, text=True, check=False)
    return ran.stdout


def test_zsh_and_fish_are_told_the_commands_that_begin_so() -> None:
    zsh = completed("zsh", _TYPER_COMPLETE_ARGS="rthyb ctl st")
    assert "_arguments" in zsh or "_describe" in zsh
    fish = completed(
        "fish", _TYPER_COMPLETE_ARGS="rthyb ctl st", _TYPER_COMPLETE_FISH_ACTION="get-args"
    )
    for told in (zsh, fish):
        assert all(word in told for word in ("status", "start", "stop"))
        assert "reload" not in told


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_script_of_a_shell_has_no_mistake(shell: str) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not on this machine")
    script = ROOT / "systemd" / f"rthyb.{shell}-completion"
    subprocess.run([shell, "-n", script], check=True)
