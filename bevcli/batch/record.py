"""drive.json: the record of a drive that is done or has failed, read as a file that may be damaged."""

from typing import Annotated, NotRequired, TypedDict

import msgspec
from msgspec import Meta

from bevcli.batch.job import SCORE_BINS, Record

RECORD = "drive.json"  # in the folder of a drive's results: its record. A folder with it is whole.
_Count = Annotated[int, Meta(ge=0, le=1 << 62)]
_Number = Annotated[float, Meta(ge=-1e12, le=1e12)]


class _Failed(TypedDict):
    drive: str
    source: str
    scene: str | None
    result: str
    attempts: _Count
    error: Annotated[str, Meta(min_length=1)]


class _Scores(TypedDict):
    ground_truth_boxes: _Count


class _Done(TypedDict):
    drive: str
    source: str
    scene: str | None
    result: str
    attempts: _Count
    error: Annotated[str, Meta(max_length=0)]
    frames: _Count
    boxes: _Count
    boxes_by_class: dict[str, _Count]
    tracks: _Count | None
    dropped_images: _Count
    skipped_frames: _Count
    not_finite_frames: _Count
    seconds: _Number
    frames_per_second: _Number
    fetch_seconds: _Number
    output_bytes: _Count
    score_histogram: Annotated[list[_Count], Meta(min_length=SCORE_BINS, max_length=SCORE_BINS)]
    scores: dict[str, _Number | None] | None
    not_scored: str
    input_errors: NotRequired[str]


def read_record(content: bytes | None, result: str) -> Record | None:
    """A stored record; None if there is none, or it is broken: its drive is then run again.

    result: name of the folder of the drive's results.
    """
    try:
        record: Record = msgspec.json.decode(content or b"")
        msgspec.convert(record, _Failed if record["error"] else _Done)
        if record.get("scores"):
            msgspec.convert(record["scores"], _Scores)
    except (msgspec.MsgspecError, LookupError, TypeError, ValueError, RecursionError):
        return None
    return record if record["result"] == result else None
