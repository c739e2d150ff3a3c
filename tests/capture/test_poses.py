from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from forewarp.capture import job, poses
from forewarp.capture.poses import Search, adjust

pycolmap = pytest.importorskip("pycolmap", reason="no pycolmap; make install adds it")


def forget(found, image, numbers):
    """Delete what an image sees of some points."""
    for row, point in enumerate(found.images[image].points2D):
        if point.has_point3D() and point.point3D_id in numbers:
            found.delete_observation(image, row)


@pytest.fixture
def found():
    """Six cameras that see sixty points, twenty of which the second half does not see."""
    pycolmap.set_random_seed(0)
    made = pycolmap.synthesize_dataset(
        pycolmap.SyntheticDatasetOptions(
            num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=6, num_points3D=60
        )
    )
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.3), made)
    for image in made.reg_image_ids()[3:]:
        forget(made, image, sorted(made.points3D)[:20])
    made.update_point_3d_errors()
    return made


@pytest.mark.parametrize(("poor", "left"), [(None, 40), (0, 60), (5, 40)])
def test_doubtful_points_stay_for_the_camera_that_needs_them(found, poor, left):
    """A camera that sees fifteen sure points alone keeps its doubtful ones, of which the last has none."""
    doubtful, sure = sorted(found.points3D)[:20], sorted(found.points3D)[20:]
    if poor is not None:
        forget(found, found.reg_image_ids()[poor], sure[15:])
    error, steps = found.compute_mean_reprojection_error(), []
    assert adjust(found, Search(threads=1), lambda *step: steps.append(step)) == error
    assert steps == [(0, 1), (1, 1)]
    assert set(found.points3D) == set(sure + (doubtful if left == 60 else []))
    assert found.compute_mean_reprojection_error() < 0.6


def test_one_poor_camera_does_not_keep_the_points_of_others(found):
    """The last camera has few points and no doubtful ones; one of the first sees a single doubtful point."""
    images, doubtful = found.reg_image_ids(), sorted(found.points3D)[:20]
    forget(found, images[0], doubtful[1:] + sorted(found.points3D)[35:])
    adjust(found, Search(threads=1), lambda done, total: None)
    assert set(doubtful) & set(found.points3D) == {doubtful[0]}


def test_the_error_is_kept_for_the_next_call(found, tmp_path, monkeypatch):
    """It is that of all points, also where the poses are read again."""
    error = found.compute_mean_reprojection_error()
    for name, result in (("find_features", None), ("match", None), ("reconstruct", found)):
        monkeypatch.setattr(poses, name, lambda *given, result=result: result)
    for name in ("refuse_matches", "refuse_poses"):
        monkeypatch.setattr(job, name, lambda *given: None)
    pictures, quiet = SimpleNamespace(folder=None, masks=None), lambda done, total: None
    first = job._found(tmp_path, pictures, Search(threads=1), lambda title: nullcontext(quiet))
    again = job._found(tmp_path, pictures, Search(threads=1), None)
    assert first.error == again.error == error
    assert len(first.points) == len(again.points) == 40
