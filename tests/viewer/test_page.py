"""What a page sends of splats."""

from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch

pytest.importorskip("viser", reason="no viser: pip install forewarp[viewer]")

from forewarp.scene.cloud import Ellipsoids
from forewarp.viewer.page import Page


@pytest.mark.parametrize("shade", [0, 255])
def test_splats_are_seen_before_the_background_of_exact_pictures(shade):
    client, subject = Mock(), SimpleNamespace(background=torch.full((3,), shade / 255))
    studio = SimpleNamespace(subjects=[subject], scene=SimpleNamespace(box=SimpleNamespace(diagonal=2.0)))
    page = SimpleNamespace(studio=studio, client=client, _splats=None)
    one = Ellipsoids(torch.ones(1, 3), torch.eye(3)[None], torch.ones(1), torch.zeros(1, 1, 3))
    for _ in range(2):  # the background is sent once
        Page.splats(page, one)
    (sent,) = client.scene.set_background_image.call_args_list
    assert sent.args[0].tolist() == [[[shade] * 3]]
    assert [call.kwargs["scale"] for call in client.scene.add_gaussian_splats.call_args_list] == [0.02] * 2
