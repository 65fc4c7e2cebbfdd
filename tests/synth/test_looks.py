"""Varied looks change what is seen, and nothing that is labelled."""

import numpy as np

from bevcli.workshop.synth.catalog import Assets
from bevcli.workshop.synth.drive import RenderedDrive, RenderedFrame
from bevcli.workshop.synth.looks import bent, recoloured
from bevcli.workshop.synth.rig import DrawnRig, RigDistribution, draw_rig, nuscenes_like_rig


def rendered(assets: Assets, index: int, varied: bool) -> RenderedFrame:
    return RenderedDrive(5, 2, rig=DrawnRig(nuscenes_like_rig(96, 54), varied=varied), assets=assets).frame(index)


def test_varied_looks_change_the_images_and_keep_the_boxes(assets: Assets) -> None:
    plain, varied, again = rendered(assets, 1, False), rendered(assets, 1, True), rendered(assets, 1, True)

    np.testing.assert_array_equal(varied.boxes.centers, plain.boxes.centers)
    np.testing.assert_array_equal(varied.boxes.sizes_lwh, plain.boxes.sizes_lwh)
    np.testing.assert_array_equal(varied.boxes.classes, plain.boxes.classes)
    for name, image in plain.images.items():
        assert np.abs(varied.images[name].astype(int) - image).mean() > 5
        np.testing.assert_array_equal(again.images[name], varied.images[name])


def test_individuals_of_a_drive_look_different(assets: Assets) -> None:
    random, mesh = np.random.default_rng(0), assets.by_class["car"][0].poses[0]
    one, other = bent(mesh, random), bent(mesh, random)

    assert np.abs(one.faces - other.faces).max() > 0.02
    assert (recoloured(mesh, random).albedo != recoloured(mesh, random).albedo).any()


def test_a_bent_mesh_stays_symmetric_and_near_its_cuboid(assets: Assets) -> None:
    mesh = assets.by_class["car"][0].poses[0]
    size = mesh.extents

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
