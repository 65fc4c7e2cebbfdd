"""The program that makes models, skies and textures of public packages (material.py): its parts on made-up files."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path

import material
import material_images
import material_models
import numpy as np
import pytest
from material_models import Part, Soup
from PIL import Image

from bevcli.workshop.synth.mesh import Material

RED, BLUE = (1.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 1.0)
AC3D = """AC3Db
MATERIAL "" rgb 1 1 1 amb 1 1 1 emis 0 0 0 spec 0 0 0 shi 0 trans 0
OBJECT world
kids 1
OBJECT poly
name "BODY_s_0"
texture "colors.png" base
texture "shadow.png" tiled
loc 1 0 0
numvert 4
0 0 0
2 0 0
0 1 0
2 1 0
numsurf 1
SURF 0x14
mat 0
refs 4
0 0 0
1 1 0
2 0 1
3 1 1
kids 0
"""


def test_an_ac3d_file_gives_the_triangles_of_its_strips(tmp_path: Path) -> None:
    Image.fromarray(np.array([[[255, 0, 0], [0, 0, 255]]], np.uint8)).save(tmp_path / "colors.png")
    (tmp_path / "model.acc").write_text(AC3D)
    soup = material_models.read_ac3d(tmp_path / "model.acc")
    # x forward and y up become x forward and z up; the location is added.
    expected = [[(1, 0, 0), (3, 0, 0), (1, 0, 1)], [(1, 0, 1), (3, 0, 0), (3, 0, 1)]]
    assert np.array_equal(soup.corners, expected)
    assert {soup.parts[k].name for k in soup.part} == {"BODY_s_0"}
    assert np.array_equal(soup.parts[soup.part[0]].image, [[RED, BLUE]])
    normal, area = material_models.normals(soup.corners)
    assert np.array_equal(normal, [(0, -1, 0)] * 2)  # both triangles of the strip face one side
    assert np.array_equal(area, [1, 1])


def square(image: list) -> Soup:
    """A square of 1 m, upright, with an image on it."""
    corners = np.array([[(0, 0, 0), (1, 0, 0), (1, 0, 1)], [(0, 0, 0), (1, 0, 1), (0, 0, 1)]], float)
    return Soup(corners, corners[..., [0, 2]], np.zeros(2, int), [Part("", np.ones(4), np.array(image))])


def test_the_first_row_of_an_image_is_the_top() -> None:
    fine = material_models.split(square([[RED], [BLUE]]), longest_m=0.1)
    red, middle = fine.colors().mean(1)[:, 0], fine.corners.mean(1)
    assert (red[middle[:, 2] > 0.6] > 0.95).all()
    assert (red[middle[:, 2] < 0.4] < 0.05).all()


def test_splitting_keeps_the_surface() -> None:
    coarse = square([[RED, BLUE]])
    fine = material_models.split(coarse, longest_m=0.1)
    area = material_models.normals(fine.corners)[1]
    assert len(area) > 2
    assert area.sum() == pytest.approx(1)
    assert np.allclose(fine.uv, fine.corners[..., [0, 2]])
    plain = material_models.split(square([[RED, RED]]), longest_m=0.1)
    assert len(plain.part) == 2


def box(*size: float) -> Soup:
    """A box of two parts: its lower triangles are the body, those on the top are glass. All corners are clockwise."""
    mesh = material_models.trimesh.creation.box(size)
    top = mesh.triangles[..., 2].min(1) > 0
    parts = [Part("body", np.array([0.5, 0, 0, 1])), Part("window", np.array([0, 0, 0, 1.0]))]
    return Soup(mesh.triangles[:, ::-1].copy(), np.zeros((12, 3, 2)), top.astype(int), parts)


@pytest.mark.slow
def test_a_vehicle_has_its_size_paint_and_glass() -> None:
    inside = box(0.4, 0.4, 0.4)
    inside = inside._replace(corners=inside.corners + (0.03, 0.05, 0.02))
    mesh = material_models.vehicle(material_models.joined([box(1, 1, 1), inside]), (4.0, 2.0, 1.5))
    assert np.allclose(mesh.extents, (4, 2, 1.5), atol=1e-6)
    assert len(mesh.faces) == 10  # without the underside, and without the box inside
    normal, _ = material_models.normals(mesh.faces.astype(float))
    outwards = mesh.faces.mean(1) - (0, 0, 0.75)
    assert ((normal * outwards).sum(1) > 0).all()
    paint = mesh.material == Material.PAINT
    assert np.array_equal(mesh.material[~paint], [Material.GLASS] * 2)
    assert np.allclose(mesh.albedo[paint], 1, atol=1e-6)  # a factor on the paint of the individual


def test_clothes_take_the_colors_of_the_individual() -> None:
    assert material_models.KINDS[material_models.TOP] == Material.PAINT
    assert material_models.KINDS[material_models.LEGS] == Material.DYE


def test_smoothing_moves_only_the_points_of_clothes() -> None:
    points = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 3)], float)
    faces = np.array([(0, 1, 2), (1, 3, 2)])
    moved = material_models.smoothed(points, faces, np.array([0, 0, 0, 1]))
    assert np.array_equal(moved[:3], points[:3])
    assert np.allclose(moved[3], (0.5, 0.5, 0))  # the mean of its neighbours


def test_a_texture_has_the_stated_mean_and_repeats() -> None:
    draw = np.random.default_rng(0)
    slope = np.linspace(0, 120, 300)[None, :, None] + draw.uniform(0, 80, (200, 300, 3))
    image = np.concatenate([slope, np.full((200, 300, 1), 255)], -1).astype(np.uint8)
    asphalt = material_images.texture("asphalt", image)
    assert asphalt.mean((0, 1)) == pytest.approx([85, 85, 85], rel=1e-3)
    seam = np.abs(asphalt[:, 0] - asphalt[:, -1]).mean()
    assert seam < 1.5 * np.abs(np.diff(asphalt, axis=1)).mean() + 5
    facade = material_images.texture("facade", np.full((200, 300, 4), 188, np.uint8))
    assert facade.shape == (256, 404, 3)  # 300 of 190 pixels: the lowest twentieth is cut off
    assert np.allclose(facade, 85)


def test_a_cutout_is_pasted_at_the_horizon_and_around() -> None:
    image = np.zeros((material_images.HEIGHT, material_images.WIDTH, 3), np.float32)
    cutout = np.full((8, 8, 3), 100, np.float32)
    material_images.paste(image, cutout, np.ones((8, 8, 1), np.float32), material_images.WIDTH - 4, 8, 8)
    assert np.allclose(image[-8:, :4], 100)
    assert np.allclose(image[-8:, -4:], 100)
    assert image.sum() == pytest.approx(8 * 8 * 3 * 100)


def test_a_sun_that_lost_colors_is_white() -> None:
    light = np.full((4, 64, 3), 0.5, np.float32)
    light[:2, 16:24], light[2:, 16:24] = (np.inf, -np.inf, np.nan), (0, -1e-6, 9000)
    shown = material_images.displayed(light, brightness=0.5)
    assert shown.shape == (512, 2048, 3)
    assert (shown[:, 600:680] > 250).all()


def test_sources_that_are_missing_are_left_out(tmp_path: Path, monkeypatch, capsys) -> None:
    written = []
    with zipfile.ZipFile(tmp_path / "made-1-py3.whl", "w") as wheel:
        wheel.writestr("made/up.txt", "1")
        wheel.writestr("other.txt", "2")

    def build(package: Path, out: Path) -> None:
        written.extend(path.name for path in package.rglob("*.txt"))

    there = material.Source("made 1", "made-1-*.whl", ("no-such-program",), "made/", build, "CC0\n  made.npz")
    missing = there._replace(name="other 2", pattern="other-*.whl")
    broken = there._replace(name="other 3", pattern="more-*.whl", download=(sys.executable, "-c", "exit('no network')"))
    monkeypatch.setattr(material, "SOURCES", (missing, broken, there))
    assert material.main([str(tmp_path / "out"), "--packages", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "other 2 is left out: there is no no-such-program" in said
    assert "no network" in said
    assert written == ["up.txt"]
    assert (tmp_path / "out/LICENCES.txt").read_text() == "made 1: CC0\n  made.npz\n"
    monkeypatch.setattr(material, "SOURCES", (missing,))
    assert material.main([str(tmp_path / "out"), "--packages", str(tmp_path)]) == 1
