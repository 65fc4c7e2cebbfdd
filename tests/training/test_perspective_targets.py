"""Targets of the perspective head (projections, levels, positive pixels, masks), and its loss."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import torch
from made_boxes import made_boxes
from painted_drives import CONFIG, PaintedDrives, batch_of

from bevcli.errors import InputError
from bevcli.frame import BevMap
from bevcli.geometry.bev_grid import BevGrid
from bevcli.geometry.boxes import Boxes3D
from bevcli.model.bevformer import BEVFormer
from bevcli.model.decoder import encode
from bevcli.model.fpn import FPNConfig
from bevcli.model.image_tokens import ImageTokensConfig
from bevcli.model.resnet import ResNetConfig
from bevcli.workshop.training.frame_losses import (
    OUTLINE_DEPTH_M,
    FeatureLocations,
    FrameLosses,
    ImageObjects,
    PerspectiveHead,
    PerspectiveLossConfig,
    feature_locations,
    perspective_loss,
    perspective_targets,
    project_objects,
)
from bevcli.workshop.training.job import TrainingConfig
from bevcli.workshop.training.samples import Batch, Clip
from bevcli.workshop.training.targets import PaddedTargets, detection_targets, of_all, segmentation_targets

SIZE = (224, 384)  # height, width
SHAPES = [(28, 48), (14, 24), (7, 12)]  # strides 8, 16, 32
FOCAL, PRINCIPAL_POINT = 200.0, (192.0, 112.0)
INTRINSICS = np.array([[FOCAL, 0, PRINCIPAL_POINT[0]], [0, FOCAL, PRINCIPAL_POINT[1]], [0, 0, 1]])
CAMERA_FROM_BEV = np.array([[1.0, 0, 0, 0], [0, 0, -1, 1.5], [0, 1, 0, 0], [0, 0, 0, 1]])  # 1.5 m high; ahead is +y


@dataclass(frozen=True)
class ImageTargets:
    """The K positive locations of an image, their classes and box numbers, and which of all locations are ignored."""

    locations: torch.Tensor
    labels: torch.Tensor
    boxes: torch.Tensor
    ignored: torch.Tensor


def of_frame(targets: PaddedTargets, index: int) -> PaddedTargets:
    """The boxes of one frame of several."""
    return PaddedTargets(*(column[index : index + 1] for column in vars(targets).values()))


def targets_of_image(
    image_from_bev: torch.Tensor, truth: PaddedTargets, locations: FeatureLocations, size: tuple[int, int]
) -> ImageTargets:
    found = perspective_targets(image_from_bev[None], truth, locations, size)
    positive = found.positive[0]
    return ImageTargets(positive.nonzero()[:, 0], found.labels[0, positive], found.boxes[0, positive], found.ignored[0])


def objects_of_image(image_from_bev: torch.Tensor, codes: torch.Tensor, size: tuple[int, int]) -> ImageObjects:
    objects = project_objects(image_from_bev[None], codes[None], size)
    return ImageObjects(**{name: part[0] for name, part in vars(objects).items()})


def image_from_bev(camera_from_bev: np.ndarray = CAMERA_FROM_BEV, intrinsics: np.ndarray = INTRINSICS) -> torch.Tensor:
    image_from_camera = np.eye(4)
    image_from_camera[:3, :3] = intrinsics
    return torch.from_numpy(image_from_camera @ camera_from_bev).float()


def boxes(*rows: tuple[float, ...]) -> Boxes3D:
    """x, y, z, length, width, height, yaw of each."""
    table = np.array(rows, dtype=float).reshape(-1, 7)
    return made_boxes(table[:, :3], sizes_lwh=table[:, 3:6], yaws=table[:, 6])


def truth(*rows: tuple[float, ...]) -> PaddedTargets:
    codes = torch.from_numpy(encode(boxes(*rows))).float()
    return PaddedTargets.of_frame(torch.arange(len(codes)), codes)


def targets(*rows: tuple[float, ...], shapes: list[tuple[int, int]] = SHAPES) -> ImageTargets:
    locations = feature_locations(tuple(shapes), SIZE, torch.device("cpu"))
    return targets_of_image(image_from_bev(), truth(*rows), locations, SIZE)


def cells(locations: torch.Tensor, shape: tuple[int, int] = SHAPES[0], start: int = 0) -> list[tuple[int, int]]:
    """Row and column of locations on a level that starts at an index."""
    return [divmod(int(index) - start, shape[1]) for index in locations]


def tilted_camera() -> np.ndarray:
    """A camera that is turned about all three axes, away from the origin."""
    camera_from_bev = np.eye(4)
    rotation = cv2.Rodrigues(np.array([0.1, -0.2, 0.15]))[0]
    camera_from_bev[:3, :3] = rotation @ CAMERA_FROM_BEV[:3, :3]
    camera_from_bev[:3, 3] = [0.4, 1.2, -0.7]
    return camera_from_bev


def test_centers_depths_and_outlines_equal_opencv() -> None:
    rng = np.random.default_rng(0)
    count = 40
    rows = np.column_stack(
        [rng.uniform(-6, 6, count), rng.uniform(9, 40, count), rng.uniform(-1, 2, count),
         rng.uniform(0.4, 9, (count, 3)), rng.uniform(-4, 4, count)]
    )  # fmt: skip
    camera_from_bev = tilted_camera()
    intrinsics = INTRINSICS * [[1.2], [0.9], [1]]  # fx is not fy
    objects = objects_of_image(image_from_bev(camera_from_bev, intrinsics), truth(*rows).codes[0], SIZE)

    def project(points: np.ndarray) -> np.ndarray:
        rotation = cv2.Rodrigues(camera_from_bev[:3, :3])[0]
        return cv2.projectPoints(
            np.ascontiguousarray(points).reshape(-1, 3), rotation, camera_from_bev[:3, 3], intrinsics, None
        )[0][:, 0]

    np.testing.assert_allclose(objects.centers, project(rows[:, :3]), atol=1e-2)
    depths = (rows[:, :3] @ camera_from_bev[:3, :3].T + camera_from_bev[:3, 3])[:, 2]
    np.testing.assert_allclose(objects.depths, depths, atol=1e-4)
    assert objects.focal == pytest.approx(FOCAL * math.sqrt(1.2 * 0.9), rel=1e-4)

    corners = project(boxes(*rows).corners()).reshape(count, 8, 2)
    expected = np.concatenate([corners.min(1).clip(0), np.minimum(corners.max(1), [SIZE[1], SIZE[0]])], 1)
    shown = (expected[:, 2:] > expected[:, :2]).all(1)
    assert shown.sum() > 10
    np.testing.assert_array_equal(objects.visible, shown)
    np.testing.assert_allclose(objects.outlines[shown], expected[shown], atol=2e-2)


def test_a_box_has_the_targets_computed_by_hand() -> None:
    """A box 4 m long, 1 m wide and 2 m high, 10 m ahead and 2 m to the right, at the camera's height, heading ahead."""
    found = targets((2, 10, 1.5, 4, 1, 2, math.pi / 2))
    # The centre projects to x 192 + 200 · 2 / 10 = 232, y 112. The outline spans x from 217 (front left) to 254.5 (rear
    # right) and y from 87 to 137. Its half extent is 25 pixels, which belongs on stride 8. Pixels of stride 8 have
    # centres at 4, 12, ...: those up to 12 pixels from (232, 112) are in columns 27 to 30 and rows 12 to 15.
    found_cells = cells(found.locations)
    assert sorted(found_cells) == [(row, column) for row in (12, 13, 14, 15) for column in (27, 28, 29, 30)]
    assert found.labels.tolist() == [0] * 16
    at = found_cells.index((13, 28))  # its centre is (228, 108)
    ray_azimuth = math.atan2(10, 2)
    expected = [
        4 / 8, 4 / 8, math.log(10 * 8 / 200), math.log(4), math.log(1), math.log(2),
        math.sin(math.pi / 2 - ray_azimuth), math.cos(math.pi / 2 - ray_azimuth),
    ]  # fmt: skip
    np.testing.assert_allclose(found.boxes[at], expected, atol=1e-5)
    assert not found.ignored.any()


@pytest.mark.parametrize(("distance", "level"), [(7, 0), (5, 1)])
def test_the_level_follows_from_the_size_in_the_image(distance: float, level: int) -> None:
    # The box is seen from its side, 4 m long, with its near face at `distance`: half extents of 10, 57, 80 and
    # 160 pixels. The limits are 64 pixels at stride 8 and 128 at stride 16.
    found = targets((0, distance + 0.5, 1.5, 4, 1, 2, 0))
    starts = [0, 28 * 48, 28 * 48 + 14 * 24, 28 * 48 + 14 * 24 + 7 * 12]
    assert len(found.locations) > 0
    assert ((found.locations >= starts[level]) & (found.locations < starts[level + 1])).all()
    stride = 8 * 2**level
    torch.testing.assert_close(found.boxes[0, 2].exp(), torch.tensor((distance + 0.5) * stride / FOCAL))


@pytest.mark.parametrize("shapes", [[(7, 12)], [(28, 48), (14, 24)], [(28, 48), (14, 24), (7, 12), (4, 6), (2, 3)]])
def test_every_visible_box_is_detected_with_any_number_of_levels(shapes: list[tuple[int, int]]) -> None:
    near_and_far = ((0, 3, 1, 4, 2, 1.6, 0), (6, 20, 1, 4, 2, 1.6, 0), (-20, 60, 1, 0.4, 0.4, 1, 0))
    found = targets(*near_and_far, shapes=shapes)
    assert set(found.labels.tolist()) == {0, 1, 2}


def test_a_box_smaller_than_a_pixel_has_one_positive_pixel() -> None:
    found = targets((0.5, 60, 1.6, 0.4, 0.4, 1, 0))  # 1.3 x 3.3 pixels around (193.7, 111.7)
    assert cells(found.locations) == [(13, 24)]


def test_of_two_boxes_a_pixel_detects_that_of_the_nearer_center() -> None:
    one, other = (0, 10, 1.5, 1, 1, 1, 0), (1, 10, 1.5, 1, 1, 1, 0)  # centres 20 pixels apart, at x 192 and 212
    found = targets(one, other)
    pixels = feature_locations(tuple(SHAPES), SIZE, torch.device("cpu")).pixels[found.locations]
    assert set(found.labels.tolist()) == {0, 1}
    assert (pixels[found.labels == 0, 0] < 202).all()
    assert (pixels[found.labels == 1, 0] > 202).all()


@pytest.mark.parametrize("row", [(0, -10, 1, 4, 2, 1.6, 0), (100, 10, 1, 4, 2, 1.6, 0), (0, 10, 50, 4, 2, 1.6, 0)])
def test_boxes_behind_the_camera_or_outside_teach_nothing(row: tuple[float, ...]) -> None:
    for found in (targets(row), targets()):
        assert found.boxes.shape == (0, 8)
        assert not len(found.locations)
        assert found.ignored.shape == (28 * 48 + 14 * 24 + 7 * 12,)
        assert not found.ignored.any()


def test_a_box_centered_just_outside_is_detected_at_the_border() -> None:
    found = targets((10.2, 10, 1.5, 4, 2, 2, 0))  # centre at x 396, the image ends at 384, the box begins at 341
    pixels = feature_locations(tuple(SHAPES), SIZE, torch.device("cpu"))
    assert len(found.locations) > 0
    strides = pixels.strides[pixels.levels[found.locations]]
    projected = pixels.pixels[found.locations] + found.boxes[:, :2] * strides
    torch.testing.assert_close(projected, torch.tensor([[396.0, 112.0]]).expand_as(projected))
    assert not found.ignored.any()


def test_a_truck_beside_a_camera_is_not_detected_nor_background() -> None:
    """Its centre is behind the camera, its front end is visible."""
    row = (3, -1, 1.5, 12, 2, 3, math.pi / 2)
    found = targets(row)
    assert not len(found.locations)
    pixels = feature_locations(tuple(SHAPES), SIZE, torch.device("cpu")).pixels[found.ignored]
    # Its front at y = 5 ends at x = 2 m: pixel 192 + 200 · 2 / 5 = 272. It reaches the right border.
    assert 272 <= pixels[:, 0].min() < 288
    assert pixels[:, 0].max() > 376


def test_a_box_partly_behind_has_the_outline_of_its_front_part() -> None:
    """A box from 4 m behind to 8 m ahead looks like the box from the cutting plane to 8 m ahead."""
    start, end = OUTLINE_DEPTH_M, 8.0
    whole, part = (1, 2, 1.0, 12, 1, 1, math.pi / 2), (1, (start + end) / 2, 1.0, end - start, 1, 1, math.pi / 2)
    of_whole, of_part = (
        objects_of_image(image_from_bev(), truth(row).codes[0], SIZE).outlines for row in (whole, part)
    )
    torch.testing.assert_close(of_whole, of_part, atol=0.5, rtol=0)


def test_the_rotation_is_relative_to_the_viewing_ray() -> None:
    """Boxes around the camera, all turned away from it, have the same rotation: they look alike."""
    azimuths = np.radians([60, 90, 120])
    camera = np.linalg.inv(tilted_camera())[:3, 3]
    rows = [(camera[0] + 12 * math.cos(a), camera[1] + 12 * math.sin(a), 1, 4, 2, 1.6, a + 0.3) for a in azimuths]
    rotations = objects_of_image(image_from_bev(tilted_camera()), truth(*rows).codes[0], SIZE).rotations
    expected = torch.tensor([[math.sin(0.3), math.cos(0.3)]]).expand(3, 2)
    torch.testing.assert_close(rotations, expected, atol=1e-4, rtol=0)


def test_the_depth_target_ignores_scaling_of_image_and_focal() -> None:
    """The features of an image do not tell its focal length: the same pixels must have the same target."""
    half = np.diag([0.5, 0.5, 1]) @ INTRINSICS
    box = truth((2, 10, 1.5, 4, 1, 2, 0.2))
    whole_locations = feature_locations(tuple(SHAPES), SIZE, torch.device("cpu"))
    half_locations = feature_locations(tuple(SHAPES), (112, 192), torch.device("cpu"))
    whole = targets_of_image(image_from_bev(), box, whole_locations, SIZE)
    halved = targets_of_image(image_from_bev(intrinsics=half), box, half_locations, (112, 192))
    assert torch.equal(whole.locations, halved.locations)
    torch.testing.assert_close(whole.boxes, halved.boxes)


GRID = BevGrid(4, 8, x_range_m=(-8, 8), y_range_m=(-4, 4))  # cells of 2 m


def classed_boxes(*rows: tuple[str, float, float, float], num_points: list[int] | None = None) -> Boxes3D:
    """Rows of class, x, y, yaw; 4 m long, 2 m wide."""
    names, xs, ys, yaws = zip(*rows, strict=True)
    return made_boxes(np.stack([xs, ys], -1), names, yaws=np.array(yaws, dtype=float), num_points=num_points)


def test_boxes_out_of_range_class_or_points_are_no_targets(mini_config) -> None:
    config = replace(mini_config, classes=("car", "pedestrian"))
    rows = [("pedestrian", 1, 2, 0), ("car", 30, 0, 0), ("bus", 0, 0, 0), ("car", 5, 5, 0), ("car", 6, 5, 0)]
    truth = classed_boxes(*rows, num_points=[3, 9, 9, -1, 0])
    targets = detection_targets(truth, config)
    assert targets.labels.tolist() == [[1, 0]]
    assert targets.codes[0, :, :2].tolist() == [[1, 2], [5, 5]]


def test_a_vehicle_covers_the_cells_under_it() -> None:
    along_y = classed_boxes(("car", 1.0, 0.0, np.pi / 2), ("pedestrian", -5.0, 1.0, 0.0))
    targets = segmentation_targets(along_y, None, GRID)
    assert targets.has_stuff.tolist() == [[False]]
    expected = torch.zeros(1, 4, 8)
    expected[0, 1:3, 4] = 1  # x 0 to 2, y -2 to 2
    assert torch.equal(targets.things[0], expected.flatten(1))
    assert targets.locations[0].tolist() == [pytest.approx([9 / 16, 0.5, 2 / 16, 4 / 8])]
    small = replace(classed_boxes(("bicycle", 0.2, 0.2, 0.3)), sizes_lwh=np.array([[0.5, 0.3, 1.0]]))
    assert segmentation_targets(small, None, GRID).things[0].nonzero().tolist() == [[0, 2 * 8 + 4]]


def test_a_class_needs_a_minimum_share_of_a_cell() -> None:
    cells = np.zeros((8, 16), dtype=np.uint8)  # cells of 1 m; the first row has the largest y
    cells[:2] = 1  # y 2 to 4, the last row of the grid: all road
    cells[2, :2] = 4  # a crossing on half of the cell at the smallest x, y 0 to 2
    cells[4, :1] = 4  # a crossing on a quarter of the cell below: too little
    cells[7, 15] = 2  # a lane boundary on a quarter of the cell at the largest x, smallest y; enough for lines
    stuff = segmentation_targets(Boxes3D.empty(), BevMap(cells, (-8, 8), (-4, 4)), GRID).stuff[0]
    road, line, crossing = stuff.reshape(3, 4, 8)
    assert road[3].all()
    assert not road[:3].any()
    assert line.nonzero().tolist() == [[0, 7]]
    assert crossing.nonzero().tolist() == [[2, 0]]


def test_the_bits_of_a_map_are_those_that_it_states() -> None:
    cells = np.full((8, 16), 2, dtype=np.uint8)
    crossings = BevMap(cells, (-8, 8), (-4, 4), {"kerb": 1, "pedestrian_crossing": 2})
    stuff = segmentation_targets(Boxes3D.empty(), crossings, GRID).stuff[0]
    assert stuff.any(dim=1).tolist() == [False, False, True]
    kerbs = BevMap(np.zeros((8, 16), np.uint8), (-8, 8), (-4, 4), {"kerb": 1})
    with pytest.raises(InputError, match="has the classes kerb, but the segmentation head learns drivable_road"):
        segmentation_targets(Boxes3D.empty(), kerbs, GRID)
    with pytest.raises(InputError, match="covers x -6 to 6 m, but the model's BEV grid -8 to 8 m"):
        segmentation_targets(Boxes3D.empty(), BevMap(np.zeros((4, 4), np.uint8), (-6, 6), (-4, 4)), GRID)


WEIGHTS = PerspectiveLossConfig(weight=1.0)
NOTHING = PaddedTargets.of_frame(torch.zeros(0, dtype=torch.int64), torch.zeros(0, 10))
# Two levels, of strides 8 and 16.
TWO_LEVELS = replace(
    CONFIG,
    backbone=ResNetConfig((1, 1, 1, 1), width=8, output_stages=(2, 3)),
    neck=FPNConfig(2),
    image_tokens=ImageTokensConfig(level_embeddings=2),
    heads=("detection",),
)


def batch(frames: int = 2) -> Batch:
    """The second frame of painted drives."""
    clips = [Clip(drive, (1,)) for drive in range(frames)]
    return batch_of(PaintedDrives(frames), clips, TWO_LEVELS)


def make_head(layers: int = 1) -> PerspectiveHead:
    torch.manual_seed(0)
    return PerspectiveHead(TWO_LEVELS.channels, len(TWO_LEVELS.classes), layers)


def loss_of(
    head: PerspectiveHead,
    maps: list[torch.Tensor],
    data: Batch,
    config: PerspectiveLossConfig = WEIGHTS,
    *,
    has_image: torch.Tensor | None = None,
    targets: PaddedTargets | None = None,
) -> dict[str, torch.Tensor]:
    inputs = data.inputs[0]
    truth = data.targets[0].perspective if targets is None else targets
    seen = inputs.has_image if has_image is None else has_image
    return perspective_loss(head, maps, inputs.image_from_bev, seen, inputs.image_size, truth, config)


def random_maps(images: int) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(1)
    return [torch.randn(images, 32, rows, columns, generator=generator) for rows, columns in ((12, 16), (6, 8))]


@pytest.mark.slow
def test_backbone_and_head_learn_the_depths_of_boxes() -> None:
    data, head = batch(), make_head()
    torch.manual_seed(0)
    model = BEVFormer(TWO_LEVELS)
    inputs = data.inputs[0]
    trained = [*model.backbone.parameters(), *model.neck.parameters(), *head.parameters()]
    optimizer = torch.optim.Adam(trained, lr=3e-3)
    images = inputs.images.flatten(0, 1)
    totals = []
    for _ in range(200):
        maps = model.neck(model.backbone(images))
        loss = loss_of(head, maps, data)
        optimizer.zero_grad()
        sum(loss.values()).backward()
        optimizer.step()
        totals.append(sum(loss.values()).item())
    assert totals[-1] < totals[0] / 10

    logits, boxes = head(maps)
    locations = feature_locations(
        tuple((m.shape[-2], m.shape[-1]) for m in maps), inputs.image_size, torch.device("cpu")
    )
    errors = []
    for image, matrix in enumerate(inputs.image_from_bev.flatten(0, 1)):
        truth = of_frame(data.targets[0].perspective, image // 2)
        expected = targets_of_image(matrix, truth, locations, inputs.image_size)
        errors.append((boxes[image, expected.locations, 2] - expected.boxes[:, 2]).exp() - 1)
        assert torch.equal(logits[image, expected.locations].argmax(-1), expected.labels)
    relative = torch.cat(errors).abs()
    assert len(relative) > 20
    assert relative.max() < 0.2
    assert relative.mean() < 0.05


def test_the_backbone_receives_a_gradient_that_is_not_zero() -> None:
    """Through the hook that a training uses, with the loss of the BEV path left out."""
    torch.manual_seed(0)
    data, model = batch(), BEVFormer(TWO_LEVELS)
    losses = FrameLosses(model, TrainingConfig(perspective_loss=WEIGHTS))
    with losses.watching(model):
        outputs = model(data.inputs[0])
        named = losses(data.inputs[0], outputs, data.targets[0])
    (named["perspective classes"] + named["perspective boxes"]).backward()
    for module in (model.neck, losses.auxiliary_heads["perspective_head"], model.backbone.conv1, model.backbone.stages):
        gradients = [parameter.grad for parameter in module.parameters()]
        assert any(gradient is not None and gradient.any() for gradient in gradients)
    assert model.backbone.conv1.weight.grad.any()
    assert all(parameter.grad is None for parameter in model.encoder.parameters())


def test_every_parameter_of_the_head_receives_a_gradient() -> None:
    data, head = batch(), make_head(layers=2)
    loss = loss_of(head, random_maps(4), data)
    sum(loss.values()).backward()
    assert all(parameter.grad.any() for parameter in head.parameters())


def test_images_without_boxes_have_no_box_loss() -> None:
    data, head = batch(), make_head()
    loss = loss_of(head, random_maps(4), data, targets=of_all([NOTHING, NOTHING]))
    assert loss["perspective boxes"] == 0
    assert loss["perspective classes"] > 0
    loss["perspective boxes"].backward()
    assert not any(parameter.grad is not None and parameter.grad.any() for parameter in head.parameters())


def test_a_camera_without_an_image_contributes_nothing() -> None:
    data, head, maps = batch(), make_head(), random_maps(4)
    first_only = torch.tensor([[True, False], [False, False]])
    loss = loss_of(head, maps, data, has_image=first_only)
    changed = [features.clone() for features in maps]
    for features in changed:
        features[1:] += 7
    assert loss_of(head, changed, data, has_image=first_only) == loss
    assert loss_of(head, changed, data) != loss_of(head, maps, data)
    none = loss_of(head, maps, data, has_image=torch.zeros(2, 2, dtype=torch.bool))
    assert (none["perspective classes"], none["perspective boxes"]) == (0, 0)


def test_ignored_pixels_have_no_class_loss() -> None:
    """A truck beside a camera: its pixels may have any class logits."""
    data, head = batch(1), make_head(layers=0)
    matrix = data.inputs[0].image_from_bev[0, 0]
    truck = PaddedTargets.of_frame(torch.tensor([0]), torch.tensor([[2.5, -1, 1.1, 2.5, 0, 1.1, 0, -1, 0, 0]]))
    locations = feature_locations(((12, 16), (6, 8)), data.inputs[0].image_size, torch.device("cpu"))
    ignored = targets_of_image(matrix, truck, locations, data.inputs[0].image_size).ignored
    assert 0 < ignored.sum() < len(ignored)
    maps = random_maps(2)
    only_front = torch.tensor([[True, False]])

    def head_with_high_logits(pixels: torch.Tensor) -> torch.Tensor:
        def high(features: list[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
            logits, boxes = head(features)
            return torch.where(pixels[:, None], 9.0, logits), boxes

        return loss_of(high, maps, data, has_image=only_front, targets=truck)["perspective classes"]

    nowhere = torch.zeros_like(ignored)
    assert head_with_high_logits(ignored) == head_with_high_logits(nowhere)
    assert head_with_high_logits(~ignored) > head_with_high_logits(nowhere)


def test_a_batch_has_its_frames_mean_loss_by_positive_pixel() -> None:
    both, head, maps = batch(2), make_head(), random_maps(4)
    whole = loss_of(head, maps, both)
    inputs = both.inputs[0]
    locations = feature_locations(((12, 16), (6, 8)), inputs.image_size, torch.device("cpu"))
    total, count = 0.0, 0
    for frame in range(2):
        truth = of_frame(both.targets[0].perspective, frame)
        part = perspective_loss(
            head, [features[2 * frame : 2 * frame + 2] for features in maps], inputs.image_from_bev[[frame]],
            inputs.has_image[[frame]], inputs.image_size, truth, WEIGHTS,
        )  # fmt: skip
        positives = sum(
            len(targets_of_image(matrix, truth, locations, inputs.image_size).locations)
            for matrix in inputs.image_from_bev[frame]
        )
        total, count = total + positives * sum(part.values()).item(), count + positives
    assert sum(whole.values()).item() == pytest.approx(total / count, rel=1e-4)


def test_boxes_outside_the_grid_are_detected_too() -> None:
    """The grid ends at 16 m; the camera sees further."""
    config = replace(TWO_LEVELS, bev_grid=replace(TWO_LEVELS.bev_grid, y_range_m=(-6, 6)))
    data = batch_of(PaintedDrives(1), [Clip(0, (1,))], config)
    targets = data.targets[0]
    assert targets.detection.counts[0] < targets.perspective.counts[0] == 5
