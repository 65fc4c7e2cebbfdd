"""The place of a bag's drive on Earth, from the satellite positions in it."""

from __future__ import annotations

import numpy as np

from bevcli.geometry.ego_motion import EgoMotion
from bevcli.geometry.geographic import GeoOrigin
from bevcli.sequences.ros.bag import Bag, spread
from bevcli.sequences.ros.ego_motion import BagEgoMotion
from bevcli.sequences.ros.messages import short_type

FIX_TYPES = ("sensor_msgs/NavSatFix", "foxglove/LocationFix")
FIXES_TRIED = 50
MAX_OFFSET_M = 10_000.0  # from the world's origin; GeoOrigin counts the Earth as flat around it


def find_geo_origin(bag: Bag, motion: EgoMotion | BagEgoMotion | None) -> GeoOrigin | None:
    """Where the world frame is on Earth: the first valid NavSatFix, at the vehicle's place at its time.

    The world's x axis is taken as east and y as north, as ROS's REP 103 and 105 say of a map frame. The antenna counts
    as the vehicle's origin. None without poses, without a valid position, or if the vehicle is too far from the
    world's origin.
    """
    topics = [
        name for name, topic in bag.topics.items() if short_type(topic.type_name) in FIX_TYPES and len(bag.times(name))
    ]
    if motion is None or not topics:
        return None
    times = bag.times(topics[0])
    for index in spread(len(times), FIXES_TRIED):
        time = int(times[index])
        if not motion.first_ns <= time <= motion.last_ns:
            continue
        fix = bag.message(topics[0], index)
        position = np.array([fix.latitude, fix.longitude], dtype=np.float64)
        is_valid = getattr(getattr(fix, "status", None), "status", 0) >= 0
        if not (is_valid and np.isfinite(position).all() and np.any(position)):
            continue
        place = motion.pose_at(time).translation
        if np.linalg.norm(place[:2]) > MAX_OFFSET_M:
            return None
        latitude, longitude = GeoOrigin(*position.tolist()).latitude_longitude(-place)
        return GeoOrigin(float(latitude), float(longitude))
    return None
