"""The live view of several axes in chromium: the buttons that turn from one to another."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from live_process import live
from test_axes_realtime import AXES, faulty

from rthyb_rt.record import recording


def test_buttons_turn_from_axis_to_axis_and_name_them(place: Path, open_page: Any) -> None:
    rec = faulty([])
    recording.write(place / "recording.h5", rec)
    with live(place / "recording.h5", folder=place) as said:
        page = open_page(said["url"])
        page.wait_for_selector("#axes button")
        assert page.locator("#axes button").all_text_contents() == list(AXES)
        shown = []
        for name in (*AXES, AXES[0]):
            page.click(f"#axes button:text-is('{name}')")
            page.wait_for_function("() => rthybLive.store.head !== null")
            assert page.get_attribute(f"#axes button:text-is('{name}')", "aria-current") == "true"
            shown.append(
                page.evaluate("Math.max(...rthybLive.store.y[2].filter((y) => y !== null))")
            )
    for name, peak_mm in zip((*AXES, AXES[0]), shown, strict=True):
        wanted_mm = 1e3 * float(rec.axis(name)["x_meas_m"].max())
        assert abs(peak_mm - wanted_mm) < 1e-3 * abs(wanted_mm)
    assert shown[0] == shown[2] != shown[1]
