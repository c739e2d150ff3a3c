"""Hold out cameras and moments of a rig: cameras with names that film together, moment by moment."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from reprlib import repr as short

from forewarp.data.agreement import small_image
from forewarp.data.files import mismatch
from forewarp.scene.frame import Frame

_SHOWN = 6  # names of cameras in an error
_DIFFER = 0.02  # difference of colours in [0, 1], from which on two images are not of one pose
_MOMENTS = 3  # of two cameras of one pose, whose images are compared


def held_cameras(wanted: Sequence[str | int] | None, names: list[str], default: Iterable[int]) -> list[int]:
    """Find the cameras to hold out, their ascending places in ``names``.

    Args:
        wanted: names, not of all cameras; None: see ``default``.
        names: of the cameras.
        default: places of those that are held out where nothing is wanted.

    Raises:
        SceneError: for anything else.

    >>> held_cameras(["cam02"], ["cam00", "cam02", "cam13"], [0])
    [1]
    """
    if wanted is None:
        return sorted(default)
    are_names = isinstance(wanted, Sequence) and not isinstance(wanted, str)
    texts = [str(name) for name in wanted] if are_names else []
    unknown = [text for text in texts if text not in names]
    if not are_names or unknown or len({*texts}) < len(texts) or len(texts) >= len(names):
        there = ", ".join(names) if len(names) <= _SHOWN else f"{names[0]}, {names[1]} .. {names[-1]}"
        got = f"no camera {unknown[0]}" if unknown else short(wanted)
        raise mismatch("data.test_cameras", f"some of the cameras {there}, not all", got)
    return sorted(map(names.index, texts))


def held_moments(wanted: Sequence[int] | None, count: int) -> frozenset[int]:
    """Check the moments to hold out, numbers below ``count``, not all; None: there are none.

    >>> sorted(held_moments([3, 1], 5))
    [1, 3]
    """
    moments = () if wanted is None else wanted
    are_numbers = isinstance(moments, Sequence) and all(type(n) is int and 0 <= n < count for n in moments)
    if not are_numbers or len({*moments}) >= count:
        raise mismatch("data.test_moments", f"numbers of 0 to {count - 1}, not all", short(wanted))
    return frozenset(moments)


def split_rig(
    frames: Iterable[tuple[int, Frame]], cameras: Collection[int], moments: Collection[int], every: int = 1
) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
    """Part frames into those to train on and those to test on; their order stays.

    A test frame measures ``space`` if only its camera is held out, ``time`` if only its moment is, and
    ``space_time`` if both are.

    Args:
        frames: each with the number of its moment.
        cameras: ids of those held out.
        moments: numbers of those held out.
        every: test held-out cameras at every n-th moment alone; held-out moments are all tested.

    Raises:
        SceneError: where nothing is left to test on.
    """
    train, test = [], []
    for moment, frame in frames:
        kinds = [("space", frame.camera_id in cameras), ("time", moment in moments)]
        ability = "_".join(kind for kind, is_held in kinds if is_held)
        if not ability:
            train.append(frame)
        elif ability != "space" or moment % every == 0:
            test.append(replace(frame, ability=ability))
    if not train:
        advice = "hold out fewer in data.test_cameras and data.test_moments"
        raise mismatch("data.test_cameras", "a camera and a moment to train on", "none", advice)
    if not test:
        advice = "name some in data.test_cameras or data.test_moments"
        raise mismatch("data.test_cameras", "a camera or a moment to test on", "none", advice)
    return tuple(train), tuple(test)


def refuse_copied_poses(frames: Iterable[Frame], where: object) -> None:
    """Refuse two cameras of just one pose whose images of one time differ.

    Args:
        frames: of a rig; without ``camera_id`` folders of images tell cameras.
        where: what poses belong to.

    Raises:
        SceneError: naming both.

    Cost: where poses are one, two images of at most three moments are decoded.
    """
    first: dict[tuple, Frame] = {}
    compared: Counter[tuple] = Counter()

    def taker(frame: Frame) -> object:
        return frame.name.rpartition("/")[0] if frame.camera_id is None else frame.camera_id

    for frame in frames:
        pose = frame.camera.camera_to_world
        other = first.setdefault((frame.time, frame.camera.inner, tuple(pose.flatten().tolist())), frame)
        pair = taker(other), taker(frame)
        if pair[0] == pair[1] or compared[pair] == _MOMENTS:
            continue
        compared[pair] += 1
        pixels = [each.load() for each in (other, frame)]
        one, two = map(small_image, pixels)
        shown = max(float((image[..., 3] > 0).float().mean()) for image in pixels)  # of a cut-out, little
        if float((one - two).abs().mean()) > _DIFFER * shown:
            got = f"one for {other.name} and {frame.name}, whose images differ"
            advice = "mend the pose that was copied, or the times if one camera took both"
            raise mismatch(where, "a pose for each camera", got, advice)
