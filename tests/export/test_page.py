import base64
import io
import re

import imageio.v3 as iio
import msgspec
import numpy as np
import pytest
import torch
import zstandard
from scipy.spatial import KDTree

from forewarp.export.formats import write
from tests.export.conftest import TIMES


def read(folder):
    """What the page plays: pairs of a second and a message, with arrays in their places."""
    text = (folder / "scene.html").read_text()
    data = base64.b64decode(re.search(r'__VISER_EMBED_DATA__="([^"]+)"', text)[1])
    raw = zstandard.ZstdDecompressor().decompress(
        data[8:], max_output_size=int.from_bytes(data[:8], "little")
    )
    at = 8 + int.from_bytes(raw[:8], "little")
    content, buffers = msgspec.msgpack.decode(raw[8:at]), []
    for length in content["binaryBufferLengths"]:
        at += -at % 8
        buffers.append(raw[at : at + length])
        at += length

    def filled(value):
        if isinstance(value, dict) and "__binary_index" in value:
            return np.frombuffer(buffers[value["__binary_index"]], value["dtype"])
        return {key: filled(part) for key, part in value.items()} if isinstance(value, dict) else value

    return content["durationSeconds"], [(second, filled(message)) for second, message in content["messages"]]


def shown(messages, part, last):
    """The scene's props at the start, and what it is when everything until a second was played."""
    of_scene = [(s, m) for s, m in messages if m.get("name") == "/scene" and s <= last]
    props = next(dict(m["props"]) for _, m in of_scene if "props" in m)
    for _, message in of_scene:
        props |= message.get("updates", {})
    return props, props[part]


def export(source, folder, **options):
    defaults = {"points": 200, "seconds": 2.0, "megabytes": 20.0}
    return write("html", source, folder, {}, lambda *n: None, **defaults | options)


def test_particles_are_splats_of_each_time(particles, tmp_path):
    about = export(particles, tmp_path / "html")
    assert "thinned" not in about
    duration, messages = read(tmp_path / "html")
    assert duration == pytest.approx(3.0)  # the last time is shown as long as others are, on average
    clouds = [particles.method.ellipsoids(time) for time in TIMES]
    for time, cloud in zip(TIMES, clouds):
        props, buffer = shown(messages, "buffer", 2 * time + 1e-6)
        table = buffer.view("<f4").reshape(-1, 8)
        assert len(table) == len(cloud) == about["particles"]
        chosen = KDTree(cloud.centers).query(props["scale"] * table[:, :3])[1]
        assert len(set(chosen)) == len(chosen)
        np.testing.assert_allclose(props["scale"] * table[:, :3], cloud.centers[chosen], atol=1e-5)
        halves = props["scale"] ** 2 * buffer.view("<f2").reshape(-1, 16)[:, 8:14].astype(np.float32)
        wanted = cloud.covariances[chosen][:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        largest = wanted.abs().amax(-1, keepdim=True)
        assert float((abs(torch.from_numpy(halves) - wanted) / largest).max()) < 2e-3
        bytes_of = buffer.view("u1").reshape(-1, 32)[:, 28:] / 255
        np.testing.assert_allclose(bytes_of[:, :3], cloud.colors[chosen], atol=0.005)
        np.testing.assert_allclose(bytes_of[:, 3], cloud.opacity[chosen], atol=0.005)


@pytest.mark.parametrize("color", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])
def test_it_is_seen_before_the_background_of_exact_pictures(ball, tmp_path, color):
    object.__setattr__(ball, "background", color)
    export(ball, tmp_path / "html", points=20)
    _, messages = read(tmp_path / "html")
    behind = [message["rgb_data"] for _, message in messages if message["type"] == "BackgroundImageMessage"]
    assert (iio.imread(io.BytesIO(bytes(behind[-1])))[..., :3] == 255 * np.array(color)).all()


def test_voxels_are_points_of_each_time(ball, tmp_path):
    about = export(ball, tmp_path / "html")
    _, messages = read(tmp_path / "html")
    first = torch.from_numpy(shown(messages, "points", 0.0)[1].reshape(-1, 3).copy())
    assert len(first) == about["points"] == 200
    wanted = ball.method.trajectories(first, torch.tensor(TIMES))
    for row, time in enumerate(TIMES):
        props, points = shown(messages, "points", 2 * time + 1e-6)
        np.testing.assert_allclose(points.reshape(-1, 3), wanted[:, row], atol=1e-5)
        painted = torch.sigmoid(2 * first)
        np.testing.assert_allclose(props["colors"].reshape(-1, 3) / 255, painted, atol=0.005)


def test_what_does_not_fit_is_left_out_and_said(particles, tmp_path):
    object.__setattr__(particles, "times", tuple(i / 39 for i in range(40)))
    most = 0.87  # viser's own page has 0.82
    about = export(particles, tmp_path / "html", megabytes=most)
    assert (tmp_path / "html" / "scene.html").stat().st_size <= most * 1e6
    count = len(particles.method.means)
    assert about["thinned"] == f"{about['particles']} of {count} particles, 12 of 40 times"
    assert 10 < about["particles"] < count
    _, messages = read(tmp_path / "html")
    seconds = sorted({second for second, _ in messages})
    np.testing.assert_allclose(seconds, 2 * np.array(about["times on the page"]), atol=1e-6)
    with pytest.raises(ValueError, match="megabytes: expected room for the page, but got 0.5"):
        export(particles, tmp_path / "none", megabytes=0.5)
