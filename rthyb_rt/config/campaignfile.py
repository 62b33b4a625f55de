"""The campaign file: one test over lists, grids, seeds and randomly drawn plants."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import Field, PlainValidator

from rthyb_rt.config.fields import (
    SLUG,
    SOME_TEXT,
    Alternatives,
    Condition,
    Count,
    Range,
    Table,
    WholeFile,
    explained,
    written,
)

CAMPAIGN_SCHEMA = "rthyb-campaign/1"
MOST_RUNS = 1_000_000

Scalar = str | bool | int | float
Values = tuple[Scalar, ...]


def _values(given: object) -> Values:
    """Return the values of one key; raise an explained error if it is not a list of values."""
    found = given if isinstance(given, list) else [given]
    if not found:
        raise explained("found an empty list; give at least one value")
    for value in found:
        if not isinstance(value, (str, bool, int, float)):
            raise explained(
                f"found {written(value)}; each value must be a string, a number, true or false"
            )
        if isinstance(value, float) and not math.isfinite(value):
            raise explained(f"found {value}; each number must be finite")
    if len({(type(value), value) for value in found}) < len(found):
        raise explained(f"found {written(found)}; a value occurs in it twice")
    return tuple(found)


Listed = Annotated[Values, PlainValidator(_values)]


class What(Table):
    """The test that the campaign varies, and the runs whose recordings are kept."""

    name: Annotated[str, SLUG]
    test: Annotated[str, SOME_TEXT] | None = None
    rig: Annotated[str, SOME_TEXT] | None = None
    keep: Literal["nothing", "tripped", "all"] = "tripped"


class Spread(Table):
    """Distribution of a drawn value: factors by which the file's value is multiplied."""

    std: Annotated[float, Range("", 0.0, 1.0, "a standard deviation", open_low=True)] | None = None
    low: Annotated[float, Range("", 0.0, 1e3, "the smallest factor", open_low=True)] | None = None
    high: Annotated[float, Range("", 0.0, 1e3, "the largest factor", open_low=True)] | None = None

    choices = (
        Alternatives(("std", "low"), required=True),
        Alternatives(("std", "high"), required=True),
    )
    checks = (
        Condition(
            "high",
            ("low", "high"),
            lambda low, high: (
                None
                if low is None or high is None or low < high
                else f"found low = {low:g}, high = {high:g}; high must be above low"
            ),
        ),
    )

    @classmethod
    def expand(cls, data: Any) -> Any:
        """Accept a plain number as the standard deviation."""
        return {"std": data} if isinstance(data, (int, float)) else data


class Draws(Table):
    """Plants drawn around that of the file, all keys at once."""

    count: Annotated[int, Count(1, 100_000, "the number of plants")]
    seed: Annotated[int, Count(0, 2**32 - 1, "the seed of the draws")] = 0
    nominal: bool = True
    spread: dict[str, Spread] = Field(min_length=1)


class Benchmark(Table):
    """A published benchmark instead of a test: it determines its tests and rigs itself."""

    name: Literal["rths"]
    plants: Annotated[
        int, Count(0, 20, "the number of perturbed plants, in addition to the nominal one")
    ] = 20
    width: Annotated[
        float, Range("", 0.0, 10.0, "the spread of the perturbed plants", open_low=True)
    ] = 1.0
    yielding: bool = False
    noise: Annotated[float, Range("", 0.0, 10.0, "the size of the sensors' noise")] = 1.0


BENCHMARK_KEYS: Final = ("rate_hz", "motion", "law", "structure")
"""What a benchmark can be varied over; a key that is not given means all its values. What the
benchmark calls a case is called a structure, because in a campaign "case" has another meaning."""


class CampaignFile(WholeFile):
    """A campaign: the keys that are varied, and their values."""

    schema_: Literal["rthyb-campaign/1"] = Field(alias="schema")
    campaign: What
    over: dict[str, Listed] = Field(default_factory=dict)
    together: list[dict[str, Listed]] = Field(default_factory=list)
    noise_seeds: Annotated[int, Count(1, 100_000, "the number of repetitions of each run")] = 1
    draws: Draws | None = None
    benchmark: Benchmark | None = None

    @classmethod
    def further_faults(
        cls, keys: dict[str, Any]
    ) -> Iterator[tuple[tuple[str, ...], str, tuple[str, ...]]]:
        """Reject lists of different length, keys named twice, and keys that no benchmark has."""
        if keys.get("benchmark") is not None:
            yield from _foreign_to_benchmark(keys)
        seen: dict[str, str] = {}
        over = keys.get("over")
        for key in over if isinstance(over, dict) else ():
            seen[key] = "over"
        tables = keys.get("together")
        for number, table in enumerate(tables if isinstance(tables, list) else ()):
            if not isinstance(table, dict):
                continue
            lengths = {k: len(v) if isinstance(v, list) else 1 for k, v in table.items()}
            if len(set(lengths.values())) > 1:
                listed = ", ".join(f"{key}: {length}" for key, length in lengths.items())
                yield (
                    ("together",),
                    f"table {number + 1} has lists of different length ({listed}); lists that vary "
                    "together must have the same length",
                    (),
                )
            for key in table:
                if key in seen:
                    yield (
                        ("together",),
                        f"{key} is varied in [[together]], but is already in [{seen[key]}]; "
                        "remove one of the two",
                        (),
                    )
                seen.setdefault(key, "[together]")


def _foreign_to_benchmark(
    keys: dict[str, Any],
) -> Iterator[tuple[tuple[str, ...], str, tuple[str, ...]]]:
    """Reject tests, rigs and plants in a campaign of a benchmark, which has its own."""
    own = "a benchmark has its own tests, rigs and plants; leave this out, or leave out [benchmark]"
    for key in ("together", "draws"):
        if keys.get(key):
            yield (key,), own, ()
    if keys.get("noise_seeds", 1) != 1:
        yield ("noise_seeds",), own, ()
    campaign, over = (keys.get(key) for key in ("campaign", "over"))
    for key in ("test", "rig"):
        if isinstance(campaign, dict) and key in campaign:
            yield ("campaign", key), own, ()
    for key in over if isinstance(over, dict) else ():
        if key not in BENCHMARK_KEYS:
            allowed = ", ".join(BENCHMARK_KEYS)
            yield ("over", key), f"is not a key of a benchmark; allowed are {allowed}", ()


def beside(path: Path, name: str) -> str:
    """Return the path of a file named in a campaign file: in the latter's folder, if it exists."""
    found = path.parent / name
    return str(found) if found.is_file() else name
