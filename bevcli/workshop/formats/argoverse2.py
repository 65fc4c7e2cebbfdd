"""A log of the Argoverse 2 sensor dataset as an input format."""

from bevcli.options import option, options
from bevcli.sequences.format import Format
from bevcli.sequences.options import FormatOptions

# Any of these makes a folder a log, so that an incomplete one gets an error that names the missing file.
MARKERS = ("city_SE3_egovehicle.feather", "calibration/egovehicle_SE3_sensor.feather", "calibration/intrinsics.feather")
AXLE_HEIGHT_M = 0.33
# Class names; docs/other-inputs.md says what is lost. Names are compared without case; others, such as BOLLARD, SIGN
# and STROLLER, stay as they are, and are not scored.
CLASS_OF_CATEGORY = {
    "REGULAR_VEHICLE": "car",
    "LARGE_VEHICLE": "truck",
    "BOX_TRUCK": "truck",
    "TRUCK": "truck",
    "TRUCK_CAB": "truck",
    "BUS": "bus",
    "SCHOOL_BUS": "bus",
    "ARTICULATED_BUS": "bus",
    "VEHICULAR_TRAILER": "trailer",
    "MESSAGE_BOARD_TRAILER": "trailer",
    "TRAFFIC_LIGHT_TRAILER": "trailer",
    "MOTORCYCLE": "motorcycle",
    "BICYCLE": "bicycle",
    "PEDESTRIAN": "pedestrian",
    "OFFICIAL_SIGNALER": "pedestrian",
    "CONSTRUCTION_CONE": "traffic_cone",
    "CONSTRUCTION_BARREL": "traffic_cone",
}


@options("Input")
class Argoverse2Options(FormatOptions):
    """The options of an Argoverse 2 log."""

    stereo: bool = option(default=False, help="Argoverse 2: also use the two stereo cameras.")
    distorted: bool = option(
        default=False,
        help="Argoverse 2: the images have the lens distortion k1 to k3. The published images have none.",
    )
    axle_height_m: float = option(
        default=AXLE_HEIGHT_M, help="Argoverse 2: height of the rear axle above the ground, metres.", metavar="M"
    )


FORMAT = Format(
    name="an Argoverse 2 log",
    expected="city_SE3_egovehicle.feather",
    recognises=lambda path: any((path / marker).exists() for marker in MARKERS),
    opener="bevcli.workshop.formats.argoverse2_log:open_log",
    options=Argoverse2Options,
    annotated=True,
)
