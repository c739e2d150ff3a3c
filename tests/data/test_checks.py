"""What a scene's cameras, box, alpha, masks and points say against each other, before training."""

import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from forewarp.data import dnerf, nhr, posed_video
from forewarp.data.cameras import FLIP, check_camera
from forewarp.data.checks import check_seen, remarks
from forewarp.data.files import SceneError
from forewarp.data.images import is_premultiplied, straight, write_image
from forewarp.scene.box import Box
from forewarp.scene.camera import Camera, look_at
from forewarp.scene.frame import Frame, sightings, walk_of
from tests.support.room import BALLS, shown, walk
from tests.support.tiny_scene import ball_scene
from tests.support.written_scenes import (
    MIDDLE,
    UP,
    dnerf_shots,
    dome,
    dome_frames,
    edit,
    posed_cameras,
    refused,
    write_dome,
    write_video,
)

SCENE = ball_scene(frames=8, size=16)


def changed(frames=None, **changes):
    """The scene, its training frames changed by a function of each image's pixels."""
    if frames is not None:
        changes["train"] = tuple(replace(f, load=lambda f=f: frames(f.load().clone())) for f in SCENE.train)
    return replace(SCENE, **changes)


def moved(share, down=0.0):
    """The training frames with their principal points moved by shares of the width and the height."""
    cameras = [f.camera for f in SCENE.train]
    cameras = [replace(c, cx=c.cx + share * c.width, cy=c.cy + down * c.height) for c in cameras]
    return tuple(replace(f, camera=camera) for f, camera in zip(SCENE.train, cameras))


def named(names):
    """The training frames in the order of their times, with other names."""
    frames = sorted(SCENE.train, key=lambda frame: frame.time)
    return tuple(replace(f, name=name) for f, name in zip(frames, names, strict=True))


def masked(value):
    """The training frames with a mask of one value."""
    return tuple(replace(f, load_valid=lambda: torch.full((8, 8), value) > 0) for f in SCENE.train)


def ranged(near, far):
    return tuple(replace(f, camera=replace(f.camera, near=near, far=far)) for f in SCENE.train)


def with_alpha(change):
    def of(rgba):
        rgba[..., 3] = change(rgba[..., 3])
        return rgba

    return of


def test_what_fits_together_is_not_doubted(tmp_path):
    assert list(remarks(SCENE)) == []
    for train in (moved(0.05), named(["0", "1", "2", "3", "4", "5", "10", "11"]), named("abcdefgh")):
        assert not any("principal" in line or "texts" in line for line in remarks(changed(train=train)))
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(0)) - 0.5  # an orbit around them
    assert list(remarks(changed(still=points))) == []
    write_video(tmp_path / "toy", near=20.0, far=120.0)
    np.save(tmp_path / "toy" / "points.npy", MIDDLE.numpy() + 5 * points.numpy())
    scene = posed_video.read_scene(tmp_path, "toy")
    assert (scene.protocol["derived"], len(scene.still)) == (["box"], 200)
    assert list(remarks(scene)) == []


def walked(degrees, count=9, seconds=None):
    """A film of a camera that goes so far around the origin, at equal steps."""
    frames = []
    for i in range(count):
        angle = np.deg2rad(degrees) * i / (count - 1)
        pose = look_at([4 * np.cos(angle), 4 * np.sin(angle), 0.5], [0.0, 0, 0], [0.0, 0, 1])
        camera = replace(SCENE.train[0].camera, camera_to_world=pose)
        frames.append(replace(SCENE.train[0], name=f"a{i}", time=i / (count - 1), camera=camera))
    protocol = {} if seconds is None else {"seconds": seconds}
    return replace(SCENE, train=tuple(frames), protocol=protocol)


def test_a_film_says_how_fast_its_camera_goes_around_its_subject():
    flat = 0.99228  # the walk is above the ground, so that angles are a little smaller
    degrees, speed = walk_of(walked(40, seconds=2.0))
    assert (degrees, speed) == pytest.approx((40 * flat, 20 * flat), rel=1e-3)
    assert walk_of(walked(40))[1] is None
    film = walked(40)
    assert walk_of(replace(film, train=(*film.train, replace(film.train[0], name="b")))) is None  # a rig
    assert walk_of(replace(film, train=film.train[:2])) is None
    line = "the camera goes 3 degrees around what it looks at, 1.5 a second: hardly more than one that stands"
    for film, said in (
        (walked(3, seconds=2.0), line),
        (walked(3), line.replace(", 1.5 a second", "")),
        (walked(20, seconds=40.0), "the camera goes 20 degrees around what it looks at, 0.5 a second"),
    ):
        (text,) = (text for text in remarks(film) if text.startswith("the camera goes"))
        assert text.startswith(said)
    for film in (walked(6), walked(20, seconds=2.0), SCENE):
        assert not any("the camera goes" in text for text in remarks(film))


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        (changed(train=ranged(0.1, 1.0)), r"look at, .* is \S+ away, with far at 1; set data.far"),
        (changed(train=ranged(30.0, 60.0)), r"away, with near at 30; set data.near"),
        (changed(box=Box((5, 5, 5), (6, 6, 6))), r"look at, .* lies far outside the box .*data.box=null"),
        (changed(box=Box((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1))), r"\d\d% of the subject's pixels see nothing"),
        (changed(with_alpha(lambda alpha: 255 - alpha)), "in 8 of 8 .* fills the edges and not the middle"),
        (changed(with_alpha(lambda alpha: alpha * 0 + 255)), "alpha is opaque in all training images"),
        (changed(train=moved(0.3)), "principal point lies at 80% of the width and 50% of the height"),
        (
            changed(train=moved(0.2)),
            "at 70% of .* the middle of images of .* columns were cut off, subtr",
        ),
        (changed(train=moved(0.12, 0.1)), "at 62% of .* if they are resized copies, multiply fl_x, fl_y, cx"),
        (changed(train=moved(-0.49, -0.51)), "as if cx and cy were written from the middle; add half of"),
        (changed(train=masked(1)), "masks hide nothing in all 8 of the training images looked at"),
        (changed(train=named(["0", "1", "10", "11", "2", "3", "4", "5"])), "texts.*10 comes where 2 is due"),
        (changed(still=torch.full((4, 3), 500.0)), "cameras see 0% of the 4 points that never move"),
    ],
)
def test_what_contradicts_itself_is_told(scene, said):
    assert any(re.search(said, line) for line in remarks(scene))


def test_the_order_of_hexadecimal_names_is_not_doubted():
    names = ["0000", "0001", "0008", "0009", "000a", "000b", "0010", "0011"]
    assert not any("as texts" in line for line in remarks(changed(train=named(names))))


def torso(rows, columns):
    """A silhouette (H, W) that fills shares of the rows and columns, by their ends."""
    row, column = ((torch.arange(30) + 0.5) / 30).expand(2, 30, 30)
    row = row.T
    inside = (row > rows[0]) & (row < rows[1]) & (column > columns[0]) & (column < columns[1])
    return inside.byte() * 255


def said_of(alpha):
    """What is said of a scene all of whose images have one alpha (30, 30)."""
    rgba = alpha[..., None].repeat(1, 1, 4)
    train = [replace(f, camera=f.camera.resized(30, 30), load=lambda: rgba) for f in SCENE.train]
    return "; ".join(remarks(replace(SCENE, train=tuple(train))))


@pytest.mark.parametrize("sides", [((0.2, 1), (0.25, 0.75)), ((0, 1), (0.2, 0.7)), ((0, 1), (0.05, 0.95))])
def test_inverted_masks_of_a_subject_that_crosses_the_edges_are_told(sides):
    assert "alpha or masks were inverted" in said_of(255 - torso(*sides))
    assert "inverted" not in said_of(torso(*sides))


@pytest.mark.parametrize("aside", [((0, 1), (0, 0.33)), ((0, 1), (0.6, 1)), ((0.6, 1), (0, 1))])
def test_a_subject_at_one_side_is_not_taken_for_inverted(aside):
    assert "inverted" not in said_of(torso(*aside))


def of_test(**changes):
    """The scene whose test cameras are changed."""
    test = tuple(replace(f, camera=replace(f.camera, **changes)) for f in SCENE.test)
    return replace(SCENE, test=test)


def far_off(scale):
    pose = SCENE.test[0].camera.camera_to_world.clone()
    pose[:3, 3] *= scale
    return of_test(camera_to_world=pose)


def filmed_by(change):
    """The scene whose training cameras are changed."""
    return replace(SCENE, train=[replace(f, camera=change(f.camera)) for f in SCENE.train])


@pytest.mark.parametrize(
    ("size", "focal", "is_told"),
    [((128, 96), 24, True), ((1920, 1080), 24, True), ((128, 96), 40, True), ((128, 96), 46.5, False)],
)
def test_focal_lengths_in_millimetres_are_told(size, focal, is_told):
    inner = {"fx": focal, "fy": focal, "cx": size[0] / 2, "cy": size[1] / 2}
    scene = filmed_by(lambda camera: replace(camera, width=size[0], height=size[1], **inner))
    lines = [line for line in remarks(scene) if "divide it by the sensor's width" in line]
    assert len(lines) == is_told


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        (far_off(1000), r"3 of 3 test images see nothing of the box .*in other units"),
        (of_test(fx=60.0, fy=60.0), r"focal length of test images is 3.8 of .* training images 1.2 to 1.2"),
        (
            filmed_by(lambda camera: replace(camera, fx=2.0, fy=2.0)),
            "images are 152 degrees wide, as if .* not in pixels; if fl_x is in millim.* by w",
        ),
        (filmed_by(lambda camera: replace(camera, fy=10.0)), "pixels are 0.521 times as wide as high"),
        (filmed_by(lambda _: SCENE.train[0].camera), "in one place"),
    ],
)
def test_test_images_and_focal_lengths_of_other_units_are_told(scene, said):
    assert re.search(said, next(remarks(scene)))


def test_images_without_a_subject_are_refused_and_few_of_them_told():
    with refused("r_0.*expected a subject in some .* 0 everywhere in all 8; mend alpha"):
        list(remarks(changed(with_alpha(torch.zeros_like))))
    shown = [False, True, False, False, True, False, False, False]
    empty = (replace(f, load=lambda f=f: torch.zeros_like(f.load())) for f in SCENE.train)
    train = tuple(f if on else bare for f, bare, on in zip(SCENE.train, empty, shown))
    (line,) = remarks(replace(SCENE, train=train))
    assert line.startswith("6 of 8 training images looked at show no subject")


def test_masks_of_a_dome_may_be_inverted(tmp_path):
    write_dome(tmp_path / "right")
    assert list(remarks(nhr.read_scene(tmp_path, "right", half_resolution=False))) == []
    frames = [replace(f, masks=[255 - mask for mask in f.masks]) for f in dome_frames(dome())]
    nhr.write_scene(tmp_path / "turned", dome(), frames)
    (line,) = remarks(nhr.read_scene(tmp_path, "turned", half_resolution=False))
    assert "alpha or masks were inverted" in line


def test_near_and_far_of_a_file_are_told_in_its_units(tmp_path):
    write_video(tmp_path / "toy", near=1.0, far=30.0)
    (line,) = remarks(posed_video.read_scene(tmp_path, "toy"))
    at = ", ".join(f"{v:g}" for v in MIDDLE.tolist())
    said = f"the point that all cameras look at, ({at}), is 70 away, with far at 30"
    assert line == f"{said}; set data.far, or mend the file's"


def test_masks_that_leave_little_are_told(tmp_path):
    folder = tmp_path / "toy"
    write_video(folder)
    mask = np.zeros((20, 30), np.uint8)
    mask[:5] = 255
    write_image(folder / "mask.png", mask)
    edit(folder / "transforms.json", {f"frames.{i}.mask_path": "mask.png" for i in range(10)})
    (line,) = remarks(posed_video.read_scene(tmp_path, "toy"))
    assert line.startswith("masks leave 25% of the pixels to train on")


def ball(premultiplied, brightness=200, size=64):
    """A ball whose edge is soft, uint8 (H, W, 4)."""
    row, column = np.mgrid[:size, :size] - size / 2 + 0.5
    alpha = np.clip(20 / 64 * size - np.hypot(row, column) + 0.5, 0, 1)[..., None] ** 0.5
    rgb = np.full((size, size, 3), brightness) * np.where(alpha > 0, 1, 0) * (alpha if premultiplied else 1)
    return np.rint(np.concatenate([rgb, 255 * alpha], -1)).astype(np.uint8)


@pytest.mark.parametrize(("read", "in_training"), [("dnerf", False), ("dnerf", True), ("video", True)])
def test_splits_may_differ_in_how_colours_are_multiplied(tmp_path, read, in_training):
    parts = {"train": in_training, "test": not in_training}
    written = {s: [replace(shot, rgba=ball(is_so)) for shot in dnerf_shots(4)] for s, is_so in parts.items()}
    written["val"] = dnerf_shots(1, size=(64, 64))
    if read == "dnerf":
        dnerf.write_scene(tmp_path / "toy", written, camera_angle_x=0.7)
    else:
        views = zip(posed_cameras(8, (64, 64)), ["train", "test"] * 4)
        shots = [
            posed_video.PosedShot(f"{i}.png", view, ball(parts[split]), split=split)
            for i, (view, split) in enumerate(views)
        ]
        posed_video.write_scene(tmp_path / "toy", shots)
    scene = {"dnerf": dnerf, "video": posed_video}[read].read_scene(tmp_path, "toy")
    (line,) = [line for line in scene.protocol["assumed"] if "multiplied" in line]
    assert f"colours of {'train' if in_training else 'test'} images, unlike those of the others, are" in line
    for part in (scene.train, scene.test):
        off = part[0].load().int() - torch.from_numpy(ball(False)).int()
        assert int(off.abs().max()) <= 200 // 20  # of thin alpha little is left


@pytest.mark.parametrize("read", ["dnerf", "video"])
def test_premultiplied_colours_are_recognised_by_edges(read, tmp_path):
    shots = [replace(shot, rgba=ball(True)) for shot in dnerf_shots(4)]
    expected = torch.from_numpy(ball(False))
    if read == "dnerf":
        dnerf.write_scene(tmp_path / "toy", {"train": shots, "test": shots[:1]}, camera_angle_x=0.7)
        reader = dnerf.read_scene
    else:
        views = posed_cameras(4, (64, 64))
        shots = [posed_video.PosedShot(f"{i}.png", view, ball(True)) for i, view in enumerate(views)]
        posed_video.write_scene(tmp_path / "toy", shots)
        reader = posed_video.read_scene
    scene = reader(tmp_path, "toy")
    assert any("colours are taken as multiplied by alpha" in line for line in scene.protocol["assumed"])
    rgba = scene.train[0].load()
    solid = rgba[..., 3] > 100
    assert int((rgba[solid].int() - expected[solid].int()).abs().max()) <= 2
    as_is = reader(tmp_path, "toy", alpha="straight").train[0].load()
    assert torch.equal(as_is, torch.from_numpy(ball(True)))
    with refused("data.alpha: expected straight, premultiplied or null, but got 'associated'"):
        reader(tmp_path, "toy", alpha="associated")


def over(rgba, color, alpha):
    """Straight RGBA (H, W, 4) over one colour whose alpha is (H, W), 0 to 255."""
    front, behind = rgba[..., 3:] / 255, np.rint(alpha)[..., None] / 255 * (1 - rgba[..., 3:] / 255)
    whole = front + behind
    rgb = (rgba[..., :3] * front + np.array(color) * behind) / np.where(whole > 0, whole, 1)
    return np.rint(np.concatenate([rgb, 255 * whole], -1)).astype(np.uint8)


def disk(size, radius, soft=1.0):
    """A disk in the middle that fades over ``soft`` pixels, (H, W), 0 to 1."""
    row, column = np.mgrid[:size, :size] - size / 2 + 0.5
    return np.clip((radius - np.hypot(row, column)) / soft + 0.5, 0, 1)


def shadowed(size, color=0):
    """A bright ball before a soft shadow, as Blender's shadow catcher makes it."""
    shadow = np.roll(150 * disk(size, 0.2 * size, 0.3 * size), size // 4, 0)
    return over(ball(False, size=size), [color] * 3, shadow)


def toon(size=200):
    """A bright coat and a body that lets light through, both behind an outline whose edge is soft."""
    image = np.zeros((size, size, 4), np.uint8)
    image[disk(size, 85) > 0] = [0, 0, 0, 255]
    image[..., 3] = np.rint(255 * disk(size, 85, 4))
    image[disk(size, 80) > 0.5] = [150, 150, 150, 180]
    image[disk(size, 55) > 0.5] = [220, 220, 220, 255]
    return image


def pane(size=200):
    """A pane of glass before a soft shadow, beside a bright ball."""
    image = shadowed(size)
    image[20:60, 20:180] = (120, 110, 100, 170)
    return image


def multiplied(rgba):
    """Multiply straight colours by alpha, uint8 (H, W, 4)."""
    colors = rgba[..., :3] * (rgba[..., 3:] / 255)
    return np.rint(np.concatenate([colors, rgba[..., 3:]], -1)).astype(np.uint8)


@pytest.mark.parametrize(
    "image",
    [
        *(shadowed(size, color) for size in (200, 400, 800) for color in (0, 3, 12)),
        toon(),
        pane(400),
        ball(False),
        ball(False, 60, 400),
        np.full((8, 8, 4), 255, np.uint8),
    ],
)
def test_straight_colours_are_left_as_they_are(image):
    assert not is_premultiplied([torch.from_numpy(image)] * 4)


@pytest.mark.parametrize(
    "image", [ball(True), ball(True, 100, 800), *(multiplied(shadowed(*of)) for of in ((200,), (400, 3)))]
)
def test_premultiplied_colours_are_divided_by_alpha(image):
    image = torch.from_numpy(image)
    assert is_premultiplied([image] * 4)
    divided, solid = straight(image), image[..., 3] == 255
    assert torch.equal(divided[solid], image[solid])
    faint = (image[..., 3] < 200) & (image[..., :3].amax(-1) > 4)
    assert bool((divided[faint][:, :3].amax(-1) > image[faint][:, :3].amax(-1)).all())


def test_smoke_is_a_subject_and_one_that_comes_late_is_only_told(tmp_path):
    """The greatest alpha of smoke is 110; of 60 images only four, none of the eight looked at, show it."""
    assert list(remarks(changed(with_alpha(lambda alpha: (alpha * (110 / 255)).byte())))) == []
    late = [replace(SCENE.train[i % 8], load=lambda: torch.zeros(16, 16, 4).byte()) for i in range(60)]
    late[1:5] = SCENE.train[1:5]
    (line,) = remarks(replace(SCENE, train=tuple(late)))
    assert line.startswith("8 of 8 training images looked at show no subject")
    views = posed_cameras(4, (20, 30))
    empty = np.zeros((20, 30, 4), np.uint8)
    shots = [posed_video.PosedShot(f"{i}.png", view, empty) for i, view in enumerate(views)]
    posed_video.write_scene(tmp_path / "toy", shots)
    with refused(r"toy.*0\.png: expected a subject .*; set data.masks=off, or mend"):
        list(remarks(posed_video.read_scene(tmp_path, "toy")))


@pytest.mark.parametrize(
    ("dataset", "near", "box", "seen"),
    [
        ("nhr", "mend the point clouds, or set data.box=", *["mend the point clouds, or set data.box="] * 2),
        ("hypernerf", "mend near in scene.json", *["mend scene.json, or set data.box=null"] * 2),
        ("video_with_poses", "set data.near, or mend the", "set data.box=null, or mend", "set data.box"),
        ("dnerf", "set data.near", "set data.box=null", "set data.box=null data.near=null data.far=null"),
    ],
)
def test_what_mends_it_is_of_the_format_and_one_cause_has_one_line(dataset, near, box, seen):
    protocol, away = {"dataset": dataset}, Box((50, 50, 50), (51, 51, 51))
    (line,) = remarks(changed(train=ranged(30.0, 60.0), protocol=protocol))
    assert f"near at 30; {near}" in line
    (line,) = remarks(changed(train=ranged(30.0, 60.0), box=away, protocol=protocol))
    assert f"lies far outside the box (50, 50, 50) to (51, 51, 51); {box}" in line
    with pytest.raises(SceneError) as error:
        check_seen(changed(box=away, protocol=protocol))
    assert seen in str(error.value)
    for key in ("data.near", "data.far") if dataset in ("nhr", "hypernerf") else ():
        assert key not in f"{near} {error.value}"


@pytest.mark.slow
def test_point_clouds_in_millimetres_have_one_line_with_a_key_that_is_there(tmp_path):
    folder = write_dome(tmp_path / "toy")
    for path in folder.glob("pointclouds/*.npy"):
        cloud = np.load(path)
        cloud[:, :3] *= 1000
        np.save(path, cloud)
    lines = list(remarks(nhr.read_scene(tmp_path, "toy")))
    assert len(lines) == 1
    assert lines[0].endswith("mend the point clouds, or set data.box=[x0,y0,z0,x1,y1,z1]")


@pytest.mark.parametrize(("factor", "doubted"), [(1, False), (300, True)])
def test_a_box_far_wider_than_all_cameras_is_told_by_name(tmp_path, factor, doubted):
    """Clouds around the point that all cameras look at, which alone shows nothing wrong."""
    folder = write_dome(tmp_path / "toy")
    for path in folder.glob("pointclouds/*.npy"):
        cloud = np.load(path)
        around = np.random.default_rng(0).uniform(-0.2, 0.2, (len(cloud), 3))
        cloud[:, :3] = [0.1, 0.05, 0.9] + factor * around
        np.save(path, cloud)
    lines = list(remarks(nhr.read_scene(tmp_path, "toy")))
    said = [line for line in lines if "times as wide as the ring of all cameras, as if point clouds" in line]
    assert len(said) == doubted


@pytest.mark.parametrize(("shift", "doubted"), [(0.0, False), (1.0, True)])
def test_test_times_beyond_those_of_training_are_told(shift, doubted):
    train = tuple(replace(f, time=f.time / 2) for f in SCENE.train)
    test = tuple(replace(f, time=0.1 + shift / 2 + f.time / 4) for f in SCENE.train)
    lines = list(remarks(changed(train=train, test=test)))
    assert ["lie outside training's, 0 to 0.5, of which" in line for line in lines] == [True] * doubted


@pytest.mark.slow
def test_all_cameras_of_a_long_walk_are_asked_for_points_at_no_cost_of_their_size(monkeypatch):
    """Cameras every metre along a street look across; points are 3 m away; masks of 12 Mpx are not made."""
    up, frames, bytes_of = torch.tensor([0.0, 0.0, 1.0]), [], []

    def measured(points, cameras, masks):
        bytes_of.extend(mask.untyped_storage().nbytes() for mask in masks)
        return sightings(points, cameras, masks)

    monkeypatch.setattr("forewarp.data.checks.sightings", measured)
    for i in range(400):
        eye = torch.tensor([float(i), 0.0, 0.0])
        pose = look_at(eye, eye + torch.tensor([0.0, 3.0, 0.0]), up)
        camera = Camera(4000, 3000, 12000.0, 12000.0, 2000.0, 1500.0, pose, 0.1, 10.0)
        frames.append(Frame(f"{i}", i / 399, camera, lambda: torch.zeros(3, 4, 4, dtype=torch.uint8)))
    points = torch.stack([torch.linspace(0, 399, 2000), torch.full((2000,), 3.0), torch.zeros(2000)], 1)
    box = Box((-1, 0, -1), (400, 4, 1))
    street = replace(SCENE, train=tuple(frames), test=(), box=box, has_alpha=False, still=points)
    assert list(remarks(street)) == []
    assert (len(bytes_of), sum(bytes_of)) == (400, 400)


@pytest.mark.parametrize(
    ("size", "middle", "advice"),
    [
        ((64, 48), (16, 12), "of images 2 times as small: scale them up"),
        ((64, 48), (64, 48), "of images 2 times as large: scale them down"),
        ((64, 48), (0.5, 0.5), "shares of the size: multiply"),
        ((48, 64), (32, 24), "width and height seem exchanged"),
        ((64, 48), (16.6, 11.7), "of images 1.99 times as small"),  # 3 % off the middle
        ((60, 48), (23.2, 31.3), "width and height seem exchanged"),
    ],
)
def test_a_middle_of_other_images_is_named(size, middle, advice):
    camera = Camera(*size, 50.0, 50.0, *middle, torch.eye(4).double(), 0.1, 1.0)
    with refused(advice):
        check_camera(camera, "cx", "k1")


@pytest.mark.parametrize("middle", [(32, 24), (20, 24), (40, 30), (0, 0), (31, 27), (25, 18)])
def test_a_middle_that_is_shifted_is_taken(middle):
    check_camera(Camera(64, 48, 50.0, 50.0, *middle, torch.eye(4).double(), 0.1, 1.0), "cx", "k1")


def with_motion(mask, still=None, key="load_moving"):
    train = tuple(replace(f, **{key: lambda: mask}) for f in SCENE.train)
    return "; ".join(remarks(replace(SCENE, train=train, still=still)))


def test_masks_the_other_way_round_are_told_by_points_or_their_place():
    middle = torch.zeros(16, 16, dtype=torch.bool)
    middle[5:11, 5:11] = True
    still = 0.02 * torch.randn(200, 3, generator=torch.Generator().manual_seed(0))
    assert "100% of the points that never move lie in what moving_path says move, 14%" in with_motion(
        middle, still
    )
    assert "moving_path" not in with_motion(~middle[:, :9].repeat(1, 2)[:, :16] & middle)
    assert "moving_path" not in with_motion(middle)
    assert "moving_path says move 86% of the pixels, as if masks were dark where" in with_motion(~middle)
    assert "says move nothing in all 8 images looked at" in with_motion(middle & ~middle)
    assert "lie in what masks hide, 14% of images" in with_motion(~middle, still, "load_valid")
    assert "hide" not in with_motion(~middle, key="load_valid")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("keys", "change", "said"),
    [
        ({}, lambda pose: pose, None),
        ({}, torch.linalg.inv, "if read with data.inverse=true; compare"),
        ({}, lambda pose: pose @ torch.from_numpy(FLIP), "if read with data.axes=opencv; compare"),
        ({"fl_x": 108.8, "fl_y": 108.8}, lambda pose: pose, "if focal lengths are 0.5 times as long; comp"),
    ],
)
def test_poses_in_which_images_of_a_walk_do_not_agree_are_doubted(tmp_path, keys, change, said):
    shots = [
        posed_video.PosedShot(f"{i:02d}.png", camera, shown(camera)[0], i / 15)
        for i, camera in enumerate(walk(16))
    ]
    posed_video.write_scene(tmp_path / "toy", shots, near=0.2, far=9.0)

    def written(content):
        for frame in content["frames"]:
            frame["transform_matrix"] = change(torch.tensor(frame["transform_matrix"]).double()).tolist()

    edit(tmp_path / "toy" / posed_video.FILE, written)
    edit(tmp_path / "toy" / posed_video.FILE, keys)
    lines = [line for line in remarks(posed_video.read_scene(tmp_path, "toy")) if "images agree" in line]
    assert len(lines) == (said is not None)
    assert (said or "") in "".join(lines)


def orbit(count, wide, size=(64, 48), cut_out=False):
    """A film around the room's balls, over ``wide`` degrees: from within the room, or cut out, from afar."""
    frames, balls = [], [(torch.tensor(middle, dtype=torch.float64), radius) for middle, radius in BALLS]
    away = 4.0 if cut_out else 1.5
    for i, angle in enumerate(np.deg2rad(np.linspace(0, wide, count))):
        place = [0.3 + away * np.cos(angle), 0.5 + away * np.sin(angle), 1.4]
        pose = look_at(place, [0.3, 0.5, 0.6], UP).double()
        camera = Camera(*size, 0.8 * size[0], 0.8 * size[0], size[0] / 2, size[1] / 2, pose, 0.2, 9.0)
        if cut_out:
            rays = camera.rays(dtype=torch.float64)
            aside = [torch.linalg.cross(m - rays.origins, rays.directions).norm(dim=-1) < r for m, r in balls]
            solid = torch.stack(aside).any(0).view(size[1], size[0], 1)
            image = (255 * solid.expand(-1, -1, 4)).byte()
        else:
            image = torch.from_numpy(shown(camera)[0])
        frames.append(Frame(f"o_{i:02d}", i / (count - 1), camera, lambda image=image: image))
    return replace(
        SCENE, train=tuple(frames), test=(), val=(), box=Box((-3, -3, -3), (3, 3, 3)), has_alpha=cut_out
    )


@pytest.mark.parametrize(("wide", "cut_out"), [(90, False), (720, True)])
def test_focal_lengths_that_images_around_a_subject_do_not_agree_with_are_doubted(wide, cut_out):
    scene = orbit(24, wide, cut_out=cut_out)
    assert not any("agree" in line for line in remarks(scene))
    cameras = [replace(f.camera, fx=2 * f.camera.fx, fy=2 * f.camera.fy) for f in scene.train]
    wrong = tuple(replace(frame, camera=camera) for frame, camera in zip(scene.train, cameras))
    (line,) = (line for line in remarks(replace(scene, train=wrong)) if "agree" in line)
    what = "silhouettes of neighbouring images" if cut_out else "images of different directions"
    assert line.startswith(f"{what} agree much better if focal lengths are 0.5 times as long")
