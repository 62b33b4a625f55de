"""A sweep: a campaign given by arguments, whose files are written to its own folder."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rthyb_rt import config
from rthyb_rt.campaign import plan
from rthyb_rt.campaign.book import GIVEN, PLAN
from rthyb_rt.config import AxesRig, RigFile, TestFile
from rthyb_rt.config.campaignfile import CAMPAIGN_SCHEMA, CampaignFile
from rthyb_rt.errors import InputError
from rthyb_rt.record.recording import replacing

TEST, RIG, CAMPAIGN = "test.toml", "rig.toml", "campaign.toml"
"""Files of a sweep."""


def texts(
    test: TestFile, rig: RigFile | AxesRig, values: dict[str, Any], called: str
) -> tuple[CampaignFile, dict[str, str]]:
    """Return the campaign, and the files of a sweep by name: test, rig, campaign.

    Args:
        test, rig: the files that are varied.
        values: tables of the campaign file; ``campaign.test`` and ``campaign.rig`` are filled in.
        called: prefix of the keys in messages.

    Raises:
        InputError: with the errors in the values.
    """
    tables = {key: value for key, value in values.items() if value not in ({}, [])}
    about = {**tables["campaign"], "test": TEST}
    campaign = config.check_values(CampaignFile, {**tables, "campaign": about}, called)
    parts = {TEST: config.dump(test)}
    if "rig" not in campaign.over:
        # What reads the sweep's files tells what the rig omits.
        parts[RIG] = config.dump_given(rig)
        about["rig"] = RIG
    tables["campaign"] = about
    parts[CAMPAIGN] = config.dump_values({"schema": CAMPAIGN_SCHEMA, **tables})
    return campaign, parts


def plan_of(folder: Path, parts: Mapping[str, str]) -> plan.Plan:
    """Write the input files of the runs to the folder of the sweep, and return the runs.

    Raises:
        InputError: the folder contains another sweep, or the first run has an error.
        RthybError: it cannot be written.
    """
    given = folder / GIVEN
    if folder.is_dir() and any(folder.iterdir()) and not given.is_dir():
        raise InputError(
            "is not empty and does not hold a sweep; choose another folder with --out", str(folder)
        )
    for name, text in parts.items():
        path = given / name
        if path.exists() and path.read_text(encoding="utf-8") == text:
            continue
        # Before there is a plan, no run has been done, and the arguments may be corrected.
        if (folder / PLAN).exists():
            raise InputError(
                "holds a sweep of another test or rig or with other values, whose runs cannot be "
                "mixed with new ones; choose another folder with --out, or delete this one",
                str(folder),
            )
        with replacing(path) as temporary:
            temporary.write_text(text, encoding="utf-8")
    path = given / CAMPAIGN
    campaign = config.parse_campaign(config.read_text(path, "campaign"), str(path))
    return plan.of(campaign, path)
