"""A column of boxes is stated once: an imaginary one is in files, tables, scores and recordings at once."""

import subprocess
import sys
from pathlib import Path

import bevcli.geometry.boxes

NEW = '    lanes: Annotated[NDArray[np.int64] | None, Column("lane", "count", recorded="lane")] = None\n'
BEFORE = "    futures: Array | None = None\n"
LIKE_INSTALLED = """
import importlib.util, sys
spec = importlib.util.spec_from_file_location("bevcli.geometry.boxes", sys.argv[1])
sys.modules[spec.name] = module = importlib.util.module_from_spec(spec)
spec.loader.exec_module(module)

from dataclasses import replace
from pathlib import Path
import numpy as np
from bevcli.sequences.files.boxes_table import write_csv
from bevcli.workshop.scores.detection import with_all_columns
from bevcli.recording.writer import Recording
from bevcli.sequences.files.boxes_file import BoxesFile, FrameBoxes, read_boxes, write_boxes
from bevcli.viewer.recording_reader import read_recording
sys.path.insert(0, sys.argv[3])
from memory_drive import MemoryDrive
from recorded_drive import NamedModel, boxes_ahead, predict

folder, drive = Path(sys.argv[2]), MemoryDrive(1)
boxes, frame = replace(boxes_ahead()[:2], lanes=np.array([7, -1])), drive.load(0)
assert boxes.to_dict()["lane"] == [7, -1]
assert with_all_columns(boxes_ahead()).lanes.tolist() == [-1] * len(boxes_ahead())
file = BoxesFile("world", (FrameBoxes(frame.stamp, frame.world_from_ego, boxes),))
write_boxes(file, folder / "boxes.json")
assert read_boxes(folder / "boxes.json").frames[0].boxes.lanes.tolist() == [7, -1]
write_csv(file, folder / "boxes.csv")
assert [line.rpartition(",")[2] for line in (folder / "boxes.csv").read_text().split()] == ["lane", "7", ""]
with Recording(folder / "r.rrd", drive, NamedModel()) as recording:
    recording.log(frame, replace(predict(frame), boxes=boxes))
assert sorted(read_recording(folder / "r.rrd").frames[0].boxes.lanes.tolist()) == [-1, 7]
"""


def test_a_new_column_is_one_line(tmp_path):
    source = Path(bevcli.geometry.boxes.__file__).read_text()
    assert source.count(BEFORE) == 1
    changed = tmp_path / "boxes.py"
    changed.write_text(source.replace(BEFORE, NEW + BEFORE))
    tests = Path(__file__).parents[1]
    done = subprocess.run(
        [sys.executable, "-c", LIKE_INSTALLED, changed, tmp_path, tests], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
