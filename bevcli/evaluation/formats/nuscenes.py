"""nuScenes submissions for detection and tracking."""

from bevcli.evaluation.box_format import BoxFormat
from bevcli.evaluation.submission import write_submission

DETECTION = BoxFormat("results_nusc.json", lambda boxes, target, *_: f"{write_submission(boxes, target)} samples")
TRACKING = BoxFormat(
    "tracking_nusc.json", lambda boxes, target, *_: f"{write_submission(boxes, target, tracking=True)} samples"
)
