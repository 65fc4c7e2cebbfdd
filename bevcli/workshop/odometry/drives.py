"""The option `odometry` of `open_sequence`: a drive with the motion that its images show."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from bevcli.frame import DerivedDrive, Drive, Frame
from bevcli.geometry.transforms import inverse
from bevcli.sequences.open import select, select_rate
from bevcli.workshop.odometry.measure import MeasuredMotion, MeasuredStep, measure_steps
from bevcli.workshop.odometry.report import check_measured, measured_note

MOST_RATE_HZ = 10.0  # a faster drive is measured at this rate: shorter steps cost time and add errors
FASTER = 1.5  # times this rate is thinned to it


class MeasuredDrive(DerivedDrive):
    """A drive with its measured motion: poses and kinematics of every frame, and poses at each camera's own time.

    Ground truth in the world frame is moved with the vehicle.
    """

    def __init__(self, sequence: Drive, motion: MeasuredMotion) -> None:
        super().__init__(sequence)
        self.motion, self.ego_motion, self.has_ego_motion = motion, motion.ego_motion, True
        self.facts = replace(sequence.facts, geo_origin=None, motion_measured=True)

    def load(self, index: int) -> Frame:
        return self._moved(self.sequence.load(index))

    def ground_truth_frame(self, index: int) -> Frame:
        return self._moved(self.sequence.ground_truth_frame(index))

    def _moved(self, frame: Frame) -> Frame:
        motion, time = self.motion.ego_motion, frame.stamp.timestamp_ns
        times = {name: frame.images[name].timestamp_ns if name in frame.images else time for name in frame.rig.names}
        pose, truth = motion.pose_at(time), frame.ground_truth
        moved = pose.matrix @ inverse(frame.world_from_ego.matrix)
        return replace(
            frame,
            world_from_ego=pose,
            ground_truth=None if truth is None else truth.transformed(moved),
            world_from_ego_at={name: motion.pose_at(at) for name, at in times.items()},
            kinematics=motion.kinematics_at(time),
            sample_token=None,  # of a submission, whose boxes are in the world of nuScenes
        )


class MeasuredScenes(DerivedDrive):
    """A drive of several scenes, each with a measured motion of its own, which begins at its first frame."""

    def __init__(self, scenes: Mapping[str, MeasuredDrive]) -> None:
        first = next(iter(scenes.values()))
        super().__init__(first.sequence)
        self.has_ego_motion, self.facts, self._scenes, self.ego_motion = True, first.facts, scenes, None

    def load(self, index: int) -> Frame:
        return self._scenes[self.stamps[index].scene].load(index)

    def ground_truth_frame(self, index: int) -> Frame:
        return self._scenes[self.stamps[index].scene].ground_truth_frame(index)


def with_measured_motion(
    drive: Drive, whole: Drive, after_step: Callable[[int, int], None] | None = None
) -> MeasuredDrive | MeasuredScenes:
    """The drive with its measured motion, which a note of each scene states.

    Args:
        drive: the frames that are used.
        whole: a drive with further frames: those between the first and the last one of a scene are measured too.
        after_step: called with the number of steps that are done, and of all, scene by scene.

    Raises InputError where not one step of a scene can be measured.
    """
    scenes, notes = dict[str, MeasuredDrive](), list(drive.notes)
    for scene in dict.fromkeys(stamp.scene for stamp in drive.stamps):
        part = at_most_rate(frames_between(drive, whole, scene))
        steps, total = list[MeasuredStep](), len(part.stamps) - 1
        if after_step is not None and total:
            after_step(0, total)
        for step in measure_steps(part):
            steps.append(step)
            if after_step is not None:
                after_step(len(steps), total)
        motion = MeasuredMotion.of(part, steps)
        check_measured(motion)
        scenes[scene] = MeasuredDrive(drive, motion)
        notes.append(measured_note(motion))
    result = MeasuredScenes(scenes) if len(scenes) > 1 else next(iter(scenes.values()))
    result.notes = tuple(notes)
    return result


def frames_between(drive: Drive, whole: Drive, scene: str) -> Drive:
    """The frames of `whole` from the first to the last frame of `drive` in a scene."""
    times = [stamp.timestamp_ns for stamp in drive.stamps if stamp.scene == scene]
    between = [stamp.scene == scene and times[0] <= stamp.timestamp_ns <= times[-1] for stamp in whole.stamps]
    return select(whole, np.flatnonzero(between).tolist())


def at_most_rate(drive: Drive) -> Drive:
    """The drive, thinned to MOST_RATE_HZ where its frames follow each other faster."""
    steps = np.diff([stamp.timestamp_ns for stamp in drive.stamps])
    if not len(steps) or np.median(steps) * FASTER * MOST_RATE_HZ > 1e9:
        return drive
    return select_rate(drive, MOST_RATE_HZ)
