"""``forewarp-report``: tables and curves of finished runs."""

from __future__ import annotations

from pathlib import Path

from forewarp.cli.entry import command

HELP = """
forewarp-report makes pages with tables and curves of runs that are already there. It computes nothing anew.

  forewarp-report kind=accuracy_time        accuracy against training time, and the cheapest way to each dB
  forewarp-report kind=price_list           what each choice costs and brings, with the spread over seeds
  forewarp-report kind=paper                the paper's tables and figures: Markdown, LaTeX, CSV, HTML
  forewarp-report kind=price_list runs=FOLDER out=FOLDER

What one types most:
  kind=accuracy_time|price_list|paper|effects   which page
  runs=FOLDER                      searched for runs (runs/accuracy_time; of kind=paper runs/paper)
  out=FOLDER                       where the page goes (results/ below the runs)
  target=DB                        accuracy_time: PSNR that every variant's seconds are listed for
  published=FILE                   accuracy_time: points that others report; paper: what is printed
  curves=FOLDER                    paper: where accuracy_time put its pictures (runs/accuracy_time/results)

The runs: make accuracy-time [DATA=FOLDER SCENE=NAME MINUTES=N], make price-list DATA=FOLDER,
make reproduce-tables [DATA=FOLDER]. One that has no
results is named at the end of the page.
"""

KINDS = ("accuracy_time", "price_list", "paper", "effects")


def report(config) -> None:
    """Write the page."""
    if config.kind not in KINDS:
        raise ValueError(f"kind: expected one of {', '.join(KINDS)}, but got '{config.kind}'")
    if not isinstance(config.target, int | float | None):
        raise ValueError(f"target: expected a number of dB or null, but got '{config.target}'")
    default = f"{config.paths.runs}/{config.kind if config.kind in ('paper', 'effects') else 'accuracy_time'}"
    runs = Path(config.runs or default)
    for file in _written(config, runs, Path(config.out or runs / "results")):
        print(f"written: {file}")


def _written(config, runs: Path, out: Path) -> list[Path]:
    """The files of the page of this kind."""
    from forewarp.report.accuracy_time import write_accuracy_time
    from forewarp.report.curve import OTHERS, read_published
    from forewarp.report.effects import write_effects
    from forewarp.report.paper import write_paper
    from forewarp.report.price_list import write_price_list
    from forewarp.report.published import PAPER

    if config.kind == "price_list":
        return write_price_list(runs, out)
    if config.kind == "effects":
        return write_effects(runs, out)
    if config.kind == "paper":
        curves = Path(config.curves or f"{config.paths.runs}/accuracy_time/results")
        return write_paper(runs, out, Path(config.published or PAPER), curves)
    published = read_published(Path(config.published or OTHERS))
    return write_accuracy_time(runs, out, target=config.target, published=published)


def draw_run(folder: Path) -> None:
    """Draw a run's own curve into ``accuracy_time.png``, where it has one."""
    from forewarp.report import curve
    from forewarp.report.collect import read_curve

    points = read_curve(folder)
    if not points:
        return
    try:
        print(f"curve    {curve.draw_run(folder / 'accuracy_time.png', points, folder.name)}")
    except ImportError as error:
        print(f"without accuracy_time.png: {error}")


def main() -> None:
    """The console script."""
    command("report", report, HELP)


if __name__ == "__main__":
    main()
