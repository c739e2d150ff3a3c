"""The page of a run that nobody trained, and of a fitted one."""

import json
import re
import shutil
from html.parser import HTMLParser

import pytest
import torch
import yaml

from forewarp.drawing.files import write_png, write_video
from forewarp.report.run_page import Media, Shown, media_of, read_story, telling, write_run_page
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
    expected = ["ball", "forward, preset fast", "31.25 dB", "training 0:50", "1.00 GiB", "a cpu", "2,000,000"]
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
        ({"metrics": {"effects": None}}, "No effects: neither a plan nor metrics.json", "Effects, and why"),
        ({"metrics": {"test": {"all": {"psnr": 20.0, "lpips_vgg": None}}}}, "LPIPS (vgg)", "None"),
        ({"curve": None}, "No PSNR against training time", "PSNR while it learned"),
        ({"views": 0}, "No PSNR by view and through the scene's time", "view, from worst to best"),
        ({"views": 1}, "Through the scene's time", "No PSNR by view"),
        ({}, "No loss: the folders of the stages have no TensorBoard events", "Loss against training time"),
        ({}, "No pictures: the run's folder has none", "Pictures are"),
        ({}, "No video: the run's folder has none", "Video:"),
        ({}, "No plan was made", "Truth against prediction"),
        (
            {"config": {"stage": {"coarse": {}, "fine": {}}}},
            "of its stages fine has not ended (finished: coarse; trained for 0:50). It goes on with",
            "forewarp-view",
        ),
        ({"config": {"stage": {"a": {}, "b": {}}}}, "of its stages a, b have not ended", "forewarp-view"),
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
        (
            "config.yaml",
            "{data: {scene: a}, model: {name: b}, preset: null, seed: 0, budget: {}}",
            "not subscriptable",
        ),
        ("coarse/done.json", '{"steps": 3}', "no key 'seconds'"),
    ],
)
def test_a_broken_file_ends_in_one_line(tmp_path, file, content, says):
    folder = told_run(tmp_path)
    (folder / file).write_text(content)
    with pytest.raises(
        ValueError, match="^run: expected a run whose files can be (read|shown), but"
    ) as caught:
        write(folder)
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_losses_are_against_the_clock_of_training(fitted):
    row = read_story(fitted)
    ends = [points[-1][0] for points in row["loss"].values()]
    spent = [done["seconds"] for done in row["stages"].values()]
    assert list(row["loss"]) == ["coarse", "fine"]
    assert ends == pytest.approx([spent[0], sum(spent)], rel=1e-3)
    (kind, count), rows = row["consists"], (fitted / "accuracy_time.csv").read_text().split()
    assert kind == "voxels"
    assert rows[-1].endswith(f",{count}")


def test_one_view_is_the_best_of_all():
    views = [{"name": "a", "time": 0.5, "psnr": 30.0}, {"name": "b", "time": 0.6, "psnr": 20.0}]
    assert telling(views[:1]) == {"a": "best"}
    assert telling([]) == {}
    assert telling(views) == {"a": "best", "b": "worst"}


@pytest.mark.parametrize(("count", "name"), [(5, "r"), (5, "r" * 120), (1, "r")])
def test_the_markup_of_the_views_is_within_the_limit(tmp_path, count, name):
    folder = told_run(tmp_path)
    media = Media([shown(f"view {i}", about=f"{name}, 20.0 dB") for i in range(count)])
    write(folder, media)
    whole = (folder / "page.html").stat().st_size
    assert write(folder, media, (whole - 1) / 1e6).tags.count("img") == 5 * count  # smaller, none left out
    write(folder, media, (whole - 1000) / 1e6)


def test_pictures_rendered_smaller_than_the_view_are_said_to_be(tmp_path):
    view = Shown("best", "r_0, 20.0 dB", shown().pictures, side=1600)
    assert "quality 92, scaled from 1600 to 800 pixels" in write(told_run(tmp_path), Media([view])).text


def test_words_are_of_all_views_where_only_some_are_drawn(tmp_path):
    folder = told_run(tmp_path, views=1500)
    rows = json.loads((folder / "per_image.json").read_text())
    rows["images"][1]["scores"]["psnr"] = 3.0
    (folder / "per_image.json").write_text(json.dumps(rows))
    page = write(folder)
    assert len(re.findall(r" (?:3\d\d|40\d) of the 1500 views are drawn", page.text)) == 2
    assert page.text.count("time 0.001: 3.00 dB") == 2
    assert "The lowest, 3.0 dB, is test/r_1 at" in page.text
    assert "of 1500 are more than 1 dB below it" in page.text
    assert "The first 1000 of 1500 views" in page.text
    assert page.tags.count("tr") < 1010


def test_numbers_that_are_none_are_left_out(tmp_path):
    folder = told_run(tmp_path, curve=((10, 20.0), (20, "nan"), (40, 25.5), (50, "inf")))
    rows = json.loads((folder / "per_image.json").read_text())
    rows["images"][0]["scores"] |= {"psnr": float("nan")}
    rows["images"][1]["scores"] |= {"ssim": None}
    (folder / "per_image.json").write_text(json.dumps(rows))
    page = write(folder)
    assert "25.5 dB after 40 s" in page.text
    assert "Every test view (2)" in page.text
    assert "nan" not in page.text
    assert "inf" not in page.text


def test_folders_are_relative_to_the_current_one_and_quoted(in_tmp):
    folder = told_run(in_tmp / "my runs", command=f"forewarp-train data.root={in_tmp}/data run=a")
    page = write(folder)
    assert "forewarp-train data.root=data run=a" in page.text
    assert "forewarp-view run='my runs/ball/base-1.0-seed0'" in page.text
    assert str(in_tmp) not in page.text


def test_an_option_that_says_nothing_by_itself_is_not_shown(tmp_path):
    config = {"model": {"name": "forward", "motion": "dct", "codes": 2, "view": True}}
    effects = dict.fromkeys(("motion", "codes", "view"), True)
    text = write(told_run(tmp_path, config=config, metrics={"effects": effects})).text
    assert [f"on {one} As" in text for one in ("motion dct", "codes", "view")] == [True] * 3


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
    names, labels = zip(*(alt.split(":")[0].split(", ") for alt in page.of("alt") if alt))
    assert {"best", "median", "worst"} <= set(labels)
    assert names[:4] == ("truth", "prediction", "error", "depth")
    assert page.tags.count("video") == 1
    assert page.tags.count("svg") == 4
    assert "voxels" in page.text


def test_without_rendering_the_page_has_what_the_folder_has(ok, run, tmp_path):
    folder = shutil.copytree(run, tmp_path / "run")
    shutil.rmtree(folder / "fine" / "images")
    done = ok("report", "kind=run", f"run={folder}", "render=false")
    page = Page((folder / "page.html").read_text())
    assert "depth, " not in " ".join(page.of("alt"))
    assert "prediction, best: " in " ".join(page.of("alt"))
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
    assert "prediction, in training: stage fine at 100 %" in page.of("alt")


def test_a_missing_video_is_made_as_forewarp_render_does(ok, run, tmp_path, monkeypatch):
    asked = []

    def film(config, run, module):
        asked.append((config.path, config.format, config.frames))
        return write_video(tmp_path / "made.mp4", (noise(16, i) for i in range(2)), fps=10)

    monkeypatch.setattr("forewarp.cli.report.write_film", film)
    for more in (["path=both"], ["path=orbit"]):
        ok("report", "kind=run", f"run={run}", f"out={tmp_path}", *more)
    assert asked == [("orbit", "mp4", 60)]
    assert "Once around the scene at one time." in Page((tmp_path / "page.html").read_text()).text


def test_what_was_rendered_before_an_error_is_shown(ok, run, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device", "film.mp4")

    monkeypatch.setattr("forewarp.cli.report.write_film", full)
    done = ok("report", "kind=run", f"run={run}", f"out={tmp_path}", "path=fixed")
    assert done.out.startswith("Rendering for this page stopped: film.mp4: expected room to write")
    page = Page((tmp_path / "page.html").read_text())
    assert "depth, best: " in " ".join(page.of("alt"))
    assert "video" not in page.tags


def test_after_an_interrupt_the_page_has_what_was_rendered(forewarp, run, tmp_path, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("forewarp.cli.report.write_film", interrupted)
    done = forewarp("report", "kind=run", f"run={run}", f"out={tmp_path}", "path=fixed")
    assert done.status == 130
    page = Page((tmp_path / "page.html").read_text())
    assert "depth, best: " in " ".join(page.of("alt"))
    assert "Rendering for this page was interrupted." in page.text


def test_sheets_are_named_for_what_they_are_among_all_views(tmp_path):
    folder = told_run(tmp_path, views=8)
    for number in (3, 5):
        write_png(folder / "images" / "sheets" / "test" / f"r_{number}.png", torch.rand(8, 32, 3))
    views = media_of(read_story(folder)).views
    assert [(one.why, one.about.split(",")[0]) for one in views] == [
        ("best of 2 drawn", "test/r_5"),
        ("median", "test/r_3"),
    ]


@pytest.mark.parametrize(("typed", "device"), [([], "cpu"), (["trainer=gpu"], "gpu")])
def test_a_run_keeps_its_trainer_unless_one_is_named(ok, run, tmp_path, monkeypatch, typed, device):
    seen = []

    def build(config):
        seen.append(config.trainer.accelerator)
        raise ValueError("enough")

    monkeypatch.setattr("forewarp.runs.build.build_run", build)
    ok("report", "kind=run", f"run={run}", f"out={tmp_path}", *typed)
    assert seen == [device]


def test_a_synthetic_scene_that_is_gone_is_not_made_again(ok, run, tmp_path):
    folder = shutil.copytree(run, tmp_path / "run")
    config = yaml.safe_load((folder / "config.yaml").read_text())
    config["data"] |= {"_target_": "forewarp.synth.module.SyntheticDataModule", "root": f"{tmp_path}/gone"}
    config["data"]["synthesis"] = {"size": 16, "frames": 2}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    done = ok("report", "kind=run", f"run={folder}")
    assert "data.root: expected the scene of the run, but got none in" in done.out
    assert not (tmp_path / "gone").exists()


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
        (
            ["run=a", "path=spiral"],
            "path: expected one of both, trajectories, swing, fixed, orbit or null, but got",
        ),
    ],
)
def test_mistakes_end_in_one_line(refused, in_tmp, arguments, line):
    write_run("several")
    write_run("several", seed=1)
    assert line in refused("report", "kind=run", "out=out", *arguments)
    assert not (in_tmp / "out").exists()
