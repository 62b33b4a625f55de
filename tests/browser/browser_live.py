"""The live view as an operator has it: in chromium, against a service and a recording.

``make test-live``. Every page must end without an error on its console and without a request to
anywhere but this PC (see `open_page`).
"""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from live_process import live, load, paced, start
from realtime_bench import process, until
from service_bench import await_state, status

from rthyb_rt import config
from rthyb_rt.core import RUNNING
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.record import recording
from rthyb_rt.record.ring import Ring
from rthyb_rt.service.control import Client
from rthyb_rt.service.daemon import Daemon

PATIENCE_MS = 30_000
SURE_AFTER_MS = 700
"""A second activation that comes sooner is not taken for an answer."""
USEFUL = "[aria-disabled=false]"
"""A button that keeps its place, whether it is of use or not."""


@pytest.fixture
def service(place: Path) -> Iterator[Daemon]:
    with paced(place) as made:
        yield made


@pytest.fixture
def view(place: Path, service: Daemon) -> Iterator[dict[str, Any]]:
    with live(place, "--operator", folder=place) as said:
        yield said


def await_text(page: Any, selector: str, text: str) -> None:
    page.wait_for_function(
        "([selector, text]) => document.querySelector(selector).textContent.includes(text)",
        arg=[selector, text],
        timeout=PATIENCE_MS,
    )


def pixels(page: Any, canvas: str) -> str:
    return str(page.evaluate("name => document.querySelector(name).toDataURL()", canvas))


def moves(page: Any, canvas: str) -> None:
    before = pixels(page, canvas)
    until(lambda: pixels(page, canvas) != before, f"another picture in {canvas}")


# ---- a test that runs ---------------------------------------------------------------------------


def test_curves_and_loop_move_while_the_test_runs(
    place: Path, view: dict[str, Any], open_page: Any
) -> None:
    page = open_page(view["url"])
    await_text(page, "#state", "IDLE")
    start(place)
    await_text(page, "#state", "RUNNING")
    for figure in ("displacement", "tracking", "force", "loop", "alpha", "jitter"):
        moves(page, f"#{figure} canvas")
    page.wait_for_function(
        "() => parseFloat(document.querySelector('#s-x').textContent.split('peak')[1]) > 0"
    )
    frames = page.evaluate("rthybLive.frames")
    page.wait_for_timeout(500)
    assert page.evaluate("rthybLive.frames") > frames
    measured = page.evaluate("rthybLive.store.y[2].filter(y => y !== null)")
    found = status(place)["newest"]
    assert found is not None
    assert max(map(abs, measured)) > 0.1
    assert "of 60.0 s" in page.text_content("#progress-text")


def test_hold_and_stop_work_and_say_that_they_are_no_emergency_stop(
    place: Path, view: dict[str, Any], open_page: Any
) -> None:
    start(place)
    page = open_page(view["url"])
    assert "not an emergency stop" in page.text_content("#commands")
    assert not page.is_visible("#operator")
    await_text(page, "#state", "RUNNING")
    page.click("#hold")
    await_state(place, "HOLD")
    await_text(page, "#state", "HOLD")
    await_text(page, "#answer", "Held")
    page.click("#stop")
    await_state(place, "IDLE")
    await_text(page, "#state", "IDLE")
    await_text(page, "#cause", "last test stopped by the operator")


def test_keyboard_reaches_hold_and_stop_first(
    place: Path, view: dict[str, Any], open_page: Any
) -> None:
    """In every state: a button that is of no use now says why, and keeps its place and focus."""
    page = open_page(view["url"])
    await_text(page, "#state", "IDLE")
    focused = "document.activeElement.id"
    page.keyboard.press("Tab")
    assert page.evaluate(focused) == "hold"
    page.keyboard.press("Enter")
    await_text(page, "#answer", "hold is allowed in RUNNING")
    start(place)
    page.wait_for_selector("#hold" + USEFUL)
    assert page.evaluate(focused) == "hold"
    page.keyboard.press("Enter")
    await_state(place, "HOLD")
    # It may be given again, for a way back that moves already can be held as well.
    await_text(page, "#state", "HOLD")
    page.wait_for_selector("#hold" + USEFUL)
    assert page.evaluate(focused) == "hold"
    page.keyboard.press("Tab")
    assert page.evaluate(focused) == "stop"
    page.keyboard.press("Enter")
    await_state(place, "IDLE")


def test_page_is_told_nothing_that_was_found_out_before_it_was_opened(
    place: Path, view: dict[str, Any], open_page: Any
) -> None:
    """Without a page the view looks once a second: by then the state may be another."""
    told = """() => {
        window.held = [];
        const watch = () => {
            const hold = document.querySelector("#hold");
            if (!hold) return requestAnimationFrame(watch);
            const note = () => window.held.push(hold.getAttribute("aria-disabled"));
            note();
            const what = { attributes: true, attributeFilter: ["aria-disabled"] };
            new MutationObserver(note).observe(hold, what);
        };
        watch();
    }"""
    start(place)
    page = open_page(view["url"], f"({told})()")
    page.wait_for_selector("#hold" + USEFUL)
    page.wait_for_timeout(1500)
    assert page.evaluate("held") == ["true", "false"]


def armed(place: Path, view: dict[str, Any], open_page: Any) -> Any:
    """Return an operator's page on which a test was zeroed and armed."""
    load(place)
    page = open_page(view["operator_url"])
    page.click("[data-command=zero]" + USEFUL, timeout=PATIENCE_MS)
    page.click("[data-command=arm]" + USEFUL, timeout=PATIENCE_MS)
    return page


def test_operator_takes_a_test_from_zero_to_start(
    place: Path, view: dict[str, Any], open_page: Any
) -> None:
    page = armed(place, view, open_page)
    await_text(page, "#state", "ARMED")
    await_text(page, "#cause", "tare ")
    page.click("[data-command=start]" + USEFUL, timeout=PATIENCE_MS)
    # The first click only asks back.
    assert page.text_content("[data-command=start]") == "Really start?"
    assert status(place)["state"] == "ARMED"
    page.wait_for_timeout(SURE_AFTER_MS)
    page.click("[data-command=start]")
    # Sent: it asks no more.
    assert page.text_content("[data-command=start]") == "Start"
    await_state(place, "RUNNING")
    await_text(page, "#state", "RUNNING")


def test_double_click_and_held_key_only_ask_back(
    place: Path, view: dict[str, Any], open_page: Any
) -> None:
    page = armed(place, view, open_page)
    start_button = "[data-command=start]" + USEFUL
    page.wait_for_selector(start_button, timeout=PATIENCE_MS)
    where = page.locator(".operator").bounding_box()
    page.dblclick(start_button)
    page.wait_for_timeout(500)
    assert page.text_content(start_button) == "Really start?"
    # Nothing else came under the pointer.
    assert page.locator(".operator").bounding_box() == where
    assert status(place)["state"] == "ARMED"
    page.wait_for_timeout(SURE_AFTER_MS)
    # Of another double click the first half is meant.
    page.dblclick(start_button)
    await_state(place, "RUNNING")
    assert page.text_content("[data-command=start]") == "Start"
    with Client(place / "control.sock") as client:
        client.call("Hold")
    resume = "[data-command=resume]"
    page.wait_for_selector(resume + USEFUL, timeout=PATIENCE_MS)
    page.focus(resume)
    page.keyboard.down("Enter")
    for _ in range(10):
        page.wait_for_timeout(100)
        page.keyboard.down("Enter")
    page.keyboard.up("Enter")
    assert page.text_content(resume) == "Really resume?"
    page.wait_for_timeout(500)
    assert status(place)["state"] == "HOLD"
    page.keyboard.press("Enter")
    await_state(place, "RUNNING")


def test_trip_is_shown_with_its_first_cause_and_the_curves_stay(
    place: Path, view: dict[str, Any], open_page: Any
) -> None:
    page = open_page(view["url"])
    start(place, {"limits.force_n": "1500"})
    await_state(place, "TRIPPED")
    await_text(page, "#state", "TRIPPED")
    await_text(page, "#cause", "first cause: force 1.5")
    band = "getComputedStyle(document.querySelector('#band')).backgroundColor"
    assert page.evaluate(band) == "rgb(179, 71, 0)"
    page.wait_for_timeout(1500)
    forces = page.evaluate("rthybLive.store.y[4].filter(y => y !== null)")
    assert max(map(abs, forces)) >= 1.5
    with Client(place / "control.sock") as client:
        client.call("Reset")
    await_text(page, "#state", "IDLE")


def test_service_that_goes_away_is_shown_and_found_again(place: Path, open_page: Any) -> None:
    with live(place / "control.sock", folder=place) as said:
        page = open_page(said["url"])
        await_text(page, "#state", "NO SERVICE")
        assert page.get_attribute("#stop", "aria-disabled") == "true"
        with paced(place):
            await_text(page, "#state", "IDLE")
        await_text(page, "#state", "NO SERVICE")
        await_text(page, "#cause", "cannot be reached")
        page.close()


@pytest.mark.parametrize("size", [(1280, 600), (1100, 700), (420, 800)])
def test_nothing_is_cut_off_in_a_small_window(
    place: Path, view: dict[str, Any], open_page: Any, size: tuple[int, int]
) -> None:
    start(place)
    page = open_page(view["operator_url"], size=size)
    await_text(page, "#state", "RUNNING")
    page.wait_for_function("() => rthybLive.frames > 0")
    page.wait_for_selector("[data-seconds]")
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    beyond = """() => [...document.querySelectorAll("body *")]
        .filter(e => e.getBoundingClientRect().right > innerWidth + 0.5).map(e => e.outerHTML)"""
    assert page.evaluate(beyond) == []
    too_long = """() => [...document.querySelectorAll("button, #band, #test, #numbers > div")]
        .filter(e => e.scrollWidth > e.clientWidth).map(e => e.outerHTML)"""
    assert page.evaluate(too_long) == []
    heights = "[...document.querySelectorAll('figure .plot')].map(e => e.clientHeight)"
    assert min(page.evaluate(heights)) >= 100
    overlap = """() => {
        const boxes = [...document.querySelectorAll("figure")].map(e => e.getBoundingClientRect());
        return boxes.some((a, i) => boxes.slice(i + 1).some(b => a.left < b.right - 1
            && b.left < a.right - 1 && a.top < b.bottom - 1 && b.top < a.bottom - 1));
    }"""
    assert not page.evaluate(overlap)


def test_rows_that_stop_coming_are_told_and_found_again(
    place: Path, run: Path, open_page: Any
) -> None:
    rec = recording.open_run(run)
    ring = Ring.create(place / "rings", rec)
    rows = rec.samples[rec.samples["state"] == RUNNING]
    ring.push(rows[:3000])
    with live(place / "rings", folder=place) as said:
        page = open_page(said["url"])
        await_text(page, "#state", "NO ROWS")
        await_text(page, "#cause", " s: the curves are out of date.")
        assert page.get_attribute("#band", "data-state") == "none"
        done = iter(range(3000, 6000, 100))

        def flows() -> bool:
            at = next(done)
            ring.push(rows[at : at + 100])
            return bool(page.text_content("#state") == "RUNNING")

        while not flows():
            page.wait_for_timeout(100)
        ring.close()
        await_text(page, "#cause", "the test is over")
        page.wait_for_timeout(1500)
        assert page.text_content("#state") == "RUNNING"
        page.close()
    ring.remove()


def test_view_that_hangs_is_told_though_its_socket_is_open(
    place: Path, service: Daemon, open_page: Any
) -> None:
    with process(place, "live", "--port", "0", "--json", place / "control.sock") as made:
        said = ""
        while not said.endswith("}\n"):
            said += made.line()
        page = open_page(json.loads(said)["url"])
        await_text(page, "#state", "IDLE")
        # Whoever looks back, and whoever sees nothing new, hears all the same.
        page.click("#follow")
        page.wait_for_timeout(5000)
        assert page.text_content("#state") == "IDLE"
        made.signal(signal.SIGSTOP)
        await_text(page, "#state", "NO CONNECTION")
        await_text(page, "#cause", "No data for ")
        assert page.get_attribute("#stop", "aria-disabled") == "true"
        made.signal(signal.SIGCONT)
        await_text(page, "#state", "IDLE")
        page.close()


def test_window_can_be_paused_zoomed_and_followed_again(
    place: Path, view: dict[str, Any], open_page: Any
) -> None:
    start(place)
    page = open_page(view["url"])
    page.wait_for_function("() => rthybLive.frames > 30", timeout=PATIENCE_MS)
    page.click("#follow")
    page.wait_for_selector("#outline", state="visible")
    page.wait_for_timeout(300)
    shown = page.evaluate("rthybLive.shown")
    picture = pixels(page, "#displacement canvas")
    page.wait_for_timeout(700)
    assert pixels(page, "#displacement canvas") == picture
    with Client(place / "control.sock") as client:
        client.call("Hold")
    # Whoever looks back must still see what is now.
    await_text(page, "#state", "HOLD")
    page.click("#in")
    closer = page.evaluate("rthybLive.shown")
    assert closer[1] - closer[0] == pytest.approx((shown[1] - shown[0]) / 2)
    page.keyboard.press("End")
    moves(page, "#displacement canvas")
    assert page.text_content("#follow") == "Pause"


# ---- a test of the past -------------------------------------------------------------------------


@pytest.fixture(scope="session")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    test = config.load_test(config.builtin_test_path())
    rec = virtual_time.run(experiment.prepare(test, config.load_rig(config.find_rig(test.rig))))
    folder = tmp_path_factory.mktemp("run")
    recording.write(folder / recording.FILE_NAME, rec)
    return folder


def test_past_test_can_be_scrubbed_and_zoomed(run: Path, open_page: Any) -> None:
    rec = recording.open_run(run)
    with live(run, folder=run) as said:
        page = open_page(said["url"])
        await_text(page, "#cause", "completed; at ")
        assert not page.is_visible("#commands")
        page.wait_for_function("() => rthybLive.frames > 0")
        first, last = page.evaluate("rthybLive.shown")
        assert (first, last) == (rec.samples["tick"][0], rec.samples["tick"][-1])
        everything = page.text_content("#s-x")
        peak_mm = 1e3 * float(abs(rec.samples["x_meas_m"]).max())
        assert everything.endswith(f"peak {peak_mm:.2f}")
        whole = pixels(page, "#displacement canvas")
        page.keyboard.press("Home")
        for _ in range(8):
            page.keyboard.press("+")
        page.click("[data-seconds='2']")
        page.keyboard.press("Shift+ArrowLeft")
        moved = page.evaluate("rthybLive.shown")
        assert moved[1] - moved[0] == pytest.approx(2.0 * rec.fs_hz)
        until(lambda: pixels(page, "#displacement canvas") != whole, "the part that was asked for")
        until(lambda: page.text_content("#s-x") != everything, "the peak of this part")
        box = page.locator("#displacement .u-over").bounding_box()
        page.mouse.move(box["x"] + 0.25 * box["width"], box["y"] + 20)
        page.mouse.down()
        page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 20, steps=4)
        page.mouse.up()
        selected = page.evaluate("rthybLive.shown")
        assert selected[1] - selected[0] == pytest.approx(0.5 * rec.fs_hz, rel=0.02)
        page.click("#all")
        until(lambda: pixels(page, "#displacement canvas") == whole, "the whole test again")
        page.close()


# ---- who is let in ------------------------------------------------------------------------------


def test_wrong_token_and_foreign_page_are_refused(
    browser: Any, place: Path, view: dict[str, Any]
) -> None:
    address = urlsplit(view["url"])
    page = browser.new_page()
    found = page.goto(f"http://{address.netloc}/{'x' * 32}/")
    assert found.status == 403
    assert page.goto(f"http://{address.netloc}/").status == 403
    # A page of elsewhere that knows the address all the same.
    page.goto("data:text/html,elsewhere")
    outcome = page.evaluate(
        """address => new Promise(done => {
            const socket = new WebSocket(address);
            socket.onopen = () => done("opened");
            socket.onerror = () => done("refused");
        })""",
        f"ws://{address.netloc}{address.path}socket",
    )
    assert outcome == "refused"
    page.close()


def test_page_comes_by_name_through_a_forwarded_port_as_well(
    view: dict[str, Any], open_page: Any
) -> None:
    page = open_page(view["url"].replace("127.0.0.1", "localhost"))
    await_text(page, "#state", "IDLE")
