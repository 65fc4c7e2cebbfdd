"""A CSV table."""

from bevcli.evaluation.box_format import BoxFormat
from bevcli.evaluation.boxes_csv import write_csv

FORMAT = BoxFormat("boxes.csv", lambda boxes, target, *_: f"{write_csv(boxes, target)} boxes")
