import pytest
from memory_drive import make_rig

from bevcli.errors import InputError
from bevcli.geometry.cameras import NUSCENES_YAWS_DEG
from bevcli.model.step import assign_cameras

MODEL = tuple(NUSCENES_YAWS_DEG)


def test_known_names_take_the_models_order_not_the_rigs():
    rig = make_rig(dict(reversed(NUSCENES_YAWS_DEG.items())))
    assignment = assign_cameras(rig, MODEL)
    assert assignment.cameras == assignment.embeddings == MODEL


def test_unknown_names_go_by_viewing_direction():
    rig = make_rig({"nose": 4.0, "tail": -176.0, "left": 80.0, "right": -92.0})
    assignment = assign_cameras(rig, MODEL)
    given = dict(zip(assignment.cameras, assignment.embeddings, strict=True))
    assert given == {"nose": "CAM_FRONT", "tail": "CAM_BACK", "left": "CAM_FRONT_LEFT", "right": "CAM_BACK_RIGHT"}


def test_a_seventh_camera_shares_an_embedding_after_its_owner():
    assignment = assign_cameras(make_rig({**NUSCENES_YAWS_DEG, "extra": 2.0}), MODEL)
    assert assignment.cameras[:2] == ("CAM_FRONT", "extra")
    assert assignment.embeddings[:2] == ("CAM_FRONT", "CAM_FRONT")


def test_the_users_choice_goes_first_and_is_checked():
    rig = make_rig({"nose": 0.0})
    assert assign_cameras(rig, MODEL, {"nose": "CAM_BACK"}).embeddings == ("CAM_BACK",)
    with pytest.raises(InputError, match="tail"):
        assign_cameras(rig, MODEL, {"tail": "CAM_BACK"})
    with pytest.raises(InputError, match="CAM_TOP"):
        assign_cameras(rig, MODEL, {"nose": "CAM_TOP"})
