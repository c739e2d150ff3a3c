"""``forewarp-report``: tables and curves of finished runs."""

from __future__ import annotations

from glob import glob
from pathlib import Path

from forewarp.cli.entry import command

KINDS = {
    "accuracy_time": "accuracy against training time, and the cheapest way to each dB",
    "price_list": "what each choice costs and brings, with the spread over seeds",
    "paper": "the paper's tables and figures: Markdown, LaTeX, CSV, HTML",
    "ablation": "what each part of the paper's method brings, and whether the paper's order holds",
    "minutes": "what each method reaches on each scene in so many minutes, by seed and view",
    "methods": "all methods under one clock: what each reaches, PSNR against seconds, views side by side",
    "effects": "planned runs against every effect at once and the paper's fixed set",
    "compare": "a few runs side by side, printed, and with out=FOLDER drawn",
    "run": "the page of one run: its video, truth against prediction, curves, effects and why",
}

HELP = f"""
forewarp-report makes tables, curves and pages of runs that are already there. Only kind=run renders anything.

{chr(10).join(f"  kind={kind:<14} {about}" for kind, about in KINDS.items())}

  forewarp-report kind=price_list runs=FOLDER out=FOLDER
  forewarp-report kind=compare runs=[runs/demo/particles,runs/demo/forward] out=runs/demo
  forewarp-report kind=run run=runs/vehicle/particles-demo-seed0

What one types most:
  runs=FOLDER            searched for runs (runs/accuracy_time, minutes, effects, ablations, else paper)
  runs=[FOLDER,FOLDER]   compare: the runs themselves; patterns with * are expanded
  out=FOLDER             where the page goes (results/ below the runs); compare: where the picture goes
  target=DB              accuracy_time: PSNR that every variant's seconds are listed for
  published=FILE         accuracy_time, minutes: results of others; paper, ablation: the printed numbers
  curves=FOLDER          paper: where accuracy_time put its pictures (runs/accuracy_time/results)
  run=FOLDER             run: the run; its page is <run>/page.html, or out=FILE.html
  megabytes=N            run: most of the page; pictures and the video are made smaller to fit
  render=false           run: show only what the folder has; load no method and no data; for slow methods
  path=both|trajectories|swing|fixed|orbit   run: which video, as in forewarp-render
  data.root=FOLDER       run: where the data are now, if they moved
  trainer=cpu|gpu|auto   run: device to compute with; without it the one of the run
  trust=[PACKAGE]        run: code of other packages that a run's config may name

The runs: make accuracy-time [DATA=DATASETS SCENE=NAME MINUTES=N], make price-list DATA=DATASETS,
make reproduce-tables [DATA=DATASETS], make ablations, make effects. Runs without results are listed.
"""


def report(config) -> None:
    """Write the page, or print the table."""
    if config.kind not in KINDS:
        raise ValueError(f"kind: expected one of {', '.join(KINDS)}, but got '{config.kind}'")
    if not isinstance(config.target, int | float | None):
        raise ValueError(f"target: expected a number of dB or null, but got '{config.target}'")
    if config.kind == "run":
        from forewarp.cli.run_page import run_page

        print(run_page(config))
        return
    if config.kind == "compare":
        print(_compared(config, _folders(config.runs)))
        return
    if not isinstance(config.runs, str | None):
        raise ValueError(f"runs: expected one folder for kind={config.kind}, but got a list; name one folder")
    folders = {kind: kind for kind in ("paper", "effects", "minutes")}
    folders |= {"ablation": "ablations", "methods": "paper"}
    default = folders.get(config.kind, "accuracy_time")
    runs = Path(config.runs or f"{config.paths.runs}/{default}")
    for file in _written(config, runs, Path(config.out or runs / "results")):
        print(f"written: {file}")


def _folders(runs) -> list[str]:
    """List the runs named by ``runs``: a folder, a pattern, or a list of them."""
    named = [] if runs is None else [runs] if isinstance(runs, str) else list(runs)
    if not named:
        raise ValueError("runs: expected folders of runs, but got none; set runs=[FOLDER,FOLDER]")
    return [folder for one in named for folder in sorted(glob(str(one))) or [str(one)]]


def _compared(config, folders: list[str]) -> str:
    """Return the table of ``kind=compare``, and draw a view by each run where ``out`` is set."""
    from forewarp.report.compare import compare, draw_compared

    drawn = draw_compared(folders, Path(config.out)) if config.out else None
    none = "no picture: the runs share no test view with a sheet; type views= and sheets= alike"
    about = f"written: {drawn}" if drawn else none
    return compare(folders).plain() + (f"\n{about}" if config.out else "")


def _written(config, runs: Path, out: Path) -> list[Path]:
    """Write the page of this kind and return its files."""
    from forewarp.report.ablation import write_ablation
    from forewarp.report.accuracy_time import write_accuracy_time
    from forewarp.report.curve import OTHERS, read_published
    from forewarp.report.effects import write_effects
    from forewarp.report.methods import write_methods
    from forewarp.report.minutes import write_minutes
    from forewarp.report.paper import write_paper
    from forewarp.report.paper_printed import PAPER
    from forewarp.report.price_list import write_price_list

    if config.kind == "price_list":
        return write_price_list(runs, out)
    if config.kind == "effects":
        return write_effects(runs, out)
    if config.kind == "minutes":
        return write_minutes(runs, out, read_published(Path(config.published or OTHERS)))
    if config.kind == "methods":
        return write_methods(runs, out)
    if config.kind == "ablation":
        return write_ablation(runs, out, Path(config.published or PAPER))
    if config.kind == "paper":
        curves = Path(config.curves or f"{config.paths.runs}/accuracy_time/results")
        return write_paper(runs, out, Path(config.published or PAPER), curves)
    published = read_published(Path(config.published or OTHERS))
    return write_accuracy_time(runs, out, target=config.target, published=published)


def main() -> None:
    """Run the console script."""
    command("report", report, HELP)


if __name__ == "__main__":
    main()
