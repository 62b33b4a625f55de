"""The live view of several axes in chromium: the buttons that turn from one to another."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from live_process import live
from test_axes_realtime import AXES, faulty

from rthyb_rt.record import recording

DIRECTIONS = ("ground-floor", "first-floor")
"""Of the rig's interface."""


def test_buttons_turn_from_axis_to_axis_and_name_them(place: Path, open_page: Any) -> None:
    rec = faulty([])
    recording.write(place / "recording.h5", rec)
    with live(place / "recording.h5", folder=place) as said:
        page = open_page(said["url"])
        page.wait_for_selector("#axes button")
        assert page.locator("#axes button").all_text_contents() == list(AXES)
        shown, stiffness = [], []
        for name in (*AXES, AXES[0]):
            page.click(f"#axes button:text-is('{name}')")
            page.wait_for_function("() => rthybLive.store.head !== null")
            assert page.get_attribute(f"#axes button:text-is('{name}')", "aria-current") == "true"
            shown.append(
                page.evaluate("Math.max(...rthybLive.store.y[2].filter((y) => y !== null))")
            )
            caption = page.text_content("#stiffness figcaption .unit")
            newest = page.evaluate("rthybLive.store.y[6].filter((y) => y !== null).at(-1)")
            stiffness.append((caption, newest, page.text_content("#s-k")))
            # The hysteresis has the points of the axis that is shown.
            loop_mm = page.evaluate("Math.max(...rthybLive.store.loop.map((point) => point[1]))")
            assert abs(loop_mm - shown[-1]) < 0.02 * abs(shown[-1])
    for (caption, newest, tile), direction in zip(
        stiffness, (*DIRECTIONS, DIRECTIONS[0]), strict=True
    ):
        k = DIRECTIONS.index(direction)
        assert caption == f"kN/mm, direction {direction}"
        assert tile == direction
        wanted = 1e-6 * float(rec.samples["k_t_n_per_m_1" if k else "k_t_n_per_m"][-1])
        assert abs(newest - wanted) < 1e-3 * wanted
    for name, peak_mm in zip((*AXES, AXES[0]), shown, strict=True):
        wanted_mm = 1e3 * float(rec.axis(name)["x_meas_m"].max())
        assert abs(peak_mm - wanted_mm) < 1e-3 * abs(wanted_mm)
    assert shown[0] == shown[2] != shown[1]
