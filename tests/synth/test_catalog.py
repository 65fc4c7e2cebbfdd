"""The meshes: enough variants, plausible sizes, closed surfaces, boxes that fit; varied looks and roadside objects."""

import cv2
import numpy as np
import pytest

from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.workshop.synth.catalog import Assets, draw_body
from bevcli.workshop.synth.city import STOP_LINE_M, CityPlan
from bevcli.workshop.synth.drive import RenderedDrive, RenderedFrame
from bevcli.workshop.synth.rig import DrawnRig, RigDistribution, draw_rig, nuscenes_like_rig
from bevcli.workshop.synth.scenery import bent, recoloured
from bevcli.workshop.synth.simulation import Roadside, StandingActor

VEHICLES = ("car", "truck", "construction_vehicle", "bus", "trailer", "motorcycle", "bicycle")
# Smallest and largest plausible length, width and height of each class, metres.
PLAUSIBLE = {
    "car": ((3.5, 1.5, 1.2), (5.8, 2.2, 2.4)), "truck": ((4.5, 1.8, 1.6), (12, 2.7, 4.2)),
    "construction_vehicle": ((3.5, 1.8, 2.2), (10, 3.5, 4.5)), "bus": ((6, 2.2, 2.5), (18.5, 3.1, 4.5)),
    "trailer": ((3, 1.7, 1.2), (15, 3, 4.5)), "barrier": ((0.2, 1.5, 0.7), (0.9, 3.5, 1.4)),
    "motorcycle": ((1.5, 0.5, 0.9), (2.6, 1.1, 2.0)), "bicycle": ((1.4, 0.4, 0.8), (2.2, 0.9, 2.1)),
    "pedestrian": ((0.2, 0.3, 0.9), (1.2, 1.0, 2.1)), "traffic_cone": ((0.2, 0.2, 0.4), (0.8, 0.8, 1.3)),
}  # fmt: skip


@pytest.mark.parametrize("name", NUSCENES_CLASSES)
def test_variants_are_many_plausible_and_fill_their_boxes(assets: Assets, name: str):
    looks = {v.name.removesuffix("_standing") for v in assets.by_class[name]}
    assert len(looks) >= (6 if name in VEHICLES else 4)
    rng, (low, high) = np.random.default_rng(3), np.array(PLAUSIBLE[name])
    for variant in assets.by_class[name]:
        assert (low < variant.size_lwh).all(), variant.name
        assert (variant.size_lwh < high).all(), variant.name
        body = draw_body(variant, rng, "one")
        for pose in variant.poses:
            points = pose.fitted(body.size_lwh).faces.reshape(-1, 3)
            corner = np.array([-body.size_lwh[0] / 2, -body.size_lwh[1] / 2, 0])
            np.testing.assert_allclose(points.min(0), corner, atol=1e-5)
            np.testing.assert_allclose(points.max(0), corner + body.size_lwh, atol=1e-5)


@pytest.mark.parametrize("name", NUSCENES_CLASSES)
def test_meshes_have_no_holes_and_no_inverted_faces(assets: Assets, name: str):
    """From every side, the faces that point to the viewer cover the same area as all faces."""
    for variant in assets.by_class[name]:
        for pose in variant.poses:
            faces = pose.fitted(variant.size_lwh / variant.size_lwh.max()).faces
            for view in ((1, 0.3, 0.4), (-0.7, 1, 0.2), (0.2, -1, 1), (-1, -0.4, -0.6)):
                every, towards = _silhouettes(faces, np.array(view))
                assert (every & ~towards).mean() < 2e-4, (variant.name, view)


def _silhouettes(faces, view, size=400):
    """(size, size) bool images seen from direction `view`: of all faces, and of those that point to the viewer."""
    view = view / np.linalg.norm(view)
    right = np.cross((0, 0, 1), view) / np.linalg.norm(np.cross((0, 0, 1), view))
    axes = np.stack([right, np.cross(view, right)], -1)
    flat = faces @ axes
    x, y = flat[..., 0], flat[..., 1]
    area = (x[:, 1] - x[:, 0]) * (y[:, 2] - y[:, 0]) - (x[:, 2] - x[:, 0]) * (y[:, 1] - y[:, 0])
    pixels = np.round((flat - flat.min((0, 1))) * size * 0.55 * 16).astype(np.int32)
    images = [np.zeros((size, size), np.uint8) for _ in range(2)]
    for corners, turned in zip(pixels, area, strict=True):
        for image in images if turned > 0 else images[:1]:
            cv2.fillConvexPoly(image, corners, 1, cv2.LINE_8, 4)
    return images[0] > 0, cv2.dilate(images[1], np.ones((3, 3), np.uint8)) > 0


def rendered(assets: Assets, index: int, varied: bool) -> RenderedFrame:
    return RenderedDrive(5, 2, rig=DrawnRig(nuscenes_like_rig(96, 54), varied=varied), assets=assets).frame(index)


@pytest.mark.slow
def test_varied_looks_change_the_images_and_keep_the_boxes(assets: Assets) -> None:
    plain, varied, again = rendered(assets, 1, False), rendered(assets, 1, True), rendered(assets, 1, True)
    np.testing.assert_array_equal(varied.boxes.centers, plain.boxes.centers)
    np.testing.assert_array_equal(varied.boxes.sizes_lwh, plain.boxes.sizes_lwh)
    np.testing.assert_array_equal(varied.boxes.classes, plain.boxes.classes)
    for name, image in plain.images.items():
        assert np.abs(varied.images[name].astype(int) - image).mean() > 5
        np.testing.assert_array_equal(again.images[name], varied.images[name])


def test_bent_meshes_differ_stay_symmetric_and_near_their_cuboid(assets: Assets) -> None:
    random, mesh = np.random.default_rng(0), assets.by_class["car"][0].poses[0]
    size = mesh.extents
    assert np.abs(bent(mesh, random).faces - bent(mesh, random).faces).max() > 0.02
    assert (recoloured(mesh, random).albedo != recoloured(mesh, random).albedo).any()
    for seed in range(20):
        points = bent(mesh, np.random.default_rng(seed)).faces.reshape(-1, 3)
        mirrored = points * (1, -1, 1)
        assert abs(points[:, 1].max() + points[:, 1].min()) < 1e-5
        assert np.ptp(points, axis=0).max() < 1.2 * size.max()
        np.testing.assert_allclose(np.sort(mirrored[:, 1]), np.sort(points[:, 1]), atol=1e-5)


def test_a_share_of_varied_drives_leaves_the_rigs_as_they_are() -> None:
    plain, varied = RigDistribution(random_share=0.5), RigDistribution(random_share=0.5, varied_share=0.5)
    drawn = [(draw_rig(plain, seed, (96, 54)), draw_rig(varied, seed, (96, 54))) for seed in range(40)]
    assert not any(one.varied for one, _ in drawn)
    assert 10 < sum(other.varied for _, other in drawn) < 30
    for one, other in drawn:
        assert one.rig.names == other.rig.names
        assert one.jpeg_quality == other.jpeg_quality
    assert RigDistribution().digest != RigDistribution(varied_share=0.5).digest


WORKS = ("barrier-", "cone-", "machine-", "worker-")


class EvenCity(CityPlan):
    """A city whose streets all have the same distance."""

    def __init__(self, seed: int, spacing_m: float) -> None:
        super().__init__(seed)
        self.spacing_m = spacing_m

    def _make_position(self, axis: int, index: int) -> float:
        return index * self.spacing_m


def standing(city: CityPlan, assets: Assets) -> list[tuple[StandingActor, int, int, int]]:
    """The actors at the kerbs of 60 stretches, each with axis, street and crossing street."""
    roadside = Roadside(city, assets)
    stretches = [(axis, index, cross) for axis in (0, 1) for index in range(5) for cross in range(6)]
    return [(actor, *stretch) for stretch in stretches for actor in roadside.stretch(*stretch)]


@pytest.mark.parametrize(("spacing_m", "has_works"), [(45.0, False), (100.0, True)])
def test_only_stretches_with_room_have_road_works(assets: Assets, spacing_m: float, has_works: bool):
    """Road works are at least 15 m long. With 45 m between the streets no stretch has that much room."""
    names = [actor.body.instance for actor, *_ in standing(EvenCity(3, spacing_m), assets)]
    assert any(name.startswith("parked") for name in names)
    assert any(name.startswith(WORKS) for name in names) == has_works


@pytest.mark.parametrize("spacing_m", [45.0, 66.0, 100.0])
def test_all_at_a_kerb_is_between_stop_lines_on_the_parking_lane(assets: Assets, spacing_m: float):
    city = EvenCity(3, spacing_m)
    checked = 0
    for actor, axis, index, cross in standing(city, assets):
        street = city.street(axis, index)
        before, after = city.street(1 - axis, cross), city.street(1 - axis, cross + 1)
        plan = city.unbend(actor.position[:2])
        along, across = plan[axis], abs(plan[1 - axis] - street.position)
        half = actor.body.size_lwh[0] / 2 if actor.body.instance.startswith("parked") else 0.0
        assert along - half > before.position + before.half_width + STOP_LINE_M
        assert along + half < after.position - after.half_width - STOP_LINE_M
        assert street.half_width - street.parking_m - 0.5 < across < street.half_width
        checked += 1
    assert checked > 50
