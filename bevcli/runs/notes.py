"""Notes on a run and on its frames, for the user."""

from bevcli.frame import Frame, Prediction, Sequence, StartReason
from bevcli.inference.load import Model


def run_notes(model: Model, drive: Sequence, *, live: bool = False) -> list[str]:
    """Notes on a model and a drive before the run starts. live: whether a viewer follows the run."""
    found = list(drive.notes)
    if model.untrained:
        found.append("the weights are UNTRAINED: random weights, the boxes are meaningless")
    if model.is_exported:
        found.append("an exported file shows no attention: the recording has no history map, pillars and probes")
    if model.left_out:
        found.append(f"{model.weights}: left out {model.left_out}, which only training uses")
    if model.not_read:
        found.append(f"{model.weights}: objects that were not read, and not run: {', '.join(model.not_read)}")
    later = model.config.later_frames
    if live and later:
        found.append(f"model {model.name} looks ahead: the viewer shows a frame when {later} more are read")
    found += model.rig_notes(drive.rig)
    if model.bundled:
        found.append("these weights were trained on rendered streets, not on the real world (docs/model-card.md)")
    return found


def frame_warnings(frame: Frame, prediction: Prediction) -> list[str]:
    """Warnings on missing images, results that are not finite, and gaps in time; the recording logs its own events."""
    where = f"frame {frame.stamp.index}"
    found = [f"{where}: camera {camera} has no image: {why}" for camera, why in frame.dropped.items()]
    if prediction.skipped:
        found.append(f"{where}: no camera has an image; the state is passed on to the next frame")
    if prediction.not_finite:
        found.append(f"{where}: NaN or infinity in {prediction.not_finite}; no boxes, the history starts anew")
    if prediction.started_anew and prediction.started_anew.reason is StartReason.GAP:
        found.append(f"{where}: {prediction.started_anew}; the history starts anew")
    return found
