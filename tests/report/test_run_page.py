"""The page of a run that nobody trained, and of a fitted one."""

import json
import os
import re
import shutil
import struct
from html.parser import HTMLParser

import pytest
import torch
import yaml

from forewarp.drawing.images import write_png, write_video
from forewarp.metrics.registry import METRICS, Metric
from forewarp.report.run_page import (
    Axis,
    Media,
    Shown,
    best_median_worst,
    chart,
    media_of,
    read_story,
    write_run_page,
)
from tests.support.runs_on_disk import write_run, write_views

NASTY = "<img src=x onerror=alert(1)>&\"'</script>"
KNOWN = """html head meta title style body main header section footer div span figure figcaption video
img input p label h1 h2 h3 b i small dl dt dd ul ol li code pre svg g line text circle polyline details
summary table tr th td script noscript"""


class Page(HTMLParser):
    """What a browser makes of a page: its tags, attributes and text."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.words = [], [], []
        self.feed(text)
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.attributes += [(tag, key, value) for key, value in attrs]

    def handle_data(self, data):
        if self.tags[-1:] not in (["style"], ["script"]):
            self.words.append(data)

    def of(self, name):
        return [value for _, key, value in self.attributes if key == name]


def told_run(root, *, views=3, plan=None, config=None, metrics=None, **more):
    """A run on disk with some measured views, of a single stage."""
    stage = {"stage": {"coarse": {"share": 1.0}}, "model": {"name": "forward", "motion": "dct"}}
    folder = write_run(root, config=stage | (config or {}), metrics=metrics, **more)
    if views:
        write_views(folder, {f"test/r_{i}": (i / max(views - 1, 1), 20.0 + i) for i in range(views)})
    if plan is not None:
        (folder / "plan.yaml").write_text(yaml.safe_dump(plan))
    return folder


def change_scores(folder, changes):
    """Change the scores of some views, by number."""
    rows = json.loads((folder / "per_image.json").read_text())
    for number, scores in changes.items():
        rows["images"][number]["scores"] |= scores
    (folder / "per_image.json").write_text(json.dumps(rows))


def write(folder, media=None, megabytes=4.0):
    """The page of a run's folder, read back."""
    file = folder / "page.html"
    size = write_run_page(file, read_story(folder), media or Media(), megabytes=megabytes)
    assert size == file.stat().st_size <= 1e6 * megabytes
    return Page(file.read_text())


def noise(side, seed=0):
    return torch.rand(side, side, 3, generator=torch.Generator().manual_seed(seed))


def shown(why="best", side=64, about="test/r_0, time 0.00, 20.0 dB", scored=0):
    names = ("truth", "prediction", "error", "depth")
    return Shown(why, about, {name: noise(side, i) for i, name in enumerate(names)}, scored)


def test_the_page_tells_what_the_run_is(tmp_path, monkeypatch):
    monkeypatch.setitem(METRICS, "mean_error", Metric("mean_error", "Mean error", 3))
    effects = {"motion": {"choice": "dct", "on": True, "because": "trial +4.0 dB"}}
    effects["view"] = {"choice": "none", "on": False, "because": "trial +0.1 dB"}
    metrics = {"flow": {"epe_moving": 0.1, "motion_mean": 0.4}, "size": {"particles": 2874}}
    metrics["effects"] = {"motion": True, "view": False, "extra": True}
    metrics["test"] = {"all": {"psnr": 31.25, "ssim": 0.9, "mean_error": 0.125}}
    metrics["test"] |= {"moving": {"psnr": 17.25}, "still": {"psnr": 33.5}}
    metrics["protocol"] = {"nearest_training_frame": "1 to 2 steps of 0.04 s", "moving": "images and poses"}
    plan = {"effects": effects, "seconds": 65.0}
    folder = told_run(tmp_path, plan=plan, metrics=metrics, command="forewarp-train data.scene=ball")
    page = write(folder, Media([shown()]))
    expected = ["ball", "forward, preset fast", "31.25 dB", "training 0:50", "1.00 GiB", "a cpu", "2,000,000"]
    expected += ["forewarp-train data.scene=ball", "trial +4.0 dB", "for 1:05", "off view trial +0.1 dB"]
    expected += ["on extra", "Through the scene's time", "test/r_2", "25.5 dB after 40 s", "particles 2,874"]
    expected += ["PSNR of what moves (dB) 17.25", "PSNR of what is still (dB) 33.50", "Mean error 0.125"]
    expected += ["nearest training frame 1 to 2 steps of 0.04 s", "what moves, known from images and poses"]
    expected += ["off by 0.1000 world units, 25% of their motion", "coarse: 100 steps in 0:50", "format=html"]
    assert [text for text in expected if text not in page.text] == []
    assert page.tags.count("svg") == 2  # no events of a loss
    assert all(value.startswith("data:") for value in page.of("src"))
    assert page.of("href") == []
    assert all(alt is not None for alt in page.of("alt"))
    assert page.tags.count("img") == len(page.of("alt")) == 5


def as_link(path):
    path.symlink_to("/etc/passwd")


def _event(content):
    """Write a record as TensorBoard does."""
    from tensorboard.compat.tensorflow_stub.pywrap_tensorflow import masked_crc32c

    length = struct.pack("<Q", len(content))
    sums = (struct.pack("<I", masked_crc32c(part)) for part in (length, content))
    return length + next(sums) + content + next(sums)


BAD = {  # what lies in a run's folder -> how it is made, and what the refusal says
    "videos/both.mp4": (as_link, "both.mp4: expected no links inside a run's folder"),
    "images/sheets/a.png": (as_link, "a.png: expected no links inside a run's folder"),
    "metrics.json": (as_link, "metrics.json: expected no links inside a run's folder"),
    "tensorboard/events.out.tfevents.1": (os.mkfifo, "expected a file, but got a device or a pipe"),
    "config.yaml": (
        lambda path: path.write_text(f"command: {'x' * 70000}"),
        "command: expected a text of at",
    ),
    "plan.yaml": (lambda path: path.write_text("a: &a [1]\nb: [*a, *a]"), "expected no aliases"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_lies_in_the_folder_of_a_stranger_is_refused_before_it_is_read(tmp_path, name):
    (folder := told_run(tmp_path, views=0)).joinpath(name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).unlink(missing_ok=True)
    make, said = BAD[name]
    make(folder / name)
    with pytest.raises(ValueError, match=said):
        read_story(folder)


def test_events_that_are_none_are_refused_in_a_line(tmp_path):
    folder = told_run(tmp_path, views=0)
    (folder / "tensorboard").mkdir()
    length = b"\xff" * 8
    (folder / "tensorboard" / "events.out.tfevents.1").write_bytes(length + b"\0" * 4)
    assert read_story(folder)["loss"] == {}  # torn, as of a killed run
    (folder / "tensorboard" / "events.out.tfevents.1").write_bytes(_event(b"\xff\xff\xff"))
    with pytest.raises(ValueError, match="tensorboard: expected events of TensorBoard, but got others"):
        read_story(folder)


def test_names_of_stages_lead_nowhere(tmp_path):
    with pytest.raises(ValueError, match="stage: expected names of letters, digits, _ and -, but got '../x'"):
        read_story(told_run(tmp_path, config={"stage": {"../x": {"share": 1.0}}}))


def test_a_file_that_is_no_video_is_not_put_into_the_page(tmp_path):
    (video := tmp_path / "both.mp4").write_text("0000ftyp the user's own")
    with pytest.raises(ValueError, match="both.mp4: expected an MP4 video, but got another file"):
        write(told_run(tmp_path), Media([shown()], video=video))


def test_what_a_file_says_is_text_and_never_markup(tmp_path):
    said = {"command": f"forewarp-train {NASTY}"}
    said["config"] = {"data": {"scene": NASTY}, "preset": {"name": NASTY}}
    said["plan"] = {"effects": {NASTY: {"choice": NASTY, "on": True, "because": NASTY}}}
    said["metrics"] = {"protocol": {"device": NASTY, "dataset": NASTY}, "test": {NASTY: {NASTY: 1.0}}}
    folder = told_run(tmp_path, **said)
    rows = [{"name": NASTY, "time": 0, "ability": NASTY, "scores": {"psnr": 20.0, NASTY: 1}}]
    (folder / "per_image.json").write_text(json.dumps({"images": rows}))
    page = write(folder, Media([shown(NASTY, about=NASTY)], missing=[NASTY]))
    assert set(page.tags) <= set(KNOWN.split())
    assert page.tags.count("script") == 1
    assert [key for _, key, _ in page.attributes if key.startswith("on")] == []
    assert all(value.startswith("data:") for value in page.of("src"))
    assert page.text.count(NASTY) > 10


BEGUN = {"config": {"stage": {"coarse": {}, "fine": {}}}}


@pytest.mark.parametrize(
    ("more", "says", "absent"),
    [
        ({"psnr": None, "views": 0}, "The run is not measured", "dB PSNR"),
        ({"metrics": {"effects": None}}, "No effects: neither a plan nor metrics.json", "Effects, and why"),
        ({"metrics": {"test": {"all": {"psnr": 20.0, "lpips_vgg": None}}}}, "LPIPS (vgg)", "None"),
        ({"curve": None}, "No PSNR against training time", "PSNR while it learned"),
        ({"views": 0}, "No PSNR by view and through the scene's time", "The worst test views"),
        ({"views": 1}, "Through the scene's time", "No PSNR by view"),
        ({}, "No loss: neither TensorBoard's events nor csv/metrics.csv", "What is minimised"),
        ({}, "No pictures: the run's folder has none", "Pictures are"),
        ({}, "No video: the run's folder has none", "Truth against prediction"),
        ({}, "No plan was made for this run", "Truth against prediction"),
        (BEGUN, "of its stages fine has not ended (finished: coarse; trained for 0:50). It", "forewarp-view"),
        ({"config": {"stage": {"a": {}, "b": {}}}}, "of its stages a, b have not ended", "forewarp-view"),
    ],
)
def test_what_is_missing_is_said_and_left_out(tmp_path, more, says, absent):
    page = write(told_run(tmp_path, **({"metrics": {"effects": {"motion": True}}} | more)))
    assert says in page.text
    assert absent not in page.text


def test_an_effect_names_what_was_typed_and_an_option_that_says_something(tmp_path):
    model = {"name": "forward", "motion": "dct", "codes": 2, "depth": True}
    effects = dict.fromkeys(("motion", "codes", "depth"), True) | {"view": False}
    command = "forewarp-train ablation=full model/motion=dct 'a=[1, 2]"  # no closing quote
    run = told_run(tmp_path, command=command, config={"model": model}, metrics={"effects": effects})
    text = write(run).text
    assert "on motion dct Typed: model/motion=dct." in text
    for name in ("on codes", "on depth", "off view"):
        assert f"{name} As model=forward has it with ablation=full." in text


@pytest.mark.slow
def test_pictures_and_video_are_made_smaller_until_the_page_fits(tmp_path):
    folder = told_run(tmp_path)
    film = write_video(tmp_path / "film.mp4", (noise(128, i) for i in range(12)), fps=10)
    media = Media([shown("best", 300), shown("worst", 300)], film, "once around")
    large, small = write(folder, media, 40), write(folder, media, 0.2)
    assert "Pictures are JPEG of quality 92." in large.text
    assert "Once around." in large.text
    assert re.search(r"Pictures are JPEG of quality \d+, scaled from 300 to \d+ pixels", small.text)
    assert "encoded again with more loss" in small.text or "The video is left out" in small.text
    assert {value.split(";")[0] for value in large.of("src")} == {"data:image/jpeg", "data:video/mp4"}
    text = write(folder, Media([shown("best", scored=1600)])).text
    assert "quality 92, scaled from 1600 to 800 pixels" in text  # the view that was scored was larger
    line = "megabytes: expected room for the page's text, 0.0.*but got 0.01; raise"
    with pytest.raises(ValueError, match=line):
        write(folder, media, 0.01)


@pytest.mark.parametrize(("count", "name"), [(5, "r" * 120), (1, "r")])
def test_the_markup_of_the_views_is_within_the_limit(tmp_path, count, name):
    folder = told_run(tmp_path)
    media = Media([shown(f"view {i}", about=f"{name}, 20.0 dB") for i in range(count)])
    write(folder, media)
    whole = (folder / "page.html").stat().st_size
    assert write(folder, media, (whole - 1) / 1e6).tags.count("img") == 5 * count  # smaller, none left out


CONFIG = "data: {scene: a}, model: {name: b}, seed: 0"


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("metrics.json", '{"test": {}}', "no key 'seconds'"),
        ("per_image.json", '{"images": [{"name": "a"}]}', "no key 'scores'"),
        ("config.yaml", "a: [", "expected a run whose files can be read"),
        ("plan.yaml", "effects: {motion: {choice: x}}", "no key 'on'"),
        ("config.yaml", f"{{{CONFIG}, preset: null, budget: {{}}}}", "preset: expected keys of its own"),
        ("coarse/done.json", '{"steps": 3}', "no key 'seconds'"),
        ("config.yaml", f"{{{CONFIG}, preset: {{name: c}}, budget: {{minutes: x}}}}", "minutes: expected"),
    ],
)
def test_a_broken_file_ends_in_one_line(tmp_path, file, content, says):
    folder = told_run(tmp_path)
    (folder / file).write_text(content)
    with pytest.raises(ValueError, match="^run: expected a run whose files can be (read|shown), b") as caught:
        write(folder)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_losses_are_against_the_clock_of_training(fitted):
    row = read_story(fitted)
    ends = [points[-1][0] for points in row["loss"].values()]
    spent = [done["seconds"] for done in row["stages"].values()]
    assert list(row["loss"]) == ["coarse", "fine"]
    assert ends == pytest.approx([spent[0], sum(spent)], rel=1e-3)
    assert row["consists"] == ("voxels", row["size"])


def test_one_view_is_the_best_of_all():
    views = [{"name": "a", "time": 0.5, "psnr": 30.0}, {"name": "b", "time": 0.6, "psnr": 20.0}]
    assert [best_median_worst(views[:count]) for count in (0, 1, 2)] == [
        {},
        {"a": "best"},
        {"a": "best", "b": "worst"},
    ]


@pytest.mark.slow
def test_of_many_views_some_are_drawn_and_the_lowest_too(tmp_path):
    folder = told_run(tmp_path, views=1500)
    change_scores(folder, {1: {"psnr": 3.0}})
    page = write(folder)
    assert len(re.findall(r" (?:3\d\d|40\d) of the 1500 views are drawn", page.text)) == 1
    assert page.text.count("time 0.001: 3.00 dB") == 1
    assert "The first 1000 of 1500 views" in page.text
    assert page.tags.count("tr") < 1010


def test_numbers_that_are_none_are_left_out(tmp_path):
    folder = told_run(tmp_path, curve=((10, 20.0), (20, "nan"), (40, 25.5), (50, "inf")))
    change_scores(folder, {0: {"psnr": float("nan")}, 1: {"ssim": None}})
    page = write(folder)
    assert "25.5 dB after 40 s" in page.text
    assert "Every test view (2)" in page.text
    assert re.search("nan|inf", page.text) is None


def test_folders_are_relative_to_the_current_one_and_quoted(in_tmp):
    page = write(told_run(in_tmp / "my runs", command=f"forewarp-train data.root={in_tmp}/data run=a"))
    assert "forewarp-train data.root=data run=a" in page.text
    assert "forewarp-view run='my runs/ball/base-1.0-seed0'" in page.text
    assert str(in_tmp) not in page.text


@pytest.mark.parametrize("log", [False, True])
def test_points_and_ticks_of_a_chart_share_their_axes(log):
    points = [(value, value, "") for value in (1.0, 10.0, 100.0)]
    drawn = chart("", "", [("", "dots", points)], ("x", "y"), logs=(log, log))
    ((_, _, placed),) = drawn["series"]
    assert [place[:2] for place in placed] == [(drawn["x"].at(v), drawn["y"].at(v)) for v in (1, 10, 100)]
    (a, b, c), (low, middle, high) = zip(*[place[:2] for place in placed])
    assert 50 <= a < b < c <= 446
    assert 226 >= low > middle > high >= 14  # upwards
    assert (b - a == pytest.approx(c - b, abs=0.2)) is log


@pytest.mark.parametrize("points", [[(3.0, 5.0, "")], [(0.0, 0.0, "")], [(1.0, 2.0, ""), (2.0, 2.0, "")]])
def test_without_a_range_everything_stays_inside(points):
    drawn = chart("", "", [("", "dots", points)], ("x", "y"), mean=points[0][1])
    assert all(50 <= a <= 446 and 14 <= b <= 226 for _, _, of in drawn["series"] for a, b, _ in of)


@pytest.mark.parametrize(
    ("low", "high", "log"), [(29.4, 36.4, False), (2.0, 63.0, True), (2.0, 2.5, True), (1e-3, 1e5, True)]
)
def test_ticks_are_few_and_inside(low, high, log):
    ticks = Axis("", [low, high], (0, 100), 0.0001, log).ticks
    assert 2 <= len(ticks) <= 8
    assert 0.99 * low <= ticks[0] < ticks[-1] <= 1.01 * high


def test_sheets_are_named_for_what_they_are_among_all_views(tmp_path):
    folder = told_run(tmp_path, views=8)
    for number in (3, 5):
        write_png(folder / "images" / "sheets" / "test" / f"r_{number}.png", torch.rand(8, 32, 3))
    views = [(view.why, view.about.split(",")[0]) for view in media_of(read_story(folder)).views]
    assert views == [("best of 2 drawn", "test/r_5"), ("median", "test/r_3")]


@pytest.fixture(scope="module")
def run(fitted, tmp_path_factory):
    """A copy of the shared run, with a short film."""
    folder = shutil.copytree(fitted, tmp_path_factory.mktemp("runs") / "vehicle")
    write_video(folder / "videos" / "both.mp4", (noise(32, i) for i in range(3)), fps=10)
    return folder


@pytest.mark.slow
def test_the_command_renders_the_telling_views(ok, run, tmp_path):
    done = ok("report", "kind=run", f"run={run}", f"out={tmp_path}/shown.html")
    *told, written, link = done.out.strip().splitlines()
    assert link == f"file://{tmp_path}/shown.html"
    assert re.fullmatch(rf"written: {tmp_path}/shown.html: 0\.\d of at most 4 MB", written)
    assert told[0] == "why it is not better:"
    page = Page((tmp_path / "shown.html").read_text())
    names, labels = zip(*(alt.split(":")[0].split(", ") for alt in page.of("alt") if alt))
    assert {"best", "median", "worst"} <= set(labels)
    assert names[:4] == ("truth", "prediction", "error", "depth")
    assert (page.tags.count("video"), page.tags.count("svg")) == (1, 3)
    assert "voxels" in page.text
    # The same as data, and its worst views are shown: truth, prediction and error.
    data = json.loads((tmp_path / "shown.json").read_text())
    scores = {
        i["name"]: i["scores"]["psnr"] for i in json.loads((run / "per_image.json").read_text())["images"]
    }
    assert [view["name"] for view in data["worst"]] == sorted(scores, key=scores.get)
    assert all({"time", "psnr", "degrees", "gap"} <= view.keys() for view in data["worst"])
    assert [label for label in labels if label in scores] == [
        n for view in data["worst"] for n in [view["name"]] * 3
    ]
    assert data["views"] == len(scores)
    assert told[1].strip() == f"{data['findings'][0]['brings']:.1f} dB at most: " + " ".join(
        [data["findings"][0]["text"], f"Try {data['findings'][0]['try']} ({data['findings'][0]['advice']})."]
    )


@pytest.mark.slow
def test_a_run_without_rendering_data_or_its_end_still_has_a_page(ok, run, tmp_path):
    folder = shutil.copytree(run, tmp_path / "run")
    done = ok("report", "kind=run", f"run={folder}", f"data.root={tmp_path}/moved")
    line = done.out.splitlines()[0]
    assert line.startswith("Rendering for this page stopped: data.root: expected an existing folder")
    assert line in Page((folder / "page.html").read_text()).text
    config = yaml.safe_load((folder / "config.yaml").read_text())
    config["data"] |= {"_target_": "forewarp.synth.module.SyntheticDataModule", "root": f"{tmp_path}/gone"}
    config["data"]["synthesis"] = {"size": 16, "frames": 2}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    done = ok("report", "kind=run", f"run={folder}")  # a synthetic scene that is gone is not made again
    assert "data.root: expected the scene of the run, but got none in" in done.out
    assert not (tmp_path / "gone").exists()
    done = ok("report", "kind=run", f"run={folder}", "render=false")
    alts = " ".join(Page((folder / "page.html").read_text()).of("alt"))
    assert ("depth, " in alts, "prediction, best: " in alts) == (False, True)
    assert "error, test_space/r_000: one of the worst" in alts
    assert "Rendering" not in done.out
    for name in ("metrics.json", "per_image.json", "images", "fine/done.json"):
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    ok("report", "kind=run", f"run={folder}", f"out={tmp_path}/begun")
    page = Page((tmp_path / "begun" / "page.html").read_text())
    assert "forewarp-train resume=" in page.text
    assert "prediction, in training: stage fine at 100 %" in page.of("alt")


@pytest.mark.slow
def test_a_missing_video_is_made_as_forewarp_render_does(ok, run, tmp_path, monkeypatch):
    asked = []

    def film(config, run, module):
        asked.append((config.path, config.format, config.frames))
        return write_video(tmp_path / "made.mp4", (noise(16, i) for i in range(2)), fps=10)

    monkeypatch.setattr("forewarp.cli.report.write_film", film)
    for more in (["path=both"], ["path=orbit"]):
        ok("report", "kind=run", f"run={run}", f"out={tmp_path}", *more)
    assert asked == [("orbit", "mp4", None)]
    assert "Once around the scene at one time." in Page((tmp_path / "page.html").read_text()).text


@pytest.mark.slow
@pytest.mark.parametrize(
    ("error", "status", "says"),
    [
        (OSError(28, "No space left on device", "film.mp4"), 0, "stopped: film.mp4: expected room to write"),
        (KeyboardInterrupt(), 130, "Rendering for this page was interrupted."),
    ],
)
def test_what_was_rendered_before_an_error_or_an_interrupt_is_shown(
    forewarp, run, tmp_path, monkeypatch, error, status, says
):
    def fail(*_):
        raise error

    monkeypatch.setattr("forewarp.cli.report.write_film", fail)
    done = forewarp("report", "kind=run", f"run={run}", f"out={tmp_path}", "path=fixed")
    assert (done.status or 0) == status
    assert says in done.out
    page = Page((tmp_path / "page.html").read_text())
    assert says in page.text
    assert "depth, best: " in " ".join(page.of("alt"))
    assert "video" not in page.tags


@pytest.mark.slow
@pytest.mark.parametrize(("typed", "device"), [([], "cpu"), (["trainer=gpu"], "gpu")])
def test_a_run_keeps_its_trainer_unless_one_is_named(ok, run, tmp_path, monkeypatch, typed, device):
    seen = []

    def build(config):
        seen.append(config.trainer.accelerator)
        raise ValueError("enough")

    monkeypatch.setattr("forewarp.runs.fitted.build_run", build)
    ok("report", "kind=run", f"run={run}", f"out={tmp_path}", *typed)
    assert seen == [device]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ([], "run: expected the folder of a run, but got nothing; set run=runs/..."),
        (["run=[a,b]"], "[a,b]/config.yaml: expected the configuration of a run, but got none"),
        (["runs=a"], "run: expected the folder of a run, but got runs=; set run=<a run's folder>"),
        (["run=nowhere"], "nowhere/config.yaml: expected the configuration of a run, but got none"),
        (["run=several"], "but got several, which holds 2; choose one: several/ball/base-1.0-seed0, "),
        (["run=a", "megabytes=0.1"], "megabytes: expected a number in [0.3, 1000], but got 0.1"),
        (["run=a", "render=some"], "render: expected true or false, but got 'some'"),
        (
            ["run=a", "path=spiral"],
            "path: expected lean, stabilised, as_filmed, both, trajectories, swing, fixed, ",
        ),
    ],
)
def test_mistakes_end_in_one_line(refused, in_tmp, arguments, line):
    write_run("several")
    write_run("several", seed=1)
    assert line in refused("report", "kind=run", "out=out", *arguments)
    assert not (in_tmp / "out").exists()


@pytest.mark.parametrize("doubts", [["ended after 3 steps", NASTY], 7, None])
def test_what_is_doubted_about_a_run_stands_on_its_page(tmp_path, doubts):
    metrics = {"protocol": {"doubts": doubts}, "test": {"all": {"psnr": 20.0}}}
    page = write(told_run(tmp_path, metrics=metrics))
    assert ("ended after 3 steps; " + NASTY in page.text) == isinstance(doubts, list)
