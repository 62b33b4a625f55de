"""The mapping file of a recording, which assigns the columns of a table to channels."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from rthyb_rt.config.fields import SOME_TEXT, Sign, Table

MAP_SCHEMA = "rthyb-map/1"


class Column(Table):
    """A column of the table; ``"-LVDT 1 [mm]"`` is short for column, unit and sign."""

    column: Annotated[str, SOME_TEXT]
    unit: Annotated[str, SOME_TEXT] | None = None
    sign: Annotated[int, Sign("what the column is multiplied by")] | None = None

    @classmethod
    def expand(cls, data: Any) -> Any:
        """Accept a plain text for the column with its sign and unit."""
        return {"column": data} if isinstance(data, str) else data


class Channels(Table):
    """The channels, with the column of each."""

    t: Column | None = None
    ag: Column | None = None
    x_num: Column | None = None
    x_cmd: Column | None = None
    x_meas: Column | None = None
    f_meas: Column | None = None
    f_in: Column | None = None
    a_meas: Column | None = None
    fy_meas: Column | None = None


class MapFile(Table):
    """Columns of an external recording, by channel."""

    schema_: Literal["rthyb-map/1"] = Field(alias="schema")
    channels: Channels
