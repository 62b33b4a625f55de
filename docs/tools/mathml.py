"""Hook of mkdocs: formulas become MathML, which browsers draw without a script."""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

_FORMULA = re.compile(
    r'<(span|div) class="arithmatex">(?:\\\((.*?)\\\)|\\\[(.*?)\\\])</\1>', re.DOTALL
)


def on_page_content(content: str, **_: Any) -> str:
    """Return the page's HTML with its formulas converted."""
    return _FORMULA.sub(_converted, content)


def _converted(match: re.Match[str]) -> str:
    inline, block = match[2], match[3]
    display = "inline" if block is None else "block"
    formula = convert(html.unescape(block or inline).strip(), display=display)
    # On a narrow screen a long formula is scrolled by itself, not the whole page.
    return formula if block is None else f'<div style="overflow-x: auto">{formula}</div>'
