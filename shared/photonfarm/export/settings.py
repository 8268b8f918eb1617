"""What is asked of an export."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field

from photonfarm.core.models import Frozen
from photonfarm.plan.hold_out import HOLD_OUT

FormatName = Literal["webdataset", "exr", "npz", "parquet"]
Extra = Literal["points", "photons", "visibility"]


class ExportSettings(Frozen):
    """What every sample of an export holds, and in which files: the same for all of a folder's."""

    to: FormatName
    buffers: tuple[str, ...]  # names of buffers and guides
    extras: tuple[Extra, ...] = ()  # what is exported only where it is asked for
    samples_per_file: Annotated[int, Field(ge=1)]
    hold_out: Annotated[float, Field(gt=0, lt=1)]  # the share of configurations labelled as held out


@dataclass(frozen=True, slots=True)
class ExportRequest:
    """What a user asks to be exported."""

    to: FormatName
    split: Literal["all", "train", "held-out"] = "all"
    rows: str = ""  # such as 0-31,40; "": all
    buffers: str = "all"
    extras: tuple[Extra, ...] = ()
    samples_per_file: int | None = None  # None: as many as the format has, or as make 128 MB
    hold_out: float = HOLD_OUT
