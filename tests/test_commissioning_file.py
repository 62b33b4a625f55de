"""The commissioning file: which rig it holds for, where it lies, what a test asks of it."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import pytest
from commissioning_bench import COLUMN, rig

from rthyb_rt import config
from rthyb_rt.errors import InputError
from rthyb_rt.lab.realtime import RefusedError
from rthyb_rt.rig.commissioning import certificate
from rthyb_rt.rig.commissioning.certificate import Certificate, CheckedStep

K_E = "elastic_stiffness_n_per_m = 5"
DATE = "2026-11-20T10:00:00+00:00"


@pytest.fixture(autouse=True)
def _state_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def rig_file(folder: Path, text: str = COLUMN, name: str = "column.toml") -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def certified(path: Path, date: str = DATE, passed: bool | None = True) -> Certificate:
    """Write a certificate with all steps for a rig file as it is."""
    given = config.load_rig(path)
    made = Certificate(given.rig.name, certificate.rig_hash(given), False, "a socket")
    for name in certificate.STEPS:
        made = made.with_step(CheckedStep(name, passed, date, {"figure": 1.5}, ()))
    certificate.write(certificate.place(path), made)
    return made


# ---- the hash -----------------------------------------------------------------------------------

SAME = [
    ("a comment", COLUMN + "\n# a remark\n"),
    ("another name", COLUMN.replace('name = "column"', 'name = "column-2"')),
    ("another k_e", COLUMN.replace("elastic_stiffness_n_per_m = 1", K_E)),
    ("another way to write it", COLUMN.replace('"10 mm"', '{ value = 0.01, action = "trip" }')),
    ("an identification", COLUMN + "\n[identified]\nalpha = 12\ndelay_s = 0.012\n"),
    ("another specimen", COLUMN.replace("k_n_per_m = 500000.0", "k_n_per_m = 1")),
]  # fmt: skip
OTHER = [
    ("another link", COLUMN.replace('"/nowhere"', '"/elsewhere"')),
    ("a virtual rig", COLUMN.replace("[link]", "[link]\nvirtual = true")),
    ("a turned load cell", COLUMN + "\n[calibration]\nforce = { polarity = -1 }\n"),
    ("a similitude", COLUMN + "\n[calibration]\nsimilitude = { length = 2 }\n"),
    ("another actuator", COLUMN.replace("delay_samples = 12", "delay_samples = 13")),
    ("another sensor", COLUMN.replace('"30 mm"', '"31 mm"')),
    ("another limit", COLUMN.replace('"8 kN"', '"9 kN"')),
    ("another action", COLUMN.replace('"8 kN"', '{ value = "8 kN", action = "hold" }')),
]


@pytest.mark.parametrize(("what", "text"), SAME, ids=[what for what, _ in SAME])
def test_change_that_turns_no_sign_and_moves_no_limit_needs_no_new_check(
    what: str, text: str
) -> None:
    assert text != COLUMN
    assert certificate.rig_hash(config.parse_rig(text)) == certificate.rig_hash(rig())


@pytest.mark.parametrize(("what", "text"), OTHER, ids=[what for what, _ in OTHER])
def test_change_of_what_matters_needs_a_new_check(what: str, text: str) -> None:
    assert text != COLUMN
    assert certificate.rig_hash(config.parse_rig(text)) != certificate.rig_hash(rig())


def test_content_of_a_dbc_file_counts_and_not_its_place(tmp_path: Path) -> None:
    pytest.importorskip("cantools")
    text = COLUMN.replace('kind = "socket"\nchannel = "/nowhere"', 'kind = "can"\nchannel = "can0"')
    text = text.replace("[link]\n", '[link]\ndbc = "rthyb.dbc"\n')
    dbc = (Path(__file__).parents[1] / "hw" / "rthyb.dbc").read_text(encoding="utf-8")
    hashes = []
    for name, content in (("a", dbc), ("b", dbc), ("c", dbc + "\n")):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "rthyb.dbc").write_text(content, encoding="utf-8")
        hashes.append(certificate.rig_hash(config.load_rig(rig_file(folder, text))))
    assert hashes[0] == hashes[1] != hashes[2]


# ---- the file -----------------------------------------------------------------------------------


def test_certificate_of_before_holds_for_a_rig_file_that_sets_nothing_new() -> None:
    """The hash of this very file by the program that first asked for one."""
    first = "7baf530102c4fa1e46bf1d49b7646e24d336b1d139c16a366f5afc5f489d2b47"
    assert certificate.rig_hash(rig()) == first


def test_certificate_reads_back_as_it_was_written(tmp_path: Path) -> None:
    path = rig_file(tmp_path)
    made = certified(path)
    place = tmp_path / "column.commissioned.json"
    assert certificate.place(path) == place
    assert certificate.read(place) == made
    document = json.loads(place.read_text(encoding="utf-8"))
    assert document["schema"] == "rthyb-commissioned/1"
    assert document["date"] == DATE
    assert list(document["steps"]) == list(certificate.STEPS)


def test_certificate_that_root_has_written_is_read_by_the_service(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Root's umask may be narrow; the service's user may not write beside the rig file."""
    before = os.umask(0o077)
    try:
        path = rig_file(tmp_path)
        certified(path)
    finally:
        os.umask(before)
    beside = tmp_path / "column.commissioned.json"
    assert beside.stat().st_mode & 0o777 == 0o644
    monkeypatch.setattr(certificate.os, "access", lambda *_: False)
    assert certificate.standing(config.load_rig(path), path).why_not == ""
    rig_file(tmp_path, COLUMN.replace('"8 kN"', '"9 kN"'))
    why_not = certificate.standing(config.load_rig(path), path).why_not
    assert "have changed since the rig was commissioned on 2026-11-20" in why_not


def test_certificate_of_a_shipped_rig_goes_to_the_users_state(tmp_path: Path) -> None:
    path = config.shipped_rig("shaking-table-can")
    place = tmp_path / "state" / "rthyb" / "shaking-table-can.commissioned.json"
    assert certificate.place(path) == place
    certified(path)
    assert certificate.find(config.load_rig(path), path)[0] is not None


def test_certificate_of_a_folder_that_may_not_be_written_goes_to_the_users_state(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = rig_file(tmp_path)
    monkeypatch.setattr(certificate.os, "access", lambda *_: False)
    assert certificate.place(path).parent == tmp_path / "state" / "rthyb"


@pytest.mark.parametrize(
    "damage",
    [
        "",
        "[]",
        "{}",
        '{"schema": "rthyb-commissioned/9"}',
        "broken {",
        '{"schema": "rthyb-commissioned/1", "rig_name": "a", "rig_hash": "b", "virtual": false, '
        '"link": "", "version": "", "steps": {"polarity": {"passed": true, "date": "yesterday", '
        '"figures": {}, "faults": []}}}',
        '{"schema": "rthyb-commissioned/1", "rig_name": "a", "rig_hash": "b", "virtual": false, '
        '"link": "", "version": "", "steps": {"luck": {"passed": true, "date": "2026-11-20", '
        '"figures": {}, "faults": []}}}',
    ],
)
def test_damaged_certificate_is_none(tmp_path: Path, damage: str) -> None:
    path = rig_file(tmp_path)
    certificate.place(path).write_text(damage, encoding="utf-8")
    with pytest.raises(
        InputError, match=r"column\.commissioned\.json: is not a commissioning file"
    ):
        certificate.demand(config.load_rig(path), path)


# ---- what a test asks ---------------------------------------------------------------------------


def demanded(path: Path) -> dict[str, Any]:
    facts: dict[str, Any] = certificate.demand(config.load_rig(path), path)["commissioning"]
    return facts


def test_rig_that_was_never_commissioned_is_refused(tmp_path: Path) -> None:
    path = rig_file(tmp_path)
    with pytest.raises(
        RefusedError, match="has not been commissioned: it has not been verified"
    ) as caught:
        demanded(path)
    assert caught.value.exit_code == 5
    assert f"`rthyb commission {path}`" in str(caught.value)


def test_commissioned_rig_brings_its_dates_into_the_recording(tmp_path: Path) -> None:
    path = rig_file(tmp_path)
    made = certified(path)
    assert demanded(path) == {
        "demanded": True,
        "virtual": False,
        "rig_hash": made.rig_hash,
        **dict.fromkeys(certificate.STEPS, DATE),
    }


def test_rig_file_that_changed_since_is_refused_with_the_date(tmp_path: Path) -> None:
    path = rig_file(tmp_path)
    certified(path)
    rig_file(tmp_path, COLUMN.replace('"8 kN"', '"9 kN"'))
    with pytest.raises(RefusedError, match=r"have changed since .* commissioned on 2026-11-20"):
        demanded(path)


@pytest.mark.parametrize("name", certificate.STEPS)
@pytest.mark.parametrize(
    ("passed", "told"), [(False, "FAILED"), (None, "could not be checked")], ids=str
)
def test_each_check_that_did_not_pass_is_refused_by_its_name(
    tmp_path: Path, name: str, passed: bool | None, told: str
) -> None:
    path = rig_file(tmp_path)
    made = certified(path)
    certificate.write(certificate.place(path), made.with_step(CheckedStep(name, passed, DATE)))
    with pytest.raises(RefusedError, match=f"has passed: {name} {told}; run ") as caught:
        demanded(path)
    assert f"`rthyb commission {path} --steps {name}`" in str(caught.value)


def test_test_on_a_real_link_is_refused_where_all_but_the_signs_failed(tmp_path: Path) -> None:
    path = rig_file(tmp_path)
    made = certified(path, passed=False).with_step(CheckedStep("polarity", True, DATE))
    certificate.write(certificate.place(path), made)
    told = "link FAILED, limits FAILED, watchdog FAILED, trip FAILED"
    with pytest.raises(RefusedError, match=told):
        demanded(path)


def test_old_certificate_is_read_and_names_the_checks_it_lacks(tmp_path: Path) -> None:
    """Of a version under which a passed polarity was enough."""
    path = rig_file(tmp_path)
    made = certified(path)
    old = dataclasses.replace(made, version="0.9.0", steps={"polarity": made.steps["polarity"]})
    certificate.write(certificate.place(path), old)
    assert certificate.read(certificate.place(path)) == old
    told = "link was not done, limits was not done, watchdog was not done, trip was not done"
    with pytest.raises(RefusedError, match=told):
        demanded(path)


def test_setting_on_the_command_line_counts_as_a_change(tmp_path: Path) -> None:
    path = rig_file(tmp_path)
    certified(path)
    turned = config.load_rig(path, {"calibration.force.polarity": "-1"})
    with pytest.raises(RefusedError):
        certificate.demand(turned, path)


@pytest.mark.parametrize(
    "text",
    [
        COLUMN.replace("[link]", "[link]\nvirtual = true"),
        COLUMN.replace('[link]\nkind = "socket"\nchannel = "/nowhere"\n', ""),
    ],
    ids=["link.virtual", "no link"],
)
def test_virtual_rig_needs_no_commissioning_and_is_marked(tmp_path: Path, text: str) -> None:
    facts = demanded(rig_file(tmp_path, text))
    assert (facts["demanded"], facts["virtual"], facts["polarity"]) == (False, True, "")


def test_identified_copy_of_a_rig_file_takes_the_certificate_with_it(tmp_path: Path) -> None:
    path = rig_file(tmp_path)
    certified(path)
    text = COLUMN + "\n[identified]\nalpha = 12\ndelay_s = 0.012\n"
    beside = rig_file(tmp_path, text, "identified.toml")
    assert demanded(beside)["polarity"] == DATE
    folder = tmp_path / "runs"
    folder.mkdir()
    elsewhere = rig_file(folder, text)
    with pytest.raises(RefusedError):
        demanded(elsewhere)
    certificate.carry(config.load_rig(path), path, elsewhere)
    assert demanded(elsewhere)["polarity"] == DATE
