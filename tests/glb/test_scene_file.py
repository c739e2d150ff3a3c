"""What is written is read back; what is none of ours is refused."""

import math
import struct
import tracemalloc
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

import forewarp
from forewarp.fields.curves import Curve
from forewarp.fields.moving import MovingGaussians, NodeMotion
from forewarp.fields.windows import Window
from forewarp.glb.reader import Container, Fields, read
from forewarp.glb.writer import COMPACT, LOSSLESS, MOTION, SPLATS, Setting, morton, rows_in_file, write
from forewarp.scene.camera import Lens
from forewarp.scene.cloud import Ellipsoids
from forewarp.scene.view import Moment, View
from tests.support.gltf import attributes_of, motion_of, packed, unpacked
from tests.support.tiny_scene import ball_scene

CAMERAS = [frame.camera for frame in ball_scene(frames=5, size=20).train]
NODES, COUNT = 7, 90
TIMES = (0.0, 0.13, 0.5, 1.0)
OPTIONS = {
    "natural splines": {},
    "splines": {"natural": False},
    "cosines": {"kind": "cosines", "offsets": 0.0},
    "no rotation": {"rotates": False},
    "no motion": {"kind": None},
    "colours and opacity over time": {"over_time": 2},
    "every effect": {"over_time": 3, "rests": True, "degree": 3},
    "no offsets": {"offsets": 0.0, "degree": 0, "rests": True},
}


def moving(kind="spline", *, natural=True, rotates=True, over_time=0, rests=False, degree=1, offsets=0.1):
    """Random Gaussians in view of ``CAMERAS``; some have faded, and a third of them rests if ``rests``."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape, size=1.0):
        return size * torch.randn(*shape, generator=generator)

    opacity, motion = random(COUNT), None
    opacity[::7] = -9.0
    if kind is not None:
        curve = Curve(kind, 8, 9, 0.25, straight=natural)
        links = torch.stack([torch.randperm(NODES, generator=generator)[:6] for _ in range(COUNT)]).int()
        weights = random(COUNT, 6, size=3).softmax(-1)
        if rests:
            weights[::3] = 0
        shape = NODES, curve.count, 3
        turns = random(*shape, size=0.2) if rotates else None
        times = torch.linspace(0, 1, 9).tolist() if offsets else []
        shifts = random(len(times)).clamp(-1.5, 1.5).mul(offsets).tolist()
        places = random(NODES, 3, size=0.4)
        motion = NodeMotion(places, random(*shape, size=0.2), turns, curve, links, weights, times, shifts)
    return MovingGaussians(
        random(COUNT, 3, size=0.4), random(COUNT, 3, size=0.5) - 2.5, random(COUNT, 4), opacity,
        random(COUNT, (degree + 1) ** 2, 3, size=0.5), random(COUNT, over_time, 3) if over_time else None,
        random(COUNT, over_time) if over_time else None, 0.25, 0.1, motion,
    )  # fmt: skip


def written(gaussians, quality=LOSSLESS, cameras=CAMERAS):
    rotation, focus = torch.eye(3).double(), torch.ones(3).double()
    setting = Setting(cameras, rotation, focus, 2.5, (0.0, 0.5, 1.0))
    return write([(Window(gaussians, (0.0, 1.0), 0.0), rows_in_file(gaussians))], setting, quality)


@pytest.fixture(scope="module")
def every():
    return moving(**OPTIONS["every effect"])


@pytest.fixture
def kept(tmp_path):
    """``kept(data)`` is a file of these bytes."""

    def keep(data):
        path = tmp_path / "scene.glb"
        path.write_bytes(data)
        return path

    return keep


def parts(cloud: Ellipsoids) -> dict[str, torch.Tensor]:
    return {field.name: getattr(cloud, field.name) for field in fields(cloud)}


@pytest.mark.parametrize("options", OPTIONS.values(), ids=OPTIONS)
def test_a_lossless_file_holds_what_the_model_shows_at_all_times(options, kept):
    gaussians = moving(**options)
    held = read(kept(written(gaussians))).gaussians
    order, count, _ = rows_in_file(gaussians)
    assert 0 < len(order) < len(gaussians.means)
    assert held.moves == (options.get("kind", "spline") is not None) == (count > 0)
    for time in TIMES:
        now, wanted = parts(held.ellipsoids(time)), parts(gaussians.ellipsoids(time)[order])
        for name in wanted:
            torch.testing.assert_close(now[name], wanted[name], rtol=3e-5, atol=3e-6, msg=name)
    if gaussians.motion is not None and gaussians.motion.times:
        assert held.motion.motion_time(0.13) == pytest.approx(gaussians.motion.motion_time(0.13), abs=1e-6)


def test_a_compact_file_is_near_it_and_much_smaller(every, kept):
    data = written(every, COMPACT)
    assert len(unpacked(data)[1]) < 0.45 * len(unpacked(written(every))[1])
    held, (order, count, _) = read(kept(data)).gaussians, rows_in_file(every)
    least = 0.02  # a sixth of a pixel of these images
    for time in TIMES:
        now, wanted = held.ellipsoids(time), every.ellipsoids(time)[order]
        assert float((now.centers - wanted.centers).norm(dim=-1).max()) < least
        error = (now.covariances - wanted.covariances).abs().amax((1, 2))
        size = wanted.covariances.diagonal(dim1=1, dim2=2).sum(1)
        assert bool((error < 0.05 * size + least**2).all())
        torch.testing.assert_close(now.opacity, wanted.opacity, rtol=0, atol=0.02)
        torch.testing.assert_close(now.harmonics, wanted.harmonics, rtol=0, atol=0.06)
    assert 0 < count < len(order)  # those at rest come last
    weights = held.motion.weights.sum(1)
    torch.testing.assert_close(weights[:count], torch.ones(count))
    assert not weights[count:].any()


def test_images_of_a_file_are_those_of_the_run(every, kept):
    camera = replace(CAMERAS[1], skew=0.4, lens=Lens((0.1, -0.05, 0.0), (0.01, 0.0)))
    scene = forewarp.load(kept(written(every, cameras=[camera, *CAMERAS[2:5]])))
    assert len(scene.cameras) == 4
    for field in fields(camera):
        if field.name not in ("camera_to_world", "near"):
            assert getattr(scene.cameras[0], field.name) == getattr(camera, field.name)
    torch.testing.assert_close(scene.cameras[0].camera_to_world, camera.camera_to_world)
    assert (scene.seconds, scene.background.tolist()) == (2.5, [0.0, 0.5, 1.0])
    for time in (0.0, 0.7):
        wanted = every.at(Moment(time)).render(View(camera), scene.background).rgb.clamp(0, 1)
        image = scene.render(camera.camera_to_world.numpy(), time).rgb
        torch.testing.assert_close(image.reshape(-1, 3), wanted, rtol=0, atol=1e-4)
        assert image.std() > 0.05
    points = scene.matter().points[:5]
    paths = scene.trajectories(points, [every.canonical_time, 0.9])
    torch.testing.assert_close(paths[:, 0], points, rtol=0, atol=1e-3)
    wanted = every.trajectories(points, torch.tensor([0.9]))[:, 0]
    torch.testing.assert_close(paths[:, 1], wanted, rtol=0, atol=1e-3)
    with pytest.raises(ValueError, match="time: expected a number in"):
        scene.render(scene.cameras[0], 1.5)


def test_points_near_each_other_lie_near_each_other_in_a_file():
    points = np.random.default_rng(0).normal(size=(2000, 3))
    ordered = points[np.argsort(morton(points))]
    apart = [np.linalg.norm(np.diff(places, axis=0), axis=1).mean() for places in (points, ordered)]
    assert apart[1] < 0.25 * apart[0]
    assert morton(np.zeros((3, 3))).tolist() == [0, 0, 0]


def test_a_scene_of_one_particle_at_rest(kept):
    one, colors = torch.zeros(1, 3), torch.full((1, 1, 3), 0.3)
    still = MovingGaussians(one, one - 1, torch.zeros(1, 4), one[:, 0], colors, None, None, 0.0, 0.1, None)
    for quality in (LOSSLESS, COMPACT):
        held = read(kept(written(still, quality))).gaussians
        assert not held.moves
        torch.testing.assert_close(held.means, one)
        assert held.at(Moment(0.3)).gaussians.opacity.tolist() == [[pytest.approx(0.0, abs=0.01)]]
        turned = held.template().roots  # a quaternion of length 0 turns nothing
        torch.testing.assert_close(turned, math.exp(-1) * torch.eye(3)[None], rtol=0, atol=0.01)


# What is refused -------------------------------------------------------------------------------------------


def setter(path, value):
    """Sets a property by its path of keys."""

    def change(description):
        *head, last = path
        for key in head:
            description = description[key]
        if value is None:
            del description[last]
        else:
            description[last] = value

    return change


def in_motion(*path_and_value):
    *path, value = path_and_value
    return lambda description: setter(path, value)(motion_of(description))


COMPRESSED = ("bufferViews", 0, "extensions", "EXT_meshopt_compression")
WRONG = {
    "another major version": (in_motion("version", "2.0"), "expected version 1.1, but got '2.0'"),
    "no version": (in_motion("version", None), "version: expected a text, but got none"),
    "an unknown feature": (in_motion("features", ["births"]), "features known here, but got 'births'"),
    "a feature that is no name": (in_motion("features", [[]]), "features known here, but got []"),
    "an unknown extension": (setter(["extensionsRequired"], ["KHR_x"]), "known here, but got 'KHR_x'"),
    "no extension": (
        setter(["meshes", 0, "primitives", 0, "extensions"], None),
        f"expected Gaussians with {MOTION}, but got a glTF without",
    ),
    "no meshes": (setter(["meshes"], []), "mesh: expected a whole number from 0 to -1, but got 0"),
    "an accessor that there is not": (in_motion("nodes", "positions", 999), "accessors, but got 999"),
    "a negative accessor": (in_motion("links", [-1]), "accessors, but got -1"),
    "no positions": (lambda d: attributes_of(d).pop("POSITION"), "POSITION: expected one of"),
    "a lost harmonic": (
        lambda d: attributes_of(d).pop(f"{SPLATS}:SH_DEGREE_2_COEF_4"),
        "COEF_4: expected",
    ),
    "another type": (setter(["accessors", 0, "type"], "VEC4"), "POSITION: expected rows of VEC3, but got"),
    "too many rows": (setter(["accessors", 1, "count"], 10**6), "ROTATION: expected"),
    "absurd counts": (setter(["accessors", 0, "count"], 2**60), "count: expected a whole number from 1"),
    "an absurd view": (
        lambda d: [setter([*COMPRESSED, "count"], 2**27)(d), setter(["accessors", 0, "count"], 2**27)(d)],
        "expected at most 268435456 bytes in all",
    ),
    "a large view": (setter([*COMPRESSED, "count"], 10**7), "expected 10000000 elements by attribute codec"),
    "a view beyond the end": (setter([*COMPRESSED, "byteOffset"], 2**30), "bytes, but got"),
    "an unknown filter": (setter([*COMPRESSED, "filter"], "COLOR"), "but got ATTRIBUTES by COLOR"),
    "triangles": (setter([*COMPRESSED, "mode"], "TRIANGLES"), "but got TRIANGLES"),
    "an odd stride": (setter([*COMPRESSED, "byteStride"], 6), "expected a stride of"),
    "a sparse accessor": (setter(["accessors", 0, "sparse"], {}), "expected plain numbers"),
    "an unknown component": (setter(["accessors", 0, "componentType"], 5130), "expected plain numbers"),
    "a word for a number": (in_motion("canonicalTime", "soon"), "canonicalTime: expected a number from 0"),
    "true for a number": (in_motion("moving", True), "moving: expected a whole number from"),
    "more in motion": (in_motion("inMotion", 10**5), "inMotion: expected a whole number from 0 to"),
    "more that move": (in_motion("moving", 10**5), "moving: expected a whole number from 0 to"),
    "an unknown curve": (in_motion("curve", "kind", "bezier"), "kind: expected spline or cosines"),
    "cosines with offsets": (
        lambda d: motion_of(d)["curve"].update(kind="cosines", padding=0.2),
        "curve.kind: expected spline, as there are timeOffsets, but got 'cosines'",
    ),
    "a curve of other length": (in_motion("curve", "count", 9), "translations: expected"),
    "far too many links": (in_motion("links", [1] * 17), "links: expected a list of at most 16, but got"),
    "far too many cosines": (in_motion("colorOverTime", [8] * 65), "expected a list of at most 64"),
    "another cutoff": (in_motion("cutoff", 0.01), "cutoff: expected 0.00392157, but got 0.01"),
    "no nodes": (in_motion("nodes", None), "nodes: expected an object, but got None"),
    "no weights": (in_motion("weights", []), "weights: expected accessors, but got none"),
    "offsets of other length": (
        lambda d: in_motion("timeOffsets", "offsets", motion_of(d)["opacityLogits"])(d),
        "expected ascending times in [0, 1] with offsets",
    ),
    "a list for an object": (setter(["meshes", 0], []), r"meshes[0]: expected an object, but got []"),
    "no lens": (setter(["cameras", 0, "extras", "lens"], [1]), "lens: expected 5 numbers, but got [1]"),
    "no image": (setter(["cameras", 0, "extras", "width"], 0), "width: expected a whole number from 1"),
    "a scaled scene": (setter(["nodes", 0, "scale"], [2, 2, 2]), "scale: expected a rotation alone"),
    "no rotation": (setter(["nodes", 0, "rotation"], [0, 0, 0, 0]), "expected a unit quaternion"),
    "no node": (setter(["nodes", 0, "children"], [10**6]), "children: expected nodes, but got 1000000"),
}


@pytest.mark.parametrize(("change", "says"), WRONG.values(), ids=WRONG)
def test_a_file_with_a_mistake_is_refused_by_name(every, kept, change, says):
    description, binary = unpacked(written(every, COMPACT))
    change(description)
    path = kept(packed(description, binary))
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        forewarp.load(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert says in text
    assert "\n" not in text
    assert len(text) < 300 + len(str(path))


@pytest.mark.parametrize("name", ["absurd counts", "an absurd view", "a large view", "too many rows"])
def test_what_a_file_claims_takes_no_memory(every, kept, name):
    description, binary = unpacked(written(every, COMPACT))
    WRONG[name][0](description)
    path = kept(packed(description, binary))
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=r"scene\.glb: "):
            read(path)
        assert tracemalloc.get_traced_memory()[1] < 1 << 22
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("made", "says"),
    [
        (lambda data: b"", "expected a binary glTF, but got another file"),
        (lambda data: b"ply\nformat ascii 1.0\n" * 9, "expected a binary glTF, but got another file"),
        (lambda data: data[:-1], "bytes, as its header says, but got"),
        (lambda data: data + b"more", "bytes, as its header says, but got"),
        (lambda data: data[:4] + struct.pack("<I", 1) + data[8:], "expected version 2 of glTF, but got 1"),
        (lambda data: data[:12] + b"\xff\xff\xff\x7f" + data[16:], "expected a whole chunk of JSON"),
        (lambda data: packed(b"{}", b""), f"expected Gaussians with {MOTION}"),
        (lambda data: packed(b"[1, 2", b""), "expected JSON, but"),
        (lambda data: packed(b"[" * 10**5, b""), "expected JSON, but"),
        (lambda data: packed(b"\xff\xfe", b""), "expected JSON, but"),
        (lambda data: packed(b'{"nodes": NaN}', b""), "expected JSON, but got 'the number NaN'"),
        (lambda data: packed(b'{"a": ' + b"9" * 5000 + b"}", b""), "expected JSON, but"),
        (lambda data: packed(b"[]", b""), "glTF: expected an object, but got []"),
        (lambda data: packed(b" " * (1 << 21), b""), "expected at most 1048576 bytes of JSON"),
        (lambda data: struct.pack("<4sII", b"glTF", 2, 12), "expected a whole chunk of JSON and one of"),
    ],
)
def test_other_files_are_refused_by_name(every, kept, made, says):
    path = kept(made(written(every, COMPACT)))
    with pytest.raises(ValueError, match=r"^[^\n]*$") as caught:
        forewarp.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert says in str(caught.value)


def test_a_file_that_there_is_not_is_named(tmp_path):
    with pytest.raises(OSError, match=r"nothing\.glb"):
        forewarp.load(tmp_path / "nothing.glb")


FLOATS = "POSITION", f"{SPLATS}:SCALE", "translations", "weights"


@pytest.mark.parametrize(
    ("key", "dtype", "value", "says"),
    [
        *((key, "<f4", math.nan, f"{key}: expected finite numbers, but got others") for key in FLOATS),
        ("POSITION", "<f4", math.inf, "POSITION: expected finite numbers"),
        ("links", "<u1", 255, "links: expected numbers below"),
        ("weights", "<f4", -1.0, "weights: expected numbers >= 0"),
        (f"{SPLATS}:OPACITY", "<f4", 1.5, "OPACITY: expected numbers in its range"),
        (f"{SPLATS}:SCALE", "<f4", -1.0, "SCALE: expected numbers in its range"),
        ("times", "<f4", 2.0, "expected ascending times"),
        ("times", "<f4", -0.5, "expected ascending times in [0, 1]"),
        ("offsets", "<f4", 0.5, "offsets of at most 0.2"),
    ],
)
def test_numbers_that_are_none_or_out_of_range_are_refused(every, kept, key, dtype, value, says):
    description, binary = unpacked(written(every))
    motion = motion_of(description)
    places = attributes_of(description) | motion["timeOffsets"] | motion["nodes"]
    places |= {name: motion[name][0] for name in ("links", "weights")}
    begin = description["bufferViews"][description["accessors"][places[key]]["bufferView"]]["byteOffset"]
    stored = np.array([value], dtype).tobytes()
    wrong = binary[:begin] + stored + binary[begin + len(stored) :]
    with pytest.raises(ValueError) as caught:  # noqa: PT011
        read(kept(packed(description, wrong)))
    assert says in str(caught.value)


def test_accessors_of_one_view_take_no_more_memory_than_views_may(every, monkeypatch):
    description, binary = unpacked(written(every))
    rows = 5 * 10**5
    count = len(binary)
    binary += bytes(3 * rows)
    description["buffers"][0]["byteLength"] = len(binary)
    view = {"buffer": 0, "byteOffset": count, "byteLength": 3 * rows}
    one = {"bufferView": len(description["bufferViews"]), "componentType": 5121, "count": rows}
    description["bufferViews"].append(view)
    description["accessors"].append(one | {"type": "VEC3", "normalized": True})
    monkeypatch.setattr("forewarp.glb.reader._MOST", 24 * rows - 1)
    container = Container(packed(description, binary))
    part = Fields({"colors": len(description["accessors"]) - 1}, "here")
    container.array(part, "colors", "VEC3")
    with pytest.raises(ValueError, match=r"^here.colors: expected at most \d+ bytes in all, but got more"):
        container.array(part, "colors", "VEC3")


def test_whole_numbers_of_nodes_are_lengths(every, kept):
    description, binary = unpacked(written(every))
    number = motion_of(description)["nodes"]["translations"]
    accessor = description["accessors"][number]
    count = len(binary)
    steps = np.random.default_rng(0).integers(-2, 3, (accessor["count"], 3))
    files = []
    for dtype, component in (("<i2", 5122), ("<f4", 5126)):
        content = np.ascontiguousarray(steps, dtype).tobytes()
        view = {"buffer": 0, "byteOffset": count, "byteLength": len(content)}
        description["bufferViews"][accessor["bufferView"]] = view
        accessor["componentType"] = component
        files.append(read(kept(packed(description, binary + content))).gaussians.ellipsoids(0.7).centers)
    torch.testing.assert_close(*files)


def test_what_is_not_known_beside_it_is_passed_over(every, kept):
    description, binary = unpacked(written(every, COMPACT))
    motion_of(description).update(version="1.7", births=[1], extras={"a": 1})
    description["animations"] = [{}]
    assert read(kept(packed(description, binary))).gaussians.moves


def test_random_damage_is_an_answer_in_one_line_or_none(every, kept):
    data, generator = written(every, COMPACT), np.random.default_rng(0)
    for _ in range(60):
        wrong = bytearray(data)
        for place in generator.integers(12, len(wrong), 3):
            wrong[place] = int(generator.integers(256))
        try:
            read(kept(bytes(wrong)))
        except ValueError as error:
            assert "\n" not in str(error)  # noqa: PT017
