"""A boxes file, as predictions.json."""

from bevcli.evaluation.box_format import BoxFormat
from bevcli.printing import counted
from bevcli.sequences.files.boxes_file import write_boxes

FORMAT = BoxFormat("boxes.json", lambda boxes, target, *_: counted(write_boxes(boxes, target), "boxes"))
