"""``forewarp-report kind=run``: gather what the page of a run shows, and write it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from omegaconf import DictConfig, ListConfig, OmegaConf

from forewarp.cli.mistakes import one_line
from forewarp.cli.render import check, write_film
from forewarp.report.run_files import WHYS, Story, read_story, telling
from forewarp.runs.config_files import project_root

PAGE = "page.html"
MEGABYTES = 0.3, 1000  # least and most that may be asked for
MOST_SIDE = 800  # pixels of a picture's longer side
# Videos in the order in which one of a folder is taken.
FILMS = {
    "both": "once around the scene while its time passes",
    "trajectories": "one camera, with the paths of points on the moving surface",
    "swing": "to and fro between the training cameras while the scene's time passes",
    "fixed": "one camera, through the scene's time",
    "orbit": "once around the scene at one time",
}


def run_page(config: DictConfig) -> str:
    """Write the page of the run that ``config.run`` names; return what to print.

    After Ctrl-C while pictures or the video are made, the page has those that there are.

    Raises:
        ValueError: in one line, if ``config.run`` is not one run's folder, or a setting is wrong.
    """
    folder = named(config)
    story = read_story(folder)
    file = Path(config.out or folder)
    file = file if file.suffix in (".html", ".htm") else file / PAGE
    # These load torch; mistakes have been answered before.
    from forewarp.report.run_media import Media
    from forewarp.report.run_page import room_of, write_run_page

    def written() -> str:
        size = write_run_page(file, story, media, megabytes=float(config.megabytes))
        told = [*media.missing, f"written: {file}: {size / 1e6:.1f} of at most {config.megabytes:g} MB"]
        return "\n".join(told)

    media = Media(told_views(story), *newest_film(config, story))
    room_of(story, media, float(config.megabytes))  # refuses before minutes of rendering
    try:
        for more in gathered(config, story, media):
            media = more
    except KeyboardInterrupt:
        media = replace(media, missing=("Rendering for this page was interrupted.",))
        print(written())
        raise
    return written()


def named(config: DictConfig) -> Path:
    """Return the run's folder; refuse settings of which no page can be made."""
    low, high = MEGABYTES
    if type(config.megabytes) not in (int, float) or not low <= config.megabytes <= high:
        raise ValueError(f"megabytes: expected a number from {low} to {high}, but got {config.megabytes}")
    if type(config.render) is not bool:
        raise ValueError(f"render: expected true or false, but got {config.render}")
    if config.path not in (None, *FILMS):
        raise ValueError(f"path: expected one of {', '.join(FILMS)} or null, but got '{config.path}'")
    if config.run is None and config.runs is not None:
        raise ValueError("run: expected the folder of a run, but got runs=; set run=<a run's folder>")
    if config.run is None:
        raise ValueError("run: expected the folder of a run, but got nothing; set run=runs/...")
    if isinstance(config.run, ListConfig):
        raise ValueError(
            f"run: expected the folder of one run, but got {len(config.run)}; a page shows one run, and "
            "kind=compare several"
        )
    return Path(str(config.run))


def gathered(config: DictConfig, story: Story, media) -> Iterator:
    """Give the page's media after each part that is made; what cannot be made is told, and left out."""
    if not config.render or story.unfinished:
        return
    try:
        for more in rendered(config, story, media):
            yield (media := more)
    except Exception as error:
        reason = one_line(error)
        if reason is None:
            raise
        yield replace(media, missing=(f"Rendering for this page stopped: {reason}.",))


def rendered(config: DictConfig, story: Story, media) -> Iterator:
    """Render the telling views, and the video if the run has none; give what there is after each."""
    from forewarp.evaluation.images import parts_of
    from forewarp.report.run_media import Shown
    from forewarp.runs.config import saved_config
    from forewarp.runs.fitted import opened

    saved = saved_config(str(story.result.folder), config)
    refuse_to_synthesize(saved)
    run, module = opened(saved)
    targets = run.datamodule.targets("test")
    places = {frame.name: number for number, frame in enumerate(targets.frames)}
    views = []
    for name, why in telling(story.views).items():
        if name in places:
            camera = targets.frames[places[name]].camera
            parts = parts_of(module, targets[places[name]], MOST_SIDE)
            views.append(Shown(why, about(story, name), parts, max(camera.width, camera.height)))
    media = replace(media, views=views or media.views)
    yield media
    if media.video is not None:
        return
    if not len(targets):
        yield replace(media, missing=("No video: the scene has no test view to begin it from.",))
        return
    film = OmegaConf.load(project_root() / "conf" / "render.yaml")
    film.path = config.path or ("both" if story.result.config.get("capture") == "cut_out" else "swing")
    check(film)
    yield replace(media, video=write_film(film, run, module), about=FILMS[film.path])


def refuse_to_synthesize(saved: DictConfig) -> None:
    """Refuse a synthetic scene that is not there: reading it would make it, and a page writes no data.

    Raises:
        ValueError: naming the scene's folder.
    """
    from forewarp.runs.build import build_run
    from forewarp.synth.module import Synthetic, is_scene

    data = build_run(saved).datamodule
    if isinstance(data, Synthetic) and not is_scene(data.folder):
        raise ValueError(
            f"data.root: expected the scene of the run, but got none in {data.folder}; set data.root=FOLDER"
        )


def newest_film(config: DictConfig, story: Story) -> tuple[Path | None, str]:
    """Return a video in the folder that was made after training, and what it shows; None without one."""
    done = [path.stat().st_mtime_ns for path in story.result.folder.glob("*/done.json")]
    for name in [config.path] if config.path else FILMS:
        file = story.result.folder / "videos" / f"{name}.mp4"
        if file.is_file() and file.stat().st_mtime_ns >= max(done, default=0):
            return file, FILMS[name]
    return None, ""


def told_views(story: Story) -> list:
    """Return what the folder has of truth, prediction and error: of test views, or as training drew them.

    Of the telling views those that have a sheet; then others, named for what they are among those with one.
    """
    from forewarp.drawing.files import read_image
    from forewarp.report.run_media import Shown
    from forewarp.report.sheets import sheets_of, thirds

    folder, names = story.result.folder, ("truth", "prediction", "error")
    sheets = sheets_of(folder)
    chosen = {name: why for name, why in telling(story.views).items() if name in sheets}
    drawn = [view for view in story.views if view.name in sheets]
    chosen |= {
        name: f"{why} of {len(drawn)} drawn" for name, why in telling(drawn).items() if name not in chosen
    }
    shown = [
        Shown(why, about(story, name), dict(zip(names, thirds(read_image(sheets[name])))))
        for name, why in sorted(chosen.items(), key=lambda one: WHYS.index(one[1].split()[0]))
    ]
    if shown:
        return shown
    stages = [*story.result.config.get("stage", {})]
    drawn = sorted(
        (path for path in folder.glob("*/images/*_compare.png") if path.parts[-3] in stages),
        key=lambda path: (stages.index(path.parts[-3]), path.name),
    )
    return [
        Shown(
            "in training",
            f"stage {path.parts[-3]} at {int(path.stem.split('_')[0])} %",
            dict(zip(names, thirds(read_image(path)))),
        )
        for path in drawn[-1:]
    ]


def about(story: Story, name: str) -> str:
    """Say which view it is: name, time and PSNR."""
    view = next(view for view in story.views if view.name == name)
    return f"{view.name}, time {view.time:.2f}, {view.psnr:.1f} dB"
