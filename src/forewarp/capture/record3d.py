"""A scan by Record3D, on a phone that measures depth, to a scene: poses, depths and confidences are its own.

An ``.r3d`` is a ZIP archive. ``metadata`` is JSON: ``w h`` and ``dw dh`` are the sizes of images and depths;
``poses`` has of each frame the quaternion x, y, z, w of a camera-to-world rotation with OpenGL's axes, and
the camera's place in metres; ``K`` is the camera matrix, column by column (row by row is told from that);
``perFrameIntrinsicCoeffs``, where it is there, is fx, fy, cx, cy of each frame; ``frameTimestamps`` are
seconds, or ``fps`` frames a second.
``rgbd/<i>.jpg`` is an image, ``rgbd/<i>.depth`` float32 metres along the optical axis and ``rgbd/<i>.conf`` a
byte for each, ARKit's level 0, 1 or 2; both are compressed by LZFSE.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from reprlib import repr as short

import numpy as np
import torch

from forewarp.capture.frames import Step, write_smaller
from forewarp.data.agreement import likeliest_reading, small_image
from forewarp.data.cameras import check_camera
from forewarp.data.checks import IN_ONE_PLACE, are_one_place
from forewarp.data.depth import SHOWN, along_rays
from forewarp.data.directions import opposite
from forewarp.data.files import Entry, mismatch
from forewarp.data.images import by, read_image
from forewarp.data.posed_video import PosedShot, write_scene
from forewarp.files import MOST_FILM, check_size, folder_written_whole, memory_within, write_json
from forewarp.ops.gaussians import rotations
from forewarp.scene.camera import Camera
from forewarp.scene.frame import spread

_MOST_SIDE, _UNITS, _MOST_BYTES = 1e5, (-1e6, 1e6), 200_000_000
_MOST_DEPTH_SIDE = 2048  # pixels; LiDARs have 256 x 192, cameras of the face 640 x 480
_SECONDS = 0.0, 1e11  # since the phone began or 1970
_METADATA = 1 << 24  # bytes: parsed they take thirty times as many; of a frame about 150
_ROOM = 1 << 26  # bytes that unpacking a plane may take beside what it holds
_OVERHEAD = 4096  # bytes, at most, that compressed data are larger by: LZFSE stores blocks that do not shrink
_GROUPS, _BESIDE = 3, (0, 6, 20)  # views that tell the order of quaternions, with others so many later
_SAMPLED, _SMALLER = 16, 2  # depths that tell near and far; how many times smaller the copies are
_ENDS = ((0.001, 0.75), (0.999, 1.25))  # of near and far: quantile of all depths, and room beside it


def capture_record3d(scan: Path, out: Path, step: Step, mark: str, frames: int | None = None) -> dict:
    """Make a scene in ``out`` of a scan, and return what was found, which the file ``mark`` there holds too.

    Args:
        scan: the ``.r3d``.
        out: the scene's folder; an earlier capture in it is replaced.
        step: gives a ``Progress``.
        mark: see ``folder_written_whole``.
        frames: most frames, evenly spread; None: all.

    Raises:
        SceneError: in a line, for what is missing or wrong in the archive; ImportError: without ``lzfse``.
    """
    check_size(scan, MOST_FILM)
    try:
        archive = zipfile.ZipFile(scan)
    except (OSError, zipfile.BadZipFile) as error:
        raise mismatch(scan, "a scan of Record3D, a ZIP archive", "another file") from error
    with archive:
        read = _Scan(scan, archive)
        chosen = spread(len(read.poses), frames or len(read.poses))
        depths = [read.depth(chosen[k]) for k in spread(len(chosen), _SAMPLED)]
        there = np.concatenate([depth[depth > 0] for depth in depths])
        if not there.size:
            raise mismatch(f"{scan}: rgbd/*.depth", "depths above 0", "holes alone")
        near, far = (float(np.quantile(there, share)) * room for share, room in _ENDS)
        first, last = (read.times[chosen[k]] for k in (0, -1))
        with folder_written_whole(out, mark) as folder, step("frames") as progress:
            read.settle_order(chosen, folder)

            def shots() -> Iterator[PosedShot]:
                for done, i in enumerate(chosen, 1):
                    name = f"{i:06d}.jpg"
                    pixels = read.image(i, folder)[..., :3].numpy()
                    write_smaller(folder, name, pixels, _SMALLER)
                    time, evidence = (read.times[i] - first) / ((last - first) or 1.0), read.confidence(i)
                    camera = read.camera(i)
                    yield PosedShot(name, camera, pixels, time, depth=read.depth(i), confidence=evidence)
                    progress(done, len(chosen))

            write_scene(folder, shots(), near=near, far=far, seconds=last - first)
            facts = {"source": str(scan), "pictures": len(chosen), "found": len(read.poses)}
            facts |= {"size": list(read.size), "depth": list(read.of_depth), "seconds": last - first}
            facts |= {"near": near, "far": far, "w_first": read.w_first}
            places = torch.tensor([read.poses[i][4:] for i in chosen], dtype=torch.float64)
            facts["in_one_place"] = are_one_place(places)
            write_json(folder / mark, facts)
    return facts


def summary(facts: dict) -> list[str]:
    """Say what was found in a few lines."""
    size, of_depth, near, far = by(facts["size"]), by(facts["depth"]), facts["near"], facts["far"]
    order = "; quaternions are w, x, y, z, as neighbouring views agree so" if facts["w_first"] else ""
    still = f"cameras {IN_ONE_PLACE}; scans by the front camera have none"
    return [
        f"frames: {facts['pictures']} of {facts['found']}, {size} pixels, {facts['seconds']:.1f} s",
        f"depth: {of_depth}, near {near:.2f} and far {far:.2f} metres; poses are the phone's{order}",
        *[still] * facts["in_one_place"],
    ]


class _Scan:
    """What an open archive holds, checked: ``size``, ``of_depth`` (width, height), ``poses``, ``times``."""

    def __init__(self, path: Path, archive: zipfile.ZipFile) -> None:
        self.path, self.archive = path, archive
        try:
            about = json.loads(self.member("metadata", _METADATA))
        except (ValueError, RecursionError) as error:  # of its text, too; of absurd nesting
            raise mismatch(f"{path}: metadata", "JSON", str(error)) from error
        if not isinstance(about, dict):
            raise mismatch(f"{path}: metadata", "an object", short(about))
        self.about = Entry(path, about, "metadata: ")
        width, height = (int(self.about.number(key, 1, _MOST_SIDE)) for key in ("w", "h"))
        self.size = width, height
        if lacking := [key for key in ("dw", "dh") if about.get(key) is None]:
            expected, advice = (
                "the width and height of depth",
                "add them: 192 and 256 of a LiDAR's upright scans",
            )
            raise mismatch(self.about.where(", ".join(lacking)), expected, "none", advice)
        width, height = (int(self.about.number(key, 1, _MOST_DEPTH_SIDE)) for key in ("dw", "dh"))
        self.of_depth = width, height
        if abs(height * self.size[0] - width * self.size[1]) > max(width, height, *self.size):
            expected = f"the proportions of w and h, {by(self.size)}"
            advice = "exchange dw and dh, if depths are as upright as images"
            raise mismatch(self.about.where("dw, dh"), expected, by(self.of_depth), advice)
        self.poses, self.w_first = self._rows("poses", 7), False
        count, matrix = len(self.poses), self.about.numbers("K", 9, *_UNITS)
        images = sum(re.fullmatch(r"rgbd/\d+\.jpg", name) is not None for name in archive.NameToInfo)
        if images > count:
            advice = "export the scan once more, or remove the images that have none"
            raise mismatch(self.about.where("poses"), f"one of each of {images} images", count, advice)
        if lacking := [i for i in range(count) if f"rgbd/{i}.jpg" not in archive.NameToInfo]:
            advice = "export the scan once more"
            if lacking[-1] - lacking[0] == count - 1 - lacking[0] == len(lacking) - 1:
                advice += f"; if the recording broke off, remove its last {len(lacking)} poses"
            got = f"{len(lacking)} of {count} without one, as rgbd/{lacking[0]}.jpg"
            raise mismatch(self.about.where("poses"), "an image of each", got, advice)
        by_rows = matrix[6] == matrix[7] == 0 < min(matrix[2], matrix[5])
        self.intrinsics = [[matrix[k] for k in ((0, 4, 2, 5) if by_rows else (0, 4, 6, 7))]] * count
        if about.get("perFrameIntrinsicCoeffs"):
            self.intrinsics = self._rows("perFrameIntrinsicCoeffs", 4, count)
        if about.get("frameTimestamps"):
            self.times = self.about.numbers("frameTimestamps", count, *_SECONDS)
            back = next((i for i in range(1, count) if self.times[i] <= self.times[i - 1]), None)
            if back is not None:
                got = f"{self.times[back]:.10g} of frame {back} after {self.times[back - 1]:.10g}"
                raise mismatch(
                    self.about.where("frameTimestamps"), "seconds that grow", got, "remove the key"
                )
        else:
            fps = self.about.number("fps", 1e-3, _MOST_SIDE)
            self.times = [i / fps for i in range(count)]

    def camera(self, i: int, *, w_first: bool = False) -> Camera:
        """Return the camera of a frame; its near and far are not known."""
        (*q, x, y, z), pose = self.poses[i], torch.eye(4, dtype=torch.float64)
        place, q = (
            [x, y, z],
            torch.tensor(q if w_first or self.w_first else [q[3], *q[:3]], dtype=torch.float64),
        )
        if not 0.9 < float(q.norm()) < 1.1:
            where = f"{self.path}: metadata: poses[{i}]"
            raise mismatch(where, "a quaternion of length 1", f"{float(q.norm()):g}")
        pose[:3, :3] = rotations(q[None])[0]
        pose[:3, 3] = torch.tensor(place, dtype=torch.float64)
        fx, fy, cx, cy = self.intrinsics[i]
        if min(fx, fy) <= 0:
            raise mismatch(f"{self.path}: metadata: focal length of frame {i}", "above 0", f"{min(fx, fy):g}")
        camera = Camera(*self.size, fx, fy, cx, cy, opposite(pose[None])[0], 0.0, 1.0)
        check_camera(camera, f"{self.path}: metadata: principal point of frame {i}", "")
        return camera

    def settle_order(self, chosen: Sequence[int], folder: Path) -> None:
        """Set ``w_first`` where neighbouring views of those ``chosen`` agree only if quaternions are w, x, y,
        z; ``folder`` is the scene's.
        """
        groups, turned = [], {}
        for k in spread(len(chosen), _GROUPS):
            group = []
            for i in [chosen[k + n] for n in _BESIDE if k + n < len(chosen)]:
                image = small_image(self.image(i, folder), SHOWN)
                camera = self.camera(i).resized(image.shape[1], image.shape[0])
                pose = self.camera(i, w_first=True).camera_to_world
                turned[id(camera)] = replace(camera, camera_to_world=pose)
                depth = torch.from_numpy(self.depth(i).copy())
                group.append((camera, image, along_rays(depth[None], camera)[0]))
            groups.append(group)
        reading = {"w_first": lambda camera, away: (turned[id(camera)], away)}
        self.w_first = likeliest_reading(groups, reading) is not None

    def image(self, i: int, folder: Path) -> torch.Tensor:
        """Write the image of a frame into a scene's folder as it is, and decode it: uint8 (H, W, 4)."""
        path = folder / "images" / f"{i:06d}.jpg"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(self.member(f"rgbd/{i}.jpg"))
        return read_image(path, self.size)

    def depth(self, i: int) -> np.ndarray:
        """Return metres (H, W) float32 along the optical axis, 0 where there is none."""
        depth = self._plane(f"rgbd/{i}.depth", np.float32)
        return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))

    def confidence(self, i: int) -> np.ndarray | None:
        """Return levels (H, W) uint8, or None where there are none."""
        name = f"rgbd/{i}.conf"
        return self._plane(name, np.uint8) if name in self.archive.NameToInfo else None

    def member(self, name: str, most: int = _MOST_BYTES) -> bytes:
        """Return the bytes of a file in the archive, at most ``most``."""
        where = f"{self.path}: {name}"
        if name not in self.archive.NameToInfo:
            raise mismatch(where, "this file in the archive", "none", "export the scan with depth once more")
        if (size := self.archive.getinfo(name).file_size) > most:
            raise mismatch(where, f"at most {most} bytes", size)
        try:
            return self.archive.read(name)
        except Exception as error:  # BadZipFile, zlib.error, RuntimeError and more
            raise mismatch(where, "a whole file", f"one that cannot be unpacked ({error})") from error

    def _plane(self, name: str, kind: type) -> np.ndarray:
        import lzfse

        (width, height), where = self.of_depth, f"{self.path}: {name}"
        size = width * height * np.dtype(kind).itemsize
        try:
            packed = self.member(name, size + _OVERHEAD)
            with memory_within(4 * size + _ROOM):
                raw = lzfse.decompress(packed)
        except lzfse.error as error:
            raise mismatch(where, "data compressed by LZFSE", "others") from error
        except MemoryError as error:
            raise mismatch(where, f"{size} bytes as dw and dh say", "many times as many") from error
        if len(raw) != size:
            raise mismatch(where, f"{width} x {height} numbers as dw and dh say", f"{len(raw)} bytes")
        return np.frombuffer(raw, kind).reshape(height, width)

    def _rows(self, key: str, columns: int, count: int | None = None) -> list[list[float]]:
        rows = self.about.get(key)
        if not isinstance(rows, list) or not rows or (count and len(rows) != count):
            expected = f"{count} rows of {columns} numbers" if count else "a pose of each frame"
            raise mismatch(self.about.where(key), expected, short(rows))
        each = Entry(self.path, {f"[{i}]": row for i, row in enumerate(rows)}, f"metadata: {key}")
        return [each.numbers(place, columns, *_UNITS) for place in each.own]
