import numpy as np
import pytest
import torch

from forewarp.capture.sparse import read_model
from tests.support.sparse_scene import cameras_on_arc, write_model

pytest.importorskip("pycolmap", reason="no pycolmap; make install adds it")
POINTS = np.random.default_rng(0).uniform(-1, 1, (40, 3))
LENS = (0.05, -0.02, 0.001, -0.002)


@pytest.mark.parametrize(
    ("model", "lens"), [("OPENCV", LENS), ("OPENCV", (0, 0, 0, 0)), ("SIMPLE_RADIAL", LENS)]
)
def test_a_model_is_read_as_it_was_written(tmp_path, model, lens):
    cameras = cameras_on_arc(4, roll=0.1)
    write_model(tmp_path / "sparse", cameras, POINTS, model, lens)
    found = read_model(tmp_path / "sparse")
    assert list(found.cameras) == list(cameras)
    for name, camera in cameras.items():
        one = found.cameras[name]
        torch.testing.assert_close(one.camera_to_world, camera.camera_to_world)
        same = ("width", "height", "fx", "fy", "cx", "cy")
        assert [getattr(one, key) for key in same] == [getattr(camera, key) for key in same]
        if not any(lens):
            assert one.lens is None
        else:
            assert (one.lens.k, one.lens.p) == (
                ((*lens[:2], 0), lens[2:]) if model == "OPENCV" else ((lens[0], 0, 0), (0, 0))
            )
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


def test_what_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(ValueError, match="expected a folder with cameras.bin, images.bin and points3D.bin"):
        read_model(tmp_path)
    write_model(tmp_path / "fish", cameras_on_arc(3), POINTS, "OPENCV_FISHEYE", LENS)
    with pytest.raises(ValueError, match="with k1 k2 k3 p1 p2, as OPENCV, but got OPENCV_FISHEYE; undistort"):
        read_model(tmp_path / "fish")
    write_model(tmp_path / "more", cameras_on_arc(3), POINTS)
    with pytest.raises(ValueError, match="a picture frame_000002.jpg, as the model has, but got none"):
        read_model(tmp_path / "more", {"picture_000001.jpg": "frame_000001.jpg"})
    write_model(tmp_path / "torn", cameras_on_arc(3), POINTS)
    (tmp_path / "torn" / "cameras.txt").write_text("1 OPENCV x\n")
    with pytest.raises(ValueError, match="torn: expected a COLMAP model, but got"):
        read_model(tmp_path / "torn")
