"""The report and the result table: right numbers, plain words, and no test too broken to show."""

from __future__ import annotations

import base64
import csv
import json
import re
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from recording_data import FS_HZ, K_E, recording

from rthyb_rt import config
from rthyb_rt.analysis import measures
from rthyb_rt.analysis.summary import (
    OUT_OF_RANGE,
    notices,
    result_table,
    setup,
    stiffness_shares,
    summarize,
    verdict,
)
from rthyb_rt.core import FLAGS, STATES
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.numbers import number, percent, quantity
from rthyb_rt.record.recording import UNITS, RecordedTest
from rthyb_rt.report import render, write_report, zoom
from rthyb_rt.report.decimate import envelope, robust_limit, trace
from rthyb_rt.report.publication import escaped, write_files

pytest.importorskip("matplotlib")


@pytest.fixture(scope="module")
def page() -> str:
    return render(recording())


def rows(rec: RecordedTest) -> dict[str, str]:
    return {row.label: row.value for row in result_table(rec)}


# --- result table -----------------------------------------------------------------------------


def sine_test(
    delay_samples: float = 10.0, gain: float = 0.98, seconds: float = 10.0
) -> RecordedTest:
    """A spring moved by a 2 Hz, 7 mm sine; the reference is 1 % larger than the command."""
    rec = recording(seconds)
    t = rec.time_s()
    samples = rec.samples
    samples["ag_mps2"] = 0.0
    samples["x_num_m"] = 0.007 * np.sin(4.0 * np.pi * t)
    samples["x_meas_m"] = 0.007 * gain * np.sin(4.0 * np.pi * (t - delay_samples / FS_HZ))
    samples["f_meas_n"] = K_E * samples["x_meas_m"]
    assert rec.reference is not None
    rec.reference["x_ref_m"] = 1.01 * samples["x_num_m"]
    return rec


def test_result_table_of_a_sine_has_the_closed_form_values() -> None:
    found = rows(sine_test())
    phase = 4.0 * np.pi * 10.0 / FS_HZ
    largest = 7.0 * abs(0.98 * np.exp(-1j * phase) - 1.0)
    response = 7.0 * abs(0.98 * np.exp(-1j * phase) - 1.01)
    assert found["Peak command"] == "7.00 mm"
    assert found["Peak displacement"] == "6.86 mm"
    assert found["Peak force"] == "4.57 kN"
    assert found["Tracking, NRMSE"] == f"{100.0 * largest / 7.0:.1f} %"
    assert found["Tracking, largest difference"].startswith(
        f"{largest:.3f} mm ({100.0 * largest / 7.0:.1f} %)"
    )
    assert found["Response, largest difference"].startswith(f"{response:.3f} mm")
    assert found["Remaining delay"] == "9.77 ms (10.0 samples) at 2.00 Hz"
    assert found["Amplitude ratio"] == "0.9800"
    energy = 20.0 * K_E * np.pi * 0.98 * 0.007**2 * np.sin(phase)
    assert float(found["Energy error"].split(" J")[0]) == pytest.approx(energy, rel=0.03)


def test_every_row_has_a_value_and_figures_have_a_formula() -> None:
    table = result_table(sine_test())
    assert all(row.label and row.value for row in table)
    assert all(row.formula for row in table if row.label != "Result")


def test_measures_leave_the_ramps_out() -> None:
    whole = sine_test()
    ramped = sine_test()
    extra = np.zeros(500, dtype=ramped.samples.dtype)
    extra["state"] = STATES.index("RAMP_IN")
    extra["x_meas_m"] = 0.05
    ramped.samples = np.concatenate([extra, ramped.samples])
    ramped.samples["tick"] = np.arange(len(ramped.samples))
    a, b = summarize(whole), summarize(ramped)
    assert b.samples == a.samples + 500
    for name in ("tracking_nrmse", "response_nrmse", "peak_measured_m", "peak_command_time_s"):
        assert getattr(b, name) == getattr(a, name)


def test_reference_follows_the_running_rows_through_a_hold() -> None:
    rec = sine_test()
    hold = np.repeat(rec.samples[3000:3001], 200)
    hold["state"] = STATES.index("HOLD")
    expected = summarize(rec).response_nrmse
    rec.samples = np.concatenate([rec.samples[:3001], hold, rec.samples[3001:]])
    rec.samples["tick"] = np.arange(len(rec.samples))
    assert summarize(rec).response_nrmse == expected


def test_test_that_tripped_early_is_compared_over_what_it_has() -> None:
    rec = sine_test()
    rec.samples = rec.samples[:1000]
    assert rec.reference is not None
    expected = measures.response_nrmse(rec.reference["x_ref_m"][:1000], rec.samples["x_meas_m"])
    assert summarize(rec).response_nrmse == expected


def test_mass_follows_from_the_period_and_the_stiffness() -> None:
    rec = recording(1.0)
    assert setup(rec).period_s == pytest.approx(0.5, rel=1e-5)
    rec.test_toml = rec.test_toml.replace("mass_kg = 4220.0", "period_s = 0.5")
    assert setup(rec).mass_kg == pytest.approx(4220.0, rel=1e-4)


def test_summary_is_json_without_nan() -> None:
    rec = recording(1.0)
    rec.samples["x_num_m"] = 0.0
    document = json.dumps(summarize(rec).as_json(), allow_nan=False)
    assert json.loads(document)["tracking_nrmse"] is None
    assert json.loads(document)["setup"]["k_e_n_per_m"] == K_E


# --- words ------------------------------------------------------------------------------------


def test_verdict_names_tracking_and_response_together() -> None:
    assert verdict(summarize(sine_test(0.0, 1.0))) == (
        "The specimen followed the command within 0 mm (0 %); the response differs from the "
        "reference simulation by at most 0.070 mm (0.99 %)."
    )


def test_verdict_without_reference_says_so() -> None:
    sentence = verdict(summarize(recording(2.0, reference=False)))
    assert sentence.startswith("The specimen followed the command within ")
    assert "no reference simulation" in sentence


def test_verdict_of_no_motion_judges_nothing() -> None:
    rec = recording(1.0)
    rec.samples["x_num_m"] = 0.0
    rec.samples["x_meas_m"] = 0.0
    assert "no motion to evaluate" in verdict(summarize(rec))


def spoil(rec: RecordedTest) -> None:
    rec.meta |= {"end_reason": "tracking error above 5 mm", "interrupted": True}
    rec.samples["flags"][:50] |= FLAGS["limited"]
    rec.samples["flags"][60:61] |= FLAGS["predicted"]
    rec.samples["x_meas_m"][70:72] = np.nan
    rec.samples["alpha"][:200] = 60.0
    rec.replay.skips = np.array([[10, 2], [40, 3]])


def test_everything_that_went_wrong_is_a_notice() -> None:
    rec = recording(2.0)
    spoil(rec)
    text = "\n".join(notice.text for notice in notices(summarize(rec)))
    assert "did not complete: tracking error above 5 mm after 2.00 s" in text
    assert "The test was held, so it is not one continuous motion" in text
    assert "50 samples of 2048 (2.4 %) had the command reduced by a limit" in text
    assert "1 sample of 2048" in text
    assert "2 rows with non-finite values" in text
    assert "5 ticks skipped" in text
    assert "one of its bounds for 9.8 % of the test" in text


def test_flawless_test_has_no_notice() -> None:
    rec = recording(2.0)
    rec.samples["k_t_n_per_m"] = K_E
    assert notices(summarize(rec)) == []


def alarms(rec: RecordedTest) -> str:
    return "\n".join(n.text for n in notices(summarize(rec)) if n.level == "alarm")


def test_response_or_tracking_off_by_more_than_half_is_an_alarm() -> None:
    lagging = sine_test(delay_samples=1024.0 / 2.0 / 4.0)  # a quarter of the period
    assert "Tracking NRMSE 140 %: the measured motion is not that of the command" in alarms(lagging)
    assert "Response NRMSE" in alarms(lagging)
    within = sine_test(0.0, 0.6)
    assert rows(within)["Tracking, NRMSE"] == "40.0 %"
    # Within half of the motion it may be of use; that it is off by a fifth is told all the same.
    assert "the measured motion is not that" not in alarms(within)
    assert "the rms difference was 40.6 % of the reference (at most 20 % is allowed)" in alarms(
        within
    )


def test_error_that_moves_more_energy_than_the_earthquake_is_an_alarm() -> None:
    rec = recording(10.0)
    assert alarms(rec) == ""
    rec.samples["ag_mps2"] *= 1e-3
    assert re.search(
        r"tracking error transferred .* J to or from the structure, more than the .* J that the",
        alarms(rec),
    )


def test_motion_that_ran_away_is_an_alarm() -> None:
    rec = recording(2.0)
    rec.samples["x_num_m"][-1] = rec.samples["x_meas_m"][-1] = 3.0
    assert (
        "The motion diverged to 3.00 m, farther than any laboratory actuator can move."
        in alarms(rec)
    )


def test_clamp_that_acted_is_an_alarm_and_a_lost_feedback_is_told_as_such() -> None:
    rec = recording(2.0)
    rec.samples["code"][100:103] |= OUT_OF_RANGE
    assert "3 samples of 2048 had an implausible value" in alarms(rec)
    rec.samples["flags"][100:103] = FLAGS["predicted"]
    assert "implausible" not in alarms(rec)


def test_tangent_stiffness_is_told_second_by_second() -> None:
    k = np.full(2560, 0.5 * K_E)
    k[:512] = 0.0
    k[1024:2048] = K_E
    edges, shares = stiffness_shares(k, K_E, FS_HZ)
    np.testing.assert_allclose(edges, [0.0, 1.0, 2.0, 2.5])
    np.testing.assert_allclose(shares, [[0.5, 0, 0], [0.5, 0, 1], [0, 1, 0]])
    assert stiffness_shares(k[:0], K_E, FS_HZ)[1].shape == (3, 0)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.12345, "0.123"),
        (9.996, "10.0"),
        (-17.04, "−17.0"),
        (1234.6, "1235"),
        (2.5e7, "2.50·10⁷"),
        (-3e-6, "−3.00·10⁻⁶"),
        (float("nan"), "–"),
        (float("inf"), "∞"),
        (None, "–"),
    ],
)
def test_number_has_three_figures_that_count(value: float | None, text: str) -> None:
    assert number(value) == text


def test_percent_and_quantity_are_for_people() -> None:
    assert percent(0.0091) == "0.91 %"
    assert percent(0.167) == "16.7 %"
    assert percent(1e9) == "> 1000 %"
    assert quantity(0.000118, "mm", 1e3) == "0.118 mm"
    assert quantity(None, "mm") == "–"


# --- page -------------------------------------------------------------------------------------


def drawings(page: str) -> list[ET.Element]:
    return [ET.fromstring(text) for text in re.findall(r"<svg.*?</svg>", page, re.DOTALL)]


class Links(HTMLParser):
    """Whatever a browser would fetch."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("src", "href", "xlink:href", "data") and not (value or "").startswith("#"):
                self.found.append(f"{tag} {name}={value}")


@pytest.mark.long
def test_page_asks_nothing_of_the_network(page: str) -> None:
    links = Links()
    links.feed(page)
    assert links.found == []
    assert not re.search(r"@import|url\((?!#)", page)
    assert "default-src 'none'" in page


def test_page_is_small_and_has_all_figures(page: str) -> None:
    assert len(page.encode()) < 2_000_000
    assert len(drawings(page)) == 15
    titles = re.findall(r"<b>Figure \d+\. (.*?)\.</b>", page)
    assert titles == [
        "Command and measured displacement",
        "At the peak",
        "Hysteresis loop",
        "Tracking error",
        "Synchronisation subspace",
        "From command to measured displacement",
        "Force of the specimen",
        "Response against the reference simulation",
        "Accumulated error",
        "Energy error and tracking indicator",
        "Energy balance",
        "Spectra of command and measured displacement",
        "Response spectra",
        "Delay estimate",
        "Tangent stiffness",
    ]


def test_compensated_command_is_drawn_where_there_is_one(page: str) -> None:
    assert "compensated command" in page.split("</header>")[1]


def test_ids_are_unique_and_every_reference_has_its_target(page: str) -> None:
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    wanted = set(re.findall(r"url\(#([^)]+)\)", page)) | set(re.findall(r'href="#([^"]+)"', page))
    assert wanted <= set(ids)


def test_text_in_figures_is_text_in_the_fonts_of_the_page(page: str) -> None:
    words = [
        "".join(node.itertext())
        for drawing in drawings(page)
        for node in drawing.iter("{http://www.w3.org/2000/svg}text")
    ]
    for label in ("displacement, mm", "force, kN", "time, s", "samples of each second, %", "ms"):
        assert label in words
    assert "DejaVu" not in page.split("</style>", 1)[1]


def test_page_holds_settings_provenance_and_verdict(page: str) -> None:
    assert "gain_per_mm2_per_sample = 0.03" in page
    assert "Imperial Valley, 18 May 1940" in page
    assert "0123abc" in page
    assert "The specimen followed the command within" in page.replace("\N{NO-BREAK SPACE}", " ")


def test_head_of_the_page_says_what_was_tested_on_what(page: str) -> None:
    head = page.split("<header>")[1].split("</header>")[0].replace("\N{NO-BREAK SPACE}", " ")
    assert "Portal frame, T = 0.5 s, El Centro 1940 NS at 0.04 g" in head
    assert "rig table-and-plate" in head
    structure = ("T = 0.500 s", "m = 4220 kg", "c = 2121 N s/m", "ζ = 2.00 %", "k_e = 666.4 kN/m")
    for figure in (*structure, "controller paper, γ = 0.03 per mm² per sample"):
        assert f"<span>{figure}</span>" in head


@pytest.mark.long
def test_window_of_the_tangent_stiffness_stands_in_the_head() -> None:
    rec = recording(1.0)
    rec.test_toml = rec.test_toml.replace("window_periods = 0.1", "window_samples = 51")
    assert "T0 = 51 samples" in render(rec).replace("\N{NO-BREAK SPACE}", " ")


@pytest.mark.long
def test_scale_kept_as_text_has_no_more_digits_than_a_reader_wants() -> None:
    rec = recording(1.0)
    rec.ground_motion["scale"] = "0.1254626434978985"
    assert "<td>0.125463</td>" in render(rec)


@pytest.mark.long
def test_settings_cannot_break_out_of_the_page() -> None:
    rec = recording(1.0)
    rec.test_toml += '\n# <script>alert("x")</script>'
    rec.meta["test_name"] = "<b>bold</b>"
    page = render(rec)
    assert "<script>alert" not in page
    assert "<b>bold" not in page


def test_identified_delay_is_drawn_and_far_bounds_are_named(page: str) -> None:
    assert "identified 17" in page
    assert "Outside the figure: bounds 0 and 60." in page


@pytest.mark.long
def test_bound_that_is_reached_is_drawn() -> None:
    rec = recording(2.0)
    rec.samples["alpha"][500:] = 60.0
    page = render(rec)
    assert "upper bound 60" in page
    assert "lower bound 0" in page


@pytest.mark.long
def test_test_without_compensation_has_no_empty_figures() -> None:
    rec = recording(2.0)
    rec.test_toml = rec.test_toml.replace('type = "paper"', 'type = "none"')
    page = render(rec)
    assert "The test ran without delay compensation." in page
    assert "The test ran without force compensation." in page
    assert "compensated" not in "".join(re.findall(r"<svg.*?</svg>", page, re.DOTALL))
    assert len(drawings(page)) == 13


@pytest.mark.long
def test_fixed_delay_is_told_in_words() -> None:
    rec = recording(2.0)
    rec.test_toml = rec.test_toml.replace(
        "[controller.delay_estimator]\nenabled = true",
        "[controller.delay_estimator]\nenabled = false",
    )
    rec.samples["alpha"] = 17.0
    text = render(rec).replace("\N{NO-BREAK SPACE}", " ")
    assert "The delay was fixed at 17 samples (16.6 ms)." in text


# --- tests that went wrong --------------------------------------------------------------------


def without_reference(rec: RecordedTest) -> None:
    rec.reference = None


def three_samples(rec: RecordedTest) -> None:
    rec.samples = rec.samples[:3]


def one_sample(rec: RecordedTest) -> None:
    rec.samples = rec.samples[:1]


def no_sample(rec: RecordedTest) -> None:
    rec.samples = rec.samples[:0]


def all_zero(rec: RecordedTest) -> None:
    for name in UNITS:
        if name not in ("tick", "state"):
            rec.samples[name] = 0
    assert rec.reference is not None
    rec.reference["x_ref_m"] = 0.0


def all_nan(rec: RecordedTest) -> None:
    for name in UNITS:
        if rec.samples.dtype[name].kind == "f":
            rec.samples[name] = np.nan


def diverged(rec: RecordedTest) -> None:
    growth = np.exp(np.arange(len(rec.samples)) / 60.0)
    for name in ("x_num_m", "x_cmd_m", "x_meas_m", "f_meas_n"):
        rec.samples[name] *= growth


def spikes(rec: RecordedTest) -> None:
    rec.samples["x_num_m"][700] = 1e300
    rec.samples["x_meas_m"][800] = -np.inf
    rec.samples["f_meas_n"][900] *= 1e6
    rec.samples["k_t_n_per_m"][5] = np.nan


def nothing_known(rec: RecordedTest) -> None:
    rec.test_toml, rec.rig_toml, rec.meta, rec.ground_motion = "not toml [", "", {}, {}


def curvature(rec: RecordedTest) -> None:
    rec.samples["beta"] = np.linspace(0.0, 144.5, len(rec.samples))


@pytest.mark.long
@pytest.mark.parametrize(
    "change",
    [
        without_reference,
        three_samples,
        one_sample,
        no_sample,
        all_zero,
        all_nan,
        diverged,
        spikes,
        nothing_known,
        curvature,
        spoil,
    ],
)
def test_report_of_any_test_is_whole(change: Callable[[RecordedTest], None]) -> None:
    rec = recording(2.0)
    change(rec)
    page = render(rec)
    assert page.rstrip().endswith("</html>")
    for drawing in drawings(page):
        paths = [path.get("d", "") for path in drawing.iter("{http://www.w3.org/2000/svg}path")]
        assert not any("nan" in path or "inf" in path or "e+" in path for path in paths)
    assert all(row.value for row in result_table(rec))


@pytest.mark.long
def test_diverged_test_keeps_its_readable_part() -> None:
    rec = recording(20.0)
    clean = np.max(np.abs(rec.samples["x_num_m"]))
    rec.samples["x_meas_m"][-2000:] *= 1e6
    assert rec.reference is not None
    limit = robust_limit(rec.samples["x_num_m"], rec.samples["x_meas_m"], anchor=clean)
    assert 0.5 * clean < limit < 5.0 * clean
    assert "The axis is truncated: the largest value is" in render(rec)


# --- fewer points -----------------------------------------------------------------------------


@given(
    n=st.integers(1, 4000),
    columns=st.integers(1, 300),
    seed=st.integers(0, 99),
    gaps=st.booleans(),
)
def test_envelope_keeps_the_extremes_of_every_column(
    n: int, columns: int, seed: int, gaps: bool
) -> None:
    rng = np.random.default_rng(seed)
    x, y = np.arange(n) / FS_HZ, rng.standard_normal(n)
    if gaps:
        y[rng.random(n) < 0.3] = np.nan
    thin_x, thin_y = envelope(x, y, columns)
    assert thin_x.size <= max(2 * columns, 1) or thin_x.size == n
    assert np.all(np.diff(thin_x) >= 0.0)
    np.testing.assert_array_equal(thin_y, y[np.searchsorted(x, thin_x)])
    width = -(-n // columns)
    kept = set(thin_x.tolist())
    for start in range(0, n, width):
        column = y[start : start + width]
        if np.isfinite(column).any():
            for row in (np.nanargmin(column), np.nanargmax(column)):
                at = np.flatnonzero(column == column[row]) + start
                assert any(float(x[i]) in kept for i in at)


def test_plain_striding_would_lose_a_spike_that_the_envelope_keeps() -> None:
    y = np.zeros(40960)
    y[12347] = 1.0
    assert envelope(np.arange(40960.0), y, 900)[1].max() == 1.0


@given(seed=st.integers(0, 50))
def test_trace_leaves_nothing_out_that_a_pixel_shows(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, y = np.cumsum(rng.normal(0.0, 0.002, (2, 3000)), axis=1)
    thin_x, thin_y = trace(x, y, 1.0, 1.0, 100)
    assert thin_x.size < x.size
    cells = set(zip(np.floor(thin_x * 100), np.floor(thin_y * 100), strict=True))
    assert cells == set(zip(np.floor(x * 100), np.floor(y * 100), strict=True))


def test_axis_takes_everything_that_is_not_far_off() -> None:
    t = np.linspace(0.0, 1.0, 5000)
    burst = 0.1 * np.sin(50.0 * t)
    burst[3000:3020] = 0.9
    assert robust_limit(burst) == 0.9
    burst[3000:3020] = 900.0
    assert 0.1 < robust_limit(burst) < 0.5
    assert robust_limit(np.zeros(5)) == 1.0
    assert robust_limit(np.full(3, np.nan)) == 1.0


# --- surroundings -----------------------------------------------------------------------------


@pytest.mark.long
def test_report_is_written_in_one_piece(tmp_path: Path) -> None:
    write_report(recording(1.0), tmp_path / "run" / "report.html")
    assert [file.name for file in (tmp_path / "run").iterdir()] == ["report.html"]


def test_report_without_matplotlib_names_the_remedy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delitem(sys.modules, "rthyb_rt.report.figures", raising=False)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(InputError, match=r"needs matplotlib.*pip install 'rthyb-rt\[report\]'"):
        write_report(recording(1.0), tmp_path / "report.html")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.long
def test_result_table_needs_neither_matplotlib_nor_h5py() -> None:
    code = (
        "import sys, rthyb_rt.analysis.summary, rthyb_rt.record.recording, rthyb_rt.report; "
        "print(sorted({'matplotlib', 'h5py', 'scipy', 'jinja2'} & set(sys.modules)))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.strip() == "[]"


@pytest.mark.long
def test_two_reports_of_one_recording_are_the_same_bytes() -> None:
    rec = recording(2.0)
    assert render(rec) == render(rec)


@pytest.mark.long
def test_how_the_station_ended_stands_in_words_and_not_as_a_dict_of_python() -> None:
    rec = recording()
    rec.meta["station"] = {"state": "IDLE", "cause_value": 0.0, "indicated": []}
    assert "state IDLE, cause_value 0</td>" in render(rec)
    rec.meta["station"] = {"state": "TRIP", "indicated": ["FORCE", "DRIVE"]}
    assert "state TRIP, indicated FORCE, DRIVE</td>" in render(rec)


def test_on_a_narrow_screen_half_figures_are_no_wider_than_beside_one_another(page: str) -> None:
    narrow = page[page.index("@media screen and (max-width: 44rem)") : page.index("@page")]
    assert re.search(r"\.two figure svg \{ max-width: 28rem; \}", narrow)


# --- the chart of the first figure ------------------------------------------------------------


@pytest.mark.long
def test_chart_that_can_be_enlarged_holds_the_signals_themselves() -> None:
    rec = recording(3.0)
    rec.samples["x_meas_m"][40] = np.nan
    told = json.loads(re.search(r'id="zoom-data">(.*?)</script>', render(rec), re.S)[1])  # type: ignore[index]
    (panel,) = [one for one in told["panels"] if one["label"] == "displacement, mm"]
    found = {one["label"]: one["data"] for one in panel["series"]}
    assert set(found) == {"measured", "command", "compensated command"}
    counts = np.frombuffer(base64.b64decode(found["measured"]), "<i2")
    values = np.where(counts == -32768, np.nan, counts * panel["scale"])
    assert values == pytest.approx(1e3 * rec.samples["x_meas_m"], abs=panel["scale"], nan_ok=True)
    assert told["start"] == rec.time_s()[0]
    assert told["step"] == 1 / FS_HZ
    # Of a long test every n-th row.
    long = zoom.chart(recording(40.0), summarize(recording(40.0)), (0.0, np.nan))
    assert long["step"] > 1 / FS_HZ
    assert long["window"] is None
    assert len(long["panels"][1]["series"][0]["data"]) * 3 / 8 <= zoom.MOST_ROWS


def test_chart_of_a_slow_test_has_the_ground_motion_of_the_structure_not_of_the_laboratory() -> (
    None
):
    def peak_g(time_scale: float) -> float:
        setup = experiment.prepare(
            *config.load_both(
                None, None, ["ground_motion.duration_s=2", f"test.time_scale={time_scale:g}"]
            )
        )
        rec = virtual_time.run(setup)
        ground = zoom.chart(rec, summarize(rec), (0.0, np.nan))["panels"][0]
        assert ground["label"] == "ground acceleration, g"
        counts = np.frombuffer(base64.b64decode(ground["series"][0]["data"]), "<i2")
        return float(np.abs(counts * ground["scale"]).max())

    # Of the slow test every n-th row is drawn.
    assert peak_g(4.0) == pytest.approx(peak_g(1.0), rel=0.05)


def test_browser_draws_the_chart_without_a_network_and_keeps_the_drawing_for_paper(
    tmp_path: Path,
) -> None:
    chromium = shutil.which("chromium")
    if chromium is None:
        pytest.skip("needs chromium")
    write_report(recording(3.0), tmp_path / "report.html")
    words = [chromium, "--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=4000",
             f"--user-data-dir={tmp_path / 'profile'}", "--dump-dom"]  # fmt: skip
    done = subprocess.run(
        [*words, f"file://{tmp_path / 'report.html'}"], capture_output=True, text=True,
        timeout=100, check=True,
    )  # fmt: skip
    figure = done.stdout.split('id="figure-displacement"')[1].split("</figure>")[0]
    assert figure.count('class="u-over"') == 2
    assert "<svg" in figure
    assert "zoomed" in done.stdout.split('id="figure-displacement"')[1][:40]


# --- files for a paper ------------------------------------------------------------------------


@pytest.mark.long
def test_figures_and_tables_are_files_of_their_own_and_twice_the_same(tmp_path: Path) -> None:
    rec = recording(3.0)
    written = write_files(rec, tmp_path / "one")
    names = {path.name for path in written}
    assert {"displacement.svg", "displacement.pdf", "balance.pdf", "transfer.svg"} <= names
    assert {"table.tex", "table.csv", "measures.csv"} <= names
    for path in written:
        if path.suffix == ".svg":
            assert ET.parse(path).getroot().get("width", "").endswith("pt")
        elif path.suffix == ".pdf":
            assert path.read_bytes().startswith(b"%PDF-")
    for path in write_files(rec, tmp_path / "two"):
        assert path.read_bytes() == (tmp_path / "one" / path.name).read_bytes(), path.name


@pytest.mark.long
def test_table_of_latex_has_every_row_and_no_letter_that_latex_takes_otherwise(
    tmp_path: Path,
) -> None:
    rec = recording(3.0)
    write_files(rec, tmp_path)
    text = (tmp_path / "table.tex").read_text()
    assert text.count(r" \\" + "\n") == len(result_table(rec))
    assert text.isascii()
    assert not re.search(r"(?<!\\)[%#](?! \\usepackage)", text)
    assert escaped("1.2·10⁻⁵ m²_x ≤ 5 %") == (
        r"1.2\ensuremath{\cdot}10\textsuperscript{-5} m\textsuperscript{2}\_x "
        r"\ensuremath{\le} 5 \%"
    )


@pytest.mark.long
def test_measures_as_csv_are_those_of_json(tmp_path: Path) -> None:
    rec = recording(3.0)
    write_files(rec, tmp_path)
    with (tmp_path / "measures.csv").open() as file:
        found = dict(csv.reader(file))
    assert float(found["tracking_nrmse"]) == summarize(rec).tracking_nrmse
