"""Declare rthyb_rt._core to cffi from the marked text of the headers.

``python -m cffi.gen_src exec-python cffi_build.py _core.c`` runs this file and writes the source of
the extension. rthyb.h includes the parts in the order in which they need each other. cffi reads C
declarations only: no preprocessor line may stand between the markers of a part except
``#define NAME <integer>``.
"""

from __future__ import annotations

import re
from pathlib import Path

from cffi import FFI

HEADER = Path(__file__).with_name("rthyb.h")
BEGIN = "/* cffi: begin */"
END = "/* cffi: end */"


def parts() -> list[Path]:
    """Return the headers that rthyb.h includes, in its order."""
    names = re.findall(r'^#include "(rthyb_\w+\.h)"$', HEADER.read_text(encoding="utf-8"), re.M)
    found = [HEADER.with_name(name) for name in names]
    forgotten = set(HEADER.parent.glob("rthyb_*.h")) - set(found)
    if forgotten:
        raise SystemExit(f"{HEADER} includes all parts but {', '.join(p.name for p in forgotten)}")
    return found


def marked_text(header: Path) -> str:
    """Return what stands between the markers, on the line numbers that it has in the header."""
    text = header.read_text(encoding="utf-8")
    if text.count(BEGIN) != 1 or text.count(END) != 1:
        raise SystemExit(f"{header}: needs exactly one '{BEGIN}' and one '{END}'")
    before, rest = text.split(BEGIN)
    marked, _ = rest.split(END)
    return "\n" * before.count("\n") + marked


ffibuilder = FFI()
for part in parts():
    try:
        ffibuilder.cdef(marked_text(part))
    except Exception as error:
        raise SystemExit(f"{part}: {error}") from error
ffibuilder.set_source("rthyb_rt._core", '#include "rthyb.h"')
