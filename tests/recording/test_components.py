"""Rows that are made of Arrow arrays equal those of rerun's archetypes."""

import numpy as np
import pytest
import rerun as rr

from bevcli.recording.entities import any_values, components, line_strips, packed, rgb_format, ui_points

RANDOM = np.random.default_rng(0)
POINTS_2D, POINTS_3D = RANDOM.normal(size=(5, 2)), RANDOM.normal(size=(5, 3))
STRIPS_2D, STRIPS_3D = RANDOM.normal(size=(5, 4, 2)), RANDOM.normal(size=(5, 4, 3))
COLORS = RANDOM.integers(0, 256, (5, 3)).astype(np.uint8)
WITH_OPACITY = RANDOM.integers(0, 256, (5, 4)).astype(np.uint8)
IMAGE = RANDOM.integers(0, 256, (6, 4, 3)).astype(np.uint8)
POSE = RANDOM.normal(size=(3, 3))
BOXES = {"centers": POINTS_3D, "half_sizes": POINTS_3D, "quaternions": WITH_OPACITY / 255}
BOXES |= {"fill_mode": "majorwireframe"}
RADIUS = rr.Radius.ui_points(1.5)


def rows(made):
    return [(part.component_descriptor(), part.as_arrow_array()) for part in made]


@pytest.mark.parametrize(
    ("archetype", "fields", "expected"),
    [
        (
            rr.LineStrips2D,
            {"strips": STRIPS_2D, "colors": COLORS, "radii": ui_points(1.5), "draw_order": 30},
            rr.LineStrips2D(STRIPS_2D, colors=COLORS, radii=RADIUS, draw_order=30),
        ),
        (
            rr.LineStrips3D,
            {"strips": STRIPS_3D, "colors": WITH_OPACITY, "radii": 0.06},
            rr.LineStrips3D(STRIPS_3D, colors=WITH_OPACITY, radii=0.06),
        ),
        (rr.LineStrips2D, {"strips": STRIPS_2D[:0]}, rr.LineStrips2D([])),
        (
            rr.Points2D,
            {"positions": POINTS_2D, "labels": ["ä", "", "car", "a", "b"], "colors": (1, 2, 3), "show_labels": True},
            rr.Points2D(POINTS_2D, labels=["ä", "", "car", "a", "b"], colors=(1, 2, 3), show_labels=True),
        ),
        (rr.Points2D, {"positions": POINTS_2D, "colors": packed(COLORS)}, rr.Points2D(POINTS_2D, colors=COLORS)),
        (rr.Boxes3D, BOXES | {"class_ids": np.arange(5)}, rr.Boxes3D(**BOXES, class_ids=range(5))),
        (
            rr.Arrows3D,
            {"vectors": POINTS_3D, "origins": POINTS_3D, "colors": None},
            rr.Arrows3D(vectors=POINTS_3D, origins=POINTS_3D),
        ),
        (rr.Transform3D, {"translation": POSE[0], "mat3x3": POSE.T}, rr.Transform3D(translation=POSE[0], mat3x3=POSE)),
        (rr.Scalars, {"scalars": np.array([1, 2])}, rr.Scalars([1, 2])),
        (
            rr.Image,
            {"buffer": IMAGE.reshape(-1), "format": rgb_format(4, 6), "draw_order": -5},
            rr.Image(IMAGE, draw_order=-5),
        ),
        (
            rr.EncodedImage,
            {"blob": np.frombuffer(b"JPEG", np.uint8), "media_type": "image/jpeg"},
            rr.EncodedImage(contents=b"JPEG", media_type="image/jpeg"),
        ),
    ],
)
def test_components_equal_those_of_the_archetype(archetype, fields, expected):
    made = components(archetype, **fields)
    of_rerun = dict(rows(expected.as_component_batches()))
    assert made.keys() == of_rerun.keys()
    for descriptor, array in of_rerun.items():
        assert made[descriptor].type == array.type
        assert made[descriptor].equals(array)


def test_any_values_equal_those_of_rerun():
    values = {"score": RANDOM.normal(size=3), "scene": "a", "timestamp_ns": 10**18}
    expected = dict(rows(rr.AnyValues(**values).as_component_batches()))
    for descriptor, array in any_values(**values).items():
        assert array.type == expected[descriptor].type
        assert array.equals(expected[descriptor])


@pytest.mark.parametrize("lengths", [[], [2], [5, 2, 3, 1], [2, 2]])
def test_strips_equal_those_of_rerun(lengths):
    random = np.random.default_rng(0)
    flat, solid = ([random.normal(size=(length, size)) for length in lengths] for size in (2, 3))
    of_flat = line_strips(np.concatenate([np.zeros((0, 2)), *flat]), lengths)
    of_solid = line_strips(np.concatenate([np.zeros((0, 3)), *solid]), lengths)
    assert of_flat.equals(rr.components.LineStrip2DBatch(flat).as_arrow_array())
    assert of_solid.equals(rr.components.LineStrip3DBatch(solid).as_arrow_array())
    assert rr.LineStrips2D(of_flat).strips.as_arrow_array().equals(of_flat)
