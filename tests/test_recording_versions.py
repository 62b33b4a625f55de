"""Recordings of every version of the record: read, reported, diagnosed and exported for ever."""

from __future__ import annotations

import dataclasses
import hashlib
import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from command_line import Rthyb
from hypothesis import given, settings
from hypothesis import strategies as st
from recording_data import recording as made_up
from scipy.io import loadmat

from rthyb_rt import core
from rthyb_rt.analysis import summary
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, realtime
from rthyb_rt.live.sources import PastSource
from rthyb_rt.record import mat_csv, recording
from rthyb_rt.record.recording import (
    UNITS,
    VERSION,
    VERSIONS,
    Field,
    RecordedTest,
    Version,
    read,
    write,
)
from rthyb_rt.report import render

STORED = Path(__file__).parent / "data" / "recordings"
FIRST = {"virtual": STORED / "version-1-virtual.h5", "stepped": STORED / "version-1-stepped.h5"}
"""Written by rthyb_rt 0.1.0: `rthyb run`, and `rthyb run --realtime --clock stepped`."""

of_version_1 = pytest.mark.parametrize("path", FIRST.values(), ids=FIRST)


def stored(path: Path) -> np.ndarray:
    """The rows as they stand in the file."""
    with h5py.File(path) as file:
        return np.asarray(file["samples"][()])


# ---- version 1 ----------------------------------------------------------------------------------


@of_version_1
def test_a_recording_of_version_1_has_todays_fields_with_its_own_numbers(path: Path) -> None:
    rec, rows = read(path), stored(path)
    assert rec.version == 1
    assert rec.meta["rthyb_version"] == "0.1.0"
    assert set(rec.samples.dtype.names or ()) == set(UNITS)
    for name in set(UNITS) & set(rows.dtype.names):
        np.testing.assert_array_equal(rec.samples[name], rows[name])
    np.testing.assert_array_equal(np.rint(rec.samples["x_read_m"] * 1e9), rows["x_raw"])
    np.testing.assert_array_equal(np.rint(rec.samples["f_read_n"] * 1e3), rows["f_raw"])
    assert np.abs(rec.samples["x_read_m"]).max() > 1e-3
    assert {name: rec.samples.dtype[name] for name in UNITS} == {
        name: core.RECORD_DTYPE[name] for name in UNITS
    }


@of_version_1
def test_a_reading_of_version_1_that_was_no_number_is_none(path: Path, tmp_path: Path) -> None:
    again = tmp_path / "recording.h5"
    again.write_bytes(path.read_bytes())
    rows = stored(path)
    rows["x_raw"][5], rows["f_raw"][6] = np.iinfo(np.int32).min, 1 - 2**31
    with h5py.File(again, "a") as file:
        file["samples"][...] = rows
    samples = read(again).samples
    assert np.flatnonzero(np.isnan(samples["x_read_m"])).tolist() == [5]
    assert samples["f_read_n"][6] == pytest.approx(-2147483.647)


@pytest.mark.long
@of_version_1
def test_a_recording_of_version_1_is_reported_and_shown(path: Path) -> None:
    rec = read(path)
    found = summary.summarize(rec)
    assert found.test_samples == {"virtual": 1536, "stepped": 1229}[found.clock]
    assert found.tracking_nrmse == pytest.approx(0.0062, abs=2e-4)
    assert "section5-t0.5" in render(rec)
    shown = PastSource(rec)
    assert shown.status()["test"] == "section5-t0.5"
    assert shown.history.rows(0, rec.samples.size)[0].size == rec.samples.size


@of_version_1
def test_a_recording_of_version_1_is_exported(path: Path, tmp_path: Path) -> None:
    rec, rows = read(path), stored(path)
    mat_csv.to_csv(rec, tmp_path / "full.csv", full=True)
    table = np.genfromtxt(tmp_path / "full.csv", delimiter=",", names=True)
    mat_csv.to_mat(rec, tmp_path / "recording.mat")
    mat = loadmat(tmp_path / "recording.mat", squeeze_me=True)
    for found in (table, mat):
        np.testing.assert_array_equal(found["f_meas_n"], rows["f_meas_n"])
        np.testing.assert_array_equal(found["x_read_m"], rec.samples["x_read_m"])
        np.testing.assert_array_equal(found["code"], rows["code"])


@of_version_1
def test_a_recording_of_version_1_is_diagnosed(path: Path, tmp_path: Path, rthyb: Rthyb) -> None:
    (tmp_path / "rig.toml").write_text(read(path).rig_toml, encoding="utf-8")
    answer = rthyb("diagnose", path, "--model", "rig.toml")
    assert answer.code == 0, answer.err
    assert "Nothing is missing" in answer.out


@of_version_1
def test_the_replay_of_version_1_names_the_program_that_replays_it(
    path: Path, rthyb: Rthyb
) -> None:
    answer = rthyb("replay", path)
    assert answer.code == 3
    assert answer.out == ""
    assert answer.err == (
        "rthyb: recording: recorded as version 1 by rthyb_rt 0.1.0; a bit-identical replay needs "
        "that version: pip install 'rthyb-rt==0.1.0'\n"
    )
    for replay in (realtime.replay, realtime.first_cause):
        with pytest.raises(InputError, match=r"rthyb-rt==0\.1\.0"):
            replay(read(path))


@of_version_1
def test_a_recording_of_version_1_that_is_written_again_is_still_one(
    path: Path, tmp_path: Path
) -> None:
    rec = read(path)
    write(tmp_path / "recording.h5", rec)
    again = read(tmp_path / "recording.h5")
    assert (again.version, again.meta) == (1, rec.meta)
    assert again.samples.tobytes() == rec.samples.tobytes()


# ---- what recorded it ---------------------------------------------------------------------------


def test_a_build_of_the_core_is_told_by_its_sources() -> None:
    folder = Path(__file__).parents[1] / "csrc"
    lines = "".join(
        f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n"
        for path in sorted(folder.iterdir())
        if path.suffix in (".c", ".h")
    )
    assert core.build_facts()["core_sources"] == hashlib.sha256(lines.encode()).hexdigest()


def test_a_replay_is_by_the_same_build_or_by_another_one() -> None:
    rec = made_up(0.25)
    rec.meta |= core.build_facts()
    assert experiment.compare(rec, rec.samples).same_build
    for fact in ("core_sources", "compiler", "architecture"):
        other = dataclasses.replace(rec, meta=rec.meta | {fact: "another"})
        assert not experiment.compare(other, rec.samples).same_build
    # A commit says nothing of what the core was made of.
    elsewhere = dataclasses.replace(rec, meta=rec.meta | {"git_hash": "another"})
    assert experiment.compare(elsewhere, rec.samples).same_build


# ---- the table of versions ----------------------------------------------------------------------


def test_the_table_of_versions_ends_with_the_cores_own_record() -> None:
    assert sorted(VERSIONS) == list(range(1, VERSION + 1))
    fields = recording.fields_of(VERSION)
    assert set(fields) == set(core.RECORD_DTYPE.names or ())
    for name, field in fields.items():
        assert core.RECORD_DTYPE[name] == np.dtype(field.type)
    assert sum(core.RECORD_DTYPE[name].itemsize for name in fields) == core.RECORD_DTYPE.itemsize


def test_a_field_more_is_a_row_in_the_table(monkeypatch: pytest.MonkeyPatch) -> None:
    speed = Field("<f8", "m/s", lambda rows: np.gradient(rows["x_read_m"]))
    more = VERSIONS | {VERSION + 1: Version("9.0.0", {"v_mps": speed})}
    before = {name: read(path) for name, path in FIRST.items()}
    monkeypatch.setattr(recording, "VERSIONS", more)
    monkeypatch.setattr(recording, "VERSION", VERSION + 1)
    for name, path in FIRST.items():
        rec = read(path)
        assert rec.samples.dtype.names == (*(before[name].samples.dtype.names or ()), "v_mps")
        np.testing.assert_array_equal(
            rec.samples["v_mps"], np.gradient(before[name].samples["x_read_m"])
        )


@pytest.mark.parametrize("number", ["0", "-1", "two", "1.5", ""])
def test_a_version_that_never_was_is_refused(number: str, tmp_path: Path) -> None:
    write(tmp_path / "recording.h5", made_up(0.25))
    with h5py.File(tmp_path / "recording.h5", "a") as file:
        file.attrs["schema"] = f"rthyb-recording/{number}"
    with pytest.raises(InputError, match="use the version of rthyb_rt that wrote the file"):
        read(tmp_path / "recording.h5")


def test_a_file_says_what_its_numbers_mean(tmp_path: Path) -> None:
    write(tmp_path / "recording.h5", made_up(0.25))
    with h5py.File(tmp_path / "recording.h5") as file:
        said = {name: recording.plain(v) for name, v in file["samples"].attrs.items()}
    assert said["units"]["x_read_m"] == "m"
    assert said["status"] == core.STATUS
    assert said["flags"] == core.FLAGS
    assert tuple(said["states"]) == core.STATES
    assert tuple(said["commands"]) == core.COMMANDS
    assert tuple(said["causes"]) == core.CAUSES


# ---- there and back -----------------------------------------------------------------------------


def content(path: Path) -> dict[str, Any]:
    """All that is in a file: bytes of the data, attributes."""
    found: dict[str, Any] = {}

    def note(name: str, item: Any) -> None:
        found.update({f"{name}@{key}": plain(value) for key, value in item.attrs.items()})
        if isinstance(item, h5py.Dataset):
            value = item[()]
            found[name] = value if isinstance(value, bytes) else (value.dtype, value.tobytes())

    def plain(value: Any) -> Any:
        return value.tobytes() if isinstance(value, np.generic) else value

    with h5py.File(path) as file:
        note("", file)
        file.visititems(note)
    return found


texts = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=30)
plain_values = st.none() | st.booleans() | st.integers(-(2**60), 2**60) | st.floats(allow_nan=False)
values = st.recursive(
    plain_values | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=6,
)
keys = st.from_regex(r"[a-z_]{1,12}", fullmatch=True).filter(
    lambda key: key not in ("schema", "converted_from")
)


@pytest.mark.long
@given(
    count=st.integers(0, 300),
    seed=st.integers(0, 2**32 - 1),
    meta=st.dictionaries(keys, values, max_size=4),
    parameters=st.lists(st.dictionaries(texts, values, max_size=3), max_size=3),
    codec=st.binary(max_size=40),
    toml=texts,
    reference=st.booleans(),
)
@settings(max_examples=80, deadline=None)
def test_what_was_read_is_written_as_it_was(
    tmp_path_factory: pytest.TempPathFactory,
    count: int,
    seed: int,
    meta: dict[str, Any],
    parameters: list[dict[str, Any]],
    codec: bytes,
    toml: str,
    reference: bool,
) -> None:
    rng = np.random.default_rng(seed)
    rows = np.frombuffer(rng.bytes(count * core.RECORD_DTYPE.itemsize), core.RECORD_DTYPE)
    rec = made_up(0.25, reference=reference)
    replay = dataclasses.replace(rec.replay, parameters=parameters, codec=codec)
    rec = dataclasses.replace(rec, samples=rows, meta=meta, replay=replay, test_toml=toml)
    folder = tmp_path_factory.mktemp("round")
    write(folder / "first.h5", rec)
    back = read(folder / "first.h5")
    assert back.samples.tobytes() == rows.tobytes()
    write(folder / "second.h5", back)
    assert content(folder / "first.h5") == content(folder / "second.h5")


def with_a_field_more(rec: RecordedTest) -> RecordedTest:
    """As a lab might that adds a channel of its own, in front of the others."""
    dtype = [("temperature_k", "<f4"), *rec.samples.dtype.descr]
    rows = np.zeros(rec.samples.size, dtype=dtype)
    for name in rec.samples.dtype.names or ():
        rows[name] = rec.samples[name]
    rows["temperature_k"] = 293.0
    return dataclasses.replace(rec, samples=rows)


def test_a_field_that_nobody_knows_is_kept_and_does_no_harm(tmp_path: Path) -> None:
    rec = made_up(2.0)
    write(tmp_path / "recording.h5", with_a_field_more(rec))
    back = read(tmp_path / "recording.h5")
    assert set(back.samples["temperature_k"]) == {293.0}
    assert summary.summarize(back).as_json() == summary.summarize(rec).as_json()
    mat_csv.to_csv(back, tmp_path / "full.csv", full=True)
    assert re.match(r"t_s,temperature_k,tick,", (tmp_path / "full.csv").read_text())
