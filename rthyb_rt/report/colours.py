"""The colours of all figures, drawn by matplotlib or in the browser.

Okabe & Ito (2008): distinguishable with any colour vision; dashes help in black and white.
"""

from __future__ import annotations

BLACK, ORANGE, GREEN, BLUE, RED, PURPLE = (
    "#1a1a1a",
    "#e69f00",
    "#009e73",
    "#0072b2",
    "#d55e00",
    "#cc79a7",
)
GREY, PALE = "#7a7a7a", "#f1f1ee"
