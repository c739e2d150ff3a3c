from dataclasses import replace
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

pytest.importorskip("pycolmap", reason="no pycolmap; make install adds it")

import pycolmap

from forewarp.capture import pipeline, poses
from forewarp.capture.frames import Frames
from forewarp.capture.poses import Evidence, Search, adjust, read_model, refuse_matches, refuse_poses
from forewarp.data.directions import inverted, opposite
from forewarp.scene.camera import Lens
from forewarp.synth.walks import cameras_of
from tests.support.captures import WALKS, cameras_on_arc, pictures_of, quiet, sparse_arc, step, write_model

POINTS = np.random.default_rng(0).uniform(-1, 1, (40, 3))
LENS = (0.05, -0.02, 0.001, -0.002)


@pytest.mark.parametrize(
    ("model", "lens", "read"),
    [
        ("OPENCV", LENS, ((*LENS[:2], 0), LENS[2:])),
        ("OPENCV", (0, 0, 0, 0), None),
        ("SIMPLE_RADIAL", LENS, ((LENS[0], 0, 0), (0, 0))),
    ],
)
def test_a_model_is_read_as_it_was_written(tmp_path, model, lens, read):
    cameras = cameras_on_arc(4, roll=0.1)
    write_model(tmp_path / "sparse", cameras, POINTS, model, lens)
    found = read_model(tmp_path / "sparse")
    assert list(found.cameras) == list(cameras)
    for name, camera in cameras.items():
        again = found.cameras[name]
        torch.testing.assert_close(again.camera_to_world, camera.camera_to_world)
        for key in ("width", "height", "fx", "fy", "cx", "cy"):
            assert getattr(again, key) == getattr(camera, key)
        assert (again.lens and (again.lens.k, again.lens.p)) == read
    np.testing.assert_allclose(np.sort(found.points, 0), np.sort(POINTS, 0))
    assert found.colors.tolist() == [[200, 100, 50]] * 40
    assert len(found.seen) == 4 * 40
    assert (found.views == 4).all()
    assert len(found.sure()) == 40


def test_cameras_come_in_the_order_of_time_under_our_names(tmp_path):
    """Of the users' names 1, 2, ... 12 the plain order is 1, 10, 11, 12, 2 ..."""
    cameras = cameras_on_arc(12)
    theirs = [f"IMG{n}.jpg" for n in range(1, 13)]
    write_model(tmp_path / "sparse", dict(zip(theirs, cameras.values())), POINTS)
    found = read_model(tmp_path / "sparse", dict(zip(cameras, theirs)))
    assert list(found.cameras) == list(cameras)
    for name, camera in cameras.items():
        torch.testing.assert_close(found.cameras[name].camera_to_world, camera.camera_to_world)


def test_cameras_without_a_picture_are_left_out(tmp_path):
    cameras = cameras_on_arc(6)
    write_model(tmp_path / "sparse", cameras, POINTS)
    theirs = {name: name for name in list(cameras)[1:]}
    found = read_model(tmp_path / "sparse", theirs)
    assert list(found.cameras) == list(theirs)
    assert found.absent == list(cameras)[:1]
    assert set(found.seen[:, 0]) == set(range(5))
    with pytest.raises(ValueError, match="images: expected pictures as .*, as the model has, but got a.png"):
        read_model(tmp_path / "sparse", {"a.png": "a.png"})


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_a_model_is_found_where_colmap_and_nerfstudio_put_it(tmp_path, place):
    cameras = cameras_on_arc(3)
    write_model(tmp_path / place, cameras, POINTS)
    assert read_model(tmp_path).cameras.keys() == cameras.keys()


@pytest.mark.parametrize(
    ("name", "empty"), [("{}.png", False), ("{}", False), ("my {}.png", False), ("{}", True)]
)
def test_a_model_without_the_second_line_of_its_images_is_refused(tmp_path, name, empty):
    cameras = {name.format(i): camera for i, camera in enumerate(cameras_on_arc(4).values())}
    write_model(tmp_path / "m", cameras, POINTS)
    file = tmp_path / "m" / "images.txt"
    file.write_text(
        "# images\n" + ("\n" * (1 + empty)).join(file.read_text().split("\n")[::2]) + "\n" * empty
    )
    (tmp_path / "m" / "points3D.txt").write_text("")
    if empty:
        assert len(read_model(tmp_path / "m").cameras) == 4
        return
    expected = "expected two lines an image .the second may be empty., but got poses in line 2 and 3"
    with pytest.raises(ValueError, match=f"images.txt: {expected}"):
        read_model(tmp_path / "m")


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_names_with_blanks_are_whole(tmp_path, end):
    cameras = {f"my frame {name}": camera for name, camera in cameras_on_arc(3).items()}
    write_model(tmp_path / "m", cameras, POINTS)
    for file in (tmp_path / "m").glob("*.txt"):
        file.write_bytes(file.read_bytes().replace(b"\n", end.encode()))
    assert list(read_model(tmp_path / "m").cameras) == list(cameras)


@pytest.mark.parametrize("part", [None, "camera", "image", "name"])
def test_a_binary_and_a_text_model_that_differ_are_refused(tmp_path, part):
    write_model(tmp_path / "m", cameras_on_arc(3), POINTS)
    model = pycolmap.Reconstruction(tmp_path / "m")
    if part == "camera":
        model.cameras[1].params = model.cameras[1].params * [1.3, 1.3, 1, 1, 1, 1, 1, 1]
    elif part == "image":
        model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), [0.1, 0, 0]))
    elif part == "name":
        model.images[1].name = "b.png"
    model.write_binary(tmp_path / "m")
    if part is None:
        assert len(read_model(tmp_path / "m").cameras) == 3
        return
    with pytest.raises(ValueError, match="expected one model, but got cameras.bin, .* differ, of .*; move"):
        read_model(tmp_path / "m")


def test_what_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(ValueError, match="expected a folder with cameras.bin, images.bin and points3D.bin"):
        read_model(tmp_path)
    for lens in ("OPENCV_FISHEYE", "SIMPLE_DIVISION"):  # the second has a k, which is none of Brown's
        write_model(tmp_path / lens, cameras_on_arc(3), POINTS, lens, LENS)
        with pytest.raises(ValueError, match=f"with k1 k2 k3 p1 p2, as OPENCV, but got {lens}; undistort"):
            read_model(tmp_path / lens)
    write_model(tmp_path / "torn", cameras_on_arc(3), POINTS)
    (tmp_path / "torn" / "cameras.txt").write_text("1 OPENCV x\n")
    with pytest.raises(ValueError, match="torn: expected a COLMAP model, but got"):
        read_model(tmp_path / "torn")


@pytest.mark.slow
def test_lengths_in_a_model_are_not_believed_beyond_its_files(tmp_path):
    write_model(tmp_path / "sparse", cameras_on_arc(3), POINTS)
    pycolmap.Reconstruction(tmp_path / "sparse").write_binary(tmp_path / "sparse")
    for file in (tmp_path / "sparse").glob("*.txt"):
        file.unlink()
    file = tmp_path / "sparse" / "points3D.bin"
    content = bytearray(file.read_bytes())
    at = 8 + 8 + 24 + 3 + 8  # the first point's track
    content[at : at + 8] = (10**9).to_bytes(8, "little")
    file.write_bytes(content)
    with pytest.raises(ValueError, match="sparse: expected a COLMAP model, but got"):
        read_model(tmp_path / "sparse")


def forget(model, image, numbers):
    """Delete what an image sees of some points."""
    for row, point in enumerate(model.images[image].points2D):
        if point.has_point3D() and point.point3D_id in numbers:
            model.delete_observation(image, row)


@pytest.fixture
def model():
    """Six cameras that see sixty points, twenty of which the second half does not see."""
    pycolmap.set_random_seed(0)
    options = {"num_rigs": 1, "num_cameras_per_rig": 1, "num_frames_per_rig": 6, "num_points3D": 60}
    made = pycolmap.synthesize_dataset(pycolmap.SyntheticDatasetOptions(**options))
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.3), made)
    for image in made.reg_image_ids()[3:]:
        forget(made, image, sorted(made.points3D)[:20])
    made.update_point_3d_errors()
    return made


@pytest.mark.parametrize(("poor", "left"), [(None, 40), (0, 60), (5, 40)])
def test_doubtful_points_stay_for_the_camera_that_needs_them(model, poor, left):
    """A camera that sees fifteen sure points alone keeps its doubtful ones, of which the last has none."""
    doubtful, sure = sorted(model.points3D)[:20], sorted(model.points3D)[20:]
    if poor is not None:
        forget(model, model.reg_image_ids()[poor], sure[15:])
    error, steps = model.compute_mean_reprojection_error(), []
    assert adjust(model, Search(threads=1), lambda *step: steps.append(step)) == error
    assert steps == [(0, 1), (1, 1)]
    assert set(model.points3D) == set(sure + (doubtful if left == 60 else []))
    assert model.compute_mean_reprojection_error() < 0.6


def test_one_poor_camera_does_not_keep_the_points_of_others(model):
    """The last camera has few points and no doubtful ones; one of the first sees a single doubtful point."""
    images, doubtful = model.reg_image_ids(), sorted(model.points3D)[:20]
    forget(model, images[0], doubtful[1:] + sorted(model.points3D)[35:])
    adjust(model, Search(threads=1), quiet)
    assert set(doubtful) & set(model.points3D) == {doubtful[0]}


def test_the_error_of_all_points_is_kept_for_the_next_call(model, tmp_path, monkeypatch):
    error = model.compute_mean_reprojection_error()
    results = {"find_features": None, "match": None, "burnt_in": np.zeros((2, 2), bool), "reconstruct": model}
    for name, result in results.items():
        monkeypatch.setattr(poses, name, lambda *given, result=result: result)
    for name in ("refuse_matches", "refuse_poses"):
        monkeypatch.setattr(pipeline, name, lambda *given: None)
    frames = SimpleNamespace(folder=None, masks=None, times=range(6))
    first = pipeline.find_poses(tmp_path, frames, Search(threads=1), step)
    again = pipeline.find_poses(tmp_path, frames, Search(threads=1), None)
    assert first.error == again.error == error
    assert len(first.points) == len(again.points) == 40


def matched(folder, turn=0.0, far=0, logo=0, count=6, size=(640, 480)):
    """A database of images whose camera moves to the right, past points near, and ``far`` ones without
    end; ``turn`` of its degrees are random. ``logo`` points stand where they are, in the upper right corner.
    """
    rng, middle = np.random.default_rng(0), np.array(size) / 2
    near = rng.uniform((-2, -1, 2), (2, 1, 5), (300, 3))
    away = rng.uniform((-500, -400, 999), (500, -300, 1000), (far, 3))
    burnt = rng.uniform((560, 20), (630, 60), (logo, 2))
    places = []
    for number in range(count):
        rotation = Rotation.from_rotvec(np.radians(turn) * rng.normal(size=3)).as_matrix()
        seen = (np.concatenate([near, away]) - (0.1 * number, 0, 0)) @ rotation.T
        world = 500 * seen[:, :2] / seen[:, 2:] + middle + rng.normal(size=(len(seen), 2)) / 5
        places.append(np.concatenate([world, burnt]).clip(0, np.array(size) - 1))
    path = folder / "database.db"
    with pycolmap.Database.open(path) as base:
        lens = pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=(500, 320, 240))
        camera = base.write_camera(lens)
        images = []
        for number, ends in enumerate(places):
            images.append(base.write_image(pycolmap.Image(name=f"{number}.png", camera_id=camera)))
            base.write_keypoints(images[-1], ends.astype(np.float32))
        every = np.arange(len(places[0]), dtype=np.uint32).repeat(2).reshape(-1, 2)
        geometry = pycolmap.TwoViewGeometry(config=3, inlier_matches=every[: 300 + far])
        for pair in combinations(images, 2):
            base.write_matches(*pair, every)
            base.write_two_view_geometry(*pair, geometry)
    return path


def test_what_is_burnt_in_is_found_and_left_out(tmp_path):
    database = matched(tmp_path, turn=2.0, logo=40)
    burnt = poses.burnt_in(database)
    assert burnt[20:60, 560:630].all()
    assert burnt.mean() < 0.05
    poses.leave_out(database, burnt)
    with pycolmap.Database.open(database) as base:
        matches = base.read_all_matches()[1]
        assert len(matches) == 15
        assert max(rows.max() for rows in matches) < 300 < min(map(len, matches)) + 20
        assert base.read_two_view_geometry_num_inliers()[0] == []  # to be verified anew


@pytest.mark.parametrize(("turn", "far"), [(2.0, 0), (2.0, 200), (0.0, 200)])
def test_the_world_is_not_taken_for_burnt_in(tmp_path, turn, far):
    """Nor are mountains behind a camera that does not turn, which stand still too."""
    assert not poses.burnt_in(matched(tmp_path, turn, far)).any()


def test_a_first_look_is_refused_before_the_rest(tmp_path, monkeypatch):
    """Of 50 images every fourth is looked at; then all, unless matches are refused."""
    looks = []
    monkeypatch.setattr(poses, "find_features", lambda *given: looks.append(given[-1]))
    monkeypatch.setattr(poses, "match", lambda *given: looks.append(given[-1]))
    monkeypatch.setattr(pipeline, "refuse_matches", lambda database, images, force: 1 / force)
    frames = SimpleNamespace(folder=None, masks=None, times=range(50))
    for force, error in ((False, ZeroDivisionError), (True, TypeError)):  # there is no database
        with pytest.raises(error):
            pipeline.find_poses(tmp_path, frames, Search(), step, force)
    assert looks == [4, 4, 4, 4, None, None]


@pytest.mark.slow
def test_images_keep_their_numbers_whatever_is_looked_at_first(tmp_path):
    """Also a look at a few is gone on with; what is not looked at yet has no features to count."""
    (tmp_path / "images").mkdir()
    pixels = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    for number in range(6):
        Image.fromarray(np.roll(pixels, 5 * number, 1)).save(tmp_path / "images" / f"{number}.png")
    search = Search(threads=1, features=200)
    for every, looked_at, pairs in ((2, {1, 3, 5}, 3), (None, {1, 2, 3, 4, 5, 6}, 15)):
        database = poses.find_features(tmp_path, tmp_path / "images", None, search, quiet, every)
        poses.match(database, search, quiet, every)
        with pycolmap.Database.open(database) as base:
            assert [image.name for image in base.read_all_images()] == [f"{n}.png" for n in range(6)]
            assert {n for n in range(1, 7) if base.exists_keypoints(n)} == looked_at
            assert base.num_cameras() == 1
            assert len(base.read_two_view_geometries()[0]) == pairs
        assert poses.evidence_of(database).features > 50


def database_of(folder, images):
    """Features and matches of images (N, H, W, 3) uint8."""
    (folder / "images").mkdir(parents=True)
    for number, pixels in enumerate(images):
        Image.fromarray(pixels).save(folder / "images" / f"{number:02d}.png")
    search = Search(threads=1)
    database = poses.find_features(folder, folder / "images", None, search, quiet)
    poses.match(database, search, quiet)
    return database


@pytest.mark.slow
def test_a_logo_in_a_film_is_found_and_the_film_without_has_none(tmp_path):
    times = np.linspace(0, 1, 8)
    cameras = cameras_of(WALKS["room"], times, 3.0, (320, 240))
    images = np.stack(list(pictures_of(WALKS["room"], times, cameras, samples=1, workers=1)))
    assert not poses.burnt_in(database_of(tmp_path / "clean", images)).any()
    logo = np.random.default_rng(0).integers(0, 256, (8, 10, 3))
    images[:, 10:58, 230:310] = logo.repeat(6, 0).repeat(8, 1)
    burnt = poses.burnt_in(database_of(tmp_path / "logo", images))
    assert burnt[10:58, 230:310].mean() > 0.9
    assert burnt.mean() < 0.15


@pytest.mark.slow
def test_an_orbit_with_a_long_lens_is_no_turn(tmp_path):
    walk = replace(WALKS["room"], radius=10.0, angle=17.0)
    times = np.linspace(0, 1, 10)
    cameras = cameras_of(walk, times, 3.0, (320, 240))
    images = pictures_of(walk, times, cameras, samples=1, workers=1)
    assert poses.evidence_of(database_of(tmp_path, images)).unrotated > 1.3 * poses.TURNED


# Checks before and after poses are found -------------------------------------------------------------------

GOOD = Evidence(features=900, shift=0.2, unrotated=0.5)


def frames(count=12, edges=1.0, masks=None, size=(320, 240), originals=()):
    times = {name: float(i) for i, name in enumerate(cameras_on_arc(count))}
    sizes = dict.fromkeys(times, size)
    return Frames(Path("pictures"), masks, times, range(count), count, edges, sizes, originals)


@pytest.mark.parametrize(
    ("evidence", "given", "says"),
    [
        ({"features": 20}, {"edges": 5.0}, r"20 in a picture; edges are 5 pixels wide .* film slower"),
        ({"features": 20}, {}, "20 in a picture; there is hardly any texture"),
        ({"features": 20}, {"masks": Path("masks")}, "no texture but on what the masks call moving"),
        ({"shift": 0.002}, {}, "moves, but got matches that shift by 0.2 % .* walk around the subject"),
        ({"unrotated": 0.01}, {}, "99 % of all shift is explained by turning it; .* something flat: walk"),
    ],
)
def test_hopeless_matches_are_refused_with_advice(monkeypatch, evidence, given, says):
    monkeypatch.setattr(poses, "evidence_of", lambda database: replace(GOOD, **evidence))
    with pytest.raises(ValueError, match=says):
        refuse_matches(Path("database.db"), frames(**given))


def test_good_matches_and_poses_pass_and_of_known_poses_three_are_enough(monkeypatch):
    monkeypatch.setattr(poses, "evidence_of", lambda database: GOOD)
    refuse_matches(Path("database.db"), frames())
    refuse_poses(sparse_arc(), frames(), Path("database.db"))
    refuse_poses(sparse_arc(count=7), frames(), Path("database.db"))
    refuse_poses(sparse_arc(count=3), frames())
    with pytest.raises(ValueError, match="a model of at least 3 pictures, but got 2"):
        refuse_poses(sparse_arc(count=2), frames())


@pytest.mark.parametrize(
    ("found", "given", "says"),
    [
        (None, {}, r"12 pictures registered, but got 0; film slower .*, take more frames \(frames=\), or"),
        ({"count": 5}, {}, "most of 12 pictures registered, but got 5; film slower and with more"),
        ({"count": 5}, {"edges": 4.0}, "but got 5; edges are 4 pixels wide"),
        (None, {"originals": {"picture_000001.jpg": "a.jpg"}}, "0; .*, take more pictures, or give"),
        ({}, {"size": (640, 480)}, "of 640 x 480 pixels, as the pictures, but got 320 x 240; set images="),
        ({"focal": 60.0}, {}, "at most 130 degrees, but got 139; if it is a fisheye, .* something flat"),
        ({"lens": Lens((-2.0, 0.0, 0.0))}, {}, "a lens that can be undone .* if it is a fisheye"),
        ({"degrees": 0.1}, {}, "places that are 0.08 % of the distance apart; .* before something flat"),
        ({"error": 3.0}, {}, "reprojection error of at most 2.5 pixels, but got 3.0"),
    ],
)
def test_bad_poses_are_refused_with_advice(monkeypatch, found, given, says):
    monkeypatch.setattr(poses, "evidence_of", lambda database: GOOD)
    with pytest.raises(ValueError, match=says):
        refuse_poses(None if found is None else sparse_arc(**found), frames(**given), Path("database.db"))


def placed_anew(change, **options):
    """A known model, its poses (12, 4, 4) changed, without points."""
    found = sparse_arc(**options)
    poses = change(torch.stack([camera.camera_to_world for camera in found.cameras.values()]))
    pairs = zip(found.cameras.items(), poses)
    cameras = {name: replace(camera, camera_to_world=pose) for (name, camera), pose in pairs}
    return replace(found, cameras=cameras, points=found.points[:0], seen=found.seen[:0])


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (inverted, r"colmap: .* look at one thing only if they are camera-to-world \(invert them\); write"),
        (opposite, "only if their axes are OpenGL's .*; write them anew, or force=true if they are right"),
        (lambda poses: poses[:1].expand(12, 4, 4), "colmap: expected cameras that move, but got all in one"),
    ],
)
def test_known_poses_of_another_kind_are_refused_before_a_scene_is_written(change, says):
    refuse_poses(placed_anew(lambda poses: poses), frames())
    with pytest.raises(ValueError, match=says):
        refuse_poses(placed_anew(change), frames())
    refuse_poses(placed_anew(change), frames(), force=True)


@pytest.mark.parametrize(("moves", "least", "most"), [(0.0, 0.0, 1e-6), (0.002, 0, 0.06), (0.3, 0.08, 1.0)])
def test_turning_and_walking_are_told_apart(moves, least, most):
    """A camera turns by six degrees and moves sideways, as a share of the distance; a quarter is wrong."""
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-0.5, 0.5, (400, 2)), rng.uniform(0.6, 1.6, (400, 1))], 1)
    rotation = Rotation.from_euler("xyz", [2, 6, 1], degrees=True).as_matrix()
    ends = [1.2 * seen[:, :2] / seen[:, 2:] for seen in (points, (points - [moves, 0, 0]) @ rotation.T)]
    ends[1][:100] += rng.normal(size=(100, 2))
    assert least <= min(poses.unrotated(*ends, focal) for focal in (1.0, 1.2, 1.6)) <= most


def test_the_cameras_of_a_rig_are_searched_from_other_pairs_until_all_are_found(tmp_path, monkeypatch):
    """The first model of all cameras is taken, and else that of the most."""

    def model(count):
        return SimpleNamespace(num_reg_images=lambda: count)

    def searched(counts, names):
        left, angles = iter(counts), []

        def mapping(database, images, place, options, **calls):
            assert place.is_dir()
            angles.append(options.mapper.init_min_tri_angle)
            return {0: model(1), 1: model(next(left))}

        monkeypatch.setattr(pycolmap, "incremental_mapping", mapping)
        words = tmp_path / "a.db", tmp_path, Search(), quiet
        return poses.reconstruct(*words, names).num_reg_images(), angles

    pycolmap.Database.open(tmp_path / "a.db").close()
    assert searched([2, 4, 3], list("abcd")) == (4, [16.0, 16.0])
    assert searched([2, 3, 2, 1, 2], list("abcd")) == (3, [16.0, 16.0, 8.0, 6.0, 16.0])
    assert searched([2], None) == (2, [16.0])
