"""Write the manual page systemd/rthyb.1 from the command line's own parser: ``make man``."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer.main

from rthyb_rt.cli import commands

PAGE = Path(__file__).resolve().parents[2] / "systemd" / "rthyb.1"


def escaped(text: str) -> str:
    """Return text as groff prints it: no escapes, no requests, ASCII hyphens that can be copied."""
    text = text.replace("\\", "\\e").replace("-", "\\-").replace("'", "\\(aq").replace("`", "\\(ga")
    return re.sub(r"^\.", r"\\&.", text, flags=re.M)


def paragraphs(text: str) -> Iterator[str]:
    """Give the paragraphs of a help text; those behind a backspace keep their lines."""
    for paragraph in re.split(r"\n\s*\n", text.strip()):
        kept = paragraph.lstrip().startswith("\b")
        lines = escaped(paragraph.replace("\b", "").strip("\n")).splitlines()
        if kept:
            head, *rest = [line for line in lines if line.strip()]
            yield ".PP\n" + head.strip() + "\n.PP\n.nf\n" + "\n".join(rest) + "\n.fi"
        else:
            yield ".PP\n" + "\n".join(line.strip() for line in lines)


def record(parameter: Any, context: Any) -> tuple[str, str, str]:
    """Return the names of an option or argument, its value, and its help with the default."""
    left, said = parameter.get_help_record(context)
    if parameter.param_type_name == "argument":
        return "", left.split(" <")[0].strip("[]{}"), said.removesuffix("[required]").rstrip()
    names = ", ".join(parameter.opts)
    return names, left.removeprefix(names).strip(), said


def usage(names: str, value: str) -> str:
    """Return how an option or argument is written: names in bold, value in italics."""
    bold = ", ".join(f"\\fB{escaped(name)}\\fR" for name in names.split(", ") if name)
    return f"{bold} \\fI{escaped(value)}\\fR".strip() if value else bold


def synopsis(path: str, command: Any, context: Any) -> str:
    """Return the line of a command with all its parameters."""
    words = [f"\\fB{escaped(path)}\\fR"]
    for parameter in command.params:
        names, value, _ = record(parameter, context)
        word = usage(names.split(", ")[-1], value)
        many = parameter.nargs == -1 or getattr(parameter, "multiple", False)
        repeated = "..." if many and not value.endswith("...") else ""
        words.append(word + repeated if parameter.required else f"[{word}]{repeated}")
    return ".PP\n" + " ".join(words)


def section(path: str, command: Any) -> Iterator[str]:
    """Give the lines of one command, and of the commands below it."""
    yield f'.SS "{escaped(path)}"'
    if hasattr(command, "commands"):
        yield from paragraphs(command.help or "")
        for name, below in command.commands.items():
            yield from section(f"{path} {name}", below)
        return
    context = command.make_context(path, [], resilient_parsing=True)
    yield synopsis(path, command, context)
    yield from paragraphs(command.help or "")
    for parameter in command.params:
        names, value, said = record(parameter, context)
        yield f".TP\n{usage(names, value)}\n{escaped(said)}"


def page() -> str:
    """Return the manual page."""
    app = typer.main.get_command(commands.app)
    about, *rest = paragraphs(app.help or "")
    title, *more = about.splitlines()[1:]
    name = " ".join([title, *more]).rstrip(".")
    lines = [
        '.\\" Written by docs/tools/man_page.py from the parser of the command line: make man.',
        '.TH RTHYB 1 "" rthyb_rt "Real\\-time hybrid testing"',
        ".SH NAME",
        f"rthyb \\- {name[0].lower()}{name[1:]}",
        ".SH SYNOPSIS",
        "\\fBrthyb\\fR \\fICOMMAND\\fR [\\fIARGUMENTS\\fR]...",
        ".SH DESCRIPTION",
        *rest,
        ".SH COMMANDS",
    ]
    for command, below in app.commands.items():  # type: ignore[attr-defined]
        lines += section(f"rthyb {command}", below)
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE.name)
