"""
forewarp-report makes tables, curves and pages of runs that are already there. Only kind=run renders anything.

  kind=accuracy_time  accuracy against training time, and the cheapest way to each dB
  kind=price_list     what each choice costs and brings, with intervals over seeds
  kind=paper          the paper's tables and figures: Markdown, LaTeX, CSV, HTML
  kind=ablation       what each part of the paper's method brings, and whether the paper's order holds
  kind=minutes        what each method reaches on each scene in so many minutes, by seed and view
  kind=methods        all methods under one clock: what each reaches, PSNR against seconds, views side by side
  kind=effects        planned runs beside the preset, every effect and none
  kind=search         the trials of a search, the best first: what was chosen, score, steps, seconds
  kind=table          any runs as one table, printed, and as Markdown, LaTeX and CSV
  kind=compare        a few runs side by side, seeds as one, printed, and with out=FOLDER drawn
  kind=run            the page of one run: its video, views, why it is not better and what to try

  forewarp-report kind=price_list runs=FOLDER out=FOLDER
  forewarp-report kind=compare runs=[runs/demo/particles,runs/demo/forward] out=runs/demo
  forewarp-report kind=run run=runs/vehicle/particles-demo-seed0

What one types most:
  runs=FOLDER            searched for runs (runs/accuracy_time, minutes, effects, search, ..., else paper)
  runs=FILE.csv          a page's own table: write it anew (ablation, effects, methods, minutes, price_list)
  runs=[FOLDER,FOLDER]   compare: the runs themselves; table: folders to search; patterns with * are expanded
  rows=NAMES columns=NAMES   table: model, preset, scene, dataset, minutes, seed, variant, a key of
                         config.yaml or its last parts (rows=model,rigid); a cell is a mean over seeds alone
  metric=NAMES           table: psnr,lpips,space/psnr, your own; costs: train, step, frame, memory, bytes, ...
  pareto=true            table: draw the first metric against seconds, memory and bytes
  out=FOLDER             where the page goes (results/ below the runs); compare: where the picture goes
  target=DB              accuracy_time: PSNR that every variant's seconds are listed for
  published=FILE         accuracy_time, minutes: results of others; paper, ablation: the printed numbers
  curves=FOLDER          paper: where accuracy_time put its pictures (runs/accuracy_time/results)
  run=FOLDER             the run (kind=run is then meant); its page is <run>/page.html, or out=FILE.html
  megabytes=N            run: most of the page; pictures and the video are made smaller to fit
  render=false           run: show only what the folder has; load no method and no data; for slow methods
  path=as_filmed|lean|both|fixed|...   run: which video, as in forewarp-render
  data.root=FOLDER       run: where the data are now, if they moved
  trainer=cpu|gpu|auto   run: device to compute with; without it the one of the run
  trust=[PACKAGE]        run: code of other packages that a run's config may name

The runs: make accuracy-time [DATA=DATASETS SCENES=NAME MINUTES=N], make price-list DATA=DATASETS,
make reproduce-tables [DATA=DATASETS], make ablations, make effects. Runs without results are listed.
"""

from __future__ import annotations

from contextlib import suppress
from glob import glob
from pathlib import Path
from pkgutil import resolve_name

from omegaconf import DictConfig, OmegaConf

from forewarp.cli.entry import command
from forewarp.cli.mistakes import one_line
from forewarp.cli.render import write_film
from forewarp.data.files import number, one_of
from forewarp.files import link_of
from forewarp.progress import told_if_slow
from forewarp.runs.config_files import project_root

# Where the runs of a kind are if none are named, what writes its page, and the options that it takes.
KINDS = {
    "accuracy_time": ("accuracy_time", "choices.write_accuracy_time", ("target", "published")),
    "price_list": ("accuracy_time", "choices.write_price_list", ()),
    "paper": ("paper", "paper.write_paper", ("curves", "published")),
    "ablation": ("ablations", "paper.write_ablation", ("published",)),
    "minutes": ("minutes", "benchmark.write_minutes", ("published",)),
    "methods": ("paper", "benchmark.write_methods", ()),
    "effects": ("effects", "choices.write_effects", ()),
    "search": ("search", "choices.write_search", ()),
}
MEGABYTES = 0.3, 1000  # least and most that may be asked for
MOST_SIDE = 800  # pixels of a picture's longer side
MOST_VIEWS = 64  # of which pixels are looked at


def report(config: DictConfig) -> None:
    """Write the page, or print the table; without a kind print the help."""
    if config.kind is None:
        print(__doc__.strip())
        asked = "expected the kind of page, but got nothing; type kind=NAME, one of the above"
        raise ValueError(f"kind: {asked}")
    one_of(config.kind, "kind", *KINDS, "table", "compare", "run")
    if not isinstance(config.target, int | float | None):
        raise ValueError(f"target: expected a number of dB or null, but got '{config.target}'")
    if config.kind == "run":
        print(run_page(config))
    elif config.kind == "compare":
        print(compared(config))
    elif config.kind == "table":
        print(tabled(config))
    elif not isinstance(config.runs, str | None):
        raise ValueError(f"runs: expected one folder for kind={config.kind}, but got a list; name one folder")
    else:
        place, function, names = KINDS[config.kind]
        runs = Path(config.runs or f"{config.paths.runs}/{place}")
        typed = {"target": config.target, "published": config.published and Path(config.published)}
        typed["curves"] = Path(config.curves or f"{config.paths.runs}/accuracy_time/results")
        options = {name: typed[name] for name in names}
        out = Path(config.out or (runs.parent if runs.suffix == ".csv" else runs / "results"))
        write = resolve_name(f"forewarp.report.{function}")
        for file in write(runs, out, **options):
            print(f"written: {file}", *([link_of(file)] if Path(file).suffix == ".html" else []), sep="\n")


def tabled(config: DictConfig) -> str:
    """Write the files of ``kind=table``; return the table and their names."""
    from forewarp.report.table import write_table

    one_of(config.pareto, "pareto", True, False)
    named = listed(config.runs) or [config.paths.runs]
    folders = [Path(folder) for name in named for folder in expanded(name, "**/config.yaml")]
    names = {key: listed(config[name]) for key, name in (("rows", "rows"), ("columns", "columns"))}
    names["metrics"] = listed(config.metric) or ["psnr"]
    out = Path(config.out or (folders[0] if len(folders) == 1 else Path(config.paths.runs)) / "results")
    text, written = write_table(folders, out, pareto=config.pareto, **names)
    return "\n".join([text, *(f"written: {file}" for file in written)])


def listed(names: object) -> list[str]:
    """List names that were typed as one, with commas between them, or as a list; null is none."""
    given = names.split(",") if isinstance(names, str) else list(names or ())
    return [str(name).strip() for name in given]


def expanded(name: str, needed: str) -> list[str]:
    """List the folders that a pattern means and that hold ``needed``; without any, all, which are refused.

    Brackets are those of a folder's name where there is such a folder, or where as a pattern they mean none.
    """
    folders = [name] if Path(name).is_dir() else sorted(glob(name)) or sorted(glob(name.replace("[", "[[]")))
    return [folder for folder in folders if any(Path(folder).glob(needed))] or folders or [name]


def compared(config: DictConfig) -> str:
    """Return the table of ``kind=compare``; draw a view by each run where ``out`` is set."""
    from forewarp.report.choices import compare
    from forewarp.report.figures import draw_beside
    from forewarp.report.results import read_compared

    named = [config.runs] if isinstance(config.runs, str) else list(config.runs or ())
    groups = read_compared([folder for name in named for folder in expanded(str(name), "config.yaml")])
    compared_runs = compare(groups)
    table = "\n".join(filter(None, [compared_runs.plain(), compared_runs.caption]))
    if not config.out:
        return table
    first = {name: own[0] for name, own in groups.items()}
    drawn = draw_beside(Path(config.out) / "compare.png", first, 0.5, "test view")
    none = "no image: the runs share no test view with a sheet; type views= and sheets= alike"
    return f"{table}\n{f'written: {drawn}' if drawn else none}"


def run_page(config: DictConfig) -> str:
    """Write the page of the run that ``config.run`` names; return what to print.

    After Ctrl-C while pictures or the video are made, the page has those that there are.

    Raises:
        ValueError: in one line, if ``config.run`` is not one run's folder, or a setting is wrong.
    """
    from forewarp.report.run_page import FILMS, media_of, read_story, room_of, write_run_page

    number(config.megabytes, "megabytes", *MEGABYTES)
    one_of(config.render, "render", True, False)
    one_of(config.path, "path", *FILMS, None)
    if config.run is None:
        got, name = ("runs=", "<a run's folder>") if config.runs is not None else ("nothing", "runs/...")
        raise ValueError(f"run: expected the folder of a run, but got {got}; set run={name}")
    folder = Path(str(config.run))
    row = read_story(folder)
    file = Path(config.out or folder)
    file = file if file.suffix in (".html", ".htm") else file / "page.html"
    most = float(config.megabytes)

    def written() -> str:
        size = write_run_page(file, row, media, megabytes=most)
        told = media.diagnosis.lines() if media.diagnosis else []
        about = f"written: {file}: {size / 1e6:.1f} of at most {most:g} MB"
        return "\n".join([*media.missing, *told, about, link_of(file)])

    media = media_of(row, config.path)  # loads torch; mistakes have been answered before
    room_of(row, media, most)  # refuses before minutes of rendering
    try:
        if config.render and not row["unfinished"]:
            _render(config, row, media)
    except KeyboardInterrupt:
        media.missing = ["Rendering for this page was interrupted."]
        print(written())
        raise
    except Exception as error:
        if (reason := one_line(error)) is None:
            raise
        media.missing = [f"Rendering for this page stopped: {reason}."]
    return written()


def _render(config: DictConfig, row: dict, media) -> None:
    """Render the best, the median and the worst view, and a player or, where there can be none, the video if
    the run has none; ``media`` takes each once it is made. First find out where the error of the stored views
    is.
    """
    from forewarp.cli.export import source_of
    from forewarp.evaluation.images import parts_of
    from forewarp.methods.method import HasMovingGaussians
    from forewarp.report.run_page import FILMS, Shown, about, best_median_worst, room_of
    from forewarp.runs.config import saved_config
    from forewarp.runs.fitted import method_name, opened

    saved = saved_config(str(row["folder"]), config)
    with told_if_slow("page", "looking where the error is", after=1.0):
        run, module = opened(saved)
        targets = run.datamodule.targets("test")
        _diagnose(row, media, run, module)
    places = {frame.name: number for number, frame in enumerate(targets.frames)}
    views = []
    with told_if_slow("page", "rendering the best, the median and the worst view", after=1.0):
        for name, why in best_median_worst(row["images"]).items():
            if name in places:
                target = targets[places[name]]
                side = max(target.frame.camera.width, target.frame.camera.height)
                views.append(Shown(why, about(row, name), parts_of(module, target, MOST_SIDE), side))
    media.views = views or media.views
    if config.path is None and isinstance(module.method, HasMovingGaussians):
        from forewarp.export.html import player_of, poster, script_digests

        with told_if_slow("page", "writing the player", after=1.0), suppress(ValueError):  # nobody sees any
            source = source_of(run, module, method_name(saved), [])
            text, _ = player_of(source)
            room = room_of(row, media, float(config.megabytes))
            if media.play(text, script_digests(), room, poster(source), source.is_film):
                return
    if media.video is not None:
        return
    if not len(targets):
        media.missing = ["No video: the scene has no test view to begin it from."]
        return
    film = OmegaConf.load(project_root() / "conf" / "render.yaml")
    film.path = config.path or ("both" if row["config"].get("capture") == "cut_out" else None)
    media.video = write_film(film, run, module)
    media.about = FILMS[film.path]


def _diagnose(row: dict, media, run, module) -> None:
    """Compare stored test views with the data, and training views with the fit; tell ``media``."""
    from forewarp.data.batches import COLORS, color_of
    from forewarp.drawing.images import error_colors
    from forewarp.evaluation.stored import placed, stored_views, view_errors
    from forewarp.report.diagnosis import diagnose
    from forewarp.report.run_page import triple
    from forewarp.runs.fitted import training_psnr

    targets, protocol = run.datamodule.targets("test"), row["metrics"].get("protocol", {})
    if protocol.get("background") in COLORS:  # forewarp-evaluate may have chosen another than the run's
        targets.background = color_of(protocol["background"])
    if protocol.get("reduced"):
        targets = targets.reduced(protocol["reduced"])
    scene = run.datamodule.scene
    (views, fit), scores = placed(scene), {image["name"]: image["psnr"] for image in row["images"]}
    for target, prediction in stored_views(targets, row["folder"], scores, MOST_VIEWS):
        views[target.frame.name] |= view_errors(target, prediction, scene)
    fit["psnr"] = training_psnr(run, module)[0]
    media.diagnosis = diagnose(row, views, fit)
    if media.diagnosis is None:
        return
    listed = {view["name"]: view["psnr"] for view in media.diagnosis.worst}
    shown = {}
    for target, prediction in stored_views(targets, row["folder"], listed, len(listed)):
        pictures = target.rgb, prediction, error_colors(target.rgb, prediction)
        shown[target.frame.name] = triple(target.frame.name, *pictures)
    media.worst = [shown[name] for name in listed if name in shown]


def main() -> None:
    """Run the console script."""
    command("report", report, __doc__)


if __name__ == "__main__":
    main()
