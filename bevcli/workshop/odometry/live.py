"""The motion of a live rig without poses, for `bevcli.Session`."""

from bevcli.frame import Frame
from bevcli.geometry.ego_motion import Kinematics, RecentPoses
from bevcli.geometry.transforms import Pose
from bevcli.workshop.odometry.measure import MeasuredStep, MotionMeter

KEPT = 8  # poses, from which the kinematics follow


class LiveMotion:
    """Measures the motion to each frame at once, and once more when the next frame is there.

    The world frame is the ego frame of the first frame.

    Attributes:
        step: the newest step, to the newest frame; None for the first frame.
        kinematics: at the newest frame, from the best known poses.
    """

    def __init__(self, meter: MotionMeter | None = None) -> None:
        """meter: measures the steps. Default: a new one."""
        self._meter = MotionMeter() if meter is None else meter
        self._path: list[tuple[int, Pose]] = []
        self._open = 0  # steps at the end of the path that are not certain
        self.step: MeasuredStep | None = None
        self.kinematics: Kinematics | None = None

    def add(self, frame: Frame) -> tuple[Pose | None, Pose]:
        """world_from_ego of the frame before as it is known now, None for the first frame; and of this frame."""
        steps = self._meter.add(frame)
        self._path.append((frame.stamp.timestamp_ns, Pose.identity()))
        if len(self._path) > 1:
            self._open += 1
            certain, newest = len(steps), self._meter.newest
            if certain < self._open and newest is not None:
                steps = [*steps, newest]
            for place, step in zip(range(-self._open, 0), steps, strict=True):
                before = self._path[place - 1][1].matrix
                self._path[place] = self._path[place][0], Pose.from_matrix(before @ step.ego_a_from_ego_b)
            self._open -= certain
            self.step = steps[-1]
        self._path = self._path[-KEPT:]
        self.kinematics = RecentPoses(tuple(self._path)).kinematics()
        return (self._path[-2][1] if len(self._path) > 1 else None), self._path[-1][1]
