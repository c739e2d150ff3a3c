"""Files are in the world of the data, whatever the scene's own was."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from plyfile import PlyData
from pygltflib import GLTF2

import forewarp
from forewarp.export.formats import FORMATS
from forewarp.scene.world import SAME, World
from tests.export.conftest import exporter

ROOM = World((3.0, -2.0, 0.5), 0.25)
UTM = World((456_012.3, 4_650_123.7, 81.2), 0.25)
MILLIMETRES = World((3000.0, -2000.0, 500.0), 0.25e-3)
OPTIONS = {
    "ply": {"degree": 3, "up": "world", "compressed": False},
    "glb": {"quality": "lossless", "seconds": 1.0},
    "usd": {"degree": 3, "up": "world", "seconds": 1.0},
    "mesh": {"resolution": 20, "level": 0.3, "files": "ply", "up": "world"},
    "gltf": {"points": 50, "seconds": 1.0},
    "npz": {"points": 50, "views": 2},
}


def vertices(file):
    table = PlyData.read(file)["vertex"]
    return np.stack([table[axis] for axis in "xyz"], -1)


def of_ply(folder):
    with np.load(folder / "motion.npz") as stored:
        motion = dict(stored)
    base = vertices(folder / "canonical.ply")
    maps = motion["maps"][-1][motion["links"]].astype(float)
    steps = (maps[..., :3] @ base[:, None, :, None] + maps[..., 3:])[..., 0]
    moved = base + (motion["weights"][..., None] * steps).sum(1)
    np.testing.assert_allclose(moved, vertices(folder / "frames" / "frame_0002.ply"), atol=1e-4, rtol=1e-5)
    return np.concatenate([base, moved, motion["node_places"]])


def of_glb(folder):
    scene = forewarp.load(folder / "scene.glb")
    cameras = torch.stack([camera.center for camera in scene.cameras])
    return torch.cat([scene.gaussians.ellipsoids(0.4).centers, cameras, scene.focus[None]]).numpy()


def of_usd(folder):
    Usd = pytest.importorskip("pxr.Usd")
    stage = Usd.Stage.Open(str(folder / "scene.usdc"))
    field = stage.GetPrimAtPath("/scene/particles")
    return np.concatenate([np.array(field.GetAttribute(name).Get(0)) for name in ("positions", "extent")])


def of_mesh(folder):
    return vertices(folder / "mesh_0001.ply")


def of_gltf(folder):
    file = GLTF2().load(folder / "points.glb")
    view = file.bufferViews[file.accessors[file.meshes[0].primitives[0].attributes.POSITION].bufferView]
    return (
        np.frombuffer(file.binary_blob(), np.float32, view.byteLength // 4, view.byteOffset)
        .reshape(-1, 3)
        .copy()
    )


def of_npz(folder):
    with np.load(folder / "trajectories.npz") as stored:
        return np.concatenate([stored["positions"].reshape(-1, 3), stored["camera_to_world"][:, :3, 3]])


PLACES = {"ply": of_ply, "glb": of_glb, "usd": of_usd, "mesh": of_mesh, "gltf": of_gltf, "npz": of_npz}


@pytest.mark.slow
@pytest.mark.parametrize("world", [ROOM, UTM, MILLIMETRES], ids=["room", "UTM", "mm"])
@pytest.mark.parametrize("kind", PLACES)
def test_places_are_those_of_the_data(particles, tmp_path, kind, world):
    if kind == "usd":
        pytest.importorskip("pxr")
    before = exporter(kind)(particles, tmp_path / "scene", **OPTIONS[kind])
    about = exporter(kind)(replace(particles, world=world), tmp_path / "data", **OPTIONS[kind])
    assert before["shift"] == [0, 0, 0]
    assert any(about["shift"]) == (world is UTM)
    assert about["normalisation"] == {"center": list(world.center), "scale": world.scale}
    assert json.loads((tmp_path / "data" / "about.json").read_text())["shift"] == about["shift"]
    if kind == "usd":
        stage = pytest.importorskip("pxr.Usd").Stage.Open(str(tmp_path / "data" / "scene.usdc"))
        assert [*stage.GetRootLayer().customLayerData.get("shift", (0, 0, 0))] == about["shift"]
    if kind == "ply":
        assert np.load(tmp_path / "data" / "motion.npz")["shift"].tolist() == about["shift"]
    wanted = world.to_data(PLACES[kind](tmp_path / "scene")).numpy()
    np.testing.assert_allclose(
        PLACES[kind](tmp_path / "data") + about["shift"], wanted, atol=max(1e-4, 1e-5 / world.scale), rtol=0
    )
    for key in ("spacing", "radius"):
        assert about.get(key) == (pytest.approx(before[key] / world.scale) if key in before else None)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["ply", "usd", "mesh"])
def test_turned_places_turn_back_by_the_rotation_of_about(particles, tmp_path, kind):
    if kind == "usd":
        pytest.importorskip("pxr")
    as_it_is = exporter(kind)(particles, tmp_path / "world", **OPTIONS[kind] | {"up": "world"})
    turned = exporter(kind)(particles, tmp_path / "turned", **OPTIONS[kind] | {"up": "y"})
    before, after = (np.array(about["rotation"]) for about in (as_it_is, turned))
    assert not np.allclose(after, np.eye(3))
    frame = "frames/frame_0001.ply"  # canonical.ply is not turned
    read = {"ply": lambda folder: vertices(folder / frame), "usd": lambda folder: of_usd(folder)[:-2]}
    places, back = (read.get(kind, of_mesh)(tmp_path / name) for name in ("world", "turned"))
    np.testing.assert_allclose(back @ after, places @ before, atol=1e-4)


def test_every_format_has_a_test_of_its_places():
    assert PLACES.keys() | {"html"} == FORMATS.keys()  # html holds a scene.glb


def test_sizes_are_those_of_the_data_and_headers_say_the_shift(particles, tmp_path):
    for name, source in (("scene", particles), ("data", replace(particles, world=UTM))):
        exporter("ply", **OPTIONS["ply"])(source, tmp_path / name)
    files = [PlyData.read(tmp_path / name / "frames" / "frame_0000.ply") for name in ("scene", "data")]
    before, after = (file["vertex"] for file in files)
    np.testing.assert_allclose(after["scale_1"], before["scale_1"] - np.log(UTM.scale), atol=1e-4)
    assert "Shift: 456010 4650120 80" in files[1].comments
    assert not any("Shift" in comment for comment in files[0].comments)


def test_a_file_shows_the_same_from_a_camera_of_the_data(particles, tmp_path):
    files = []
    for name, world in (("scene", SAME), ("data", UTM)):
        exporter("glb", **OPTIONS["glb"])(replace(particles, world=world), tmp_path / name)
        files.append(forewarp.load(tmp_path / name / "scene.glb"))
    camera = particles.cameras[1]
    pose = files[1].world.to_scene(UTM.to_data(camera.camera_to_world))
    drawn = files[1].render(replace(UTM.camera_to_data(camera), camera_to_world=pose), 0.4)
    wanted = files[0].render(camera, 0.4)
    assert float(wanted.rgb.std()) > 0.05
    torch.testing.assert_close(drawn.rgb, wanted.rgb, atol=1e-3, rtol=0)
    torch.testing.assert_close(drawn.depth * UTM.scale, wanted.depth, atol=1e-3, rtol=0)
