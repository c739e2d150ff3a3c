"""Read, check, keep and write images; reduce them and lay them over a background."""

from __future__ import annotations

import io
import mmap
import os
import weakref
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from hashlib import sha256
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor

from forewarp.clock import left_out
from forewarp.data.files import SceneError, mismatch, number, one_of, opened, read_bytes
from forewarp.files import MOST_IMAGE, written_whole
from forewarp.media import MOST_PIXELS, TooManyPixels, in_srgb, open_image
from forewarp.ops.grid import block_means, block_sums
from forewarp.scene.frame import spread

TURN = "width and height are exchanged: turn its pixels by 90 degrees"
_OTHER_KINDS = {  # at which byte, which marks tell them
    "WebP": (8, b"WEBP"),
    "TIFF": (0, (b"II*\0", b"MM\0*", b"II+\0")),
    "GIF": (0, b"GIF8"),
    "BMP": (0, b"BM"),
    "AVIF": (4, b"ftypavi"),
    "HEIC": (4, (b"ftyphei", b"ftyphev", b"ftypmif", b"ftypmsf")),
    "JPEG 2000": (4, b"jP  "),
    "JPEG XL": (0, (b"\xff\x0a", b"\0\0\0\x0cJXL ")),
    "OpenEXR": (0, b"v/1\x01"),
    "Radiance HDR": (0, b"#?R"),
}
_ORIENTATION = 0x0112  # EXIF's tag
_JPEG_END, _JPEG_TAIL = b"\xff\xd9", 4096  # some cameras write a little behind the end
_LEAST_HIDDEN, _COLORS = 0.01, 64  # share of an image, and colours, that tell an image beneath
_LINEAR = 0.9  # a PNG's gamma above it, where sRGB's is 0.45
_LOOKED_AT = 1 << 18  # pixels, so as not to sort those of large images
_ROUNDED, _STRAY, _LEAST_EDGES, _EDGES_OF = 2, 0.001, 50, 4  # of an edge; share, least edges, images
_FOREGROUND = 127  # a mask above it is foreground; masks are lossy, so never quite 0 or 255
_COLORED = 32  # of 255: difference of channels of a mask with colours; all of a DAVIS palette are as bright
_OWN_PAGES = 1 << 20  # bytes of a kept tensor from which it has pages of its own
_COMPARED, _REDUCED_SIDE, _LEAST_BLOCKS = 3, 64, 200  # images with smaller copies; blocks of each
_REDUCED, _REDUCED_MASK = 3, 16  # of 255: a difference that filters and codecs leave, of masks at their edges
_OTHER, _OWN = 60, 0.5  # of 255: difference of another image; share of that to one beside it
_NUMBERED = 15  # a mask nowhere above it holds numbers of objects
_LABELS = 32  # levels of grey, or fewer, that may be those of objects


class ImageCache:
    """Keep a tensor for each owner while the owner lives and all together take at most ``limit`` bytes.

    The least recently used goes first. What is larger than ``limit`` is never kept.

    >>> import torch
    >>> class Owner: pass
    >>> cache, a, b = ImageCache(4), Owner(), Owner()
    >>> for owner in (a, b):
    ...     _ = cache.get(owner, lambda: torch.zeros(3, dtype=torch.uint8))
    >>> cache.bytes
    3
    """

    def __init__(self, limit: int) -> None:
        self._kept: dict[int, tuple[weakref.ref, Tensor]] = {}
        self.bytes, self.limit = 0, limit

    def get(self, owner: object, make: Callable[[], Tensor]) -> Tensor:
        """Give what is kept for ``owner``, or make and keep it; treat it as read-only."""
        key = id(owner)
        if key in self._kept:
            self._kept[key] = self._kept.pop(key)  # now the last to go
            return self._kept[key][1]
        with left_out():  # reading images is no training
            made = make()
        self.keep(owner, made)
        return made

    def keep(self, owner: object, made: Tensor) -> None:
        """Keep for ``owner`` what was made beside something else."""
        key = id(owner)
        if key not in self._kept and made.nbytes <= self.limit:
            made = _in_own_pages(made) if made.nbytes >= _OWN_PAGES else made
            # Freed as soon as the owner dies; until then no other object can have its id.
            self._kept[key] = (weakref.ref(owner, lambda _: self._drop(key)), made)
            self.bytes += made.nbytes
            self._shrink()

    def resize(self, limit: int) -> None:
        """Allow ``limit`` bytes from now on.

        Raises:
            SceneError: for anything but a number >= 0.
        """
        self.limit = int(number(limit, "data.cache_bytes", 0))
        self._shrink()

    def _shrink(self) -> None:
        while self.bytes > self.limit:
            self._drop(next(iter(self._kept)))

    def _drop(self, key: int) -> None:
        self.bytes -= self._kept.pop(key)[1].nbytes


def _in_own_pages(tensor: Tensor) -> Tensor:
    """Copy a tensor to pages that go back to the system as soon as it is freed: kept amid the temporaries of
    many steps, images leave holes behind that nothing fits into, and a process takes several times the limit.
    """
    pages = mmap.mmap(-1, tensor.nbytes)
    return torch.frombuffer(pages, dtype=tensor.dtype).reshape(tensor.shape).copy_(tensor)


CACHE = ImageCache(1_000_000_000)


@dataclass(frozen=True)
class Header:
    """What an image says of itself: ``size`` is (width, height) in pixels; ``is_turned`` tells whether it is
    to be turned before it is shown, ``is_linear`` whether it says that its colours are no sRGB but light.
    """

    size: tuple[int, int]
    has_alpha: bool
    is_turned: bool = False
    is_linear: bool = False


def inspect_image(path: Path, size: tuple[int, int] | None = None, why: str = "") -> Header:
    """Check that a PNG or JPEG is whole and of a kind that is read; decode nothing.

    Args:
        path: of the image.
        size: (width, height) that it must have; None: any.
        why: what the error says of that size.

    Raises:
        SceneError: where the file is missing, empty, truncated, harmed, too large or of another kind or size.

    Cost: one read of a PNG, whose checksums are compared; two small reads of a JPEG, which has none.
    """
    with opened(path, MOST_IMAGE, "an image") as stream:
        header = _inspect(stream, path)
    if size not in (None, header.size):
        raise wrong_size(path, size, header.size, why)
    return header


def wrong_size(
    path: Path, size: tuple[int, int], stored: tuple[int, int], why: str, advice: str = ""
) -> SceneError:
    """Make the error that an image is not of a ``size`` (width, height) that ``why`` tells, with ``advice``
    beside turning or resizing it.
    """
    is_like = abs(stored[0] * size[1] - stored[1] * size[0]) <= max(*size, *stored)
    mended = TURN if stored == size[::-1] else f"resize it to {by(size)}" * is_like
    return mismatch(path, f"{by(size)} pixels{why}", by(stored), ", or ".join(filter(None, [mended, advice])))


def exif_turned(paths: Sequence[Path], where: object) -> list[str]:
    """Say in a line that images were read as stored, although their EXIF orientation turns them.

    Args:
        paths: those whose header says ``is_turned``.
        where: what they belong to.
    """
    if not paths:
        return []
    line = f"{len(paths)} images are read as stored, although their EXIF orientation turns them"
    advice = "if poses are of the images upright, turn the pixels"
    return [f"{where}: {line} ({paths[0].name}, ..); {advice}"]


def mixed_linear(headers: Mapping[Path, Header], where: object) -> list[str]:
    """Say in a line that some images say that they are linear, and others are not."""
    linear = [path for path, header in headers.items() if header.is_linear]
    if len(linear) in (0, len(headers)):
        return []
    line = f"{len(linear)} of {len(headers)} images say that they are linear (gAMA 1; {linear[0].name}, ..)"
    return [f"{where}: {line}, and all are read as sRGB; write all alike"]


def copies(paths: Sequence[Path], tested: Collection[Path] = ()) -> list[str]:
    """Say in a line that some images are copies of others, and how many of those are ``tested`` on.

    Cost: one look at the size of each, one read of those that share it.
    """
    of_size: dict[int, list[Path]] = {}
    for path in dict.fromkeys(paths):
        of_size.setdefault(path.stat().st_size, []).append(path)
    same: dict[bytes, list[Path]] = {}
    for path in (path for some in of_size.values() if len(some) > 1 for path in some):
        same.setdefault(sha256(read_bytes(path, MOST_IMAGE, "an image")).digest(), []).append(path)
    if not (groups := [some for some in same.values() if len(some) > 1]):
        return []
    count, (one, other) = sum(map(len, groups)) - len(groups), groups[0][:2]
    line = f"{count} of {len(paths)} images are the same file as others ({one.name} and {other.name}, ..)"
    both = sum(path in tested for some in groups if not {*some} <= {*tested} for path in some)
    leaked = f"; {both} to test on are trained on, too: their scores say little" if both else ""
    return [f"{line}{leaked}; leave copies out, unless nothing moved meanwhile"]


def common_header(paths: Iterable[Path], one_size: bool = True) -> tuple[Header, dict[Path, Header]]:
    """Check images that must have one size, unless ``one_size`` is false; alpha where all of them have it.

    Returns:
        what they have in common, and the header of each.

    Raises:
        SceneError: as ``inspect_image``, and where one differs in size from most.
    """
    headers = {path: inspect_image(path) for path in paths}
    size = Counter(header.size for header in headers.values()).most_common(1)[0][0]
    for path, header in headers.items() if one_size else ():
        if header.size != size:
            raise wrong_size(path, size, header.size, " as most", "remove it")
    return Header(size, all(header.has_alpha for header in headers.values())), headers


def read_image(path: Path, size: tuple[int, int] | None = None, *, upright: bool = False) -> Tensor:
    """Decode a PNG or JPEG: uint8 (H, W, 4), straight alpha, in sRGB; without an alpha channel it is 255.

    Args:
        path: of the image.
        size: (width, height) that it must have; None: any.
        upright: turn it as its EXIF orientation says; else it is as stored.

    Raises:
        SceneError: as ``inspect_image``, and where the pixels cannot be decoded.
    """
    pixels = _decode(path, "RGBA", upright)
    if size not in (None, pixels.shape[1::-1]):
        raise mismatch(path, f"{by(size)} pixels", by(pixels.shape[1::-1]))
    return torch.from_numpy(pixels)


def read_gray16(path: Path) -> np.ndarray:
    """Decode a grey PNG of 16 bits a pixel: uint16 (H, W).

    Raises:
        SceneError: as ``read_image``, and for an image of another kind.
    """
    return _decode(path, "I;16").astype(np.uint16)


def check_pixels(where: object, pixels: Tensor | np.ndarray, *shapes: tuple[int, ...]) -> np.ndarray:
    """Refuse pixels to write that are not uint8 of one of these shapes."""
    pixels = np.asarray(pixels)
    if pixels.dtype != np.uint8 or pixels.shape not in shapes:
        expected = f"uint8 pixels of shape {' or '.join(map(str, shapes))}"
        raise mismatch(where, expected, f"{pixels.dtype} of {pixels.shape}")
    return pixels


def write_image(path: Path, pixels: Tensor | np.ndarray) -> None:
    """Write uint8 pixels, whole or not at all: (H, W), (H, W, 3) or, as .png, (H, W, 4).

    A JPEG has full colour resolution and little loss.
    """
    is_png = path.suffix.lower() == ".png"
    options = {"format": "PNG"} if is_png else {"format": "JPEG", "quality": 97, "subsampling": 0}
    with written_whole(path) as beside:
        Image.fromarray(np.ascontiguousarray(pixels)).save(beside, **options)


def reduced(rgba: Tensor, factor: int = 2) -> Tensor:
    """Average blocks of ``factor`` x ``factor`` pixels of *straight* RGBA: uint8 (H, W, 4) to (H/f, W/f, 4).

    Averaging before the alpha is applied darkens silhouettes a little; the published numbers do so. Rounded
    half to even: exactly what the released half-size copies hold.

    >>> reduced(torch.tensor([[[1], [2]], [[3], [5]]], dtype=torch.uint8)).item()
    3
    """
    return block_means(rgba, factor).round().to(torch.uint8)


def halved_cutout(rgba: Tensor) -> Tensor:
    """Average each 2 x 2 block, uint8 (H, W, 4) -> (H // 2, W // 2, 4); the colour is the foreground's.

    What lies behind a cut-out is another place; averaged in, it would rim every silhouette.

    Args:
        rgba: colour is 0 wherever alpha is 0; all other pixels count alike.

    >>> halved_cutout(torch.tensor([[[9, 9, 9, 255], [0] * 4], [[0] * 4, [3, 3, 3, 255]]], dtype=torch.uint8))
    tensor([[[  6,   6,   6, 128]]], dtype=torch.uint8)
    """
    height, width = (n // 2 * 2 for n in rgba.shape[:2])
    rgba = rgba[:height, :width]
    sums, count = block_sums(rgba[..., :3]), block_sums(rgba[..., 3] > 0)[..., None].clamp(min=1)
    color = torch.div(sums + count // 2, count, rounding_mode="floor").to(torch.uint8)
    return torch.cat([color, reduced(rgba[..., 3:])], -1)


def straight(rgba: Tensor) -> Tensor:
    """Divide premultiplied colours by their alpha: uint8 (H, W, 4) -> (H, W, 4).

    >>> straight(torch.tensor([[[50, 100, 0, 100], [0, 0, 0, 0]]], dtype=torch.uint8)).tolist()
    [[[128, 255, 0, 100], [0, 0, 0, 0]]]
    """
    colors, alpha = rgba[..., :3].float(), rgba[..., 3:]
    colors = (255 * colors / alpha.clamp(min=1)).round().clamp(max=255).to(torch.uint8)
    return torch.cat([colors, alpha], -1)


def is_premultiplied(images: Iterable[Tensor]) -> bool | None:
    """Tell whether colours of images (H, W, 4) are multiplied by alpha: no edge is brighter than its alpha.

    Of straight alpha edges are about as bright as what they are of. Only those tell whose colour, divided by
    alpha, would be at least half as bright as what is opaque: black shadows and outlines are below every
    alpha. There must be some, and next to no pixel of any alpha may be brighter than it. None: no edge tells.
    """
    pixels = torch.cat([rgba.reshape(-1, 4) for rgba in images])
    brightest, alpha = pixels[:, :3].amax(-1).int(), pixels[:, 3].int()
    solid = brightest[alpha == 255]
    if not len(solid):
        return None
    middle, soft = int(solid.median()), (alpha > 0) & (alpha < 255)
    is_lit = (brightest > 2 * _ROUNDED) & (2 * 255 * brightest >= middle * alpha)
    telling = int((soft & is_lit & (2 * alpha < middle)).sum())
    above = int((soft & (brightest > alpha + _ROUNDED)).sum())
    if max(telling, above) < _LEAST_EDGES:
        return None
    return telling >= _LEAST_EDGES and above <= _STRAY * telling


def refuse_other_sizes(whole: Sequence[Path], small: Sequence[Path], *, are_masks: bool = False) -> None:
    """Refuse smaller copies of images that are of other images, such as those of an earlier extraction.

    A few are compared with theirs, whatever filter made them smaller and whatever was done to colours.

    Args:
        whole: files of the full size, in the order of what they show; one that is not there is passed over.
        small: the copy of each.
        are_masks: they are masks.

    Raises:
        SceneError: naming a copy that differs from its image by more than filters and codecs do, and that
            is as near to one beside it.

    Cost: six images are decoded; up to six more, where one differs.
    """
    pairs = [
        (big, little)
        for big, little in zip(whole, small)
        if big != little and big.is_file() and little.is_file()
    ]

    def read(path: Path) -> Tensor:
        if not are_masks:
            return read_image(path)
        mask = (bright(path) * 255).to(torch.uint8)[..., None].expand(-1, -1, 3)
        return torch.cat([mask, torch.full_like(mask[..., :1], 255)], -1)

    least = _REDUCED_MASK if are_masks else _REDUCED
    for i in spread(len(pairs), _COMPARED):
        big, little = pairs[i]
        copy = read(little)
        own = _reduced_error(read(big), copy, least)
        beside = {pairs[j][0] for j in (i - 1, i + 1) if 0 <= j < len(pairs)} - {big} if own > least else ()
        errors = {path: _reduced_error(read(path), copy, least) for path in sorted(beside)}
        nearest = min(errors, key=errors.get, default=None)
        if own > _OTHER or (nearest is not None and own > _OWN * errors[nearest]):
            like = f", nearer to {nearest.name}" if nearest is not None and errors[nearest] < own else ""
            expected = f"{big.parent.name}/{big.name} at a smaller size"
            advice = f"make {little.parent.name} again from {big.parent.name}, or set data.scale=1"
            raise mismatch(little, expected, f"another image{like} ({own:.0f} of 255 apart)", advice)


def _reduced_error(whole: Tensor, small: Tensor, enough: float) -> float:
    """Return by how much of 255 an image and a smaller copy, uint8 (H, W, 4), differ where both are opaque:
    averaged over blocks, colours fitted, by the likeliest filter or the first with a difference of at most
    ``enough``; 0 where too little is left.
    """
    planes, copy = (rgba.permute(2, 0, 1)[None].float() for rgba in (whole, small))
    size = small.shape[:2]
    blocks = [max(1, n // max(2, max(size) // _REDUCED_SIDE)) for n in size]
    area = partial(torch.nn.functional.interpolate, size=blocks, mode="area")
    copy, least = area(copy)[0].flatten(1).T.double(), float("inf")
    for mode in ("area", "nearest", "nearest-exact", "bilinear"):
        found = area(torch.nn.functional.interpolate(planes, tuple(size), mode=mode))[0].flatten(1).T.double()
        shown = (found[:, 3] > 254) & (copy[:, 3] > 254)
        if int(shown.sum()) < _LEAST_BLOCKS:
            return 0.0
        colors = found[shown, :3] / 255
        terms = torch.cat([torch.ones_like(colors[:, :1]), colors, colors**2], 1).numpy()
        there = copy[shown, :3].numpy()
        rest = there - terms @ np.linalg.lstsq(terms, there, rcond=None)[0]
        least = min(least, float(np.sqrt((rest**2).mean())))
        if least <= enough:
            break
    return least


def alpha_of(
    alpha: str | None, parts: Mapping[str, Sequence[Path]], where: object
) -> tuple[dict[str, bool], list[str]]:
    """Tell of each part whether its images are premultiplied, as said or as some of them show; and in a line
    what they show.

    Args:
        alpha: straight, premultiplied, or None to look at a few of each part.
        parts: images with alpha; one whose edges do not tell is as the first that does.
        where: what they belong to.

    Raises:
        SceneError: for another value.
    """
    one_of(alpha, "data.alpha", "straight", "premultiplied", None)
    if alpha is not None:
        return dict.fromkeys(parts, alpha == "premultiplied"), []
    chosen = {
        part: [paths[i] for i in spread(len(paths), _EDGES_OF)] for part, paths in parts.items() if paths
    }
    told = {part: is_premultiplied(map(read_image, paths)) for part, paths in chosen.items()}
    if chosen and {*told.values()} == {None}:  # together they may
        told = dict.fromkeys(
            told, is_premultiplied(read_image(p) for paths in chosen.values() for p in paths)
        )
    first = next((is_so for is_so in told.values() if is_so is not None), False)
    told = {part: first if is_so is None else is_so for part, is_so in told.items()}
    if not any(told.values()):
        return dict.fromkeys(parts, False), []
    some = ", ".join(part for part, is_so in told.items() if is_so)
    which = "colours" if all(told.values()) else f"colours of {some} images, unlike those of the others,"
    line = f"{where}: {which} are taken as multiplied by alpha, as no edge is brighter than its alpha"
    return {**dict.fromkeys(parts, first), **told}, [f"{line}; if they are not, set data.alpha=straight"]


def composited(rgba: Tensor, background: Tensor) -> Tensor:
    """``rgb * a + (1 - a) * background``: uint8 (..., 4) over (3,) or (..., 3) gives float32 (..., 3)."""
    shown = rgba.float() / 255.0
    return torch.lerp(background.expand_as(shown[..., :3]), shown[..., :3], shown[..., 3:])


@dataclass(eq=False)
class StoredImage:
    """An image decoded at its first use and kept while there is room, uint8 (H, W, 4); it is read-only.

    A ``mask`` in another file cuts it out: where the image has an alpha of its own, it counts inside the
    mask; colour is 0 where alpha is. Only the smallest rectangle that holds the foreground is kept then, a
    fraction of most images.

    Args:
        path: of the image.
        size: (width, height), what the files must hold.
        factor: average blocks of so many pixels a side; of a cut-out, at most 2, an odd last row or column is
            cut off.
        mask: of the same or a larger size; what is foreground see ``bright``.
        opaque: leave the image's own alpha aside.
        premultiplied: colours on disk are multiplied by alpha.
    """

    path: Path
    size: tuple[int, int]
    factor: int = 1
    mask: Path | None = None
    opaque: bool = False
    premultiplied: bool = False

    def __call__(self) -> Tensor:
        """Give the pixels; SceneError where a file cannot be decoded or has another size."""
        part = CACHE.get(self, self._decode)
        if self.mask is None:
            return part
        width, height = (n // self.factor for n in self.size)
        whole = torch.zeros(height, width, 4, dtype=torch.uint8)
        whole[self._rectangle] = part
        return whole

    def _decode(self) -> Tensor:
        """Decode the image, or cut out the foreground's rectangle and note where it lies."""
        rgba = read_image(self.path, self.size)
        if self.premultiplied:
            rgba = straight(rgba)
        if self.opaque:
            rgba[..., 3] = 255
        if self.mask is None:
            return rgba if self.factor == 1 else reduced(rgba, self.factor)
        rgba *= (bright(self.mask, self.size) & (rgba[..., 3] > 0))[..., None]
        rgba = rgba if self.factor == 1 else halved_cutout(rgba)
        foreground = rgba[..., 3] > 0
        sides = (foreground.any(axis).nonzero()[:, 0].tolist() for axis in (1, 0))
        self._rectangle = tuple(slice(side[0], side[-1] + 1) if side else slice(0) for side in sides)
        return rgba[self._rectangle].clone()


class StoredMask:
    """A mask decoded at its first use and kept while there is room, bool (H, W), read-only: see ``bright``.

    Args:
        path: of the mask.
        size: (width, height), to which a larger file is brought.
        of_alpha: it is the alpha of an image.
    """

    def __init__(self, path: Path, size: tuple[int, int], of_alpha: bool = False) -> None:
        self.path, self.size, self.of_alpha = path, size, of_alpha

    def __call__(self) -> Tensor:
        """Give the mask; SceneError where it cannot be decoded or is dark everywhere."""
        if self.is_dark():
            advice = "write what counts as 255 and all else as 0, or set data.masks=off"
            got = "none above 127 of 255, nor labels beside 0"
            raise mismatch(self.path, "a mask with a bright pixel", got, advice)
        return CACHE.get(self, self._decode)

    def is_dark(self) -> bool:
        """Tell whether it is dark everywhere; SceneError where it cannot be decoded."""
        return not bool(CACHE.get(self, self._decode).any())

    def _decode(self) -> Tensor:
        return bright(self.path, self.size, self.of_alpha)


class MovingMask(StoredMask):
    """A mask of what moves, bool (H, W), kept as others; it may be dark everywhere."""

    def __call__(self) -> Tensor:
        """Give the mask; SceneError where it cannot be decoded."""
        return CACHE.get(self, self._decode)


def bright(path: Path, size: tuple[int, int] | None = None, of_alpha: bool = False) -> Tensor:
    """Decode what is foreground in a mask, (H, W) bool: where it is above 127; in one with colours, as a
    palette has them for several objects, whatever is not black; in one of small numbers, and in a PNG of few
    levels that fill areas beside 0, as labels do and soft edges don't, whatever is not 0. An alpha
    counts instead where colours are one, or those of an image that was cut out. Brought to a smaller size, a
    pixel is foreground where half of it is.

    Args:
        path: of the mask.
        size: (width, height); None: as stored.
        of_alpha: the mask is the alpha of this image.

    Raises:
        SceneError: as ``read_image``, and where it is not as large as ``size`` or so many times as large.
    """
    rgba = read_image(path)
    times = max(1, round(rgba.shape[1] / size[0])) if size else 1
    if size and any(abs(n - stored / times) >= 1 for n, stored in zip(size, rgba.shape[1::-1])):
        raise mismatch(path, f"{by(size)} pixels", by(rgba.shape[1::-1]))
    if not of_alpha and bool((rgba[..., 3] < 255).any()):
        colors, inside = rgba[..., :3].reshape(-1, 3), rgba[rgba[..., 3] > _FOREGROUND][:, :3]
        of_alpha = bool((colors == colors[0]).all()) or any(map(_are_of_image, (colors, inside)))
    values = rgba[..., 3] if of_alpha else rgba[..., :3].amax(-1)
    is_colored = not of_alpha and int((values - rgba[..., :3].amin(-1)).max()) >= _COLORED
    is_labels = not of_alpha and path.suffix.lower() == ".png" and _are_labels(values)
    least = 1 if is_labels or int(values.max()) <= _NUMBERED else _COLORED if is_colored else _FOREGROUND + 1
    mask = values >= least
    if size in (None, mask.shape[::-1]):
        return mask
    return torch.nn.functional.interpolate(mask[None, None].float(), size[::-1], mode="area")[0, 0] >= 0.5


def _are_labels(values: Tensor) -> bool:
    """Tell whether a mask (H, W) holds labels of objects: few levels, 0 too, of which the dark fill areas.

    Soft edges are a pixel wide: of most of their pixels no square of 2 x 2 has one level.
    """
    levels = values.unique()
    dark = (values > 0) & (values <= _FOREGROUND)
    if int(levels[0]) > 0 or len(levels) > _LABELS or not bool(dark.any()):
        return False
    across, down = values[:, 1:] == values[:, :-1], values[1:] == values[:-1]
    square = across[1:] & across[:-1] & down[:, 1:] & down[:, :-1]
    pixel = torch.nn.functional.pad(square, (1, 1, 1, 1))
    in_square = pixel[1:, 1:] | pixel[1:, :-1] | pixel[:-1, 1:] | pixel[:-1, :-1]
    return int((dark & in_square).sum()) > int(dark.sum()) / 2


def hides_image(rgba: Tensor) -> bool:
    """Tell whether what is fully transparent in an image (H, W, 4) shows something nevertheless.

    Programs that cut out leave one colour there, or few; where many colours are, alpha may mean another thing
    ("no depth here", as of dycheck) or the image was given a mask and nothing was erased.
    """
    beneath = rgba[rgba[..., 3] == 0][:, :3]
    return len(beneath) >= max(_LEAST_HIDDEN * rgba[..., 3].numel(), _COLORS) and _are_of_image(beneath)


def _are_of_image(colors: Tensor) -> bool:
    """Tell whether colours (N, 3) are many, none of them that of most."""
    colors = colors[:: 1 + len(colors) // _LOOKED_AT].int() @ torch.tensor([65536, 256, 1], dtype=torch.int32)
    counts = colors.unique(return_counts=True)[1]
    return len(counts) >= _COLORS and int(counts.max()) < len(colors) / 2


def _decode(path: Path, mode: str, upright: bool = False) -> np.ndarray:
    """Decode the first image of a file in one of Pillow's modes, turned upright if wanted."""
    content = io.BytesIO(read_bytes(path, MOST_IMAGE, "an image"))
    _inspect(content, path, mode)
    content.seek(0)
    try:
        # In one expression: while a name keeps the image alive, its memory is not used again.
        turn = ImageOps.exif_transpose if upright else (lambda image: image)
        return np.array(in_srgb(turn(open_image(content)), mode))
    except Exception as error:  # decoders raise OSError, SyntaxError, struct.error and more
        raise mismatch(path, "an image", f"data that cannot be decoded ({error})") from error


def _inspect(stream: BinaryIO, path: Path, mode: str = "RGBA") -> Header:
    """Check an open image, which is to be read in one of Pillow's modes."""
    try:
        image = open_image(stream)
    except TooManyPixels as error:
        raise mismatch(path, f"an image of 1 to {MOST_PIXELS} pixels", error) from error
    except Exception as error:  # OSError, ValueError and more
        got, advice = str(error), ""
        if isinstance(error, UnidentifiedImageError):
            got, advice = _kind_of(stream)
        raise mismatch(path, "a PNG or JPEG image", got, advice) from error
    has_16_bits = ";16" in str(image.tile[0][3])  # the mode alone hides it
    if mode == "I;16" and not (has_16_bits and image.mode.startswith("I")):
        advice = "write it with 16 bits, or as .npy; 8 are too coarse for depth"
        raise mismatch(path, "a grey PNG of 16 bits a pixel", f"mode {image.mode}", advice)
    if mode == "RGBA" and (has_16_bits or image.mode == "CMYK"):
        got = "16 bits" if has_16_bits else "CMYK"
        raise mismatch(path, "8 bits a channel, grey or RGB", got, "convert the image")
    is_turned = False
    with suppress(Exception):  # a harmed tag, of what no pixel depends on; a PNG's own method would decode it
        is_turned = Image.Image.getexif(image).get(_ORIENTATION, 1) not in (0, 1)
    is_linear = image.info.get("gamma", 0) > _LINEAR and not {"srgb", "icc_profile"} & image.info.keys()
    header, is_whole = Header(image.size, image.has_transparency_data, is_turned, is_linear), False
    with suppress(Exception):  # OSError, SyntaxError and more
        is_whole = image.verify() is None if image.format == "PNG" else _has_jpeg_end(stream)
    if not is_whole:
        raise mismatch(path, "a whole image", "a truncated or harmed one", "copy the file again")
    return header


def _kind_of(stream: BinaryIO) -> tuple[str, str]:
    """Say what a file is that is no PNG or JPEG, by its first bytes, and what to do."""
    stream.seek(0)
    head = stream.read(32)
    for kind, (at, marks) in _OTHER_KINDS.items():
        if head[at:].startswith(marks):
            return kind, "convert it to PNG or JPEG"
    return "another kind of file or a harmed header" if head else "an empty file", ""


def _has_jpeg_end(stream: BinaryIO) -> bool:
    """Tell whether the end's marker follows, which cannot occur among the pixels; Pillow does not look."""
    here, size = stream.tell(), stream.seek(0, os.SEEK_END)
    for begin in (max(here, size - _JPEG_TAIL), here):
        stream.seek(begin)
        if _JPEG_END in stream.read():
            return True
    return False


def by(size: Iterable[int]) -> str:
    """Write a size (width, height) in words.

    >>> by((640, 480))
    '640 x 480'
    """
    return " x ".join(map(str, size))
