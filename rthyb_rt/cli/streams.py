"""stdout and stderr in any condition: closed, full, without a reader, or without Greek letters."""

from __future__ import annotations

import codecs
import contextlib
import io
import os
import re
import sys
from collections.abc import Iterator
from typing import IO, Any

ERRORS = "rthyb-ascii"

# One character for one where possible, so that columns stay aligned.
_SIGNS = {
    "½": "1/2", "µ": "u", "μ": "u", "·": "*", "⋅": "*", "×": "x", "–": "-", "−": "-", "…": "...",
    "“": '"', "”": '"', "≤": "<=", "≥": ">=", "∞": "inf", "∫": "integral of", "✓": "+", "✗": "x",
    "Δ": "Delta", "Σ": "sum of", "α": "alpha", "β": "beta", "γ": "gamma", "ζ": "zeta", "φ": "phi",
    "ω": "omega", "π": "pi", "∮": "integral of", "₀": "0", "\u00a0": " ",
}  # fmt: skip
_RAISED = "⁰¹²³⁴⁵⁶⁷⁸⁹⁻"
_RAISED_RUN = re.compile(f"[{_RAISED}]+")
_LOWERED = str.maketrans(_RAISED, "0123456789-")


def in_ascii(text: str) -> str:
    """Return a text with this program's special characters replaced by ASCII."""
    text = _RAISED_RUN.sub(lambda run: "^" + run[0].translate(_LOWERED), text)
    return "".join(_SIGNS.get(sign, sign) for sign in text)


def shown(stream: IO[str], text: str) -> str:
    """Return a text as a stream can represent it."""
    encoding = getattr(stream, "encoding", None) or "utf-8"
    return text.encode(encoding, ERRORS).decode(encoding)


def _replaced(error: UnicodeError) -> tuple[str | bytes, int]:
    if not isinstance(error, UnicodeEncodeError):
        raise error
    part = in_ascii(error.object[error.start : error.end])
    return part.encode("ascii", "backslashreplace").decode("ascii"), error.end


codecs.register_error(ERRORS, _replaced)


class Outlet(io.FileIO):
    """Destination of a stream's bytes; after a failed write the rest is dropped.

    The remaining work of a command, such as its report, must not fail for lack of a reader.

    Attributes:
        fault: why writing failed, if it did.
    """

    fault: OSError | None = None

    def write(self, data: Any, /) -> int:
        """Write bytes, or drop them."""
        if self.fault is None:
            try:
                return super().write(data)
            except OSError as error:
                self.fault = error
        return len(data)


def is_unread(stream: IO[str]) -> bool:
    """Return whether a stream's reader has gone or its disk is full, so that output is lost."""
    raw = getattr(getattr(stream, "buffer", None), "raw", None)
    return isinstance(raw, Outlet) and raw.fault is not None


@contextlib.contextmanager
def settled() -> Iterator[Outlet | None]:
    """Make printing safe within the block; yield the outlet of stdout, if there is one."""
    before = sys.stdout, sys.stderr
    outlets = {name: _settle(name) for name in ("stdout", "stderr")}
    try:
        yield outlets["stdout"]
    finally:
        for name, stream in zip(outlets, before, strict=True):
            if outlets[name] is not None:
                getattr(sys, name).flush()
                setattr(sys, name, stream)


def _settle(name: str) -> Outlet | None:
    stream = getattr(sys, name)
    if stream is None:
        setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115
        return None
    if not hasattr(stream, "reconfigure"):
        return None
    stream.reconfigure(errors=ERRORS)
    # A stream installed by someone else, such as a test, is left alone.
    if stream is not getattr(sys, f"__{name}__"):
        return None
    stream.flush()
    outlet = Outlet(stream.fileno(), "wb", closefd=False)
    settled = io.TextIOWrapper(
        io.BufferedWriter(outlet),
        encoding=stream.encoding,
        errors=ERRORS,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )
    setattr(sys, name, settled)
    return outlet
