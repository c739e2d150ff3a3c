"""Names of images, as cameras, phones, rigs and programs write them."""

from datetime import datetime, timedelta

import numpy as np
import pytest

from forewarp.data.names import read_names
from tests.support.written_scenes import refused

RIG = [(3.0 * k, 0, 0) for k in range(3) for _ in range(4)]  # three cameras that stand
PATH = [(0.1 * i, 0, 0) for i in range(12)]  # one camera that moves on


def in_groups(form: str, firsts, lasts) -> list[str]:
    return [form.format(a, b) for a in firsts for b in lasts]


@pytest.mark.parametrize(
    ("names", "frames"),
    [
        ([f"images/{i:04d}" for i in (1, 2, 5)], [0, 1, 4]),
        ([f"2024-05-01_10-{m:02d}-{s:02d}" for m, s in ((5, 59), (6, 1), (6, 2))], [0, 2, 3]),
        (["Screenshot 2024-05-01 23.59.59", "Screenshot 2024-05-02 00.00.01"], [0, 2]),
        (["20231115_170425", "20231115_170430"], [0, 5]),
        ([f"41048190_{s}" for s in ("3415.043", "3415.918", "3416.418")], [0, 0.875, 1.375]),
        (["1700000000_500000000", "1700000001_000000000"], [0, 0.5]),
        (["DSC_9998", "DSC_9999", "DSC_0001", "DSC_0003"], [0, 1, 2, 4]),  # a counter that began anew at 1
        ([f"clip{c}_{f:04d}" for c, f in ((1, 7), (1, 8), (2, 9), (2, 12))], [0, 1, 2, 5]),  # counted through
        (in_groups("cam{}/DSC_{:04d}", range(6), range(1, 5)), [0, 1, 2, 3] * 6),
        (in_groups("cam{}_frame{:02d}", range(2), range(3)), [0, 1, 2] * 2),
        (in_groups("frame_{1:05d}_{0}", range(2), (1, 3)), [0, 2] * 2),
        (in_groups("{}/{:03d}", "ab", range(4)), [0, 1, 2, 3] * 2),  # a folder for each camera
        (["Screenshot 2024-05-01 at 10.30.59", "Screenshot 2024-05-01 at 10.31.06"], [0, 7]),
        ([f"2024-05-01 at {t}" for t in ("11.50.00 AM", "12.10.00 PM", "1.30.00 PM")], [0, 1200, 6000]),
        (["cap_103310", "cap_103400"], [0, 50]),
        (["20240501_1045", "20240501_1115"], [0, 1800]),
        (["DJI_20240501120000_0001", "DJI_20240501124400_0002", "DJI_20240501124401_0003"], [0, 2640, 2641]),
        (["vlcsnap-00h00m09s200", "vlcsnap-00h01m02s300"], [0, 53100]),
        (["DJI_0998", "DJI_0999", "DJI_0001", "DJI_0002"], [0, 1, 2, 3]),
        (["t_0.0", "t_0.9", "t_1.5"], [0, 0.9, 1.5]),
        ([f"{serial}/16123456780{t}" for serial in (22139905, 33) for t in ("00", "33")], [0, 33] * 2),
        ([f"IMG_{i:04d}_2024010112000{i}" for i in range(3)], [0, 1, 2]),
        (["train/0001", "train/0005", "test/0003"], [0, 4, 2]),
        ([f"{i:06d}" for i in range(10000, 10400, 50)], range(0, 400, 50)),  # a counter, no clock
        (["2024-05-30", "2024-05-31", "2024-06-02"], [0, 86400, 259200]),
        (["sky_20240531", "sky_20240601", "sky_20240603"], [0, 86400, 259200]),
        ([f"10-{m:02d}-{s:02d}" for m, s in ((5, 58), (5, 59), (6, 1), (6, 2))], [0, 1, 3, 4]),
        (in_groups("frame_{1:04d}{0}", "ab", range(3)), [0, 1, 2] * 2),  # of two cameras, not hexadecimal
        (in_groups("{}{:03d}", "ab", range(3)), [0, 1, 2] * 2),
        ([f"3d_{i}" for i in range(3)], [0, 1, 2]),
        ([f"GX010042_{i:03d}" for i in range(3)], [0, 1, 2]),
        (["01.05.2024 10.30.59", "01.05.2024 10.31.00", "01.05.2024 10.31.02"], [0, 1, 3]),
    ],
)  # fmt: skip
def test_numbers_that_names_say_in_one_way(names, frames):
    found = np.array(read_names(names, "t.json").frames)
    assert found - found.min() == pytest.approx(frames, abs=1e-5)


def at(step: float, count: int, form: str, first: str = "2023-11-04T23:58:50.1") -> list[str]:
    """Name images taken every ``step`` seconds; ``$`` in the form are thousandths."""
    days = [datetime.fromisoformat(first) + timedelta(seconds=step * i) for i in range(count)]
    return [day.strftime(form.replace("$", f"{day.microsecond // 1000:03d}")) for day in days]


def code(frame: int, rate: int, dropped: int = 0) -> str:
    """Write a time code, without the first ``dropped`` numbers of all minutes but each tenth."""
    tens, rest = divmod(frame, 600 * rate - 9 * dropped)
    frame += 9 * dropped * tens + dropped * max(0, (rest - dropped) // (60 * rate - dropped))
    seconds = frame // rate
    return f"{seconds // 3600:02d}{seconds // 60 % 60:02d}{seconds % 60:02d}{frame % rate:02d}"


EVEN_SCHEMES = {
    "as few decimals as needed": [f"img_{0.04 * i:g}" for i in range(60)],
    "decimals of a program": [f"img_{round(i / 30, 3)}" for i in range(40)],
    "decimals and a counter": [f"{i:04d}_{i / 10:g}" for i in range(30)],
    "a version behind decimals": [f"t{i / 30:.2f}_v2" for i in range(1, 40)],
    "seconds and nanoseconds not filled": [f"{1699092672 + i // 4}_{i % 4 * 250000000}" for i in range(9)],
    "the same behind a point": [f"{1699092672 + i // 3}.{i % 3 * 333333333}" for i in range(9)],
    "nanoseconds": [str(1699092672123456789 + 33333333 * i) for i in range(9)],
    "a phone": at(0.5, 60, "PXL_%Y%m%d_%H%M%S$"),
    "behind a point": at(0.5, 60, "%Y%m%d_%H%M%S.$"),
    "behind a line": at(0.033, 60, "IMG_%Y%m%d_%H%M%S_$"),
    "one digit": at(0.2, 60, "%Y-%m-%dT%H-%M-%S.$Z"),
    "millionths": at(0.07, 60, "%Y%m%dT%H%M%S%f"),
    "a comma": at(0.07, 60, "%Y-%m-%d %H-%M-%S,$"),
    "the day first": at(31, 60, "%d.%m.%Y %H.%M.%S"),
    "the month first": at(31, 60, "%m-%d-%Y_%H-%M-%S"),
    "days, the day first": at(86400, 40, "plant_%d%m%Y"),
    "days, two digits of the year": at(86400, 40, "plant_%y%m%d"),
    "two digits of the year": at(31, 60, "%y%m%d_%H%M%S"),
    "twelve hours": at(31, 60, "%Y-%m-%d_%I-%M-%S-%p"),
    "twelve hours without a date": at(31, 60, "%I-%M-%S %p", "2023-11-04T11:50:00"),
    "time of day and millionths": at(0.53, 60, "%H%M%S_%f", "2023-11-04T10:58:50"),
    "a frame's date": at(0.5, 60, "frame_%Y-%m-%d-%H-%M-%S_$"),
    "packed time codes": [code(89950 + i, 25) for i in range(90)],
    "packed time codes of film": [code(24 * 3599 + 5 * i, 24) for i in range(90)],
    "folders of a camera": [f"{100 + i // 9999}ND750/DSC_{i % 9999 + 1:04d}" for i in range(9990, 10008)],
    "a counter of six digits": [f"{i:06d}" for i in range(110000, 112000, 50)],
    "a few of six digits": [f"{i:06d}" for i in range(0, 200, 50)],
    "nine digits": [f"{i:09d}" for i in range(7)],
    "a counter behind a date": [f"230501_{i:06d}" for i in range(0, 400, 50)],
    "digits of another script": [f"f{chr(0x661)}{chr(0x660 + i)}" for i in range(10)],
    "sizes, rates and lenses": [f"50mm_f1.8_29.97fps_{i:04d}_1920x1080_v2" for i in range(12)],
}  # fmt: skip


@pytest.mark.parametrize("scheme", EVEN_SCHEMES)
@pytest.mark.parametrize("one_camera", [False, True])
def test_schemes_of_practitioners_are_read_right(scheme, one_camera):
    names = EVEN_SCHEMES[scheme]
    order = np.random.default_rng(0).permutation(len(names))
    found = read_names([names[i] for i in order], "t.json", one_camera=one_camera)
    step = 1 / (len(names) - 1)
    # Thousandths, and hundredths of a second, are rounded.
    assert np.array(found.times) == pytest.approx(order * step, abs=0.26 * step)


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (in_groups("GX{:02d}0034_{:04d}", (1, 2), range(1, 9)), range(16)),
        ([f"take{t}_{i}" for t, n in ((1, 9), (2, 5)) for i in range(n)], range(14)),
        ([code(i, 30, 2)[:2] + "-" + "-".join(code(i, 30, 2)[k : k + 2] for k in (2, 4, 6))
          for i in range(1700, 1900)], range(200)),
        ([f"1699092672_{i:02d}" for i in range(30)] + [f"1699092673_{i:02d}" for i in range(30)], range(60)),
        ([f"{m}m{s:02d}s" for m in (1, 2) for s in range(0, 60, 2)], range(60)),
    ],
)  # fmt: skip
def test_several_numbers_of_one_camera_order_one_film(names, times):
    found = read_names(names, "p", one_camera=True).times
    assert found == pytest.approx(np.array(times) / max(times), abs=1e-6)


@pytest.mark.parametrize(
    "names",
    [
        in_groups("{}_{:04d}", ["rgb", "depth"], range(9)),
        in_groups("frame_{1:04d}_cam{0:02d}", range(3), range(9)),
        in_groups("{}_{:05d}", range(3), range(40)),
        in_groups("day{:02d}_{:02d}", (1, 5), range(4)),  # how long between them?
        ["01-05-23", "02-05-23", "01-06-23"],
        [f"{s}_{f:02d}" for s, f in ((0, 3), (0, 20), (1, 17), (1, 22), (2, 13), (3, 1))],
        [f"{day:02d}-{month:02d}" for month in (10, 11) for day in range(1, 30)],
    ],
)
def test_numbers_that_order_no_film_of_one_camera_are_refused(names):
    with refused("data.name_pattern"):
        read_names(names, "p", one_camera=True)


def test_counters_behind_a_point_are_no_fractions():
    names = [f"sh{shot}.{i}" for shot, end in ((1, 6010), (2, 6005)) for i in range(6001, end)]
    assert read_names(names, "p", one_camera=True).times == pytest.approx(np.linspace(0, 1, 13))


@pytest.mark.parametrize("form", ["{}_{:03d}", "s{}/{:03d}", "cam_{}_{:03d}", "{}-{:03d}"])
def test_where_cameras_are_tells_a_rig(form):
    found = read_names(in_groups(form, range(3), range(4)), "t.json", views=RIG)
    assert found.frames == [0, 1, 2, 3] * 3
    assert len({*found.cameras}) == 3


@pytest.mark.parametrize("form", ["{1:06d}/{0}", "img/{1}/img_{0:04d}", "a_{1:05d}_{0}"])
def test_where_cameras_are_tells_which_number_is_theirs(form):
    found = read_names(in_groups(form, range(3), range(4)), "t.json", views=RIG)
    assert found.frames == [0, 1, 2, 3] * 3


@pytest.mark.parametrize("form", ["{}_{:03d}", "part{}/{:03d}", "1_{}_{:03d}"])
def test_where_cameras_are_tells_one_film(form):
    found = read_names(in_groups(form, range(3), range(4)), "t.json", views=PATH)
    assert found.frames == list(range(12))
    assert found.cameras is None


def test_gaps_and_fractions_of_one_film_stay():
    parts = [(1, 1), (1, 2), (1, 3), (1, 33), (2, 1), (2, 2)]
    found = read_names([f"part{c}_{i:04d}" for c, i in parts], "t.json", views=PATH[:6])
    assert np.diff(found.frames).tolist() == [1, 1, 30, 1, 1]
    clocks = [(58, 0), (58, 500), (59, 250), (60, 0), (60, 500), (62, 0)]
    names = [f"10-{5 + s // 60:02d}-{s % 60:02d}-{t:03d}" for s, t in clocks]
    assert np.diff(read_names(names, "t.json", views=PATH[:6]).frames).tolist() == [500, 750, 750, 500, 1500]


def test_cameras_beside_each_other_that_move_on_are_a_rig():
    directions = [(0, 0, 3), (3, 0, 0), (-3, 0, 0)]
    views = [(i, 0, 0, *directions[k]) for i in range(4) for k in range(3)]
    found = read_names(in_groups("{:03d}_{}", range(4), range(3)), "t.json", views=views)
    assert found.frames == [i for i in range(4) for _ in range(3)]


@pytest.mark.parametrize(
    ("names", "said"),
    [
        ([f"cam{k}/DSC_{100 * k + i:04d}" for k in range(3) for i in range(1, 5)],
         "one numbering of all images, 1 to 204, but got 201 to 204 for 'cam2/DSC_0201'"),
        ([f"{split}/r_{i}" for split, n in (("train", 20), ("test", 17)) for i in range(n)], "0 to 16 for"),
        (["3f2a91", "b07c44", "aa1f03", "9c8e77", "d4d5e6"], "what is beside the numbers differs"),
        (in_groups("{}_{:03d}", range(3), range(4)), r"names as '0_000': .* \(4 times\), or .* \(12 times\)"),
        ([f"IMG_20231115_1704{i:02d}" for i in range(9)] + ["IMG_20231115_170403 (1)"], r"'IMG_.*1\)'; ren"),
        ([f"IMG_{i:04d}" for i in range(8)] + ["IMG_0003 copy"], "'IMG_0000', but got 'IMG_0003 copy'; rena"),
        ([f"IMG_{i:04d}" for i in range(8)] + ["IMG_E0003"], "but got 'IMG_E0003'; rename"),
        ([f"r_{i:03d}" for i in range(30)] + ["r_90000"], "number of r_90000: expected .* 1 to 28"),
        (in_groups("train/{1:03d}{0}", [""], range(150)) + in_groups("test/{1:03d}{0}", [""], range(20)),
         "one numbering of all images, 0 to 149, but got 0 to 19 for 'test/000'"),
        (in_groups("{}/{:03d}", range(3), range(4)), "names as '0/000': number 1 .*, or number 2 .*, or all"),
        (in_groups("img/{1}/img_{0:04d}", range(3), range(4)), "names that tell times in one way"),
        ([f"frame_{i}" for i in range(-5, 6)], "what is beside the numbers differs"),
        (in_groups("20231115_1704{:02d}_{:02d}", range(9), range(3)), "names that tell times in one way"),
        (["t_1.000e-05", "t_2.000e-05"], "numbers with exponents"),
        ([f"images/frame_{i:04x}" for i in range(18)], "'images/frame_000a': .* hexadecimal numbers"),
        ([f"r_{i:x}" for i in range(18)], "names as 'r_a': .* hexadecimal numbers"),
        ([f"{i:04X}" for i in range(158, 190)], "hexadecimal numbers"),
        ([f"cam{k}/{i:03x}_rgb" for k in range(2) for i in range(12)], "hexadecimal numbers"),
        (["cap_235000", "cap_235900", "cap_001000"], "times of day more than half a day apart"),
        (["11-50-00 PM", "11-59-00 PM", "12-10-00 AM"], "times of day more than half a day apart"),
        (["01.11.2023", "05.12.2023", "03.12.2023", "02.12.2023"], "begin with the day, or .* the month"),
        (["01.11.2023", "05.12.2023", "03.12.2023"], "begin with the day, or .* the month"),
        (["x_101112", "x_101130", "x_101205", "x_101231"], "times of day, or dates that begin with two"),
        (["a_1.3", "a_1.9", "a_1.11", "a_2.12"], "seconds with a fraction, or a counter"),
        ([f"20231104_10111{s}_{f}" for s, f in ((2, 345), (3, 410), (4, 777))], "fractions of the seconds"),
        ([f"010059{f:02d}" for f in (1, 7, 20)] + ["01010001", "01010019"], "codes of 24 frames"),
        ([f"f{i:06d}" for i in (3, 17, 48, 101, 122, 157)], "times of day, or a counter"),
        ([f"2024-05-01_{i:04d}" for i in (3, 20, 45, 101, 140, 212)], "with the year, or a counter"),
        ([f"{i:012d}_{i * 3:09d}" for i in range(10)], "names that tell times in one way"),
        ([f"{i % 65536:05d}" for i in range(65530, 65540)], "to 65535, where a counter began anew"),
        (["23-59-58", "23-59-59", "00-00-01", "00-00-02"], "names that tell times in one way"),
        ([f"{391642633 + i % 4}_{i**5 % 97 + 2}0667805286827_n" for i in range(9)], "in one way"),
        ([f"frame_{i:05d}" for i in (-50, -43, 6, 13)], "differs from image to image, as signs"),
        ([f"{c}_{i}" for c, n in ((1, 9), (2, 5)) for i in range(n)], "names that tell times in one way"),
    ],
)  # fmt: skip
def test_names_of_several_readings_are_refused(names, said):
    with refused(said + ".*data.name_pattern"):
        read_names(names, "t.json")


@pytest.mark.parametrize(
    ("form", "parts"),
    [("seq-{:02d}/frame-{:06d}", range(3)), ("clip{}_frame{:04d}", range(3)), ("c{}_{:05d}", range(3)),
     ("film{}_{:04d}", "ABC"), ("{}/{:04d}", ["first", "last", "mid"])],
)  # fmt: skip
def test_words_that_positions_contradict_are_refused(form, parts):
    with refused("positions continue one path; .*data.name_pattern"):
        read_names(in_groups(form, parts, range(4)), "t.json", views=PATH)


def test_two_cameras_that_return_to_where_they_began_are_a_rig():
    angles = 2 * np.pi * np.arange(24) / 24
    ring = np.stack([np.cos(angles), np.sin(angles), np.zeros(24)], 1)
    views = [*ring.tolist(), *(1.1 * ring).tolist()]
    found = read_names(in_groups("{}/{:04d}", ["left", "right"], range(24)), "t.json", views=views)
    assert found.frames == [*range(24)] * 2


def test_names_that_say_nothing():
    assert read_names([], "t.json") is None
    assert read_names(["left", "right"], "t.json") is None
    assert read_names(["a/1", "a/01", "b/7"], "t.json") is None  # one number twice
    assert read_names([f"cam{i}" for i in range(4)], "t.json") is None


def test_a_pattern_settles_every_case():
    names = in_groups("{}_{:03d}", range(2), (4, 6))
    found = read_names(names, "t.json", r"(?P<camera>\d)_(?P<frame>\d+)")
    assert (found.frames, found.cameras) == ([4, 6, 4, 6], ["0", "0", "1", "1"])
    assert read_names(["a1.5", "a2"], "t.json", r"a(?P<time>[\d.]+)").frames == [1.5, 2]
    films = [f"clip{c}_{f}" for c, f in ((1, 0), (1, 2), (2, 0), (10, 0))]
    assert read_names(films, "t.json", r"(?P<part>\d+)_(?P<frame>\d+)").frames == [0, 2, 4, 6]
    found = read_names([f"r_{i:04x}" for i in range(20)], "t.json", "_(?P<frame>[0-9a-f]+)")
    assert found.frames == [*range(20)]
    clocks = ["x_10-05-59", "x_10-06-01.5", "x_00:07"]
    assert read_names(clocks, "t.json", "_(?P<time>.*)").frames == [36359, 36361.5, 7]
    dated = read_names(["2024-05-01 23.59.59", "2024-05-02 00.00.01"], "t.json", "(?P<time>.*)")
    assert np.diff(dated.frames) == [2]
    days = read_names(["01.11.23", "01.12.23"], "t.json", r"(?P<day>\d+)\.(?P<month>\d+)\.(?P<year>\d+)")
    assert np.diff(days.frames) == [30 * 86400]
    seconds = read_names(["1m02.5", "2m03"], "t.json", r"(?P<minute>\d+)m(?P<second>[\d.]+)")
    assert np.diff(seconds.frames) == [60.5]


@pytest.mark.parametrize(
    ("pattern", "said"),
    [
        ("(", r"data.name_pattern: expected a regular expression, but got '\('"),
        ("[0-9]+", "a group named time or frame, .* but got neither"),
        (r"x(?P<frame>\d+)", "to be found in every name of t.json, but got not in '0_004'"),
        (r"_(?P<frame>\d+)", "each frame once, but got 4 again in '1_004'; name the camera by a group"),
        (r"(?P<month>\d)_\d+", "group month: expected a number, but got '0' of '0_004'"),
        (r"(?P<frame>_)", "group frame: expected a number, but got '_' of '0_004'"),
    ],
)
def test_a_pattern_that_cannot_be_used_is_refused(pattern, said):
    with refused(said):
        read_names(in_groups("{}_{:03d}", range(2), (4, 6)), "t.json", pattern)


@pytest.mark.parametrize(
    "form",
    ["C{:04d}.MP4_frame_{:04d}", "GX01{:04d}_frame_{:04d}", "clip{:02d}/frame_{:04d}", "a{:03d}.mp4_t{:04d}"],
)
def test_frames_counted_anew_in_each_film_are_refused_without_poses(form):
    names = [form.format(film, n) for film in (1, 2) for n in range(1, 9)]
    with refused("films that are counted anew.*name_pattern"):
        read_names(names, "toy")
    pattern = r"(?i)(?P<part>\d+)(\.mp4)?.(frame_|t)(?P<frame>\d+)"
    assert read_names(names, "toy", pattern).frames == [*map(float, range(1, 17))]
    assert len({*read_names([f"cam{k}/frame_{n}" for k in (1, 2) for n in range(9)], "toy").cameras}) == 2


def test_folders_counted_apart_are_refused_without_poses_unless_one_goes_on():
    apart = [
        f"{camera}/{n:04d}" for camera, first in (("a", 1), ("b", 101)) for n in range(first, first + 14)
    ]
    with refused("one numbering of all images, 1 to 114, but got 101 to 114 for 'b/0101'"):
        read_names(apart, "toy")
    on = [f"{part}/{n:04d}" for part, first in (("a", 1), ("b", 15)) for n in range(first, first + 14)]
    assert read_names(on, "toy").times[-1] == 1
    splits = [
        f"{split}/{n:04d}" for split, first in (("train", 1), ("test", 101)) for n in range(first, first + 14)
    ]
    assert read_names(splits, "toy").frames[-1] == 114


def test_folders_counted_in_hexadecimal_are_refused_and_hashes_are_not():
    with refused("'000a/left'.*hexadecimal"):
        read_names([f"{n:04x}/{side}" for n in range(12) for side in ("left", "right")], "toy")
    hashes = [f"{folder}/{n:03d}" for folder in ("3fa9", "b01c") for n in range(9)]
    assert len({*read_names(hashes, "toy").cameras}) == 2
