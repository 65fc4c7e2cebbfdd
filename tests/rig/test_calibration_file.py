"""calibration.json: what is written is read again to the last bit, and each mistake in it is one line that names it."""

import json
import re

import numpy as np
import pytest
from healthy_rigs import HEALTHY, copy_of
from scipy.spatial.transform import Rotation

from bevcli.errors import InputError, OutputError, errors_of
from bevcli.geometry.cameras import CameraRig
from bevcli.sequences.files.calibration_file import draft_calibration, read_calibration, write_calibration


def written(document, folder):
    path = folder / "calibration.json"
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return path


def same(a: CameraRig, b: CameraRig) -> bool:
    cameras = all(
        (x.name, x.width, x.height, x.distortion) == (y.name, y.width, y.height, y.distortion)
        and np.array_equal(x.intrinsics, y.intrinsics)
        and np.array_equal(x.ego_from_camera, y.ego_from_camera)
        for x, y in zip(a.cameras, b.cameras, strict=True)
    )
    return cameras and np.array_equal(a.ego_from_bev, b.ego_from_bev)


@pytest.mark.parametrize("name", HEALTHY)
def test_the_numbers_are_those_of_the_file_to_the_last_bit(name, tmp_path):
    document = copy_of(name)
    rig = read_calibration(written(document, tmp_path))
    assert rig.names == tuple(document["cameras"])
    for camera in rig.cameras:
        entry = document["cameras"][camera.name]
        w, x, y, z = entry["ego_from_camera"]["rotation_wxyz"]
        assert (camera.width, camera.height) == (entry["width"], entry["height"])
        assert camera.intrinsics.tolist() == entry["intrinsics"]
        assert camera.ego_from_camera[:3, 3].tolist() == entry["ego_from_camera"]["translation"]
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
        np.testing.assert_allclose(camera.ego_from_camera[:3, :3], rotation, atol=1e-14)
    write_calibration(tmp_path / "again.json", rig)
    assert same(read_calibration(tmp_path / "again.json"), rig)
    with pytest.raises(OutputError, match="no-such-folder"):
        write_calibration(tmp_path / "no-such-folder" / "calibration.json", rig)


def test_a_rotation_may_be_a_matrix(tmp_path):
    document = copy_of("six")
    for entry in [document["ego_from_bev"], *(camera["ego_from_camera"] for camera in document["cameras"].values())]:
        w, x, y, z = entry.pop("rotation_wxyz")
        entry["rotation"] = Rotation.from_quat([x, y, z, w]).as_matrix().tolist()
    by_matrix = read_calibration(written(document, tmp_path))
    by_quaternion = read_calibration(written(copy_of("six"), tmp_path))
    for a, b in zip(by_matrix.cameras, by_quaternion.cameras, strict=True):
        np.testing.assert_allclose(a.ego_from_camera, b.ego_from_camera, atol=1e-14)


def test_without_ego_from_bev_a_level_frame_y_forward_is_assumed(tmp_path):
    document = copy_of("six")
    del document["ego_from_bev"]
    rig = read_calibration(written(document, tmp_path))
    assert rig.ego_from_bev_assumed
    np.testing.assert_allclose(rig.ego_from_bev @ [0, 10, 0, 1], [10.94, 0, 1.84, 1])
    np.testing.assert_allclose(rig.ego_from_bev @ [10, 0, 0, 1], [0.94, -10, 1.84, 1])
    write_calibration(tmp_path / "again.json", rig)
    assert read_calibration(tmp_path / "again.json").ego_from_bev_assumed


def put(path, value):
    """A spoiler that puts `value` where the keys lead; DELETE takes the key away."""

    def spoil(document):
        *way, last = path
        for key in way:
            document = document[key]
        if value is DELETE:
            del document[last]
        else:
            document[last] = value

    return spoil


DELETE = object()
CAMERA = ("cameras", "CAM_BACK")
POSE, INTRINSICS, LENS = ((*CAMERA, name) for name in ("ego_from_camera", "intrinsics", "distortion"))
EYE = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]


def as_matrix(matrix):
    def spoil(document):
        entry = document["cameras"]["CAM_BACK"]["ego_from_camera"]
        del entry["rotation_wxyz"]
        entry["rotation"] = matrix

    return spoil


MISTAKES = {
    "no format": (put(("format",), DELETE), '"format" is missing'),
    "other format": (put(("format",), "bevcli-boxes/1"), "bevcli-boxes/1"),
    "no cameras": (put(("cameras",), DELETE), '"cameras" is missing'),
    "cameras is empty": (put(("cameras",), {}), "contains no camera"),
    "cameras is a list": (put(("cameras",), [1]), "contains no camera"),
    "camera is a number": (put(CAMERA, 3), "camera CAM_BACK: .*is not a camera"),
    "no width": (put((*CAMERA, "width"), DELETE), 'camera CAM_BACK: "width" is missing'),
    "width is text": (put((*CAMERA, "width"), "1600"), 'camera CAM_BACK: "width".*1600'),
    "width is zero": (put((*CAMERA, "width"), 0), 'camera CAM_BACK: "width"'),
    "height is true": (put((*CAMERA, "height"), True), 'camera CAM_BACK: "height"'),
    "no intrinsics": (put(INTRINSICS, DELETE), r'camera CAM_BACK: "intrinsics" is missing \(expected 3x3\)$'),
    "intrinsics 2x3": (put(INTRINSICS, EYE[:2]), "CAM_BACK.*expected 3x3, found 2x3"),
    "intrinsics ragged": (put(INTRINSICS, [[1, 0], [0], [1]]), "CAM_BACK.*expected 3x3"),
    "intrinsics of text": (put(INTRINSICS, [["a"] * 3] * 3), "CAM_BACK.*not an array of numbers"),
    "intrinsics NaN": (put(INTRINSICS, [[float("nan")] * 3] * 3), "CAM_BACK.*NaN"),
    "intrinsics singular": (put(INTRINSICS, [[0, 0, 800], [0, 800, 450], [0, 0, 1]]), "CAM_BACK.*singular.*fx 0"),
    "intrinsics mirrored": (put(INTRINSICS, [[-800, 0, 800], [0, 800, 450], [0, 0, 1]]), "CAM_BACK.*fx > 0"),
    "intrinsics transposed": (
        put(INTRINSICS, [[800, 0, 0], [0, 800, 0], [800, 450, 1]]), "CAM_BACK.*not a camera matrix",
    ),
    "focal length in mm": (
        put(INTRINSICS, [[4.2, 0, 800], [0, 4.2, 450], [0, 0, 1]]), "CAM_BACK.*implausible focal.*4.2",
    ),
    "focal length too long": (
        put(INTRINSICS, [[8e5, 0, 800], [0, 8e5, 450], [0, 0, 1]]), "CAM_BACK.*implausible focal length",
    ),
    "principal point absurd": (put(INTRINSICS, [[800, 0, 8e5], [0, 800, 450], [0, 0, 1]]), "CAM_BACK.*principal point"),
    "no pose": (put(POSE, DELETE), 'CAM_BACK: "ego_from_camera" is missing'),
    "pose is a list": (put(POSE, [1, 2, 3]), 'CAM_BACK: "ego_from_camera" is not a transform'),
    "no translation": (put((*POSE, "translation"), DELETE), 'CAM_BACK: "ego_from_camera.translation" is missing'),
    "translation of two": (put((*POSE, "translation"), [1, 2]), "CAM_BACK.*translation.*expected 3 numbers, found 2"),
    "translation infinite": (put((*POSE, "translation"), [1, 2, float("inf")]), "CAM_BACK.*translation.*infinity"),
    "no rotation": (put((*POSE, "rotation_wxyz"), DELETE), 'CAM_BACK: "ego_from_camera.rotation_wxyz" is missing'),
    "quaternion of three": (put((*POSE, "rotation_wxyz"), [1, 0, 0]), "CAM_BACK.*expected 4 numbers, found 3"),
    "quaternion of norm 1.002": (put((*POSE, "rotation_wxyz"), [1.002, 0, 0, 0]), "CAM_BACK.*norm.*found 1.002"),
    "quaternion of zeros": (put((*POSE, "rotation_wxyz"), [0, 0, 0, 0]), "CAM_BACK.*norm.*found 0"),
    "both rotations": (put((*POSE, "rotation"), EYE), "CAM_BACK.*in addition to"),
    "not orthonormal": (as_matrix([[1, 0.01, 0], [0, 1, 0], [0, 0, 1]]), "CAM_BACK.*not orthonormal.*0.01"),
    "left-handed": (as_matrix([[1, 0, 0], [0, 1, 0], [0, 0, -1]]), "CAM_BACK.*left-handed"),
    "a row of zeros": (as_matrix([[1, 0, 0], [0, 1, 0], [0, 0, 0]]), "CAM_BACK.*not orthonormal"),
    "unknown lens": (put(LENS, {"model": "fisheye"}), "CAM_BACK.*kannala_brandt, found fisheye"),
    "lens is a list": (put(LENS, [0.1, 0.2]), "CAM_BACK.*unknown model"),
    "three coefficients": (
        put(LENS, {"model": "brown_conrady", "coefficients": [0.1, 0.2, 0.3]}),
        "CAM_BACK.*expected 4 or 5 or 8 for brown_conrady, found 3",
    ),
    "no coefficients": (put(LENS, {"model": "kannala_brandt"}), "CAM_BACK.*expected 4.*found 0"),
    "coefficients for none": (put(LENS, {"model": "none", "coefficients": [0.1]}), "CAM_BACK.*expected 0 for none"),
    "coefficient of text": (
        put(LENS, {"model": "kannala_brandt", "coefficients": [0.1, "b", 0, 0]}),
        'CAM_BACK: "distortion.coefficients" is not an array of numbers',
    ),
    "bev without translation": (put(("ego_from_bev", "translation"), DELETE), '"ego_from_bev.translation" is missing'),
    "bev is null": (put(("ego_from_bev",), None), '"ego_from_bev" is missing'),
}  # fmt: skip


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_line_that_names_file_and_place(name, tmp_path):
    spoil, pattern = MISTAKES[name]
    document = copy_of("six")
    spoil(document)
    path = written(document, tmp_path)
    with pytest.raises(InputError) as caught:
        read_calibration(path)
    line = str(caught.value)
    assert line.startswith(f"{path}: ")
    assert re.search(pattern, line), line
    # The lenient reader finds the same, and keeps the other cameras.
    draft = draft_calibration(path)
    assert any(re.search(pattern, finding.line) for finding in errors_of(draft.findings))
    if isinstance(document.get("cameras"), dict) and document["cameras"]:
        assert set(draft.rig.names) >= set(document["cameras"]) - {"CAM_BACK"}


def test_all_mistakes_are_found_at_once(tmp_path):
    document = copy_of("six")
    for camera in document["cameras"].values():
        del camera["width"]
        camera["ego_from_camera"]["translation"] = [0, 1]
    draft = draft_calibration(written(document, tmp_path))
    assert [(finding.camera, finding.code) for finding in draft.findings] == [
        (name, code) for name in document["cameras"] for code in ("missing-key", "wrong-shape")
    ]


@pytest.mark.parametrize(
    ("text", "pattern"),
    [
        ('{"format": ', "line 1.*broken JSON"),
        ("", "broken JSON"),
        ("[1, 2]", "not a JSON object|camera 0: is no mapping"),
        ('{"cameras": {"A": {}, "A": {}}}', '"A" appears twice'),
    ],
)
@pytest.mark.parametrize("read", [read_calibration, draft_calibration])
def test_what_is_no_json_object_is_refused(read, text, pattern, tmp_path):
    path = written(text, tmp_path)
    with pytest.raises(InputError, match=pattern):
        read(path)
    (tmp_path / "bytes").write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path / "nothing.json", tmp_path, tmp_path / "bytes"):
        with pytest.raises(InputError, match=re.escape(str(path))):
            read(path)
