"""Doubt a scene before it is trained on: what its cameras, box, alpha, masks and points say of each other."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations

import torch
from torch import Tensor

from forewarp.data.agreement import BESIDE, COMPARED, likeliest, silhouette_error, small_image, sweep_error
from forewarp.data.cameras import IN_PIXELS, WIDEST, degrees_of, nine_pixels
from forewarp.data.directions import common_point, readings_of
from forewarp.data.files import SceneError, mismatch
from forewarp.data.images import StoredImage, by, copies
from forewarp.data.names import hexadecimal, in_order, read_names
from forewarp.data.paths import doubt_paths
from forewarp.scene.box import Box, Lattice
from forewarp.scene.camera import Camera, focus_point
from forewarp.scene.frame import Frame, Scene, sightings, spread, walk_of, where_seen

_LOOKED_AT = 8  # training images whose alpha is looked at
_PIXELS = 4000  # of each
_EDGE, _LEFT_OUT = 0.9, 0.02  # shares of an inverted image: subject along its edges, background at least
_SIDE, _HOLLOW = 0.5, 0.33  # of one whose subject crosses edges: at two opposite ones, in its middle ninth
_WITHIN = 5  # points along a side of the box that cameras are asked for
_FAINT = 8  # of 255: alpha that is nowhere above it was written as 0 and 1
_ZOOMED = 1.25  # focal lengths of test and training images
_ASIDE = 0.25  # share of a side by which a principal point is far from the middle
_CROPPED, _MIDDLE = 0.08, 0.01  # shares by which one of a crop is off; and the other, of one side alone
_CORNER = 0.05  # shares of the sides from the corner, which are rather from the middle
_STRETCHED, _SAME_PLACE = 1.25, 1e-9  # sides of a pixel; share of the cameras' distance from the origin
IN_ONE_PLACE = "all stand in one place, which tells nothing of depth; compare their poses"
_AROUND = 2  # half a side of a subject's box in distances of the farthest camera from what they look at
_WALKED, _SLOW = 5, 1  # degrees around what a film shows, in all and a second, that are too few
_FAR_PAIRS = 8  # of a film around a subject
_LEAST_VIEWS = 8  # whose silhouettes tell focal lengths
_VIEWS, _FACTORS = 12, (16 / 9, 9 / 16, 0.5, 0.75, 4 / 3, 2.0)  # images; focal lengths, the likeliest first
_LIKELIER, _MISSED = 0.8, 0.01  # pixels outside other silhouettes: share of those as read, and less by these
_LONGER = "if focal lengths are {:.3g} times as long"
_CUT_OFF, _FEW = 0.1, 0.5  # share of the subject beyond the box; of pixels and points that is too few
# What mends near or far, the box, and all three, by format; "" is any other.
_REMEDIES = {
    "nhr": ("mend the point clouds, or set data.box=[x0,y0,z0,x1,y1,z1]",) * 3,
    "hypernerf": ("mend {key} in scene.json", *("mend scene.json, or set data.box=null",) * 2),
    "iphone": ("mend {key} in scene.json", *("mend scene.json, or set data.box=null",) * 2),
    "video_with_poses": (
        "set data.{key}, or mend the file's",
        "set data.box=null, or mend the file's aabb",
        "set data.box=null data.near=null data.far=null, or mend the file's aabb, near and far",
    ),
    "": ("set data.{key}", "set data.box=null", "set data.box=null data.near=null data.far=null"),
}


def remarks(scene: Scene) -> Iterator[str]:
    """Say what in a scene is probably not what was meant, a line each, with what mends it.

    That is a range or box without the point that all cameras look at, or without a part of the subject, or
    one far wider than all cameras; inverted, empty or opaque alpha and masks; masks that leave little; points
    that no camera sees; cameras in one place, or of a film that hardly move, no pinholes, or of test images
    in other units; test images of times beyond those of training, or in another order than names' numbers.

    Raises:
        SceneError: if no training image shows anything.

    Cost: eight training images are decoded, which training does anyway, of cut-outs up to forty for their
    silhouettes; all, where those show nothing.
    """
    aim = common_point([frame.camera.camera_to_world for frame in scene.train])
    aside = list(_pinholes(scene)) or list(_too_wide(scene, aim))
    aside = aside or ([] if aim is None else list(_aimed(scene, aim)))
    yield from aside or _of_test_images(scene)
    names = [frame.name for frame in sorted(scene.train, key=lambda frame: frame.time)]
    read = None
    with suppress(SceneError):  # names that do not tell
        read = read_names(names, "")
    is_told = read is not None and read.frames == sorted(read.frames)  # 0.04 is before 0.2
    is_told |= hexadecimal(names) is not None
    if names == sorted(names) != (numbered := in_order(names)) and not is_told:
        got, due = next(pair for pair in zip(names, numbered) if pair[0] != pair[1])
        line = f"times follow the images' names as texts, not their numbers ({got} comes where {due} is due)"
        yield f"{line}; count them in the order of the numbers"
    yield from doubt_paths(scene)
    trained, tested = (
        [frame.load.path for frame in frames if isinstance(frame.load, StoredImage)]
        for frames in ((*scene.train, *scene.held), scene.test)
    )
    yield from copies([*dict.fromkeys((*trained, *tested))], {*tested} - {*trained})
    first, last = scene.times[0], scene.times[-1]
    beyond = [frame.time for frame in scene.test if not first <= frame.time <= last]
    if scene.test and len(beyond) == len(scene.test):
        line = f"all test times, {min(beyond):.4g} to {max(beyond):.4g}, lie outside training's"
        advice = "of which alone motion is learnt; give images of one moment one time"
        yield f"{line}, {first:.4g} to {last:.4g}, {advice}"
    if not aside and scene.has_one_camera and not scene.has_alpha:
        yield from _turned_poses(scene, aim is not None)
    walk = None if aside else walk_of(scene)
    if walk is not None and (walk[0] < _WALKED or (walk[1] or _SLOW) < _SLOW):
        speed = "" if walk[1] is None else f", {walk[1]:.2g} a second"
        line = f"the camera goes {walk[0]:.2g} degrees around what it looks at{speed}: hardly more than one"
        line += " that stands still, which tells little of depth"
        yield f"{line}; other views of what moves will be guesses"
    if scene.has_alpha:
        yield from _silhouettes(scene, None if aside else aim, bounded=not aside)
    if masked := [frame.load_valid for frame in scene.train if frame.load_valid is not None]:
        shares = [float(masked[i]().float().mean()) for i in spread(len(masked), _LOOKED_AT)]
        share = sum(shares) / len(shares)
        if share == 1:
            line = f"masks hide nothing in all {len(shares)} of the training images looked at"
            yield f"{line}; write 0 where pixels do not count, or set data.masks=off"
        if share < _FEW:
            advice = "if dark is what lies beside the subject, set data.masks=alpha"
            advice = advice if scene.protocol.get("dataset") == "video_with_poses" else "set data.masks=off"
            line = f"masks leave {share:.0%} of the pixels to train on"
            yield f"{line}; {advice}, if it is the subject, invert them"
    yield from _of_motion(scene)
    if covisible := [frame.load_covisible for frame in scene.test if frame.load_covisible is not None]:
        shown = [covisible[i]().float().mean() for i in spread(len(covisible), _LOOKED_AT)]
        if (share := float(torch.stack(shown).mean())) < _FEW:
            line = f"co-visible masks leave {share:.0%} of the test images to measure on"
            yield f"{line}; if they are dark where training images show the pixel too, invert them"
    yield from _apart(scene)
    if scene.still is not None:
        cameras = [frame.camera for frame in scene.train]
        images = [torch.ones((), dtype=torch.bool).expand(c.height, c.width) for c in cameras]
        some = scene.still[:: max(1, len(scene.still) // _PIXELS)].double()
        seen = sightings(some, cameras, images)[1]
        if (share := float((seen > 0).double().mean())) < _FEW:
            line = f"training cameras see {share:.0%} of the {len(scene.still)} points that never move"
            yield f"{line}, as if they were in other units or axes; remove them, or write them anew"


def are_one_place(places: torch.Tensor) -> bool:
    """Tell whether several cameras' places (C, 3) are the same."""
    apart = float((places - places[0]).abs().max())
    return len(places) > 1 and apart <= _SAME_PLACE * float(places.abs().max())


def _pinholes(scene: Scene) -> Iterator[str]:
    """Say that cameras stand in one place, have their middle far aside or no square pixels, or see more than
    a pinhole camera shows.
    """
    places = torch.stack([frame.camera.center for frame in scene.train])
    if are_one_place(places):
        yield f"training cameras {IN_ONE_PLACE}"
    cameras = [frame.camera for frame in scene.train]
    across = float(torch.tensor([camera.cx / camera.width for camera in cameras]).median())
    down = float(torch.tensor([camera.cy / camera.height for camera in cameras]).median())
    if max(abs(across - 0.5), abs(down - 0.5)) > _ASIDE:
        line = f"the principal point lies at {across:.0%} of the width and {down:.0%} of the height"
        advice = "as of images that were cropped since; subtract what was cut off from cx and cy"
        if max(abs(across), abs(down)) < _CORNER:
            advice = "as if cx and cy were written from the middle; add half of the width and of the height"
        yield f"{line}, {advice}"
    elif line := _of_other_shape(cameras[0].width, cameras[0].height, across, down):
        yield line
    stretched = [frame.camera.fy / frame.camera.fx for frame in scene.train]
    if not 1 / _STRETCHED < (ratio := float(torch.tensor(stretched).median())) < _STRETCHED:
        yield f"pixels are {ratio:.3g} times as wide as high, by their focal lengths; compare both"
    if (degrees := max(degrees_of(frame.camera) for frame in scene.train)) > WIDEST:
        line = f"training images are {degrees:.0f} degrees wide, as if focal lengths were not in pixels"
        yield f"{line}; {IN_PIXELS}"


def _of_other_shape(width: int, height: int, across: float, down: float) -> str | None:
    """Say that a principal point, in shares of the sides, is the middle of images of another shape, aside on
    one side or both, as of images that were cropped.
    """
    off = abs(across - 0.5), abs(down - 0.5)
    if max(off) <= _CROPPED:
        return None
    sides = round(2 * across * width), round(2 * down * height)
    key, cut = ("cy", sides[1] - height) if off[1] > off[0] else ("cx", sides[0] - width)
    at = f"the principal point lies at {across:.0%} of the width and {down:.0%} of the height"
    line = f"{at}: the middle of images of {by(sides)} pixels, where these have {by((width, height))}"
    if min(off) > _MIDDLE:
        advice = "if these were cropped, subtract from cx and cy the columns and rows before the image"
        return f"{line}; {advice}, if they are resized copies, multiply fl_x, fl_y, cx and cy, too"
    what = "rows" if key == "cy" else "columns"
    advice = f"if {what} were added before the image, add them to {key}"
    if cut > 0:
        some = f"{cut} {what} were cut off, subtract from {key} those before the image"
        advice = f"if {some}, {cut // 2} where both sides lost as many"
    return f"{line}; {advice}"


def _too_wide(scene: Scene, aim: Tensor | None) -> Iterator[str]:
    """Say that the box of a cut-out subject is far wider than the ring of cameras around the point (3,) that
    they look at, or else around its middle.
    """
    middle = torch.tensor(scene.box.center, dtype=torch.float64) if aim is None else aim
    ring = max(float((frame.camera.center - middle).norm()) for frame in scene.train)
    half = min(high - low for low, high in zip(scene.box.low, scene.box.high)) / 2
    if scene.has_alpha and half > _AROUND * ring:
        what = "point clouds were" if scene.protocol.get("dataset") == "nhr" else "it were"
        times = f"{half / max(ring, _SAME_PLACE):.3g} times as wide as the ring of all cameras"
        yield f"the box {bounds(scene)} is {times}, as if {what} in another unit; {_remedy(scene, 'box')}"


def _of_test_images(scene: Scene) -> Iterator[str]:
    """Compare places and angles of test images with those of training images and the box."""
    if (blind := blind_frames(scene, scene.test)) > _CUT_OFF * len(scene.test):
        line = f"{blind} of {len(scene.test)} test images see nothing of the box {bounds(scene)}"
        yield f"{line}, as if their poses were in other units; write them as those of training images"
    focal = [f.camera.fx / max(f.camera.width, f.camera.height) for f in scene.train]
    of_test = [f.camera.fx / max(f.camera.width, f.camera.height) for f in scene.test]
    middle = float(torch.tensor(of_test or focal).median())
    if not min(focal) / _ZOOMED < middle < max(focal) * _ZOOMED:
        line = f"the focal length of test images is {middle:.2g} of their longer side and that of training"
        yield f"{line} images {min(focal):.2g} to {max(focal):.2g}; compare both"


def _aimed(scene: Scene, aim: Tensor) -> Iterator[str]:
    """Compare the box, else near and far, with the point (3,) that cameras look at, in the file's units."""
    point = f"the point that all cameras look at, {_in_file(scene, aim.tolist())},"
    if not scene.box.scaled(2).holds(aim):
        yield f"{point} lies far outside the box {bounds(scene)}; {_remedy(scene, 'box')}"
        return  # near and far may follow from it
    cameras = [frame.camera for frame in scene.train]
    away = torch.stack([(aim - camera.center).norm() for camera in cameras])
    near, far = (torch.tensor([getattr(camera, end) for camera in cameras]) for end in ("near", "far"))
    for key, bound, beyond in (("near", near, away < near), ("far", far, away > far)):
        if float(beyond.double().mean()) > _FEW:
            distance, at = (_length(scene, float(values.median())) for values in (away, bound))
            yield f"{point} is {distance} away, with {key} at {at}; {_remedy(scene, key)}"


def _turned_poses(scene: Scene, aimed: bool) -> Iterator[str]:
    """Say that images of a film agree much better with poses or focal lengths in another way, or with the
    latter alone where cameras are ``aimed`` at one point.
    """
    frames = sorted(scene.train, key=lambda frame: frame.time)
    steps = [max(least, len(frames) // share) if share else 0 for share, least in BESIDE]
    if aimed:  # views far apart tell the focal length, those beside each other next to nothing
        pairs = [(frames[i], frames[i + steps[-1]]) for i in spread(len(frames) - steps[-1], _FAR_PAIRS)]
        first = pairs[::3]
    else:
        groups = [
            [frames[i + n] for n in steps if i + n < len(frames)] for i in spread(len(frames), COMPARED)
        ]
        pairs = [pair for group in groups for pair in combinations(group, 2)]
        first = [*combinations(groups[len(groups) // 2], 2)]
    images: dict[str, Tensor] = {}

    def view(frame: Frame, read: Callable[[Camera], Camera]) -> tuple[Camera, Tensor]:
        if frame.name not in images:
            images[frame.name] = small_image(frame.load())
        image = images[frame.name]
        camera = read(scene.world.camera_to_data(replace(frame.camera, lens=None)))  # as it is slow
        return camera.resized(image.shape[1], image.shape[0]), image

    def errors(pairs: list[tuple[Frame, Frame]], read: Callable[[Camera], Camera]) -> list[float]:
        return [sweep_error(*view(one, read), *view(other, read)) for one, other in pairs]

    changes = {} if aimed else readings_of(scene.protocol.get("dataset"))
    readings = {
        how: lambda c, change=change: replace(c, camera_to_world=change(c.camera_to_world[None])[0])
        for how, change in changes.items()
    }
    for factor in (0.5, 2.0):
        readings[_LONGER.format(factor)] = lambda c, by=factor: _zoomed(c, by)
    for some in (first, pairs):  # most scenes are right, and some pairs tell it
        mine = errors(some, lambda c: c)
        if aimed:  # views that show nothing of each other tell nothing of focal lengths
            some = [pair for pair, error in zip(some, mine) if error < torch.inf]
            if len(some) <= len(mine) / 2:
                return
            mine = [error for error in mine if error < torch.inf]
        others = {how: errors(some, read) for how, read in readings.items()}
        how = likeliest(mine, others)
        if how is None:
            return
    which = "images of different directions" if aimed else "neighbouring images"
    yield f"{which} agree much better {how}; compare poses and focal lengths with others"


def _zoomed(camera: Camera, factor: float) -> Camera:
    return replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)


def _other_focal(scene: Scene, aim: Tensor) -> Iterator[str]:
    """Say that silhouettes around the point (3,) that cameras look at agree much better with other focal
    lengths: those of images of half or twice the size, or of another shape.
    """
    frames = sorted(scene.train, key=lambda frame: frame.time)
    rows = spread(len(frames), _VIEWS)
    views: dict[int, tuple[Camera, Tensor]] = {}

    def view(row: int, factor: float) -> tuple[Camera, Tensor]:
        if row not in views:
            mask = small_image(frames[row].load()[..., 3:].expand(-1, -1, 3))[..., 0] > 0.5
            camera = replace(frames[row].camera, lens=None)
            views[row] = camera.resized(mask.shape[1], mask.shape[0]), mask
        return _zoomed(views[row][0], factor), views[row][1]

    def errors(rows: Sequence[int], factor: float) -> Tensor:
        beside = {row: [row + n for n in (-2, -1, 1, 2) if 0 <= row + n < len(frames)] for row in rows}
        each = (
            silhouette_error(*view(row, factor), [view(n, factor) for n in near], aim)
            for row, near in beside.items()
        )
        return torch.tensor([error for error in each if error is not None], dtype=torch.float64)

    for some, factors in ((rows[::2], _FACTORS[:2]), (rows, _FACTORS)):
        mine, others = errors(some, 1.0), {factor: errors(some, factor) for factor in factors}
        if len(mine) == 0:
            return
        factor = min(others, key=lambda factor: float(others[factor].mean()))
        less = float((mine - others[factor]).sign().mean())
        if float(others[factor].mean()) > min(_LIKELIER * mine.mean(), mine.mean() - _MISSED) or less < _FEW:
            return
    how = _LONGER.format(factor)
    yield f"silhouettes of neighbouring images agree much better {how}; compare focal lengths with others"


def _remedy(scene: Scene, key: str) -> str:
    """Say what mends ``near``, ``far``, the ``box`` or ``all`` of them in a scene of this format."""
    remedies = _REMEDIES.get(scene.protocol.get("dataset"), _REMEDIES[""])
    return remedies[{"box": 1, "all": 2}.get(key, 0)].format(key=key)


def bounds(scene: Scene) -> str:
    """Write a scene's box, in the file's units."""
    return f"{_in_file(scene, scene.box.low)} to {_in_file(scene, scene.box.high)}"


def _length(scene: Scene, length: float) -> str:
    """Write a length of the scene in the file's units."""
    return f"{length / scene.protocol.get('normalisation', {'scale': 1.0})['scale']:.4g}"


def _in_file(scene: Scene, place: Sequence[float]) -> str:
    """Write a place (3,) of the scene in the file's units."""
    file = scene.protocol.get("normalisation", {"center": [0, 0, 0], "scale": 1.0})
    values = (value / file["scale"] + middle for value, middle in zip(place, file["center"]))
    return f"({', '.join(f'{round(value, 9) + 0.0:.4g}' for value in values)})"


def _silhouettes(scene: Scene, aim: Tensor | None, *, bounded: bool) -> Iterator[str]:
    """Look at the alpha of a few training images: does it cut out a subject, and, if ``bounded``, is that in
    the box, and of which focal lengths? The subject is where alpha is above half of its greatest value, also
    of smoke or glass; ``aim`` (3,) what cameras look at.
    """
    frames = [scene.train[i] for i in spread(len(scene.train), _LOOKED_AT)]
    alphas = [frame.load()[..., 3].clone() for frame in frames]
    greatest = max(int(alpha.max()) for alpha in alphas)
    if 0 < greatest <= _FAINT:
        yield f"alpha is at most {greatest} of 255, as if it were written as 0 and 1; write 0 and 255"
    half = greatest // 2
    solid = [alpha > half for alpha in alphas]
    empty = [not bool(mask.any()) for mask in solid]
    if all(empty) and not any(bool(frame.load()[..., 3].any()) for frame in scene.train):
        place = f"{frames[0].name}: {getattr(frames[0].load, 'path', 'alpha')}"
        got = f"alpha or masks that are 0 everywhere in all {len(scene.train)}"
        off = "set data.masks=off, or " if scene.protocol.get("dataset") == "video_with_poses" else ""
        raise mismatch(place, "a subject in some training images", got, f"{off}mend alpha or masks")
    if sum(empty) > _FEW * len(frames):
        yield f"{sum(empty)} of {len(frames)} training images looked at show no subject; mend alpha or masks"
    if all(bool(mask.all()) for mask in solid):
        yield "alpha is opaque in all training images looked at: cut the subject out, or leave alpha out"
    turned = [_is_inverted(mask) for mask in solid]
    if sum(turned) > _FEW * len(frames):
        line = f"in {sum(turned)} of {len(frames)} training images looked at the subject fills the edges and"
        yield f"{line} not the middle, as if alpha or masks were inverted; invert them"
        return  # what is solid is not the subject
    if not bounded:
        return
    missed = total = 0
    for frame, mask in zip(frames, solid):
        pixels = mask.flatten().nonzero()[:, 0]
        pixels = pixels[:: max(1, len(pixels) // _PIXELS)]
        missed, total = missed + int((~meets(frame.camera, scene.box, pixels)).sum()), total + len(pixels)
    if missed > _CUT_OFF * total:
        line = f"{missed / total:.0%} of the subject's pixels see nothing of the box {bounds(scene)}"
        yield f"{line} between near and far; {_remedy(scene, 'all')}"
    elif aim is not None and len(scene.train) >= _LEAST_VIEWS:
        yield from _other_focal(scene, aim)


def _apart(scene: Scene) -> Iterator[str]:
    """Say that cameras of a rig film one after the other, as if each were counted by itself."""
    of_camera: dict[int, list[float]] = {}
    for frame in (*scene.train, *scene.test):
        if frame.camera_id is not None:
            of_camera.setdefault(frame.camera_id, []).append(frame.time)
    spans = sorted((min(times), max(times), camera) for camera, times in of_camera.items() if len(times) > 1)
    for (first, end, one), (start, last, other) in zip(spans, spans[1:]):
        if start - end > max(end - first, last - start) > 0:
            line = (
                f"camera {one} films from time {first:.3g} to {end:.3g}, camera {other} from {start:.3g} to"
            )
            yield f"{line} {last:.3g}; if they film together, count the images of one moment alike"
            return


def _of_motion(scene: Scene) -> Iterator[str]:
    """Look at a few masks of what moves, and of what does not count: are bright and dark exchanged?"""
    for what, key in (("moving_path says move", "load_moving"), ("masks hide", "load_valid")):
        frames = [frame for frame in scene.train if getattr(frame, key) is not None]
        frames = [frames[i] for i in spread(len(frames), _LOOKED_AT)]
        marked = [getattr(frame, key)() for frame in frames]
        marked = marked if key == "load_moving" else [~mask for mask in marked]
        if not any(bool(mask.any()) for mask in marked):
            if marked and key == "load_moving":
                yield f"{what} nothing in all {len(marked)} images looked at; write 255 where something moves"
            continue
        share = float(torch.stack([mask.float().mean() for mask in marked]).mean())
        if scene.still is not None:
            some = scene.still[:: max(1, len(scene.still) // _PIXELS)].double()
            on, seen = sightings(some, [frame.camera for frame in frames], marked)
            of_still = float(on.sum()) / max(float(seen.sum()), 1.0)
            if of_still > _FEW:
                line = f"{of_still:.0%} of the points that never move lie in what {what}"
                yield f"{line}, {share:.0%} of images, as if it were inverted; invert the masks"
                continue
        is_turned = sum(map(_is_inverted, marked)) > _FEW * len(marked) or share > _FEW
        if key == "load_moving" and is_turned:
            line = f"{what} {share:.0%} of the pixels, as if masks were dark where something moves"
            yield f"{line}; if so, invert them"


def _is_inverted(solid: Tensor) -> bool:
    """Tell whether a silhouette (H, W) fills the image's edges and leaves something else out, or half of two
    opposite edges and hardly the middle, which cameras look at.
    """
    edges = [solid[0], solid[-1], solid[:, 0], solid[:, -1]]
    if float(torch.cat(edges).float().mean()) > _EDGE:
        return float(solid.float().mean()) < 1 - _LEFT_OUT
    top, bottom, left, right = (float(edge.float().mean()) for edge in edges)
    (height, width), side = (n // 3 for n in solid.shape), max(min(top, bottom), min(left, right))
    middle = solid[height : solid.shape[0] - height, width : solid.shape[1] - width]
    return side > _SIDE and float(middle.float().mean()) < _HOLLOW


def meets(camera: Camera, box: Box, pixels: Tensor) -> Tensor:
    """Tell which pixels, flat indices (P,), see something of a box between near and far: bool (P,)."""
    low, high = (torch.tensor(end, dtype=torch.float64) for end in (box.low, box.high))
    rays = camera.rays(pixels, dtype=torch.float64)
    slabs = torch.stack([(end - rays.origins) / rays.directions for end in (low, high)])
    enter = slabs.amin(0).nan_to_num(-torch.inf).amax(-1).clamp(min=camera.near)
    leave = slabs.amax(0).nan_to_num(torch.inf).amin(-1).clamp(max=camera.far)
    return enter < leave


def check_seen(scene: Scene) -> None:
    """Refuse a box that no training camera sees between its near and far planes.

    Raises:
        SceneError: saying what the cameras look at.
    """
    if blind_frames(scene) < len(scene.train):
        return
    focus = focus_point([frame.camera for frame in scene.train]).tolist()
    near, far = (_length(scene, getattr(scene.train[0].camera, end)) for end in ("near", "far"))
    expected = "a box that cameras see between near and far"
    got = f"{bounds(scene)}, near {near}, far {far}; cameras look at {_in_file(scene, focus)}"
    raise mismatch(f"{scene.name}: box, near, far", expected, got, _remedy(scene, "all"))


def blind_frames(scene: Scene, frames: Sequence[Frame] | None = None) -> int:
    """Count the frames, by default of training, whose camera sees nothing of the box between its near and far
    planes: neither through nine of its pixels, nor any of 125 points of the box, which may lie between these.

    Cost: milliseconds for each camera; frames of one that stands still share it.
    """
    lattice = Lattice.of_count(scene.box, _WITHIN**3)
    points = lattice.to_world(lattice.all_voxels()).double()

    def sees(camera: Camera) -> bool:
        away = (points - camera.center).norm(dim=-1)
        inside = where_seen(camera, points)[2] & (away > camera.near) & (away < camera.far)
        return bool(inside.any() or meets(camera, scene.box, nine_pixels(camera)).any())

    frames = scene.train if frames is None else frames
    cameras = {id(frame.camera): frame.camera for frame in frames}
    blind = {key for key, camera in cameras.items() if not sees(camera)}
    return sum(id(frame.camera) in blind for frame in frames)
