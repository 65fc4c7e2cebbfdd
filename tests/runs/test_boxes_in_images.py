"""Boxes in the images, of a model on a detector: in Python, in the file of a run, in its recording and video."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from memory_drive import MemoryDrive, WithoutImages

from bevcli.geometry.object_classes import NUSCENES_CLASSES
from bevcli.inference.load import Model
from bevcli.inference.run import run
from bevcli.model.bevformer.bevformer import BEVFormer
from bevcli.model.image_boxes import ImageBoxes
from bevcli.model.nanodet import NanoDet, NanoDetConfig
from bevcli.recording import entities
from bevcli.runs.run_into_folder import run_into_folder
from bevcli.viewer.recording_reader import RecordingReader
from bevcli.workshop.video import RecordedImages, draw_frame, tiles

IN_IMAGE = [32.5, 18.5, 160.5, 90.5]  # of the box in the images of 320 x 180, of which the network sees half
PERSON = np.array(NUSCENES_CLASSES["pedestrian"].color)


@pytest.fixture
def model(mini_config, monkeypatch) -> Model:
    """It sees a person of score 0.9 and a weak one of 0.1 in each image."""

    def seen(backbone, maps, has_image, sizes=None):
        boxes = torch.tensor([16.0, 9.0, 80.0, 45.0]).expand(*has_image.shape, 2, 4)
        scores = torch.tensor([0.9, 0.1]) * has_image[..., None]
        none = boxes[..., :0]
        return ImageBoxes(boxes, scores, torch.zeros(scores.shape, dtype=torch.int64), none, none, none)

    monkeypatch.setattr(NanoDet, "image_boxes", seen)
    return Model(BEVFormer(replace(mini_config, backbone=NanoDetConfig(output_stages=(1,)))).eval())


def test_a_prediction_has_the_boxes_of_each_camera(model, mini_model):
    [(_, prediction)] = run(model, MemoryDrive(1))
    assert list(prediction.image_boxes) == list(prediction.camera_embeddings)
    strong, weak = prediction.image_boxes["CAM_BACK"]
    assert (strong.class_name, strong.score, weak.score) == ("person", pytest.approx(0.9), pytest.approx(0.1))
    np.testing.assert_allclose(strong.corners, IN_IMAGE)
    [(_, without)] = run(Model(mini_model), MemoryDrive(1))
    assert without.image_boxes is None


def test_a_plot_shows_those_of_its_score(model):
    [(_, prediction)] = run(model, MemoryDrive(1))
    images = [replace(prediction, image_boxes=boxes).plot("CAM_FRONT") for boxes in (prediction.image_boxes, None)]
    rows, columns = np.nonzero((images[0] != images[1]).any(-1))
    np.testing.assert_allclose((columns.min(), rows.min(), columns.max(), rows.max()), IN_IMAGE, atol=2)
    hidden = [
        replace(prediction, image_boxes=boxes).plot("CAM_FRONT", score=0.95) for boxes in (None, prediction.image_boxes)
    ]
    assert (hidden[0] == hidden[1]).all()


def test_a_run_writes_and_draws_them(model, mini_model, tmp_path):
    run_into_folder(model, WithoutImages({1: "all"}, count=2), tmp_path / "out")
    lines = (tmp_path / "out/image_boxes.csv").read_text().splitlines()
    assert lines[0] == "frame,scene,timestamp_ns,camera,class,score,x0,y0,x1,y1"
    assert lines[1] == "0,a,1000000000000000000,CAM_FRONT,person,0.9,32.5,18.5,160.5,90.5"
    assert len(lines) == 1 + 6 * 2
    entity = entities.overlay("CAM_BACK", "image_boxes")
    for frame, count in zip(RecordingReader(tmp_path / "out/recording.rrd").frames(), (1, 0), strict=True):
        strips = frame.strips(entity, "LineStrips2D:strips")
        assert len(strips) == count
        np.testing.assert_allclose([strip[[0, 2]].ravel() for strip in strips], [IN_IMAGE] * count)
        in_video = draw_frame(frame, tiles(frame), RecordedImages())[:500, :1280].astype(int)
        assert ((np.abs(in_video - PERSON[::-1]).max(-1) < 20).sum() > 100) == count
    run_into_folder(Model(mini_model), MemoryDrive(1), tmp_path / "other")
    assert not (tmp_path / "other/image_boxes.csv").exists()
