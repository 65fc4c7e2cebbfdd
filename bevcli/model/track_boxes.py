"""The boxes of UniAD, with the identities that its tracks give them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from bevcli.geometry.boxes import Boxes3D
from bevcli.model.box_coding import boxes_of_codes
from bevcli.model.uniad import UniADConfig, UniADOutputs


def decode_tracks(outputs: UniADOutputs, config: UniADConfig) -> Boxes3D:
    """The boxes with the best scores, by falling score, bev frame: one for each query, of its best class.

    Boxes of tracks whose score is high enough have an identity in `instances` and their own score in `track_scores`.
    As in the released code, the other queries give boxes too: those that do not start a track, tracks with a miss,
    and the ego query. Boxes outside track_queries.center_range_m are left out.

    Returns:
        At most config.decoder.max_boxes boxes.
    """
    tracks = config.track_queries
    scores, best = outputs.scores.topk(min(config.decoder.max_boxes, len(outputs.scores)))
    labels = outputs.class_logits[-1, 0, best].argmax(-1)
    all_codes = outputs.box_codes[-1, 0, best].double()
    inside = (all_codes[:, [0, 1, 4]].abs() <= torch.tensor(tracks.center_range_m, device=scores.device)).all(-1)
    has_track = (outputs.ids[best] >= 0) & (scores >= tracks.keep_score)
    columns = (all_codes, scores.double(), labels, outputs.ids[best], has_track)
    codes, box_scores, classes, ids, followed = (column[inside].cpu().numpy() for column in columns)
    boxes = boxes_of_codes(codes, np.asarray(config.classes)[classes], box_scores)
    centers = boxes.centers
    if tracks.box_z == "bottom":
        centers = centers + boxes.sizes_lwh * (0, 0, 0.5)
    return replace(
        boxes,
        centers=centers,
        instances=np.where(followed, ids.astype("<U20"), ""),
        track_scores=np.where(followed, box_scores, np.nan),
        duplicates=np.zeros(len(boxes), dtype=bool),
    )
