"""Checkpoints: exact, refused if they do not fit, and read without trust in the file."""

import json
import math
import zipfile
from dataclasses import replace
from functools import partial

import pytest
import torch
from torch.testing import assert_close

from forewarp.fields.curves import TrajectoryField
from forewarp.methods.method import Method, Start
from forewarp.scene.box import Box
from forewarp.scene.cloud import Cloud, Handover
from forewarp.training import checkpoints
from tests.support import tiny_scene as tiny
from tests.support.full_disk import file_size_limit


def run(folder, callbacks=(), width=8, times=None):
    """A run of one short stage."""
    trajectory = partial(TrajectoryField, bases=2, nodes=8, width=width, layers=2)
    data = tiny.ball_data(rays=64, size=16, times=times)
    model = tiny.forward_model(trajectory=trajectory)
    stages = [tiny.stage(num_voxels=[[0, 1000]])]
    return tiny.make_run(folder, stages, data=data, model=model, callbacks=callbacks)


def module(folder, **changes):
    """Make the module that such a run begins with."""
    ours = run(folder, **changes)
    ours.datamodule.setup()
    return ours._module(ours.stages[0])


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory):
    """The checkpoint of a stage that was interrupted."""
    folder = tmp_path_factory.mktemp("interrupted")
    with pytest.raises(SystemExit):
        run(folder, [tiny.Interrupt("coarse", 3)]).fit()
    return folder / "coarse" / "last.ckpt"


@pytest.mark.parametrize(
    ("changes", "name"),
    [({"width": 16}, "method.motion.trajectory.network.0.bias"), ({"times": [0.0] * 3}, "method.motion")],
    ids=["width", "motion"],  # of one time: none
)
def test_another_configuration_is_refused_by_what_differs(tmp_path, interrupted, changes, name):
    with pytest.raises(ValueError, match=f"a checkpoint of this configuration, but .* differs in {name}"):
        checkpoints.load_weights(module(tmp_path, **changes), interrupted)


@pytest.mark.parametrize(
    "change",
    [
        {"density_scale": "x"},
        {"lattices": {"home": torch.ones(2, 2, 2) > 0, "followed": {"other": [1000, 0]}}},
        {"lattices": {"home": torch.ones(2, 2, 2) > 0, "followed": {"num_voxels": [1000, "x"]}}},
        {"lattices": {"home": 3, "followed": {"num_voxels": [1000, 0]}}},
        {"lattices": []},
    ],
    ids=str,
)
def test_a_state_that_is_not_the_methods_is_refused(tmp_path, interrupted, change):
    content = torch.load(interrupted, weights_only=True)
    content["state_dict"]["method._extra_state"] |= change
    torch.save(content, tmp_path / "last.ckpt")
    with pytest.raises(ValueError, match="differs in method._extra_state; use another run folder"):
        checkpoints.check_checkpoint(tmp_path / "last.ckpt", module(tmp_path))


def test_one_flipped_bit_is_refused(tmp_path, interrupted):
    content = bytearray(interrupted.read_bytes())
    stored = torch.load(interrupted, weights_only=True)["state_dict"]["method.radiance.density"]
    at = content.index(stored.numpy().tobytes()[:64])
    content[at + 3] ^= 1
    (tmp_path / "last.ckpt").write_bytes(content)
    with pytest.raises(ValueError, match="last.ckpt: expected a checkpoint, but it cannot be read .BadZip"):
        checkpoints.check_checkpoint(tmp_path / "last.ckpt", module(tmp_path))


def test_a_checkpoint_cannot_execute_code(tmp_path):
    class Deed:
        def __reduce__(self):
            return (exec, (f"open({str(tmp_path / 'deed')!r}, 'w')",))

    torch.save({"state_dict": {"a": Deed()}}, tmp_path / "last.ckpt")
    with pytest.raises(ValueError, match="last.ckpt: expected a checkpoint, but it cannot be read"):
        checkpoints.check_checkpoint(tmp_path / "last.ckpt", module(tmp_path))
    assert not (tmp_path / "deed").exists()


@pytest.mark.slow
def test_checkpoints_come_by_the_clock(tmp_path, monkeypatch):
    saved = []
    save = lambda self, trainer: saved.append(trainer.global_step)  # noqa: E731
    monkeypatch.setattr(checkpoints.KeepCheckpoint, "save", save)
    ours = run(tmp_path)
    ours.checkpoint_seconds = 1e-9
    ours.fit()
    assert saved == [*range(1, 13), 12]


GRID = "method.radiance."
HARM = {
    "index out of range": ("index", lambda v: v.__setitem__((0, 0, 0), 10**6)),
    "index below": ("index", lambda v: v.__setitem__((0, 0, 0), -2)),
    "index of another shape": ("index", lambda v: v[1:].clone()),
    "index of another kind": ("index", lambda v: v.long()),
    "index of nothing": ("index", lambda v: "nothing"),
    "voxel outside": ("voxels", lambda v: v.__setitem__((0, 2), 10**6)),
    "voxels of a plane": ("voxels", lambda v: v[:, :2].clone()),
    "fewer rows": ("color", lambda v: v[:1].clone()),
    "more channels": ("density", lambda v: v.repeat(1, 2)),
    "an absurd shape": ("_extra_state", lambda v: v | {"shape": [10**6] * 3}),
    "no shape": ("_extra_state", lambda v: {}),
    "no box": ("_extra_state", lambda v: v | {"low": [9.0, 9.0, 9.0]}),
}


@pytest.mark.parametrize("harm", HARM)
def test_a_grid_whose_parts_do_not_fit_is_refused(tmp_path, interrupted, harm):
    """Kernels would read out of bounds and crash the process."""
    content = torch.load(interrupted, weights_only=True)
    name, change = HARM[harm]
    value = content["state_dict"][GRID + name]
    changed = change(value)
    content["state_dict"][GRID + name] = value if changed is None else changed
    torch.save(content, tmp_path / "last.ckpt")
    named = "(index|_extra_state)" if "shape" in harm else name
    with pytest.raises(ValueError, match=f"last.ckpt: expected .* that differs in {GRID}{named};"):
        checkpoints.load_weights(module(tmp_path), tmp_path / "last.ckpt")


INCOMPLETE = "expected a checkpoint with its step and generator, torch_rng, curriculum, clock, but got one"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda c: c.pop("global_step"), INCOMPLETE),
        (lambda c: c["forewarp"].update(clock=7), INCOMPLETE),
        (lambda c: c.update(forewarp=7), INCOMPLETE),
        (lambda c: c["forewarp"].pop("curriculum"), INCOMPLETE),
        (lambda c: c.update(state_dict=7), "expected a checkpoint, but it holds no weights"),
        (lambda c: c["state_dict"].update({7: 7}), "that differs in 7;"),
    ],
)
def test_odd_parts_are_refused_in_one_line(tmp_path, interrupted, change, said):
    content = torch.load(interrupted, weights_only=True)
    change(content)
    torch.save(content, tmp_path / "last.ckpt")
    with pytest.raises(ValueError, match=f"last.ckpt: .*{said}"):
        checkpoints.check_state(tmp_path / "last.ckpt", module(tmp_path))


CONTENT = {"a": torch.arange(1000.0), "b": {"c": [1, "x", None]}}


def test_a_full_disk_is_told_and_leaves_what_was_there(tmp_path):
    path = tmp_path / "a.pt"
    checkpoints.write_archive(path, {"a": 1})
    with file_size_limit(2048), pytest.raises(OSError, match="File too large") as refusal:
        checkpoints.write_archive(path, CONTENT)
    assert refusal.value.filename == str(path)
    assert checkpoints.read_archive(path) == {"a": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["a.pt"]


@pytest.mark.slow
def test_a_packed_archive_is_not_unpacked(tmp_path):
    """Zeros of 16 MB in a file of 16 KB."""
    torch.save({"a": torch.zeros(1 << 22)}, tmp_path / "plain.pt")
    with zipfile.ZipFile(tmp_path / "plain.pt") as plain:
        parts = {name: plain.read(name) for name in plain.namelist()}
    with zipfile.ZipFile(tmp_path / "a.pt", "w", zipfile.ZIP_DEFLATED) as packed:
        for name, part in parts.items():
            packed.writestr(name, part)
    assert torch.load(tmp_path / "a.pt", weights_only=True)["a"].shape == (1 << 22,)  # torch would
    with pytest.raises(ValueError, match="BadZipFile"):
        checkpoints.read_archive(tmp_path / "a.pt")


def test_no_tensor_is_larger_than_the_file(tmp_path):
    torch.save({"a": [{"b": torch.zeros(1).expand(400, 1000, 1000)}]}, tmp_path / "a.pt")
    with pytest.raises(ValueError, match="TypeError"):
        checkpoints.read_archive(tmp_path / "a.pt")
    torch.save({"a": torch.zeros(6, 5).T, "b": torch.zeros(0, 3)}, tmp_path / "a.pt")
    assert checkpoints.read_archive(tmp_path / "a.pt")["a"].shape == (5, 6)


@pytest.mark.parametrize("content", [b"", b"nonsense", [1], torch.zeros(3), {"a": torch.eye(3).to_sparse()}])
def test_what_is_no_such_file_is_refused(tmp_path, content):
    if isinstance(content, bytes):
        (tmp_path / "a.pt").write_bytes(content)
    else:
        torch.save(content, tmp_path / "a.pt")
    with pytest.raises(ValueError, match="^[A-Z]\\w+$"):
        checkpoints.read_archive(tmp_path / "a.pt")
    with pytest.raises(FileNotFoundError):
        checkpoints.read_archive(tmp_path / "b.pt")


# The handover of a stage: what it contains, and that it is written and read correctly.

SCENE = tiny.ball_scene(frames=6, size=16)


@pytest.mark.parametrize("moving", [True, False])
def test_round_trip(tmp_path, moving):
    cloud = Cloud(torch.rand(5, 3), torch.rand(5, 3), torch.rand(5), 0.25)
    times, paths = (torch.rand(4), torch.rand(5, 4, 3)) if moving else (None, None)
    box, notes = Box((-1.0, 0.25, 1 / 3), (1.0, 2.0, 3.0)), {"density_scale": 0.1}
    checkpoints.save_handover(Handover(box, True, 17, cloud, times, paths, notes), tmp_path)
    read = checkpoints.load_handover(tmp_path)
    assert (read.box, read.tight, read.frames_in_play, read.notes) == (box, True, 17, notes)
    assert_close(vars(read.cloud), vars(cloud), rtol=0, atol=0)
    assert not moving or (read.times.equal(times) and read.paths.equal(paths))
    assert (read.times is None) == (read.paths is None) == (not moving)


def _numbers(**changes):
    return lambda numbers, _: numbers.write_text(json.dumps(json.loads(numbers.read_text()) | changes))


@pytest.mark.parametrize(
    "spoil",
    [
        lambda numbers, _: numbers.write_text("{"),
        lambda numbers, _: numbers.write_text("[1]"),
        lambda numbers, _: numbers.unlink(),
        lambda _, points: points.unlink(),
        lambda _, points: points.write_bytes(b"nonsense"),
        *(_numbers(low=low) for low in ([1.0, 2.0], [0, 0, "x"])),
        _numbers(high=[-9, -9, -9]),
        *(_numbers(notes=notes) for notes in (None, {"density_scale": "long"}, {"density_scale": math.inf})),
        _numbers(size=-1.0),
    ],
)
def test_what_is_no_handover_is_refused_in_one_line(tmp_path, spoil):
    cloud = Cloud(torch.rand(5, 3), torch.rand(5, 3), torch.rand(5), 0.25)
    checkpoints.save_handover(Handover(tiny.BOX, True, 3, cloud, notes={"density_scale": 0.1}), tmp_path)
    checkpoints.load_handover(tmp_path)
    spoil(tmp_path / "handover.json", tmp_path / "handover.pt")
    with pytest.raises(ValueError, match=r"handover\.\w+: expected what a stage leaves to the next, but got"):
        checkpoints.load_handover(tmp_path)


def test_a_stage_leaves_the_tight_box():
    method = tiny.ball_method(SCENE)
    handover = checkpoints.make_handover(method, SCENE, None, 6)
    assert handover.tight
    assert handover.notes == {"density_scale": method.radiance.activation.density_scale}
    assert handover.frames_in_play == 6
    center, margin = tiny.ball_center(0.0), tiny.RADIUS + 4 * method.radiance.lattice.voxel_size
    for low, high, middle in zip(handover.box.low, handover.box.high, center.tolist()):
        assert middle - margin < low < middle - 0.5 * tiny.RADIUS
        assert middle + 0.5 * tiny.RADIUS < high < middle + margin


def test_the_box_holds_what_the_stage_calls_matter():
    method, asked = tiny.ball_method(SCENE, box_alpha=0.25), []
    bounds = method.bounds
    method.bounds = lambda times: asked.append(times) or bounds(times)
    thin = tiny.ball_method(SCENE, raw=2.0, box_alpha=0.25)  # an opacity of 0.07 over a voxel
    assert checkpoints.make_handover(method, SCENE, None, 6).tight
    assert asked == [list(SCENE.times)]
    assert not checkpoints.make_handover(thin, SCENE, None, 6).tight
    assert checkpoints.make_handover(tiny.ball_method(SCENE, raw=2.0, box_alpha=0.01), SCENE, None, 6).tight


def test_a_stage_leaves_its_matter_and_the_paths_of_it_or_a_sample(monkeypatch):
    method = tiny.ball_method(SCENE)
    handover, matter = checkpoints.make_handover(method, SCENE, None, 6), method.matter()
    assert 20 < len(handover.cloud) == len(matter)
    assert handover.cloud.points.equal(matter.points)
    assert float((matter.points - tiny.ball_center(0.0)).norm(dim=-1).max()) < tiny.RADIUS
    assert handover.times.tolist() == pytest.approx(list(SCENE.times))
    assert handover.paths.equal(method.trajectories(matter.points, handover.times))
    monkeypatch.setattr("forewarp.training.checkpoints._POINTS", 7)
    monkeypatch.setattr("forewarp.training.checkpoints._TIMES", 3)
    handover = checkpoints.make_handover(method, SCENE, None, 6)
    assert handover.paths.shape == (7, 3, 3)
    assert handover.times.tolist() == pytest.approx([SCENE.times[i] for i in (0, 2, 4)], abs=0.21)


@pytest.mark.parametrize("box", [None, tiny.BOX.scaled(0.5)])
def test_a_stage_that_found_nothing_keeps_its_box_and_says_so(box):
    before = None if box is None else Handover(box, True, 6)
    method = tiny.forward_model()(Start(SCENE, "coarse", {"num_voxels": [[0, 1500]]}, range(6), before))
    method.radiance.density.data[:] = -9.0
    handover = checkpoints.make_handover(method, SCENE, before, 6)
    assert not handover.tight
    assert handover.box == method.radiance.lattice.box == (box or tiny.BOX)
    assert len(handover.cloud) == 0


class Astray(Method):
    """A method that moved out of the scene, and can tell nothing else."""

    def bounds(self, times):
        return Box((9.0, 9.0, 9.0), (10.0, 10.0, 10.0))


@pytest.mark.parametrize("method", [Astray, Method])
def test_of_a_method_that_can_tell_nothing_the_box_is_left(tmp_path, method):
    handover = checkpoints.make_handover(method(), SCENE, None, 4)
    assert handover == Handover(tiny.BOX, False, 4)
    checkpoints.save_handover(handover, tmp_path)
    assert checkpoints.load_handover(tmp_path) == handover
    assert not (tmp_path / "handover.pt").exists()


def test_what_lies_outside_the_scene_is_cut_off():
    far = replace(SCENE, box=tiny.BOX.scaled(0.3))
    box = checkpoints.make_handover(tiny.ball_method(SCENE), far, None, 6).box
    assert all(high <= edge + 1e-6 for high, edge in zip(box.high, far.box.scaled(1.05).high))
