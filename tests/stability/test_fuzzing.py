"""Harmed files of every kind are read or refused in one line, soon and in little memory.

``make fuzz`` tries 5,000 of each, the same each time.
"""

import importlib.util
import io
import json
import os
import resource
import shutil
import zipfile
from collections import Counter
from dataclasses import replace
from functools import lru_cache
from itertools import chain
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import yaml
from hydra.core.global_hydra import GlobalHydra
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from forewarp.capture.frames import measure
from forewarp.cli.entry import one_line
from forewarp.data import dnerf, hypernerf, multicam, nhr, posed_video
from forewarp.data.files import SceneError
from forewarp.data.images import write_image
from forewarp.glb.reader import read as read_glb
from forewarp.glb.writer import COMPACT
from forewarp.report.table import write_table
from forewarp.runs.build import build_run
from forewarp.runs.config import saved_config
from forewarp.scene.frame import Scene
from forewarp.scene.view import Moment, View
from forewarp.training.checkpoints import check_state, load_weights
from tests.glb.test_scene_file import OPTIONS, moving
from tests.glb.test_scene_file import written as written_glb
from tests.support import written_scenes as written
from tests.support.captures import step
from tests.support.configs import composed
from tests.support.films import numbered, write_film
from tests.support.gltf import packed, unpacked
from tests.support.runs_on_disk import write_run

pytestmark = pytest.mark.stability

ODD = [
    *(None, True, 0, -1, 1, 2, 3.7, 1e-300, 1e300, -1e300, 10**400, float("nan"), float("inf"), "", "x"),
    *("0.5", "../x", "/etc/passwd", "a\nb.png", "\ud800", "x" * 9999, "${oc.env:HOME}", "${a.b}"),
    *("os.system", [], [1], [[1.0] * 4] * 4, {}, {"a": 1}, {"_args_": [1]}),
    {"_target_": "os.system", "command": "false"},
]
WORDS = [*b" nan inf -1 0 1e300 1e400 x *a &a !!".split(b" "), b"1 2", b"\n", b"\0"]
NAN_SIGNALLING = np.full((6, 8), 0x7F800001, np.uint32).view(np.float32)
ARRAYS = [
    *(np.full((6, 8), np.nan, np.float32), NAN_SIGNALLING, NAN_SIGNALLING[:2, :3], np.full((6, 8), 1e300)),
    *(-np.ones((6, 8)), np.zeros((0, 6)), np.zeros((3, 2), np.complex64), np.full((2, 6), np.inf)),
    *(np.full((2, 3), 1e30), np.full((2, 6), 1e30), np.diag([-1e30] * 6), np.array("x")),
    np.array([["a"] * 3]),
]


def truncated(draw, content):
    return content[: draw(st.integers(0, len(content)))]


def flipped(draw, content):
    changed = bytearray(content)
    for at in draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=20)):
        changed[at] ^= draw(st.integers(1, 255))
    return bytes(changed)


def spliced(draw, content):
    """Leave a part out, repeat one, or put other bytes in."""
    begin, end = (draw(st.integers(0, len(content))) for _ in range(2))
    return content[:begin] + draw(st.binary(max_size=300)) + content[end:]


def reworded(draw, content):
    """One word or line less, twice, or another."""
    blank = draw(st.sampled_from([b" ", b"\n", b":", b","]))
    words = content.split(blank)
    at, other = (draw(st.integers(0, len(words) - 1)) for _ in range(2))
    others = [[], [words[at]] * 2, [words[other]], [draw(st.sampled_from(WORDS))]]
    words[at : at + 1] = draw(st.sampled_from(others))
    return blank.join(words)


def slots(tree):
    """Every place of a tree that holds a value, as (container, key)."""
    for key, value in tree.items() if isinstance(tree, dict) else enumerate(tree):
        yield tree, key
        if isinstance(value, dict | list):
            yield from slots(value)


def replanted(draw, tree):
    """Another value in a tree of JSON, one less, one twice, or one in another's place."""
    places = list(slots(tree))
    (at, key), (there, other) = (places[draw(st.integers(0, len(places) - 1))] for _ in range(2))
    kind = draw(st.sampled_from(["odd", "odd", "less", "twice", "copy"]))
    if kind == "less":
        at.pop(key)
    elif kind == "twice" and isinstance(at, list):
        at.insert(key, at[key])
    else:  # a copy: no value may hold itself
        value = there[other] if kind == "copy" else draw(st.sampled_from(ODD))
        at[key] = json.loads(json.dumps(value))
    return tree


def in_json(draw, content):
    return json.dumps(replanted(draw, json.loads(content))).encode()


@lru_cache
def as_json(content):
    return json.dumps(yaml.load(content, yaml.CSafeLoader)).encode()


def in_yaml(draw, content):
    """As JSON, which is YAML too."""
    return in_json(draw, as_json(content))


def saved(save, *arrays, **named):
    file = io.BytesIO()
    save(file, *arrays, **named)
    return file.getvalue()


def in_npy(draw, content):
    return saved(np.save, draw(st.sampled_from(ARRAYS)))


def in_npz(draw, content):
    """Another array, or one less."""
    arrays = dict(np.load(io.BytesIO(content)))
    name = draw(st.sampled_from(sorted(arrays)))
    arrays[name] = draw(st.sampled_from([None, *ARRAYS]))
    return saved(np.savez, **{key: value for key, value in arrays.items() if value is not None})


def in_archive(draw, content):
    """Other bytes in one part of an archive, whose checksum then fits them, or another value in its JSON."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    pickles = [name for name in parts if name.endswith("data.pkl")] * 10  # where most can go wrong
    name = draw(st.sampled_from([*pickles, *parts]))
    if "metadata" in parts and draw(st.booleans()):
        name, parts["metadata"] = "metadata", in_json(draw, parts["metadata"])
    for _ in range(draw(st.sampled_from([1, 1, 2, 5])) if name != "metadata" else 0):
        at = draw(st.integers(0, max(len(parts[name]) - 1, 0)))
        part = parts[name][at : at + 1]
        other = draw(st.sampled_from([b"", part * 2, bytes([draw(st.integers(0, 255))])]))
        parts[name] = parts[name][:at] + other + parts[name][at + 1 :]
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for part, value in parts.items():
            archive.writestr(part, value)
    return file.getvalue()


def in_glb(draw, content):
    """Another value in the JSON of a glTF file, whose lengths then fit it."""
    described, binary = unpacked(content)
    return packed(replanted(draw, described), binary)


def in_boxes(draw, content):
    """Another number where a film's container has one: a length, a count, a size."""
    at = draw(st.integers(0, len(content) // 4 - 1)) * 4
    number = draw(st.sampled_from([0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 100_000]))
    return content[:at] + number.to_bytes(4, "big") + content[at + 4 :]


ANY = [truncated, flipped, spliced]
WAYS = {
    ".json": [in_json] * 8 + [reworded] * 2,
    ".yaml": [in_yaml] * 8 + [reworded] * 4,
    ".inf": [reworded] * 8,
    ".npy": [in_npy] * 4,
    ".npz": [in_npz] * 3 + [in_archive] * 3,
    ".ckpt": [in_archive] * 8,
    ".r3d": [in_archive] * 8,
    ".glb": [in_glb] * 8,
    **dict.fromkeys((".mp4", ".mkv"), [in_boxes] * 6),
}


class Changes(dict):
    """What files become; None: they are gone."""

    def __repr__(self):
        return f"{[path.name for path in self]}"  # not all their bytes


@st.composite
def harmed(draw, files: dict[Path, bytes]) -> Changes:
    """Draw one or two files and what they become. Every kind of file is as likely."""
    kinds: dict[str, list[Path]] = {}
    for path in files:
        kinds.setdefault(path.suffix, []).append(path)
    changes = Changes()
    for _ in range(draw(st.sampled_from([1, 1, 2]))):
        path = draw(st.sampled_from(kinds[draw(st.sampled_from(sorted(kinds)))]))
        way = draw(st.sampled_from([*ANY, *WAYS.get(path.suffix, []), "other", "gone"]))
        if callable(way):
            changes[path] = way(draw, files[path])
        else:
            changes[path] = None if way == "gone" else files[draw(st.sampled_from(list(files)))]
    return changes


MEMORY, SECONDS = 1 << 30, 10
FUZZ = settings.get_profile("fuzz")  # of conftest.py
QUICK = settings(FUZZ, max_examples=100)


def three_kinds(folder):
    shots = (written.dnerf_shots(2, i, ability=a, depth=True) for i, a in enumerate(dnerf.ABILITIES))
    splits = {"train": written.dnerf_shots(3), "test": chain(*shots)}
    dnerf.write_scene(folder, splits, camera_angle_x=0.7, trajectories=written.LEGO_TRUTH)


def two_phones(folder):
    points = np.arange(12.0).reshape(4, 3)
    written.write_rig(folder, written.rig(3), points=points, trajectories=written.RIG_TRUTH)


def small_dome(folder):
    cameras = written.dome(3, sizes=((24, 18), (18, 24)))
    written.write_dome(folder, cameras, 2, trajectories=written.dome_truth(2))


def video(folder):
    written.write_video(folder, count=6, times=[i / 5 for i in range(6)], channels=4)


def films(folder):
    """A film, and folders of frames."""
    cameras = written.fixed_cameras(3, size=(16, 24))
    written.write_multicam(folder, cameras[:1], count=2)
    for k, camera in enumerate(cameras[1:], 1):
        for n in range(2):
            write_image(folder / f"cam{k:02d}" / f"{n}.png", written.grey(camera, n, k))
    multicam.write_poses(folder, cameras, near=14.0, far=30.0)


FORMATS = {
    "dnerf": (written.write_dnerf, dnerf.read_scene),
    "lego_complete": (three_kinds, dnerf.read_lego_complete),
    "hypernerf": (two_phones, hypernerf.read_scene),
    "nhr": (small_dome, nhr.read_scene),
    "multicam": (films, multicam.read_scene),
    "video_with_poses": (video, posed_video.read_scene),
}


def check_whole(scene):
    """All that a run would use is finite and fits together."""
    assert isinstance(scene, Scene)
    assert scene.train
    assert scene.test
    assert scene.canonical_time in scene.times
    assert scene.box.diagonal < 1e16  # places within 1e9, at most 1e6 times as large
    for frame in (*scene.train, *scene.val, *scene.test):
        camera = frame.camera
        pixels, rays = frame.load(), camera.rays(torch.arange(3))
        assert (tuple(pixels.shape), pixels.dtype) == ((camera.height, camera.width, 4), torch.uint8)
        assert torch.isfinite(rays.origins).all()
        assert (rays.directions.norm(dim=-1) - 1).abs().max() < 1e-4
        assert 0 <= camera.near < camera.far < np.inf
        assert 0 <= frame.time <= 1
        if frame.load_depth is not None:
            depth = frame.load_depth()
            assert tuple(depth.shape) == (camera.height, camera.width)
            assert torch.isfinite(depth).all()
    for points in (scene.still, scene.truth and scene.truth.points):
        assert points is None or torch.isfinite(points).all()


def of_run(root):
    """A run's config and its checkpoint, each with what reads it."""
    small = ["model=forward", "experiment=demo", "stage.coarse.num_voxels=[[0,64]]", "data.root=data"]
    config = OmegaConf.to_container(composed(*small, "logger=none", "trainer=cpu"), resolve=True)
    GlobalHydra.instance().clear()
    config["data"]["_target_"] = "forewarp.data.module.DNeRFDataModule"  # whose scene may be absent
    del config["data"]["synthesis"]
    config, nothing = OmegaConf.create(config), OmegaConf.create({})
    for name in ("config", "checkpoint"):
        (root / name).mkdir()
    written.write_dnerf(root / "toy")
    scene = dnerf.read_scene(root, "toy")
    run = replace(build_run(config), datamodule=SimpleNamespace(scene=scene))
    del config.stage.coarse  # what it has, the other stage has too
    (root / "config" / "config.yaml").write_text(OmegaConf.to_yaml(config))
    module = run._module(run.stages[0], blank=True)
    content = {"state_dict": module.state_dict(), "global_step": 7}
    module.on_save_checkpoint(content)
    file = root / "checkpoint" / "last.ckpt"
    torch.save(content, file)

    def render():
        """Read, take and use it: a kernel that trusts wrong indices ends the process."""
        check_state(file, module)
        load_weights(module, file)
        module.render(View(scene.test[0].camera, torch.arange(4)), Moment(0.5), torch.ones(3))

    def build():
        """Read a run's config and build all that it names."""
        run = build_run(saved_config(str(root / "config"), nothing))
        run.callbacks(run.stages[0].settings.name, root / "config")

    return {"config": (build, Exception), "checkpoint": (render, (ValueError, OSError))}


def of_reports(root):
    """What a finished run leaves, and what makes a table of it."""
    folder = write_run(root / "report")

    def read():
        write_table([folder], root / "table")

    return {"report": (read, ValueError)}


def of_files(root):
    """A scene.glb, a scan and two films, each with what reads it."""
    for name in ("glb", "r3d", "mp4", "mkv"):
        (root / name).mkdir()
    glb = root / "glb" / "scene.glb"
    glb.write_bytes(written_glb(moving(**OPTIONS["every effect"]), COMPACT))

    def show():
        cloud = read_glb(glb).gaussians.ellipsoids(0.5)
        assert torch.isfinite(cloud.centers).all()

    found = {"glb": (show, (ValueError, OSError))}
    for name in ("mp4", "mkv"):
        film = write_film(root / name / f"film.{name}", numbered(3, (16, 24)))

        def look(film=film):
            stamps, sharp, *_ = measure(film, lambda done, total: None)
            assert 0 < len(stamps) == len(sharp) <= 1000

        found[name] = (look, (SceneError, OSError))
    if importlib.util.find_spec("lzfse") and importlib.util.find_spec("pycolmap"):
        from forewarp.capture.record3d import capture_record3d
        from tests.capture.test_record3d import write_scan

        scan = write_scan(root / "r3d" / "scan.r3d", 3)

        def capture():
            shutil.rmtree(root / "captured", ignore_errors=True)
            capture_record3d(scan, root / "captured", step, "capture.json")

        found["r3d"] = (capture, (SceneError, OSError))
    return found


@pytest.fixture(scope="module")
def loaders(tmp_path_factory):
    """By name: the folder of the files, what reads them, and how it refuses them."""
    root = tmp_path_factory.mktemp("fuzzing")
    found = {}
    for name, (write, read) in FORMATS.items():
        write(root / name)
        found[name] = (lambda read=read, name=name: check_whole(read(root, name)), SceneError)
    found |= of_run(root) | of_reports(root) | of_files(root)
    return {name: SimpleNamespace(folder=root / name, read=r, refusal=e) for name, (r, e) in found.items()}


@pytest.fixture
def bounded():
    """No more memory than so much beyond what is in use."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, before)


def put(changes):
    """Write files, or take them away."""
    for path, content in changes.items():
        if path.is_dir():
            shutil.rmtree(path)
        if content is None:
            path.unlink(missing_ok=True)
        else:
            path.write_bytes(content)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*FORMATS, "config", "checkpoint", "report", "glb", "r3d", "mp4", "mkv"])
def test_harmed_files_are_read_or_refused_in_one_line(loaders, bounded, name):
    if name not in loaders:
        pytest.skip("needs forewarp[capture]")
    loader, outcomes = loaders[name], Counter()
    files = {path: path.read_bytes() for path in sorted(loader.folder.rglob("*")) if path.is_file()}
    loader.read()  # unharmed

    @(FUZZ if settings.default is FUZZ else QUICK)
    @given(harmed(files))
    def run(changes):
        said, before = None, sum(os.times()[:4])
        try:
            put(changes)
            loader.read()
        except loader.refusal as error:
            said = one_line(error)
            if said is None:
                raise
        finally:
            put({path: files[path] for path in changes})
        outcomes["read" if said is None else "refused"] += 1
        assert sum(os.times()[:4]) - before < SECONDS  # of the processor, also by ffmpeg
        assert said is None or (": " in said and len(said.splitlines()) == 1), said
        assert said is None or ": expected " in said or loader.refusal is Exception, said

    try:
        run()
    finally:
        print(f"{name}: {dict(outcomes)}")
    assert min(outcomes["read"], outcomes["refused"]) > 0.02 * sum(outcomes.values())  # neither hopeless
