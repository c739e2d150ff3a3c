"""The page of a run that nobody trained, and of a fitted one."""

import json
import re
import shutil
from html.parser import HTMLParser

import pytest
import torch
import yaml

from forewarp.drawing.files import write_video
from forewarp.report.run_files import View, read_story, telling
from forewarp.report.run_media import Media, Shown
from forewarp.report.run_page import write_run_page
from tests.support.runs_on_disk import write_run

NASTY = "<img src=x onerror=alert(1)>&\"'</script>"
KNOWN = """html head meta title style body main header section footer div span figure figcaption video
img input p label h1 h2 h3 b i small dl dt dd ul li code pre svg g line text circle polyline details
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
    config = {"stage": {"coarse": {"share": 1.0}}, "model": {"name": "forward", "motion": "dct"}} | (
        config or {}
    )
    folder = write_run(root, config=config, metrics=metrics, **more)
    rows = [
        {"name": f"test/r_{i}", "time": i / max(views - 1, 1), "ability": "all", "scores": {"psnr": 20.0 + i}}
        for i in range(views)
    ]
    if views:
        (folder / "per_image.json").write_text(json.dumps({"images": rows}))
    if plan is not None:
        (folder / "plan.yaml").write_text(yaml.safe_dump(plan))
    return folder


def write(folder, media=None, megabytes=4.0):
    """The page of a run's folder, read back."""
    file = folder / "page.html"
    size = write_run_page(file, read_story(folder), media or Media(), megabytes=megabytes)
    assert size == file.stat().st_size <= 1e6 * megabytes
    return Page(file.read_text())


def noise(side, seed=0):
    return torch.rand(side, side, 3, generator=torch.Generator().manual_seed(seed))


def shown(why="best", side=64, about="test/r_0, time 0.00, 20.0 dB"):
    names = ("truth", "prediction", "error", "depth")
    return Shown(why, about, {name: noise(side, i) for i, name in enumerate(names)})


def test_the_page_tells_what_the_run_is(tmp_path):
    effects = {"motion": {"choice": "dct", "on": True, "because": "trial +4.0 dB"}}
    effects["view"] = {"choice": "none", "on": False, "because": "trial +0.1 dB"}
    folder = told_run(
        tmp_path,
        psnr=31.25,
        plan={"effects": effects, "seconds": 65.0},
        metrics={"effects": {"motion": True, "view": False, "extra": True}},
        command="forewarp-train data.scene=ball",
    )
    page = write(folder, Media([shown()]))
    expected = ["ball", "forward, preset fast", "31.25 dB", "0:50 min", "1.00 GiB", "a cpu", "2,000,000"]
    expected += ["forewarp-train data.scene=ball", "trial +4.0 dB", "in 1:05", "off view trial +0.1 dB"]
    expected += ["on extra", "22.0 dB", "test/r_2", "25.5 dB after 40 s"]
    assert [one for one in expected if one not in page.text] == []
    assert page.tags.count("svg") == 3  # no events of a loss
    assert all(value.startswith("data:") for value in page.of("src"))
    assert page.of("href") == []
    assert all(alt is not None for alt in page.of("alt"))
    assert page.tags.count("img") == len(page.of("alt")) == 5


def test_what_a_file_says_is_text_and_never_markup(tmp_path):
    effects = {NASTY: {"choice": NASTY, "on": True, "because": NASTY}}
    folder = told_run(
        tmp_path,
        config={"data": {"scene": NASTY}, "preset": {"name": NASTY}},
        command=f"forewarp-train {NASTY}",
        plan={"effects": effects},
        metrics={"protocol": {"device": NASTY, "dataset": NASTY}, "test": {NASTY: {NASTY: 1.0}}},
    )
    rows = [{"name": NASTY, "time": 0, "ability": NASTY, "scores": {"psnr": 20.0, NASTY: 1}}]
    (folder / "per_image.json").write_text(json.dumps({"images": rows}))
    page = write(folder, Media([shown(NASTY, about=NASTY)], missing=[NASTY]))
    assert set(page.tags) <= set(KNOWN.split())
    assert page.tags.count("script") == 1
    assert [key for _, key, _ in page.attributes if key.startswith("on")] == []
    assert all(value.startswith("data:") for value in page.of("src"))
    assert page.text.count(NASTY) > 10


@pytest.mark.parametrize(
    ("more", "says", "absent"),
    [
        ({"psnr": None, "views": 0}, "The run is not measured", "dB PSNR"),
        ({"curve": None}, "No PSNR against training time", "PSNR while it learned"),
        ({"views": 0}, "PSNR while it learned", "Through the scene's time"),
        ({"views": 1}, "Through the scene's time", "What this page lacks"),
        ({}, "No plan was made", "Truth against prediction"),
        (
            {"config": {"stage": {"coarse": {}, "fine": {}}}},
            "of its stages fine has not ended",
            "forewarp-view",
        ),
    ],
)
def test_what_is_missing_is_said_and_left_out(tmp_path, more, says, absent):
    page = write(told_run(tmp_path, **({"metrics": {"effects": {"motion": True}}} | more)))
    assert says in page.text
    assert absent not in page.text


def test_an_unplanned_effect_names_what_was_typed(tmp_path):
    command = "forewarp-train ablation=full model/motion=dct"
    folder = told_run(tmp_path, command=command, metrics={"effects": {"motion": True, "view": False}})
    text = write(folder).text
    assert "on motion dct Typed: model/motion=dct." in text
    assert "off view As model=forward has it with ablation=full." in text


def test_pictures_and_video_are_made_smaller_until_the_page_fits(tmp_path):
    folder = told_run(tmp_path)
    film = write_video(tmp_path / "film.mp4", (noise(160, i) for i in range(20)), fps=10)
    media = Media([shown("best", 300), shown("worst", 300)], film, "once around")
    large, small = write(folder, media, 40), write(folder, media, 0.35)
    assert "Pictures are JPEG of quality 92." in large.text
    assert "Once around." in large.text
    assert re.search(r"Pictures are JPEG of quality \d+, scaled from 300 to \d+ pixels", small.text)
    assert "encoded again with more loss" in small.text or "The video is left out" in small.text
    assert {value.split(";")[0] for value in large.of("src")} == {"data:image/jpeg", "data:video/mp4"}
    with pytest.raises(
        ValueError, match="megabytes: expected room for the page's text, 0.0.*but got 0.01; raise it"
    ):
        write(folder, media, 0.01)


@pytest.mark.parametrize(
    ("file", "content", "says"),
    [
        ("metrics.json", '{"test": {}}', "no key 'seconds'"),
        ("per_image.json", '{"images": [{"name": "a"}]}', "no key 'scores'"),
        ("config.yaml", "a: [", "expected a run whose files can be read"),
        ("plan.yaml", "effects: {motion: {choice: x}}", "no key 'on'"),
    ],
)
def test_a_broken_file_ends_in_one_line(tmp_path, file, content, says):
    folder = told_run(tmp_path)
    (folder / file).write_text(content)
    with pytest.raises(ValueError, match="^run: expected a run whose files can be read, but got") as caught:
        read_story(folder)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_losses_are_against_the_clock_of_training(fitted):
    story = read_story(fitted)
    ends = [points[-1][0] for points in story.curves.loss.values()]
    spent = [done["seconds"] for done in story.result.stages.values()]
    assert list(story.curves.loss) == ["coarse", "fine"]
    assert ends == pytest.approx([spent[0], sum(spent)], rel=1e-3)
    (kind, count), rows = story.curves.size, (fitted / "accuracy_time.csv").read_text().split()
    assert kind == "voxels"
    assert rows[-1].endswith(f",{count}")


def test_one_view_is_the_best_of_all():
    assert telling([View("a", 0.5, "all", 30.0, {})]) == {"a": "best"}
    assert telling([]) == {}


@pytest.fixture(scope="module")
def run(fitted, tmp_path_factory):
    """A copy of the shared run, with a short film."""
    folder = shutil.copytree(fitted, tmp_path_factory.mktemp("runs") / "vehicle")
    write_video(folder / "videos" / "both.mp4", (noise(32, i) for i in range(3)), fps=10)
    return folder


def test_the_command_renders_the_telling_views(ok, run, tmp_path):
    done = ok("report", "kind=run", f"run={run}", f"out={tmp_path}/shown.html")
    assert re.fullmatch(rf"written: {tmp_path}/shown.html: 0\.\d of at most 4 MB", done.out.strip())
    page = Page((tmp_path / "shown.html").read_text())
    labels = [alt.split(" of the ")[1].split(" view")[0] for alt in page.of("alt") if alt]
    names = [alt.split()[0] for alt in page.of("alt") if alt]
    assert {"best", "median", "worst"} <= set(labels)
    assert names[:4] == ["truth", "prediction", "error", "depth"]
    assert page.tags.count("video") == 1
    assert page.tags.count("svg") == 4
    assert "voxels" in page.text


def test_without_rendering_the_page_has_what_the_folder_has(ok, run, tmp_path):
    folder = shutil.copytree(run, tmp_path / "run")
    shutil.rmtree(folder / "fine" / "images")
    done = ok("report", "kind=run", f"run={folder}", "render=false")
    page = Page((folder / "page.html").read_text())
    assert "depth of the best view" not in " ".join(alt for alt in page.of("alt") if alt)
    assert "prediction of the best view" in " ".join(page.of("alt"))
    assert done.out.count("\n") == 1


def test_a_run_without_its_data_or_its_end_still_has_a_page(ok, run, tmp_path):
    folder = shutil.copytree(run, tmp_path / "run")
    done = ok("report", "kind=run", f"run={folder}", f"data.root={tmp_path}/moved")
    line = done.out.splitlines()[0]
    assert line.startswith("Rendering for this page stopped: data.root: expected an existing folder")
    assert line in Page((folder / "page.html").read_text()).text
    for name in ("metrics.json", "per_image.json", "images", "fine/done.json"):
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    ok("report", "kind=run", f"run={folder}", f"out={tmp_path}/begun")
    page = Page((tmp_path / "begun" / "page.html").read_text())
    assert "forewarp-train resume=" in page.text
    assert "prediction of the in training view: stage fine, 100 % of it" in page.of("alt")


def test_a_missing_video_is_made_as_forewarp_render_does(ok, run, tmp_path, monkeypatch):
    asked = []

    def film(config, run, module):
        asked.append((config.path, config.format, config.frames))
        return write_video(tmp_path / "made.mp4", (noise(16, i) for i in range(2)), fps=10)

    monkeypatch.setattr("forewarp.cli.run_page.write_film", film)
    for more in (["path=both"], ["path=orbit"]):
        ok("report", "kind=run", f"run={run}", f"out={tmp_path}", *more)
    assert asked == [("orbit", "mp4", 60)]
    assert "Once around the scene at one time." in Page((tmp_path / "page.html").read_text()).text


def test_what_was_rendered_before_an_error_is_shown(ok, run, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device", "film.mp4")

    monkeypatch.setattr("forewarp.cli.run_page.write_film", full)
    done = ok("report", "kind=run", f"run={run}", f"out={tmp_path}", "path=fixed")
    assert done.out.startswith("Rendering for this page stopped: film.mp4: expected room to write")
    page = Page((tmp_path / "page.html").read_text())
    assert "depth of the best view" in " ".join(page.of("alt"))
    assert "video" not in page.tags


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ([], "run: expected the folder of a run, but got nothing; set run=runs/..."),
        (["run=[a,b]"], "run: expected the folder of one run, but got 2"),
        (["runs=a"], "run: expected the folder of a run, but got runs=; set run=<a run's folder>"),
        (["run=nowhere"], "nowhere/config.yaml: expected the configuration of a run, but got none"),
        (["run=several"], "but got several, which holds 2; choose one: several/ball/base-1.0-seed0, "),
        (["run=a", "megabytes=0.1"], "megabytes: expected a number from 0.3 to 1000, but got 0.1"),
        (["run=a", "render=some"], "render: expected true or false, but got some"),
        (["run=a", "path=spiral"], "path: expected one of both, trajectories, fixed, orbit or null, but got"),
    ],
)
def test_mistakes_end_in_one_line(refused, in_tmp, arguments, line):
    write_run("several")
    write_run("several", seed=1)
    assert line in refused("report", "kind=run", "out=out", *arguments)
    assert not (in_tmp / "out").exists()
