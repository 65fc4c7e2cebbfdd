"""`Session`: predictions for frames from memory, such as those of a vehicle or a simulator."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from operator import index
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bevcli.errors import InputError
from bevcli.frame import ColorOrder, DriveFacts, Frame, FrameStamp, Prediction, check_color_order
from bevcli.geometry.cameras import CameraRig
from bevcli.geometry.ego_motion import Kinematics
from bevcli.geometry.transforms import Pose
from bevcli.inference import StepOptions
from bevcli.inference.load import Model
from bevcli.inference.preprocess import check_cameras, checked_images
from bevcli.inference.runner import RunnerState, one_command
from bevcli.options import refuse, spread
from bevcli.parsing.documents import LARGEST_INTEGER
from bevcli.workshop.odometry.measure import LiveMotion, RecentPoses

RIGID_TOLERANCE = 1e-3  # of a pose matrix: sensors and simulators often compute it in float32


class Session:
    """Steps a model over frames from memory; the BEV map of a frame is the history of the next.

        session = bevcli.Session(model, rig, color_order="rgb")
        prediction = session.step({"CAM_FRONT": image}, world_from_ego, timestamp_ns)

    The results are those of `run` on the same frames. A `Recording` takes the session in place of a sequence, and
    `recording.log(session.frame, prediction)` follows it. A session belongs to one thread.

    Without poses, `session.step(images, None, timestamp_ns)` measures the motion from the images.

    Attributes:
        name: of the drive, for titles.
        rig: the cameras.
        frame: the newest frame; None before the first one.
        motion: the `MeasuredStep` from the frame before to the newest one, with its deviations and, where it could not
            be measured, the reason; None where poses are given, and for the first frame.
        notes: warnings where the rig lies outside the training distribution.
        stamps: none, because no frame is known in advance.
        has_ego_motion: True.
        facts: the defaults.
    """

    stamps: tuple[FrameStamp, ...] = ()
    has_ego_motion = True
    facts = DriveFacts()

    def __init__(
        self,
        model: Model,
        rig: CameraRig,
        *,
        color_order: ColorOrder = "bgr",
        name: str = "live",
        **options: Any,
    ) -> None:
        """Prepare the model for a rig.

        Args:
            model: of `load_model`.
            rig: the cameras; images must have the sizes that it states.
            color_order: of the images: "bgr", as OpenCV decodes them, or "rgb".
            name: of the drive, for titles.
            options: those of `StepOptions`, but for `attention` and `probes`. `step` may change the command.

        Raises InputError for a rig without cameras or with two of one name, an unknown camera in `cameras`, color order
        or command, and for a model that needs later frames.
        """
        check_color_order(color_order)
        if not rig.names or len(set(rig.names)) < len(rig.names):
            raise InputError(f"`rig`: expected cameras with different names (found {', '.join(rig.names) or 'none'})")
        step_options, rest = spread(options, StepOptions)
        refuse(rest, "Session", StepOptions)
        if step_options.temporal and model.config.later_frames:
            raise InputError(
                f"model {model.name} uses {model.config.later_frames} later frames, which a session does not have: "
                "choose another model, or pass `temporal=False` (`--no-temporal`)"
            )
        model = model.in_engine(rig)
        self.name, self.rig, self.notes = name, rig, model.training_notes(rig)
        self.frame: Frame | None = None
        self._color_order = color_order
        self._runner = model.runner(step_options)
        self._state: RunnerState[Any] = RunnerState()
        self._poses = RecentPoses()
        self._meter: Any = None  # of a session without poses
        self._drive = 1
        self._last_ns: int | None = None
        self._stepping = Lock()

    @property
    def motion(self) -> Any:
        """See the class."""
        return None if self._meter is None else self._meter.step

    def step(
        self,
        images: Mapping[str, NDArray[Any]],
        world_from_ego: Pose | ArrayLike | None,
        timestamp_ns: int,
        *,
        world_from_ego_at: Mapping[str, Pose | ArrayLike] | None = None,
        kinematics: Kinematics | None = None,
        command: str | None = None,
    ) -> Prediction:
        """The prediction for one frame.

        After a gap in time that is longer than the model's `max_gap_s`, the history starts anew:
        `Prediction.started_anew` says so. A frame without any image has no boxes and keeps the history.

        Args:
            images: camera -> (H, W, 3) uint8; a missing camera is left out. They must not change during the call, nor
                before `frame` was used.
            world_from_ego: the vehicle's pose at the frame's time: a `Pose` or (4, 4), metres, in a world frame that
                does not move. Ego frame: x forward, y left, z up, origin on the ground under the rear axle.
                None: it is measured from the images, which must be of one moment, and so are the kinematics. The world
                frame is then the ego frame of the first frame. The step from the frame before is measured at once, and
                decided again by the next one: the history then has the better pose.
            timestamp_ns: the frame's time; later than that of the frame before.
            world_from_ego_at: camera -> the vehicle's pose when its image was taken. Default: `world_from_ego`.
            kinematics: acceleration, angular rate and velocity at the frame's time. Default: derived from the poses.
            command: of the driver, from this frame on. Default: the one before.

        Raises InputError for an unknown camera or command, an image of another size or type, a pose that is not rigid,
        poses for some frames only, a time that is not later than the one before, and a call while another thread is in
        a step. The session is then as it was before the call.
        """
        with self._alone():
            stamp = self._next_stamp(timestamp_ns)
            self._check_all_or_none(world_from_ego is None, world_from_ego_at)
            pose = Pose.identity() if world_from_ego is None else _pose(world_from_ego, "`world_from_ego`")
            poses = self._poses.with_pose(stamp.timestamp_ns, pose)
            given = (world_from_ego_at or {}).items()
            at = {name: _pose(pose_then, f"`world_from_ego_at`: camera {name}") for name, pose_then in given}
            check_cameras(at, self.rig, "world_from_ego_at")
            frame = Frame(
                stamp=stamp,
                rig=self.rig,
                images=checked_images(images, self.rig, self._color_order, stamp.timestamp_ns),
                world_from_ego=pose,
                world_from_ego_at=dict.fromkeys(self.rig.names, pose) | at,
                kinematics=poses.kinematics() if kinematics is None else kinematics,
                dropped={name: "not given" for name in self.rig.names if name not in images},
            )
            if command is not None:
                self._runner.commands = one_command(command, self._runner.config)
            if world_from_ego is None:
                frame = self._measured(frame, kinematics)
            self._state, prediction = self._runner.step(self._state, self._runner.prepare(frame))
            self.frame, self._poses, self._last_ns = frame, poses, stamp.timestamp_ns
            return prediction

    @contextmanager
    def _alone(self) -> Iterator[None]:
        if not self._stepping.acquire(blocking=False):
            raise InputError(
                "another thread is in a step of this session: call `step` from one thread, or make a session for each "
                "vehicle"
            )
        try:
            yield
        finally:
            self._stepping.release()

    def reset(self) -> None:
        """Forget the history: the next frame begins a new drive, at any time and place. Its number goes on."""
        self._state, self._poses, self._meter = RunnerState(), RecentPoses(), None
        self._drive, self._last_ns = self._drive + 1, None

    def _check_all_or_none(self, is_measured: bool, world_from_ego_at: Mapping[str, Any] | None) -> None:
        """Raise InputError for a frame without pose after one with a pose, the other way round, or with other poses."""
        if is_measured and world_from_ego_at:
            raise InputError("`world_from_ego_at`: needs `world_from_ego`, which is None: leave it out, or pass both")
        if self._last_ns is not None and is_measured != (self._meter is not None):
            found, before = ("None", "a pose") if is_measured else ("a pose", "None")
            raise InputError(
                f"`world_from_ego`: is {found}, but for the frame before it was {before}: pass poses for all frames or "
                "for none, or call reset() where a new drive begins"
            )

    def _measured(self, frame: Frame, kinematics: Kinematics | None) -> Frame:
        """The frame with its measured pose. The history gets the pose of the frame before as it is known now.

        After a gap that ends the history, the measurement begins anew.
        """
        gap_ns = 0 if self._last_ns is None else frame.stamp.timestamp_ns - self._last_ns
        if self._meter is None or gap_ns > self._runner.config.max_gap_s * 1e9:
            self._meter = LiveMotion()
        before, pose = self._meter.add(frame)
        # A frame without images has left the memory as it was.
        if before is not None and self.frame is not None and self._state.stamp == self.frame.stamp:
            memory = self._runner.model.with_pose(self._state.memory, before)
            self._state = replace(self._state, memory=memory)
        return replace(
            frame,
            world_from_ego=pose,
            world_from_ego_at=dict.fromkeys(self.rig.names, pose),
            kinematics=self._meter.kinematics if kinematics is None else kinematics,
            road_normal=None if self._meter.step is None else self._meter.step.road_normal,
        )

    def _next_stamp(self, timestamp_ns: int) -> FrameStamp:
        try:
            time = index(timestamp_ns)
        except TypeError:
            found = f"{type(timestamp_ns).__name__} {timestamp_ns!r:.40}"
            advice = "pass round(seconds * 1e9)" if isinstance(timestamp_ns, float | np.floating) else "pass an int"
            raise InputError(f"`timestamp_ns`: expected whole nanoseconds (found {found}): {advice}") from None
        if abs(time) > LARGEST_INTEGER:
            raise InputError("`timestamp_ns`: is too large (expected nanoseconds, at most 62 bits)")
        if self._last_ns is not None and time <= self._last_ns:
            raise InputError(
                f"`timestamp_ns={time}`: is not later than the frame before ({self._last_ns}): pass frames in order, "
                "or call reset() where a new drive begins"
            )
        number = 0 if self.frame is None else self.frame.stamp.index + 1
        return FrameStamp(number, str(self._drive) if self._drive > 1 else "", time)


def _pose(pose: Pose | ArrayLike, argument: str) -> Pose:
    """A pose from what the caller gave. Raises InputError where it is not rigid."""
    if isinstance(pose, Pose):
        return pose
    matrix = np.asarray(pose, dtype=np.float64)
    if matrix.shape != (4, 4):
        raise InputError(f"{argument}: expected a Pose or a matrix (4, 4) (found shape {matrix.shape})")
    rotation = matrix[:3, :3]
    is_rigid = (
        np.isfinite(matrix).all()
        and np.allclose(rotation @ rotation.T, np.eye(3), atol=RIGID_TOLERANCE)
        and np.linalg.det(rotation) > 0
        and np.array_equal(matrix[3], (0, 0, 0, 1))
    )
    if not is_rigid:
        raise InputError(f"{argument}: is not a rigid transform (expected a rotation and a translation, all finite)")
    return Pose.from_matrix(matrix)
