"""forewarp-open as people call it; the commands that it calls are tested beside it."""

import json
import os
from pathlib import Path
from types import SimpleNamespace

import pytest
from omegaconf import OmegaConf

pytest.importorskip("pycolmap", reason="no pycolmap; make install adds it")

from forewarp.cli import open as opening
from forewarp.cli.open import check, not_done, open_page
from forewarp.data.posed_video import read_scene
from forewarp.runs.fitted import open_file
from tests.support.captures import hand_film
from tests.support.configs import CONF


def config_of(*words):
    return OmegaConf.merge(OmegaConf.load(CONF / "open.yaml"), OmegaConf.from_dotlist(words))


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ([], "video: expected the file of a clip, but got none; type forewarp-open CLIP.mp4"),
        (["video=none.mp4"], "video: expected an existing film, but got none: none.mp4"),
        (
            ["video=empty"],
            "video: expected an existing film, but got a folder: empty; forewarp-capture takes",
        ),
        (["video=a.r3d"], "video: expected a film, but got a scan: a.r3d; type forewarp-capture"),
        (["video=a.mp4", "quality=high"], "quality: expected draft, good or best, but got 'high'"),
        (["video=a.mp4", "preset=compact"], "preset: expected demo, fast or faithful, but got 'compact'"),
        (["video=a.mp4", "budget.minutes=0"], "budget.minutes: expected a number .* but got 0"),
        (["video=a.mp4", "budget.clock=sun"], "budget.clock: expected wall or processor, but got 'sun'"),
        (["video=a.mp4", "browser=maybe"], "browser: expected true or false, but got 'maybe'"),
    ],
)
def test_mistakes_end_before_anything_is_loaded(in_tmp, words, says):
    (in_tmp / "empty").mkdir()
    for name in ("a.mp4", "a.r3d"):
        (in_tmp / name).touch()
    with pytest.raises(ValueError, match=says):
        check(config_of(*words))


@pytest.mark.parametrize(
    ("words", "preset", "minutes"),
    [
        ([], "fast", 5),
        (["quality=draft"], "demo", 1),
        (["quality=best"], "faithful", 20),
        (["quality=best", "budget.minutes=2"], "faithful", 2),
        (["preset=demo"], "demo", 5),
    ],
)
def test_a_quality_stands_for_a_preset_and_minutes_which_win(in_tmp, words, preset, minutes):
    (in_tmp / "a.mp4").touch()
    assert check(config_of("video=a.mp4", *words)) == (Path("a.mp4"), Path("opened/a"), preset, minutes)


@pytest.fixture
def commands(monkeypatch):
    """The commands that are called, each of which writes its file at once."""
    called, pages = [], []

    def call(name, task, words):
        called.append((name, words))
        if stops == [name]:
            raise KeyboardInterrupt
        part = next(part for part in listed[-1] if part.command == name)
        part.file.parent.mkdir(parents=True, exist_ok=True)
        scores = {"all": {"psnr": 22.14}, "moving": {"psnr": 20.41}, "still": {"psnr": 23.6}}
        part.file.write_text(json.dumps({"test": scores, "trust": {"degrees": 9.1}}))
        print(f"said by {name}")

    def parts_of(*given):
        listed.append(made(*given))
        return listed[-1]

    stops, listed, made = [], [], opening.parts_of
    monkeypatch.setattr(opening, "run_part", call)
    monkeypatch.setattr(opening, "parts_of", parts_of)
    monkeypatch.setattr(opening, "open_page", lambda address, wanted: pages.append((address, wanted)))
    return SimpleNamespace(called=called, stops=stops, pages=pages)


def test_one_command_calls_all_others_and_says_in_a_users_words_what_came_of_it(ok, in_tmp, commands):
    (in_tmp / "my clip.mp4").touch()
    done = ok("open", "my clip.mp4", "quality=draft")
    names = ["capture", "train", "render", "export", "report"]
    assert [name for name, _ in commands.called] == names
    train = commands.called[1][1]
    run = "opened/my clip/runs/demo-1-minutes-seed0"
    for word in ("data.root=opened/my clip/data", f"run={run}", "preset=demo", "budget.minutes=1"):
        assert word in train
    out = in_tmp / "opened" / "my clip"
    link = out.as_uri()
    assert done.out.splitlines() == [
        "my clip: 22.1 dB on frames that training did not see (20.4 where it moves, 23.6 where it rests)",
        "good up to 9 degrees beside where it was filmed",
        *(f"{name}  {link}/{file}" for name, file in opening.RESULTS.items()),
        "fly around it:",
        f"  forewarp-view 'run={run}'",
        "longer, and better:",
        "  forewarp-open 'my clip.mp4' quality=good",
    ]
    assert {"page.html", "film.mp4", "scene.glb"} < {path.name for path in out.iterdir()}
    assert (out / "log.txt").read_text().split("\n")[:-1] == [f"said by {name}" for name in names]
    (_, _), (page, wanted) = commands.pages
    assert (page, wanted) == (f"{link}/page.html", True)
    assert "see it train: http://127.0.0.1:" in done.err


@pytest.mark.slow
def test_the_same_command_goes_on_and_another_quality_trains_alone_anew(
    forewarp, ok, refused, in_tmp, commands
):
    (in_tmp / "a.mp4").touch()
    commands.stops.append("render")
    done = forewarp("open", "a.mp4")
    assert done.status == 130
    assert "interrupted; run the same command again to go on" in done.err
    commands.stops.clear()
    commands.called.clear()
    ok("open", "a.mp4")
    assert [name for name, _ in commands.called] == ["render", "export", "report"]
    commands.called.clear()
    assert "22.1 dB" in ok("open", "a.mp4").out
    assert commands.called == []
    ok("open", "a.mp4", "quality=best")
    assert [name for name, _ in commands.called] == ["train", "render", "export", "report"]
    (in_tmp / "a.mp4").write_text("another film")
    assert "opened/a: expected a folder of a.mp4, but got one of " in refused("open", "a.mp4")
    (in_tmp / "theirs").mkdir()
    (in_tmp / "theirs" / "file").touch()
    assert "theirs: expected a new folder, or one of this clip" in refused("open", "a.mp4", "out=theirs")


@pytest.mark.slow
def test_what_fails_ends_the_command_with_its_line(forewarp, in_tmp):
    (in_tmp / "a.mp4").write_bytes(b"no film")
    done = forewarp("open", "a.mp4", "browser=false")
    assert done.status == 2
    assert done.err.splitlines()[-1].startswith("forewarp-capture: error: a.mp4: expected a video")


def test_what_is_older_than_the_part_before_is_done_anew(tmp_path):
    parts = [opening.Part(name, 1.0, tmp_path / name, name, print, []) for name in "abcd"]
    for at, part in enumerate(parts[:3]):
        part.file.touch()
        os.utime(part.file, (at, at))
    assert list(not_done(parts)) == ["d"]
    os.utime(parts[0].file, (9, 9))
    assert list(not_done(parts)) == ["b", "c", "d"]


@pytest.mark.parametrize(("screen", "wanted", "opened"), [(":0", True, 1), (":0", False, 0), (None, True, 0)])
def test_a_page_is_opened_where_there_is_a_screen(monkeypatch, screen, wanted, opened):
    pages = []
    monkeypatch.setattr(opening.sys, "platform", "linux")
    monkeypatch.setattr(opening.webbrowser, "open", pages.append)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", screen) if screen else monkeypatch.delenv("DISPLAY", raising=False)
    open_page("file:///a", wanted)
    assert len(pages) == opened


@pytest.mark.slow
def test_a_clip_becomes_a_page_a_film_and_a_scene_also_when_interrupted(forewarp, ok, in_tmp, monkeypatch):
    hand_film(in_tmp / "hand.mp4", count=14)
    words = ["hand.mp4", "budget.minutes=0.05", "threads=1", "browser=false"]
    run_part = opening.run_part

    def stop_at_film(name, task, typed):
        if name == "render":
            raise KeyboardInterrupt
        run_part(name, task, typed)

    with monkeypatch.context() as patch:
        patch.setattr(opening, "run_part", stop_at_film)
        assert forewarp("open", *words).status == 130
    done = ok("open", *words)
    assert not {"cameras", "training"} & set(done.err.split())
    out = in_tmp / "opened" / "hand"
    assert "<html" in (out / "page.html").read_text()[:500]
    assert (out / "film.mp4").stat().st_size > 1000
    frames = read_scene(out / "data", "hand").train
    assert open_file(out / "scene.glb").render(frames[0].camera, 0.5).rgb.shape == (180, 240, 3)
    assert f"page  {(out / 'page.html').as_uri()}" in done.out
