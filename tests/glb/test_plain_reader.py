"""docs/format.md suffices: a reader that follows it alone draws what forewarp draws."""

import numpy as np
import pytest
import torch

from forewarp import load
from forewarp.synth.scenes import synthesize
from tests.glb.plain_reader import DTYPES, MOTION, SPLATS, PlainScene, sixteen
from tests.support.commands import SCENE
from tests.support.gltf import packed

TIMES = (0.0, 0.37, 1.0)
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
LENSES = ({}, {"skew": 2.0, "lens": [-0.2, 0.02, 0.01, 0.02, -0.01]}, {"lens": [0.1, 0, 0, 0.03, 0]})
NATURAL = {"kind": "spline", "count": 5, "natural": True, "frames": 9}
COSINES = {"kind": "cosines", "count": 3, "frames": 7, "padding": 0.2}  # with them are no time offsets
RUNS = {
    "spline": "model/opacity_over_time=cosines model/view_dependence=harmonics model.view_dependence=3",
    "cosines": "model/motion=cosines model/rotation=none model/view_dependence=none model/background=none",
    "rest": "model/motion=none model/rotation=none model/background=none model/color_over_time=none",
}


def assert_alike(plain, scene, cameras, least=70):
    """Compare images of all cameras and times: PSNR above ``least`` dB, from 70 on each pixel within 2/255.

    The images differ where forewarp ends a tile early, or an alpha of about 1/255 is rounded the other way.
    """
    behind = torch.tensor(plain.background, dtype=torch.float32)
    for time in TIMES:
        for camera, own in zip(cameras, plain.cameras, strict=True):
            truth = scene.render(camera, time).rgb
            assert (truth - behind).abs().max() > 0.1  # something is in the image
            error = plain.render(own, time) - truth.numpy()
            assert -10 * np.log10((error**2).mean()) > least
            assert least < 70 or abs(error).max() < 2 / 255


@pytest.mark.slow
@pytest.mark.parametrize(
    ("curve", "without", "numbers"),
    [
        (NATURAL, [], 3),
        (NATURAL | {"count": 2}, ["timeOffsets", "colorOverTime"], 4),
        ({"kind": "spline", "count": 6, "frames": 9}, ["opacityOverTime", "opacityLogits"], 3),
        (COSINES, ["timeOffsets"], 4),
    ],
)
def test_a_file_written_by_the_page_is_drawn_alike(tmp_path, curve, without, numbers):
    file = write_scene(tmp_path / "scene.glb", curve, without, numbers)
    scene = load(file)
    assert_alike(PlainScene(file), scene, scene.cameras)


@pytest.mark.slow
@pytest.mark.parametrize("effects", RUNS)
def test_an_exported_run_is_drawn_alike(ok, small_scene, tmp_path, effects):
    run, words = tmp_path / "run", f"model=particles data=dnerf data.root={small_scene} data.scene=vehicle"
    words += " preset=demo trainer=cpu threads=1 budget.iterations=60 " + RUNS[effects]
    ok("train", *words.split(), f"run={run}")
    for quality, least in (("lossless", 70), ("compact", 44)):
        ok("export", f"run={run}", "format=glb", f"quality={quality}", f"out={tmp_path / quality}")
        file = tmp_path / quality / "scene.glb"
        plain, scene = PlainScene(file), load(file)
        assert_alike(plain, scene, scene.cameras)
        assert_alike(plain, load(run), scene.cameras, least)


@pytest.fixture(scope="module")
def small_scene(tmp_path_factory):
    """The folder with a small scene, ``vehicle``."""
    root = tmp_path_factory.mktemp("scenes")
    synthesize(root / "vehicle", **SCENE)
    return root


def test_groups_of_deltas_are_as_in_the_text_of_the_extension():
    group = bytes.fromhex("175ff0bc77a9210034b5")
    values, end = sixteen(group, 0, 2)
    values = [value >> 1 ^ -(value & 1) for value in values.tolist()]
    assert (values, end) == ([-1, -4, -3, 26, -91, 0, -6, 6, -4, -4, 5, -5, 1, -1, 0, 0], 10)


def write_scene(path, curve, without, numbers, seed=0):
    """Write a file of random Gaussians by the page: 40 move, 20 rest; return its path."""
    random, n, moving, m, k = np.random.default_rng(seed), 60, 40, 6, curve["count"]
    normal, uniform = random.standard_normal, random.uniform
    document = {"asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}]}
    document |= {"accessors": [], "bufferViews": [], "extensionsUsed": [SPLATS, MOTION]}
    blob = bytearray()

    def accessor(values, gap=0, **more):
        """Add an accessor of values (rows, columns); rows begin ``gap`` bytes after each other's end."""
        values = np.asarray(values)
        values = values if values.dtype.itemsize < 4 else values.astype("<f4")
        rows = values.reshape(len(values), -1)
        padded = np.hstack([rows.view(np.uint8), np.zeros((len(rows), gap), np.uint8)])
        view = {"buffer": 0, "byteOffset": len(blob), "byteLength": padded.size}
        document["bufferViews"].append(view | ({"byteStride": padded.shape[1]} if gap else {}))
        code = next(code for code, dtype in DTYPES.items() if dtype == rows.dtype)
        about = {"bufferView": len(document["bufferViews"]) - 1, "componentType": code, "count": len(rows)}
        document["accessors"].append(about | {"type": TYPES[rows.shape[1]]} | more)
        blob.extend(padded.tobytes() + bytes(-padded.size % 4))
        return len(document["accessors"]) - 1

    centers, q = uniform(-1, 1, (n, 3)).astype(np.float32), normal((n, 4))
    q = np.round(127 * q / np.linalg.norm(q, axis=1, keepdims=True)).astype(np.int8)
    limits = {"min": centers.min(0).tolist(), "max": centers.max(0).tolist()}
    attributes = {"POSITION": accessor(centers, gap=4, **limits)}
    attributes[f"{SPLATS}:ROTATION"] = accessor(q, normalized=True)
    attributes[f"{SPLATS}:SCALE"] = accessor(uniform(0.02, 0.2, (n, 3)))
    attributes[f"{SPLATS}:OPACITY"] = accessor(
        random.integers(0, 65536, n).astype(np.uint16), normalized=True
    )
    for degree, size in enumerate((1, 0.3, 0.3, 0.2)):
        for i in range(2 * degree + 1):
            attributes[f"{SPLATS}:SH_DEGREE_{degree}_COEF_{i}"] = accessor(size * normal((n, 3)))
    shares = random.integers(1, 256, (2, moving, 4)).astype(np.uint8)
    motion = {"version": "1.7", "later": 1, "canonicalTime": 0.3, "moving": moving, "curve": curve}
    motion |= {"blur": 0.3, "background": [0.2, 0.5, 0.9]}
    motion["nodes"] = {"positions": accessor(uniform(-1, 1, (m, 3)))}
    motion["nodes"] |= {"translations": accessor(0.3 * normal((m * k, 3)))}
    motion["nodes"] |= {"rotations": accessor(0.3 * normal((m * k, numbers)))}
    motion["features"] = ["quaternions"] if numbers == 4 else []
    motion["links"] = [accessor(random.integers(0, m, (moving, 4)).astype(np.uint8)) for _ in range(2)]
    motion["weights"] = [accessor(values, normalized=True) for values in shares]
    motion["timeOffsets"] = {"times": accessor([0.1, 0.4, 0.9]), "offsets": accessor([-0.15, 0.1, 0.2])}
    motion["colorOverTime"] = [accessor(0.2 * normal((n, 3))) for _ in range(3)]
    motion["opacityOverTime"] = [accessor(normal(n)) for _ in range(2)]
    motion["opacityLogits"] = accessor(normal(n))
    motion = {key: value for key, value in motion.items() if key not in without}
    splats = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "extensions": {MOTION: motion}}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {SPLATS: splats}}
    document["meshes"] = [{"primitives": [primitive]}]
    image = {"width": 40, "height": 30, "fx": 30.0, "fy": 33.0, "cx": 19.0, "cy": 16.0}
    frustum = {"yfov": 0.9, "aspectRatio": 4 / 3, "znear": 5.0, "zfar": 6.0}
    camera = {"type": "perspective", "perspective": frustum}
    document["cameras"] = [camera | {"extras": image | lens} for lens in LENSES]
    turn = {"rotation": [0, 0, 0.6, 0.8]}
    places = [(i, distance) for i in range(len(LENSES)) for distance in (3, 1.2, 0.3)]
    views = [{"camera": i, "translation": [0.1 * z, 0.2 * z, z]} | turn for i, z in places]
    mesh = {"mesh": 0, "rotation": [0.5, 0.5, 0.5, 0.5], "children": [*range(1, len(views) + 1)]}
    document["nodes"], document["buffers"] = [mesh, *views], [{"byteLength": len(blob)}]
    path.write_bytes(packed(document, bytes(blob)))
    return path
