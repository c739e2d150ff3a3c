import pytest

from forewarp.capture.facts import told

FACTS = {
    "registered": 9,
    "pictures": 12,
    "left_out": ["a.jpg", "b.jpg", "c.jpg"],
    "searched": True,
    "reprojection_error": 0.5,
    "points": 468,
    "sure_points": 468,
    "camera": {"width": 64, "height": 48, "degrees": 60.0},
    "path": 1.0,
    "near": 0.5,
    "far": 2.0,
    "box": [-1, -1, -1, 1, 1, 1],
}


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        ({}, "points: 468; box 2.00 x 2.00 x 2.00, near 0.50, far 2.00"),
        ({"sure_points": 400}, "points: 468, 400 of them sure; box 2.00 x 2.00 x 2.00, near 0.50, far 2.00"),
        (
            {},
            "left out: 3 pictures without a pose (a.jpg, b.jpg, c.jpg); film slower and with more of what "
            "stands still",
        ),
        ({"searched": False}, "left out: 3 pictures without a pose (a.jpg, b.jpg, c.jpg)"),
    ],
)
def test_what_was_found_is_told_once_and_with_advice(changed, says):
    assert says in told(FACTS | changed)
