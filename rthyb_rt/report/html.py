"""Common parts of this program's pages: templates, style, figures side by side."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from rthyb_rt.config.fields import with_extension
from rthyb_rt.errors import InputError
from rthyb_rt.record.recording import replacing

if TYPE_CHECKING:
    import jinja2

    from rthyb_rt.report.drawing import Plate

_HERE = Path(__file__).parent


PAGE_NAMES: Final = (".html", ".htm")


def page_file(path: str | Path) -> Path:
    """Return the path of a page to write, whose file name says that it is HTML.

    Raises:
        InputError: it has another extension, with which no program would open the page.
    """
    return with_extension(
        Path(path),
        PAGE_NAMES,
        "a page is HTML, and its file name must end in",
        "; for a PDF, print the page from a browser",
    )


def write_page(path: str | Path, render: Callable[[], str]) -> None:
    """Write a page as one file, atomically.

    Args:
        path: file to write.
        render: returns the page; not called if the path is refused.

    Raises:
        InputError: the file name does not end in .html or .htm.
        RthybError: the file cannot be written.
    """
    target = page_file(path)
    html = render()
    with replacing(target) as temporary:
        temporary.write_text(html, encoding="utf-8")


@contextmanager
def extra_needed(what: str) -> Iterator[None]:
    """Explain how to install a package of the extra ``report`` that is missing in the block.

    Raises:
        InputError: replaces ImportError.
    """
    log = logging.getLogger("matplotlib")
    level = log.level
    # If no home folder is writable, its cache goes to a temporary folder, which changes no figure.
    log.setLevel(logging.ERROR)
    try:
        yield
    except ImportError as error:
        raise InputError(
            f"{what} needs {error.name}; install it with pip install 'rthyb-rt[report]'"
        ) from error
    finally:
        log.setLevel(level)


def environment(*folders: Path) -> jinja2.Environment:
    """Return the template engine for the templates in this folder and in further folders.

    Style sheets of those folders follow the report's own in the global ``style``.
    """
    import jinja2
    from markupsafe import Markup

    result = jinja2.Environment(
        loader=jinja2.FileSystemLoader([_HERE, *folders]),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=jinja2.StrictUndefined,
    )
    result.filters["tied"] = tied
    result.globals["markup"] = Markup
    styles = [sheet for folder in (_HERE, *folders) for sheet in sorted(folder.glob("*.css"))]
    result.globals["style"] = Markup("".join(s.read_text(encoding="utf-8") for s in styles))
    return result


def tied(text: str) -> str:
    """Keep a number and its unit on one line."""
    text = text.replace("> ", ">\u00a0")
    units = "%|mm²?|µm|ms|m|s|kg|N|kN|kN/m|J|Hz|samples?|percentage"
    text = re.sub(r"(?<=\d) N s/m", "\u00a0N\u00a0s/m", text)
    return re.sub(rf"(?<=\d) (?=(?:{units})(?:\W|$))", "\u00a0", text)


def sheets(plates: list[Plate], first: int = 1) -> list[list[tuple[int, Plate]]]:
    """Number the figures and arrange those of half width in pairs."""
    rows: list[list[tuple[int, Plate]]] = []
    for number, plate in enumerate(plates, start=first):
        last = rows[-1] if rows else []
        if plate.half and len(last) == 1 and last[0][1].half:
            last.append((number, plate))
        else:
            rows.append([(number, plate)])
    return rows
