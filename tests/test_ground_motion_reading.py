"""Ground-motion files as laboratories get them: every format, and every way they are broken."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from rthyb_rt import ground_motion
from rthyb_rt.errors import InputError
from rthyb_rt.ground_motion import STANDARD_GRAVITY_MPS2, GroundMotion

SAMPLES = Path(__file__).parent / "data" / "ground_motion"
RECORDS = Path(__file__).parents[2] / "shared" / "records"


def sample_acceleration_g(time_s: np.ndarray) -> np.ndarray:
    """Return what every synthetic sample file holds, in g."""
    return 0.3 * np.exp(-time_s / 0.6) * np.sin(2 * np.pi * 1.5 * time_s)


def refusal(path: Path, **arguments: object) -> str:
    """Return the message with which a file is refused."""
    with pytest.raises(InputError) as caught:
        ground_motion.read(path, **arguments)  # type: ignore[arg-type]
    assert caught.value.exit_code == 3
    for problem in caught.value.problems:
        assert problem.where
        assert "\n" not in str(problem)
    return str(caught.value)


@pytest.fixture
def written(tmp_path: Path) -> Callable[[str], Path]:
    """Return a function that writes text to a file and returns its path."""

    def write(text: str, name: str = "record.txt") -> Path:
        path = tmp_path / name
        path.write_bytes(text.encode())
        return path

    return write


# --- formats -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "channel", "units", "format", "rate_hz", "points", "sign", "tolerance_g"),
    [
        ("named_header.at2", None, None, "at2", 100, 43, 1, 6e-8),
        ("values_first.at2", None, None, "at2", 100, 43, 1, 6e-8),
        ("two_channels.v2c", 1, None, "cosmos-v2", 200, 401, 1, 1e-8),
        ("two_channels.v2c", "360 deg", None, "cosmos-v2", 200, 401, -1, 1e-6),
        ("one_channel.v1c", None, None, "cosmos-v1", 200, 401, 1, 1e-7),
        ("digital.v1", None, None, "csmip-v1", 200, 50, 1, 1e-6),
        ("film.v1", 1, None, "csmip-v1", 200, 37, 1, 6e-5),
        ("film.v1", "UP", None, "csmip-v1", 200, 37, -1, 6e-5),
        ("comma.csv", None, None, "columns", 50, 60, 1, 1e-6),
        ("semicolon_bom.csv", None, None, "columns", 50, 60, 1, 1e-6),
        ("tab_latin1.txt", None, None, "columns", 50, 60, 1, 1e-7),
        ("blanks_no_unit.txt", None, "m/s^2", "columns", 50, 60, 1, 1e-6),
        ("three_columns_ms.csv", "acc_ns", None, "columns", 50, 60, -1, 1e-7),
        ("three_columns_ms.csv", 2, None, "columns", 50, 60, 1, 1e-7),
    ],
)
def test_every_format_gives_the_same_signal(
    name: str,
    channel: int | str | None,
    units: str | None,
    format: str,
    rate_hz: float,
    points: int,
    sign: float,
    tolerance_g: float,
) -> None:
    motion = ground_motion.read(SAMPLES / name, channel=channel, units=units)
    assert motion.details["format"] == format
    assert motion.dt_s == 1.0 / rate_hz
    assert motion.acceleration_mps2.shape == (points,)
    found_g = motion.acceleration_mps2 / STANDARD_GRAVITY_MPS2
    expected_g = sign * sample_acceleration_g(np.arange(points) / rate_hz)
    np.testing.assert_allclose(found_g, expected_g, atol=tolerance_g, rtol=0)
    by_name = ground_motion.read(SAMPLES / name, channel=channel, units=units, format=format)
    np.testing.assert_array_equal(by_name.acceleration_mps2, motion.acceleration_mps2)


def test_knet_counts_are_scaled_and_the_sensor_offset_is_removed_and_told() -> None:
    motion = ground_motion.read(SAMPLES / "station.EW")
    expected_g = sample_acceleration_g(np.arange(200) / 100.0)
    found_g = motion.acceleration_mps2 / STANDARD_GRAVITY_MPS2
    # One count is 3920/6182761 gal = 6.5e-7 g.
    np.testing.assert_allclose(found_g, expected_g - expected_g.mean(), atol=7e-7, rtol=0)
    offset_gal = 1200 * 3920 / 6182761 + expected_g.mean() * 980.665
    assert float(motion.details["mean_removed_gal"]) == pytest.approx(offset_gal, abs=1e-3)
    assert motion.details["station"] == "TST001"
    assert motion.details["component"] == "E-W"


def test_csmip_fields_that_touch_are_separated_by_their_width() -> None:
    """Values of -100 cm/s2 and below leave no blank between fields of (8f10.6)."""
    text = (SAMPLES / "two_channels.v2").read_text()
    assert "-226.01193-301.77901" in text
    k = np.arange(61) * 0.02
    expected = 10.0 * np.exp(-k / 0.6) * np.sin(3 * np.pi * k)
    for channel, sign in ((1, 1.0), ("Up", -1.0)):
        motion = ground_motion.read(SAMPLES / "two_channels.v2", channel=channel)
        assert motion.details["format"] == "csmip-v2"
        assert motion.dt_s == 0.02
        np.testing.assert_allclose(motion.acceleration_mps2, sign * expected, atol=1e-7)


def test_cosmos_interval_is_that_of_the_series_not_of_the_recorder() -> None:
    """The sample has 20 ms in real header 34 (recorder) and 5 ms in 62 (series)."""
    assert ground_motion.read(SAMPLES / "one_channel.v1c").dt_s == 0.005


def test_fortran_exponents_and_signs_that_touch_are_read(written: Callable[..., Path]) -> None:
    path = written("a\nb\nACCELERATION TIME HISTORY IN UNITS OF G\nNPTS= 4, DT= .01 SEC\n"
                   "  .1234D-01-.5678D-02\n 1.0E-3 -.5\n")  # fmt: skip
    found = ground_motion.read(path).acceleration_mps2 / STANDARD_GRAVITY_MPS2
    np.testing.assert_allclose(found, [0.01234, -0.005678, 0.001, -0.5], rtol=1e-12)


@pytest.mark.parametrize(
    ("header", "factor"),
    [
        ("time_s,acc_g", 9.80665),
        ("# Time (s),Acceleration (g's)", 9.80665),
        ("t,a [m/s/s]", 1.0),
        ("time, ground acceleration in cm/s**2", 0.01),
        ("# units: gal", 0.01),
        ("time,acc (mm/s2)", 0.001),
        ("time,acc_mps2", 1.0),
        ("time,acc_mg", 9.80665e-3),
        ("time,acc (m s-2)", 1.0),
        ("time,acc (in/sec2)", 0.0254),
    ],
)
def test_unit_is_taken_from_the_header(
    written: Callable[..., Path], header: str, factor: float
) -> None:
    motion = ground_motion.read(written(f"{header}\n0.00,0.1\n0.01,-0.2\n0.02,0.3\n"))
    np.testing.assert_allclose(motion.acceleration_mps2, np.array([0.1, -0.2, 0.3]) * factor)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "latin-1", "cp1252"])
@pytest.mark.parametrize("line_end", ["\n", "\r\n", "\r"])
def test_encoding_and_line_ends_do_not_matter(tmp_path: Path, encoding: str, line_end: str) -> None:
    lines = ["# Prüfstand", "time_s;acc_g", "0;0.01", "0.01;0.02", "0.02;-0.01", ""]
    path = tmp_path / "r.csv"
    path.write_bytes(line_end.join(lines).encode(encoding))
    motion = ground_motion.read(path)
    np.testing.assert_allclose(motion.acceleration_mps2, np.array([1, 2, -1]) * 0.0980665)


@pytest.mark.parametrize("decimals", [4, 5, 6, 9])
@pytest.mark.parametrize("rate_hz", [50, 100, 128, 200, 256, 1000, 1024])
def test_printed_times_give_back_the_exact_rate(
    written: Callable[..., Path], decimals: int, rate_hz: int
) -> None:
    rows = "".join(f"{k / rate_hz:.{decimals}f} {np.sin(k):.4f}\n" for k in range(3000))
    motion = ground_motion.read(written("# time_s acc_g\n" + rows))
    assert motion.dt_s == 1.0 / rate_hz


def test_times_in_single_precision_are_equally_spaced(written: Callable[..., Path]) -> None:
    times = (np.arange(12000) * 0.005).astype(np.float32)
    rows = "".join(f"{float(t):.12g} 0.1\n" for t in times)
    assert ground_motion.read(written("# time_s acc_g\n" + rows)).dt_s == 0.005


def test_record_that_starts_late_is_shifted_and_it_is_told(written: Callable[..., Path]) -> None:
    motion = ground_motion.read(written("# time_s acc_g\n5.00 .1\n5.02 .2\n5.04 .3\n"))
    assert motion.time_s[0] == 0.0
    assert motion.details["first_time_s"] == "5"


# --- built-in and shared records -----------------------------------------------------------------


def test_built_in_el_centro_is_chopras_table() -> None:
    motion = ground_motion.load("elcentro-1940-ns")
    assert motion.acceleration_mps2.size == 1560
    assert motion.dt_s == 0.02
    assert motion.duration_s == pytest.approx(31.2, abs=1e-12)
    assert motion.pga_g == pytest.approx(0.31882, abs=1e-9)
    assert "Chopra" in motion.source
    found_g = motion.acceleration_mps2[:4] / STANDARD_GRAVITY_MPS2
    np.testing.assert_allclose(found_g, [0.0, 0.0063, 0.00364, 0.00099], atol=1e-12)
    assert ground_motion.baseline_check(motion).ok


@pytest.mark.parametrize(
    ("name", "pga_g", "points", "rate_hz"),
    [
        ("chichi1999_TCU068_EW_200Hz_g", 0.5660, 13102, 200),
        ("elcentro1940_NS_Chopra_50Hz_g", 0.3188, 1560, 50),
        ("elcentro1940_NS_PEER1999_100Hz_g", 0.3129, 4000, 100),
        ("elcentro1940_NS_RSN6_NGAW2_100Hz_g", 0.2808, 5372, 100),
        ("elcentro1940_NS_vol2_53s_50Hz_g", 0.3487, 2688, 50),
        ("kobe1995_TAK090_100Hz_g", 0.6155, 4015, 100),
        ("kobe1995_maRTHS_100Hz_g", 0.6455, 5095, 100),
        ("northridge1994_VSP360_200Hz_g", 0.9338, 9327, 200),
    ],
)
def test_shared_record_has_its_stated_peak(
    name: str, pga_g: float, points: int, rate_hz: int
) -> None:
    path = RECORDS / f"{name}.txt"
    if not path.is_file():
        pytest.skip("this machine has no further copy of the record")
    motion = ground_motion.read(path)
    assert motion.pga_g == pytest.approx(pga_g, abs=6e-5)
    assert motion.acceleration_mps2.size == points
    assert motion.dt_s == 1.0 / rate_hz


def test_built_in_record_equals_the_shared_copy() -> None:
    path = RECORDS / "elcentro1940_NS_Chopra_50Hz_g.txt"
    if not path.is_file():
        pytest.skip("this machine has no further copy of the record")
    built_in = ground_motion.builtin("elcentro-1940-ns")
    np.testing.assert_array_equal(
        built_in.acceleration_mps2, ground_motion.read(path).acceleration_mps2
    )


def test_tcu068_is_50_s_at_200_hz(tcu068_first_50_s: GroundMotion) -> None:
    assert tcu068_first_50_s.acceleration_mps2.size == 10_000
    assert tcu068_first_50_s.dt_s == 0.005
    assert tcu068_first_50_s.pga_g == pytest.approx(0.5660, abs=1e-4)


def test_tcu068_equals_the_shared_copy(tcu068_first_50_s: GroundMotion) -> None:
    path = RECORDS / "chichi1999_TCU068_EW_200Hz_g.txt"
    if not path.is_file():
        pytest.skip("this machine has no further copy of the record")
    shared = ground_motion.read(path).window(0.0, 50.0)
    np.testing.assert_allclose(
        tcu068_first_50_s.acceleration_mps2, shared.acceleration_mps2, atol=1e-8 * 9.80665
    )


# --- what is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"units": "cm/s2"}, '"cm/s2"; the built-in record elcentro-1940-ns is stored in g'),
        ({"units": "furlong"}, '"furlong"; the built-in record'),
        ({"format": "at2"}, '"at2"; the built-in record elcentro-1940-ns has the format columns'),
        ({"channel": 2}, '"2"; the built-in record elcentro-1940-ns has one component only'),
    ],
)
def test_what_contradicts_a_built_in_record_is_refused(given: dict[str, object], told: str) -> None:
    with pytest.raises(InputError) as caught:
        ground_motion.load("elcentro-1940-ns", **given)  # type: ignore[arg-type]
    (problem,) = caught.value.problems
    assert problem.where == f"ground_motion.{next(iter(given))}"
    assert told in problem.message
    assert problem.message.endswith("omit the key")


def test_unit_of_a_built_in_record_may_be_given() -> None:
    again = ground_motion.load("elcentro-1940-ns", units="g", format="columns")
    bare = ground_motion.load("elcentro-1940-ns")
    assert np.array_equal(again.acceleration_mps2, bare.acceleration_mps2)


def test_missing_file_is_refused_and_built_in_names_are_listed(tmp_path: Path) -> None:
    assert "no such file" in refusal(tmp_path / "none.at2")
    with pytest.raises(InputError, match="elcentro-1940-ns"):
        ground_motion.load(tmp_path / "none.at2")
    with pytest.raises(InputError, match="elcentro-1940-ns"):
        ground_motion.load("elcentro-1940-ew")
    with pytest.raises(InputError, match="elcentro-1940-ns"):
        ground_motion.load("bad\0name")
    with pytest.raises(InputError, match="elcentro-1940-ns"):
        ground_motion.builtin("kobe")


def test_folder_and_pipe_are_refused_without_waiting(tmp_path: Path) -> None:
    assert "not a file" in refusal(tmp_path)
    os.mkfifo(tmp_path / "pipe")
    assert "not a file" in refusal(tmp_path / "pipe")


@pytest.mark.parametrize("content", [b"", b"\n \n\t\n", b"\xef\xbb\xbf", b"\x1a"])
def test_empty_file_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "empty.txt"
    path.write_bytes(content)
    assert "is empty" in refusal(path)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"PK\x03\x04rest", "ZIP"),
        (b"\x1f\x8b\x08rest", "gzip"),
        (b"MATLAB 5.0 MAT-file", "MATLAB"),
        (b"\x89HDF\r\n\x1a\n", "HDF5"),
        (b"time,acc\n0,\x00\x01", "not a text file"),
        (b"\xff\xfe0", "damaged"),
    ],
)
def test_binary_file_is_refused_with_a_hint(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "record.dat"
    path.write_bytes(content)
    assert says in refusal(path)


def test_prose_is_an_unknown_format(written: Callable[..., Path]) -> None:
    assert "format is not recognised" in refusal(written("Dear colleague,\nhere is the record.\n"))


def test_huge_file_is_refused_without_reading_it_all(tmp_path: Path) -> None:
    path = tmp_path / "huge.txt"
    with path.open("wb") as stream:
        stream.truncate(2**40)
    assert "larger than 64 MiB" in refusal(path)


@pytest.mark.parametrize("value", ["nan", "NaN", "inf", "-Infinity", "1e999"])
def test_record_with_nan_or_inf_is_refused_with_its_row(
    written: Callable[..., Path], value: str
) -> None:
    message = refusal(written(f"time_s,acc_g\n0.00,0.1\n0.01,{value}\n0.02,0.1\n"))
    assert "record.txt:3: " in message
    assert value in message
    assert "finite" in message


def test_nan_in_fixed_fields_is_refused_with_its_row(written: Callable[..., Path]) -> None:
    text = (SAMPLES / "named_header.at2").read_text().split("\n")
    text[6] = text[6].replace(text[6].split()[2], "NaN")
    message = refusal(written("\n".join(text)))
    assert "record.txt:7: the value is NaN" in message


def test_every_bad_row_is_told_up_to_five_and_the_rest_counted(
    written: Callable[..., Path],
) -> None:
    rows = "".join(f"{k / 100:.2f},nan\n" for k in range(20))
    with pytest.raises(InputError) as caught:
        ground_motion.read(written("time_s,acc_g\n" + rows))
    assert len(caught.value.problems) == 6
    assert "15 more" in caught.value.problems[-1].message


def test_wrong_column_count_is_refused_with_its_row(written: Callable[..., Path]) -> None:
    message = refusal(written("time_s,acc_g\n0.00,0.1\n0.01,0.1,7\n0.02\n0.03,0.1\n"))
    assert "record.txt:3: the row has 3 columns, the first row has 2" in message
    assert "record.txt:4: the row has 1 columns" in message


def test_one_column_and_three_columns_are_refused(written: Callable[..., Path]) -> None:
    assert "1 column" in refusal(written("# acc_g\n0.1\n0.2\n"))
    message = refusal(SAMPLES / "three_columns_ms.csv")
    assert "2 acc_ew (gal), 3 acc_ns (gal)" in message
    assert "0 columns fit" in refusal(SAMPLES / "three_columns_ms.csv", channel="up")
    assert "2 columns fit" in refusal(SAMPLES / "three_columns_ms.csv", channel="acc")


@pytest.mark.parametrize("row", ["0,01;0,5", "0,01\t0,5", "0,01 0,5", "0,01 ; 5,0E-1"])
def test_decimal_comma_is_refused_politely(written: Callable[..., Path], row: str) -> None:
    message = refusal(written(f"t;acc (g)\n{row}\n{row}\n"))
    assert "record.txt:2: " in message
    assert "decimal points" in message


def test_word_among_the_numbers_is_refused_with_its_row(written: Callable[..., Path]) -> None:
    message = refusal(written("time_s acc_g\n0 .1\n.01 #REF!\n.02 .1\n"))
    assert "record.txt:3: '#REF!' is not a number" in message


def test_lost_sample_is_refused_with_row_found_and_expected_interval(
    written: Callable[..., Path],
) -> None:
    rows = [f"{k * 0.02:.2f} 0.1" for k in range(500)]
    del rows[300]
    message = refusal(written("# time_s acc_g\n" + "\n".join(rows)))
    assert "record.txt:302: time is not equally spaced" in message
    assert "found an interval of 0.04 s" in message
    assert "expected 0.02 s" in message


def test_times_printed_too_coarsely_are_refused(written: Callable[..., Path]) -> None:
    rows = "".join(f"{k * 0.005:.2f} 0.1\n" for k in range(0, 500, 3))
    assert "not equally spaced" in refusal(written("# time_s acc_g\n" + rows))


def test_decreasing_and_repeated_time_are_refused(written: Callable[..., Path]) -> None:
    message = refusal(written("# time_s acc_g\n0 0\n.01 0\n.02 0\n.015 0\n.03 0\n"))
    assert "record.txt:5: time goes back: 0.015 s after 0.02 s" in message
    assert "repeats" in refusal(written("# time_s acc_g\n0 0\n.01 0\n.01 0\n.02 0\n"))


def test_at2_cut_short_is_refused_with_both_counts(written: Callable[..., Path]) -> None:
    lines = (SAMPLES / "named_header.at2").read_text().split("\n")
    message = refusal(written("\n".join(lines[:8])))
    assert "NPTS says 43 points, but the file has 20" in message
    assert "truncated" in message


def test_word_inside_fixed_data_is_told_with_its_row(written: Callable[..., Path]) -> None:
    lines = (SAMPLES / "named_header.at2").read_text().split("\n")
    lines[6] = "  gap of two seconds"
    message = refusal(written("\n".join(lines)))
    assert "record.txt:7: NPTS says 43 points, but the file has 10 ('gap of two seconds'" in message


def test_at2_with_more_values_than_npts_is_refused(written: Callable[..., Path]) -> None:
    text = (SAMPLES / "named_header.at2").read_text()
    assert "NPTS says 43 points, but the file has 45" in refusal(written(text + " .1 .2\n"))


@pytest.mark.parametrize(
    ("name", "channel", "lines"),
    [
        ("two_channels.v2c", 1, 60),
        ("one_channel.v1c", None, 70),
        ("two_channels.v2", 1, 50),
        ("digital.v1", None, 31),
        ("film.v1", 1, 30),
    ],
)
def test_fixed_format_cut_short_is_refused(
    written: Callable[..., Path], name: str, channel: int | None, lines: int
) -> None:
    text = (SAMPLES / name).read_text().split("\n")[:lines]
    assert "truncated" in refusal(written("\n".join(text)), channel=channel)


def test_knet_cut_short_is_refused(written: Callable[..., Path]) -> None:
    text = (SAMPLES / "station.EW").read_text().split("\n")[:26]
    assert "it is truncated" in refusal(written("\n".join(text)))


def test_field_of_stars_is_explained(written: Callable[..., Path]) -> None:
    lines = (SAMPLES / "digital.v1").read_text().split("\n")
    lines[29] = "*********" + lines[29][9:]
    message = refusal(written("\n".join(lines)))
    assert "record.txt:30: ********* marks a number too large" in message


def test_channel_must_be_chosen_and_must_exist() -> None:
    assert "holds 2 channels: 1 (90 deg), 2 (360 deg)" in refusal(SAMPLES / "two_channels.v2c")
    assert "no channel fit '7'" in refusal(SAMPLES / "two_channels.v2", channel=7)
    assert "2 channels fit 'deg'" in refusal(SAMPLES / "two_channels.v2c", channel="deg")
    assert "one component" in refusal(SAMPLES / "named_header.at2", channel="Up")


@pytest.mark.parametrize(
    ("header", "scale", "likely"),
    [
        ("time,acc_g", 300.0, "cm/s2"),
        ("time,acc_g", 9.0, "m/s2"),
        ("time,acc (m/s2)", 300.0, "cm/s2"),
        ("time,acc_g", 2000.0, "cm/s2 or mm/s2"),
    ],
)
def test_pga_above_5_g_is_refused_naming_the_likely_unit(
    written: Callable[..., Path], header: str, scale: float, likely: str
) -> None:
    rows = "".join(f"{k * 0.01:.2f},{scale * np.sin(k / 5):.4f}\n" for k in range(200))
    message = refusal(written(header + "\n" + rows))
    assert "above 5 g" in message
    assert f"probably in {likely}" in message


def test_very_small_pga_is_read_with_a_warning(written: Callable[..., Path]) -> None:
    rows = "".join(f"{k * 0.01:.2f},{0.3 * np.sin(k / 5):.4f}\n" for k in range(200))
    motion = ground_motion.read(written("time,acc (mm/s2)\n" + rows))
    assert "very small" in motion.details["warning"]
    assert "g" in motion.details["warning"]
    assert "warning" not in ground_motion.read(SAMPLES / "comma.csv").details


def test_unknown_unit_is_asked_for_and_contradiction_refused() -> None:
    assert "does not state the unit" in refusal(SAMPLES / "blanks_no_unit.txt")
    assert "'parsec' is not a unit" in refusal(SAMPLES / "comma.csv", units="parsec")
    assert "the file says g" in refusal(SAMPLES / "comma.csv", units="m/s2")
    assert "the file says g" in refusal(SAMPLES / "named_header.at2", units="gal")


def test_wrong_format_is_refused_saying_what_the_content_looks_like() -> None:
    assert "is not a format" in refusal(SAMPLES / "comma.csv", format="mseed")
    assert "not a PEER AT2 file" in refusal(SAMPLES / "comma.csv", format="at2")
    assert "not a K-NET file" in refusal(SAMPLES / "comma.csv", format="knet")
    message = refusal(SAMPLES / "two_channels.v2c", format="cosmos-v1", channel=1)
    assert "looks like cosmos-v2" in message
    assert "looks like csmip-v1" in refusal(SAMPLES / "film.v1", format="csmip-v2", channel=1)


def test_velocity_spectra_and_raw_counts_are_refused(written: Callable[..., Path]) -> None:
    at2 = (SAMPLES / "named_header.at2").read_text()
    velocity = at2.replace("ACCELERATION TIME HISTORY IN UNITS OF G", "VELOCITY TIME HISTORY")
    assert "velocity" in refusal(written(velocity))
    cosmos = (SAMPLES / "one_channel.v1c").read_text()
    raw = cosmos.replace("Uncorrected acceleration ", "Raw acceleration counts  ")
    assert "raw counts" in refusal(written(raw))
    counts = cosmos.replace("units=g(02)", "units=counts(50)")
    assert "not a known unit of acceleration" in refusal(written(counts))
    assert "disagree" in refusal(written(cosmos.replace("units=g(02)", "units=g(04)")))
    only_velocity = cosmos.replace("401 acceleration pts", "401 velocity pts")
    assert "holds no acceleration" in refusal(written(only_velocity))
    assert "Volume 3" in refusal(written("Response and Fourier Amplitude Spectra\n1 2 3\n"))


def test_cosmos_interval_that_contradicts_the_stated_length_is_refused(
    written: Callable[..., Path],
) -> None:
    text = (SAMPLES / "one_channel.v1c").read_text()
    message = refusal(written(text.replace("       5.000000", "      50.000000")))
    assert "points times interval give 20.05 s, but the line says about 2 s" in message


def test_unevenly_digitised_film_points_to_the_volume_2(written: Callable[..., Path]) -> None:
    text = (SAMPLES / "film.v1").read_text().replace("   .050  1.253", "   .053  1.253")
    message = refusal(written(text), channel=1)
    assert "Volume 2" in message
    assert "record.txt:30: " in message


@pytest.mark.parametrize("dt_s", [1e-6, 5.0])
def test_absurd_interval_is_refused(written: Callable[..., Path], dt_s: float) -> None:
    rows = "".join(f"{k * dt_s:.9f} 0.1\n" for k in range(50))
    assert "sampling interval" in refusal(written("# time_s acc_g\n" + rows))


def test_record_of_many_hours_is_refused(written: Callable[..., Path]) -> None:
    rows = "".join(f"{k} 0.1\n" for k in range(4000))
    assert "at most 3600 s" in refusal(written("# time_s acc_g\n" + rows))


# --- anything at all -----------------------------------------------------------------------------


def read_or_refuse(path: Path, content: bytes, channel: int | None = None) -> None:
    """Read a file; anything but a motion or an `InputError` fails the test."""
    path.write_bytes(content)
    try:
        motion = ground_motion.read(path, channel=channel)
    except InputError:
        return
    assert np.isfinite(motion.acceleration_mps2).all()
    assert motion.pga_g <= 5.0


anything = settings(
    max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


HEADER_WORDS = [
    "NPTS=",
    "DT=",
    "0",
    "-1",
    "999999999",
    "99999999999999999999",
    ".0",
    "1e999",
    "nan",
    "points",
    "of",
    "accel",
    "data",
    "equally",
    "spaced",
    "at",
    "sec,",
    "in",
    "cm/sec2.",
    "(8f10.6)",
    "(0f0.0)",
    "(1F15.6E)",
    "units=g(02),",
    "Format=",
    "3920(gal)/0",
    "0Hz",
    "Chan",
    "1:",
    "Memo.",
    "acceleration",
    "pts,",
    "Real-header",
    "values",
    "follow",
]


@anything
@given(content=st.binary(max_size=300))
def test_any_bytes_are_a_motion_or_a_clear_refusal(tmp_path: Path, content: bytes) -> None:
    read_or_refuse(tmp_path / "f", content)


@anything
@given(content=st.text(st.sampled_from("0123456789.,;eE+-_ \tnaif\n#gt²١\u2028\x0c"), max_size=200))
def test_any_table_like_text_is_a_motion_or_a_clear_refusal(tmp_path: Path, content: str) -> None:
    read_or_refuse(tmp_path / "f", ("time_s acc_g\n" + content).encode())


@anything
@given(
    name=st.sampled_from(sorted(p.name for p in SAMPLES.iterdir())),
    cuts=st.lists(
        st.tuples(st.floats(0, 1), st.integers(0, 60), st.binary(max_size=12)), max_size=4
    ),
    channel=st.sampled_from([None, 1]),
)
def test_damaged_files_are_a_motion_or_a_clear_refusal(
    tmp_path: Path, name: str, cuts: list[tuple[float, int, bytes]], channel: int | None
) -> None:
    content = (SAMPLES / name).read_bytes()
    for place, length, patch in cuts:
        at = int(place * len(content))
        content = content[:at] + patch + content[at + length :]
    read_or_refuse(tmp_path / "f", content, channel)


@anything
@given(
    name=st.sampled_from(sorted(p.name for p in SAMPLES.iterdir())),
    line=st.integers(0, 60),
    words=st.lists(
        st.sampled_from(HEADER_WORDS),
        max_size=12,
    ),
)
def test_absurd_headers_are_a_motion_or_a_clear_refusal(
    tmp_path: Path, name: str, line: int, words: list[str]
) -> None:
    lines = (SAMPLES / name).read_bytes().split(b"\n")
    lines[line % len(lines)] = " ".join(words).encode()
    read_or_refuse(tmp_path / "f", b"\n".join(lines), 1)


@pytest.mark.parametrize(
    "content",
    [
        b"1" * 2_000_000,
        b" " * 2_000_000 + b"1 points",
        b"NPTS" + b" " * 2_000_000 + b"DT",
        b"1 " * 1_000_000,
        b"1\n" * 300_000,
        b"NPTS= 4, DT= .01\n" + b"-" * 2_000_000,
        b"NPTS= 4, DT= .01\n" + b"1.5-" * 500_000,
        b"NPTS= 999999999, DT= .01\n1 2 3\n",
        b"Origin Time\n" * 100_000,
        b"Corrected accelerogram\n" + b" 9 points of accel data" * 100_000,
        b"(" * 1_000_000,
        b"Chan " * 400_000,
    ],
)
def test_large_and_repetitive_content_is_refused(tmp_path: Path, content: bytes) -> None:
    read_or_refuse(tmp_path / "f", content)


# --- provenance ----------------------------------------------------------------------------------


def test_header_of_the_built_in_record_is_told_in_whole_sentences() -> None:
    header = ground_motion.builtin("elcentro-1940-ns").details["header"]
    assert header.startswith("Ground acceleration, El Centro, California, component north-south, I")
    assert header.endswith("PGA 0.3188 g.")
    assert ";" not in header


def test_long_header_without_sentences_ends_with_dots(written: Callable[..., Path]) -> None:
    header = "# station one\n# channel two" + " record" * 60
    motion = ground_motion.read(written(f"{header}\ntime_s,acc_g\n0,0.1\n0.01,-0.2\n0.02,0\n"))
    assert 290 < len(motion.details["header"]) <= 300
    assert motion.details["header"].startswith("station one; channel two record ")
    assert motion.details["header"].endswith(" record …")
