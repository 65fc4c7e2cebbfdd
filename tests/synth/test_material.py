"""Varied drives with models, skies and textures from a folder."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bevcli.errors import InputError
from bevcli.workshop.synth.catalog import Assets
from bevcli.workshop.synth.drive import RenderedDrive
from bevcli.workshop.synth.material import MaterialFolder
from bevcli.workshop.synth.mesh import PAINT, TriangleSoup, block
from bevcli.workshop.synth.rig import DrawnRig, RigDistribution, draw_rig, nuscenes_like_rig
from bevcli.workshop.synth.simulation import Density, draw_density

SEED = 6
SKY = (200, 40, 160)  # RGB
FRONT = replace(nuscenes_like_rig(96, 54), cameras=nuscenes_like_rig(96, 54).cameras[:1])


def write_model(folder: Path, name: str = "car-crate", **changes: object) -> Path:
    mesh = block((0, 0, 0.7), (4.4, 1.8, 1.4), PAINT)
    arrays = {"faces": mesh.faces, "albedo": np.full((12, 3), 0.5, np.float32), "material": mesh.material, "share": 1.0}
    (folder / "models").mkdir(parents=True, exist_ok=True)
    np.savez(folder / "models" / f"{name}.npz", **{**arrays, **changes})
    return folder


def write_sky(folder: Path) -> Path:
    (folder / "skies").mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "skies/pink.png"), np.full((8, 16, 3), SKY[::-1], np.uint8))
    return folder


def write_textures(folder: Path) -> Path:
    (folder / "textures").mkdir(parents=True, exist_ok=True)
    for kind in ("wall", "facade", "asphalt", "pavement", "leaf"):
        stripes = np.tile(np.array([40, 130], np.uint8), (4, 2))
        cv2.imwrite(str(folder / f"textures/{kind}-stripes.png"), stripes)
    return folder


def drive(assets: Assets, material: Path | str) -> RenderedDrive:
    return RenderedDrive(SEED, 2, rig=DrawnRig(FRONT, varied=True, material=str(material)), assets=assets)


def image(rendered: RenderedDrive, index: int) -> np.ndarray:
    return rendered.frame(index).images["CAM_FRONT"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_textures(write_sky(write_model(tmp_path_factory.mktemp("material"))))


@pytest.fixture(scope="module")
def varied(folder: Path, assets: Assets) -> RenderedDrive:
    return drive(assets, folder)


@pytest.mark.slow
def test_a_drive_with_material_is_the_same_each_time(varied: RenderedDrive, folder: Path, assets: Assets) -> None:
    image(varied, 0)
    np.testing.assert_array_equal(image(drive(assets, folder), 1), image(varied, 1))


def test_the_sky_of_a_drive_is_the_photograph(varied: RenderedDrive) -> None:
    assert len(varied._photo.sky)  # else choose another seed
    pixels = image(varied, 0)[:8].reshape(-1, 3)
    colors, counts = np.unique(pixels, axis=0, return_counts=True)
    blue, green, red = colors[counts.argmax()]
    assert counts.max() > 0.1 * len(pixels)
    assert red > blue > green + 30


@pytest.mark.slow
def test_what_is_not_drawn_anew_stays_in_place(varied: RenderedDrive, assets: Assets) -> None:
    plain, with_material = drive(assets, "").frame(0), varied.frame(0)
    fixed = [name for name in plain.boxes.instances if name.startswith(("rack", "standing", "fence", "site"))]
    same = [name for name in fixed if name in with_material.boxes.instances]
    before, after = (
        frame.boxes[[list(frame.boxes.instances).index(name) for name in same]] for frame in (plain, with_material)
    )
    assert len(same) > 3
    assert (plain.images["CAM_FRONT"] != with_material.images["CAM_FRONT"]).mean() > 0.3
    np.testing.assert_array_equal(before.centers, after.centers)
    np.testing.assert_array_equal(before.yaws, after.yaws)
    np.testing.assert_array_equal(before.classes, after.classes)


def test_textures_repeat_and_keep_their_aspect(tmp_path: Path) -> None:
    write_textures(tmp_path)
    cv2.imwrite(str(tmp_path / "textures/facade-stripes.png"), np.full((4, 12, 3), 85, np.uint8))
    textures = MaterialFolder.read(str(tmp_path)).textures
    facade = textures.of_kind["facade"][0]
    assert textures.aspects[facade] == 3
    assert (textures.texels[facade] == 85).all()
    assert textures.texels.shape[1] == sum(4**level for level in range(1, 9))


def test_paint_of_a_model_is_the_color_of_the_individual(folder: Path) -> None:
    model = MaterialFolder.read(str(folder)).models["car"][0]
    color, dye = np.array([0.8, 0.4, 0.2], np.float32), np.zeros(3, np.float32)
    soup = TriangleSoup.from_mesh(model.poses[0]).painted(color, dye, model.shaded)
    np.testing.assert_allclose(soup.albedo, np.tile(color / 2, (12, 1)))
    np.testing.assert_allclose(model.size_lwh, (4.4, 1.8, 1.4), rtol=1e-6)


def test_models_replace_a_share_of_their_class(folder: Path, assets: Assets) -> None:
    more = replace(assets, models=MaterialFolder.read(str(folder)).models)
    random, same = np.random.default_rng(1), np.random.default_rng(1)
    assert 0.55 < np.mean([more.draw("car", random).shaded for _ in range(300)]) < 0.75
    random = np.random.default_rng(1)
    for class_name in ("truck", "pedestrian", "car"):
        names = ["sedan", "taxi_rider"] if class_name == "car" else None  # riders have no model
        drawn = [more.draw(class_name, random, names).name for _ in range(20)]
        assert drawn == [assets.draw(class_name, same, names).name for _ in range(20)]


def test_standing_people_are_standing_models(tmp_path: Path, assets: Assets) -> None:
    write_model(write_model(tmp_path, "pedestrian-a"), "pedestrian-b_standing")
    more, random = replace(assets, models=MaterialFolder.read(str(tmp_path)).models), np.random.default_rng(0)
    drawn = {n: {more.draw("pedestrian", random, [n]).name for _ in range(50)} for n in ("man", "man_standing")}
    assert drawn == {"man": {"man", "a"}, "man_standing": {"man_standing", "b_standing"}}


def test_only_used_material_changes_the_digest(tmp_path: Path) -> None:
    one, other = write_sky(tmp_path / "a"), write_model(write_sky(tmp_path / "b"))
    assert RigDistribution().digest == "e360a40a"
    with pytest.raises(ValueError, match="varied_share must be above 0"):
        RigDistribution(material=str(one))
    assert RigDistribution(varied_share=0.5).digest == "cbb7af2d"
    digests = [RigDistribution(varied_share=0.5, material=str(folder)).digest for folder in (one, other)]
    assert len({*digests, "cbb7af2d"}) == 3
    rigs = [draw_rig(RigDistribution(varied_share=0.5, material="m"), seed, (96, 54)) for seed in range(20)]
    assert {(rig.varied, rig.material) for rig in rigs} == {(True, "m"), (False, "")}
    (tmp_path / "empty/models").mkdir(parents=True)
    for name in ("missing", "empty"):
        with pytest.raises(InputError, match=rf"{name}: .*expected models/\*-\*.npz"):
            _ = RigDistribution(varied_share=1.0, material=str(tmp_path / name)).digest
    drawn = [draw_density(np.random.default_rng(seed)) for seed in range(30)]
    assert {d.vehicles > Density().vehicles + 15 for d in drawn} == {True, False}
    for density in drawn:
        assert [sum(each.values()) for each in (density.traffic, density.parked)] == pytest.approx([1, 1])


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("tank-a", {}, "tank-a.npz: expected CLASS-NAME.npz with a class of car, .*found 'tank'"),
        ("car-a", {"albedo": np.zeros((12, 4))}, r"car-a.npz: albedo: expected .* \(12, 3\), found \(12, 4\)"),
        ("car-a", {"faces": np.full((12, 3, 3), np.nan)}, "car-a.npz: faces: expected finite numbers"),
        ("car-a", {"faces": np.zeros((0, 3, 3))}, "car-a.npz: faces: expected finite numbers"),
        ("car-a", {"material": np.full(12, 5)}, "car-a.npz: expected materials 0 MATTE, .*a share above 0"),
        ("car-a", {"share": np.array([1.0])}, r"car-a.npz: share: expected .* \(\), found \(1,\)"),
    ],
)
def test_a_wrong_model_is_an_error(name: str, changes: dict[str, np.ndarray], message: str, tmp_path: Path) -> None:
    write_model(tmp_path, name, **changes)
    with pytest.raises(InputError, match=message):
        MaterialFolder.read(str(tmp_path))


def test_wrong_textures_and_images_are_errors(tmp_path: Path) -> None:
    write_textures(tmp_path)
    cv2.imwrite(str(tmp_path / "textures/roof-a.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(InputError, match=r"roof-a\.png: expected KIND-NAME.png .*found 'roof'"):
        MaterialFolder.read(str(tmp_path))
    (tmp_path / "textures/roof-a.png").unlink()
    write_sky(tmp_path)
    (tmp_path / "skies/pink.png").write_bytes(b"no image")
    with pytest.raises(InputError, match=r"pink\.png: expected a whole image"):
        MaterialFolder.read(str(tmp_path))
