"""Whatever happens to a dataset's files: a scene that is whole, or one line that says what is wrong."""

import io
import json
import shutil
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from forewarp.data import dnerf, hypernerf, lego_complete, nhr, posed_video
from forewarp.scene.errors import SceneError
from forewarp.scene.frame import Scene
from tests.support.dnerf_scene import shots, write_tiny
from tests.support.dnerf_scene import truth as known
from tests.support.nhr_scene import truth as in_dome
from tests.support.nhr_scene import write_dome
from tests.support.posed_scene import write_tiny as write_video
from tests.support.rig_scene import rig, truth, write_rig

EXAMPLES = 120


def stock(folder):
    write_tiny(folder)


def three_kinds(folder):
    test = [s for i, a in enumerate(dnerf.ABILITIES) for s in shots(2, i, ability=a, depth=True)]
    splits = {"train": shots(3), "test": test}
    lego_complete.write_scene(folder, splits, camera_angle_x=0.7, trajectories=known())


def a_dome(folder):
    write_dome(folder, trajectories=in_dome())


def two_phones(folder):
    points = np.arange(12.0).reshape(4, 3)
    write_rig(folder, rig(3), points=points, scales=(1, 2), trajectories=truth())


def video(folder):
    write_video(folder, times=[i / 9 for i in range(10)], channels=4)


FORMATS = {
    "dnerf": (stock, dnerf.read_scene),
    "lego_complete": (three_kinds, lego_complete.read_scene),
    "hypernerf": (two_phones, hypernerf.read_scene),
    "nhr": (a_dome, nhr.read_scene),
    "video_with_poses": (video, posed_video.read_scene),
}
ODD = [
    *(None, True, 0, -1, 1, 2, 3.7, 1e-300, 1e300, -1e300, 10**400, float("nan"), float("inf")),
    *("", "x", "0.5", "../x", "a\nb.png", "\ud800", "x" * 999, [], [1], [[1.0] * 4] * 4, {}, {"a": 1}),
]
WORDS = ["", "nan", "inf", "-1", "0", "1e300", "1e400", "x", "1 2", "\n", "\x00", "\u2028"]
ARRAYS = [
    np.full((6, 8), np.nan, np.float32),
    np.full((6, 8), 0x7F800001, np.uint32).view(np.float32),  # a NaN that signals
    np.full((6, 8), -1.0),
    np.full((6, 8), 1e300),
    np.zeros((0, 6)),
    np.zeros((3, 2), np.complex64),
    np.full((2, 6), np.inf),
    np.full((2, 3), 0x7F800001, np.uint32).view(np.float32),
    np.full((2, 3), 1e30),
    np.full((2, 6), 1e30),
    np.diag([-1e30] * 6),
    np.array("x"),
    np.array([["a"] * 3]),
]


def slots(tree):
    """Every place of a JSON tree that holds a value, as (container, key)."""
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        yield tree, key
        if isinstance(value, (dict, list)):
            yield from slots(value)


def drop(folder, path, draw):
    path.unlink()


def truncate(folder, path, draw):
    content = path.read_bytes()
    path.write_bytes(content[: draw(st.integers(0, len(content)))])


def flip(folder, path, draw):
    content = bytearray(path.read_bytes())
    if content:
        content[draw(st.integers(0, len(content) - 1))] ^= draw(st.integers(1, 255))
    path.write_bytes(content)


def swap_files(folder, path, draw):
    others = sorted(p for p in folder.rglob("*") if p.is_file())
    other = draw(st.sampled_from(others))
    a, b = path.read_bytes(), other.read_bytes()
    path.write_bytes(b)
    other.write_bytes(a)


def folder_instead(folder, path, draw):
    path.unlink()
    path.mkdir()


def shuffle_lines(folder, path, draw):
    lines = path.read_bytes().split(b"\n")
    path.write_bytes(b"\n".join(draw(st.permutations(lines[:40])) + lines[40:]))


def drop_line(folder, path, draw):
    lines = path.read_bytes().split(b"\n")
    lines.pop(draw(st.integers(0, len(lines) - 1)))
    path.write_bytes(b"\n".join(lines))


def other_word(folder, path, draw):
    """Another word in a text, blanks kept as they are."""
    words = path.read_bytes().split(b" ")
    words[draw(st.integers(0, len(words) - 1))] = draw(st.sampled_from(WORDS)).encode()
    path.write_bytes(b" ".join(words))


def other_array(folder, path, draw):
    np.save(path, draw(st.sampled_from(ARRAYS)))


def other_arrays(folder, path, draw):
    arrays = dict(np.load(io.BytesIO(path.read_bytes())))
    if draw(st.booleans()):
        arrays.pop(draw(st.sampled_from(sorted(arrays))))
    else:
        arrays[draw(st.sampled_from(sorted(arrays)))] = draw(st.sampled_from(ARRAYS))
    np.savez(path, **arrays)


def in_json(folder, path, draw):
    """Another value, one value less, one twice, or two in each other's place."""
    tree = json.loads(path.read_text())
    places = list(slots(tree))
    pick = st.integers(0, len(places) - 1)
    (at, key), (there, other) = places[draw(pick)], places[draw(pick)]
    kind = draw(st.sampled_from(["value", "less", "twice", "swap", "shuffle"]))
    if kind == "less":
        at.pop(key)
    elif kind == "twice" and isinstance(at, list):
        at.insert(key, at[key])
    elif kind == "shuffle" and isinstance(at[key], list):
        at[key] = draw(st.permutations(at[key]))
    elif kind == "swap":
        text = json.dumps(at[key]), json.dumps(there[other])  # copies: no value may hold itself
        at[key], there[other] = json.loads(text[1]), json.loads(text[0])
    else:
        at[key] = draw(st.sampled_from(ODD))
    path.write_text(json.dumps(tree))


ANY = [drop, truncate, flip, swap_files, folder_instead]
TEXT = [shuffle_lines, drop_line, other_word]
BY_KIND = {
    ".json": [in_json] * 12 + TEXT + ANY,
    ".inf": [other_word] * 4 + TEXT + ANY,
    ".npy": [other_array] * 3 + ANY,
    ".npz": [other_arrays] * 3 + ANY,
}


def mutate(folder: Path, draw) -> None:
    """One change to one file; kinds of file are as likely as each other, not files."""
    kinds = {}
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        kinds.setdefault(path.suffix, []).append(path)
    path = draw(st.sampled_from(kinds[draw(st.sampled_from(sorted(kinds)))]))
    try:
        draw(st.sampled_from(BY_KIND.get(path.suffix, ANY)))(folder, path, draw)
    except (ValueError, TypeError, OSError, EOFError, KeyError, zipfile.BadZipFile):
        assume(False)  # mutated already, so that there is nothing left to change in this way


def check_whole(scene: Scene) -> None:
    """All that a run would use is finite and fits together."""
    assert isinstance(scene, Scene)
    assert scene.train
    assert scene.test
    assert scene.canonical_time in scene.times
    assert scene.box.diagonal < 1e16  # places within 1e9, at most 1e6 times as large
    for frame in (*scene.train, *scene.val, *scene.test):
        camera = frame.camera
        pixels, rays = frame.load(), camera.rays()
        assert (tuple(pixels.shape), pixels.dtype) == ((camera.height, camera.width, 4), torch.uint8)
        assert torch.isfinite(rays.origins).all()
        assert torch.isfinite(rays.directions).all()
        assert (rays.directions.norm(dim=-1) - 1).abs().max() < 1e-4
        assert 0 <= camera.near < camera.far < np.inf
        assert 0 <= frame.time <= 1
        if frame.load_depth is not None:
            depth = frame.load_depth()
            assert tuple(depth.shape) == (camera.height, camera.width)
            assert torch.isfinite(depth).all()
    for points in (scene.still, scene.truth and scene.truth.points):
        assert points is None or torch.isfinite(points).all()


def refusal(action) -> str | None:
    """What the user is told, or None where all is well; any other exception is ours."""
    try:
        action()
    except SceneError as error:
        return str(error)
    return None


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    """A valid scene of every format."""
    root = tmp_path_factory.mktemp("originals")
    for name, (write, _) in FORMATS.items():
        write(root / name)
    return root


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_not_mutated_is_whole(originals, name):
    check_whole(FORMATS[name][1](originals, name))


@pytest.mark.parametrize("name", FORMATS)
def test_a_mutated_scene_is_whole_or_refused_in_one_line(originals, name):
    outcomes = {"whole": 0, "refused": 0}

    @settings(
        max_examples=EXAMPLES,
        derandomize=True,
        deadline=None,
        database=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(data=st.data())
    def run(data):
        with tempfile.TemporaryDirectory() as root:
            folder = Path(root) / name
            shutil.copytree(originals / name, folder)
            for _ in range(data.draw(st.integers(1, 2))):
                mutate(folder, data.draw)
            said = refusal(lambda: check_whole(FORMATS[name][1](root, name)))
            assert said is None or len(said.splitlines()) == 1
            outcomes["whole" if said is None else "refused"] += 1

    run()
    assert min(outcomes.values()) > 0.03 * EXAMPLES, outcomes  # neither harmless nor hopeless
