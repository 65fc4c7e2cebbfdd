"""What `bevcli bench` needs of a BEVFormerV2: the operations of a frame, and a window that is full."""

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from bevcli.frame import FrameStamp
from bevcli.geometry.transforms import Pose
from bevcli.model.bevformer_v2.bevformer_v2 import BEVFormerV2
from bevcli.model.bevformer_v2.window import FeatureWindow
from bevcli.model.pillar_projection import PillarHits


def run_window(model: BEVFormerV2, images: Tensor, camera_index: Tensor, hits: PillarHits) -> None:
    """See `run_recurrent_frame`. Every frame of the window is encoded anew; its images were seen before."""
    features, frames = model.image_features(images, camera_index), len(model.config.frames)
    model.compute(((features, hits),) * frames, range(frames))


def with_past(memory: FeatureWindow, past: Sequence[tuple[FrameStamp, Pose]]) -> FeatureWindow:
    """A memory as if the model had seen earlier frames too, with copies of the image features.

    past: their stamps and world_from_ego.
    """
    if not memory.frames:
        return memory  # nothing of one frame is kept for the next
    seen = memory.frames[-1]
    return FeatureWindow((*(replace(seen, stamp=stamp, pose=pose) for stamp, pose in past), seen))
