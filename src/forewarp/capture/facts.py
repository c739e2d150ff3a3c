"""What a capture found, in numbers and in words."""

from __future__ import annotations

import math

import numpy as np

from forewarp.capture.pictures import Pictures
from forewarp.capture.place import Limits
from forewarp.capture.sparse import Sparse

ABOUT, PICTURE = "capture.json", "capture.png"


def facts_of(source, pictures: Pictures, sparse: Sparse, limits: Limits, scales: list[int]) -> dict:
    """Gather the numbers of ``capture.json``."""
    camera = next(iter(sparse.cameras.values()))
    times = [pictures.times[name] for name in sparse.cameras]
    lens = camera.lens
    left_out = sorted(pictures.times.keys() - sparse.cameras.keys())
    return {
        "source": str(source.path),
        "found": pictures.found,
        "pictures": len(pictures.times),
        "registered": len(sparse.cameras),
        "searched": source.colmap is None,
        "left_out": [pictures.originals.get(name, name) for name in left_out],
        "originals": pictures.originals,
        "seconds": max(times) - min(times) if source.video is not None else None,
        "reprojection_error": sparse.error,
        "points": len(sparse.points),
        "sure_points": len(sparse.sure()),
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "k": list(lens.k) if lens else [0.0] * 3,
            "p": list(lens.p) if lens else [0.0] * 2,
            "degrees": math.degrees(2 * math.atan(camera.width / (2 * camera.fx))),
        },
        "path": _path_length(sparse),
        "near": limits.near,
        "far": limits.far,
        "box": [*limits.box.low, *limits.box.high],
        "scales": scales,
    }


def _path_length(sparse: Sparse) -> float:
    """How far the camera went, where the median distance of what it sees is 1."""
    centers = np.stack([np.asarray(camera.center) for camera in sparse.cameras.values()])
    return float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())


def told(facts: dict) -> list[str]:
    """Say what was found in a few lines."""
    camera, box = facts["camera"], facts["box"]
    size = " x ".join(f"{high - low:.2f}" for low, high in zip(box[:3], box[3:]))
    all_sure = facts["sure_points"] == facts["points"]
    sure = "" if all_sure else f", {facts['sure_points']:,} of them sure"
    lines = [
        f"registered: {facts['registered']} of {facts['pictures']} pictures, {camera['width']} x "
        f"{camera['height']} pixels, reprojection error {facts['reprojection_error']:.2f} pixels",
        f"camera: {camera['degrees']:.0f} degrees wide; its path is {facts['path']:.2f} long, where what it "
        "sees is 1 away",
        f"points: {facts['points']:,}{sure}; box {size}, near {facts['near']:.2f}, far {facts['far']:.2f}",
    ]
    if facts["left_out"]:
        few = ", ".join(facts["left_out"][:3])
        advice = "; film slower and with more of what stands still" if facts["searched"] else ""
        lines.append(f"left out: {len(facts['left_out'])} pictures without a pose ({few}){advice}")
    return lines
