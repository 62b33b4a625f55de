"""Declare rthyb_rt._core to cffi from the marked part of rthyb.h.

``python -m cffi.gen_src exec-python cffi_build.py _core.c`` runs this file and writes the source of
the extension. cffi reads C declarations only: no preprocessor line may stand between the markers
except ``#define NAME <integer>``.
"""

from __future__ import annotations

from pathlib import Path

from cffi import FFI

HEADER = Path(__file__).with_name("rthyb.h")
BEGIN = "/* cffi: begin */"
END = "/* cffi: end */"


def marked_text(header: str) -> str:
    """Return what stands between the markers, on the line numbers that it has in the header."""
    if header.count(BEGIN) != 1 or header.count(END) != 1:
        raise SystemExit(f"{HEADER}: needs exactly one '{BEGIN}' and one '{END}'")
    before, rest = header.split(BEGIN)
    marked, _ = rest.split(END)
    return "\n" * before.count("\n") + marked


ffibuilder = FFI()
ffibuilder.cdef(marked_text(HEADER.read_text(encoding="utf-8")))
ffibuilder.set_source("rthyb_rt._core", '#include "rthyb.h"')
