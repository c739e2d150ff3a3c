"""
forewarp-export writes a finished run for other programs, into its exports/<format>/ (docs/exports.md).

  forewarp-export run=runs/vehicle/particles-demo-seed0 format=ply
  forewarp-export run=FOLDER format=npz times=[0,0.5,1] points=500

What one types most:
  run=FOLDER                    the run (needed); glb, html: or the folder of a film's windows
  format=ply                    particles for viewers of Gaussian splats, a file a time; voxels as points
  format=glb                    particles with all of their motion, one small file (docs/format.md)
  format=usd                    particles with time samples, for programs of OpenUSD 26.03 and later
  format=mesh                   the surface with colours, by marching cubes, a file a time
  format=gltf                   moving points as an animation, one file
  format=html                   one page that plays particles in a browser, without a server
  format=npz                    trajectories of points with what is visible of them, and the method's arrays
  times=N times=[0,0.5]         how many, evenly spaced, or which; not of glb and html, which hold all
  layer=moving|resting          only the particles that move, or those that rest
  out=FOLDER                    another folder
  degree=0|1|2|3                ply, usd: how finely colours depend on direction
  compressed=true               ply: about a tenth of the bytes, for SuperSplat, Spark, Babylon and others
  up=world|y|-y|z               ply, usd, mesh: which axis points upwards; -y for SuperSplat
  resolution=N level=SHARE      mesh: points of the lattice along the longest side; opacity of the surface
  files=ply|obj                 mesh: the files
  points=N                      gltf, npz: most points
  quality=compact|lossless      glb, html: rounded to what an eye can tell, or in float32
  seconds=N                     glb, usd, gltf, html: how long the animation lasts (as the film, else 4)
  views=N                       npz: cameras that tell which points are visible
  trust=[PACKAGE]               code of other packages that the run's config may name
  data.root=FOLDER              where the data are now, if they moved
  threads=N trainer=cpu         threads and device to compute with
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from forewarp.cli.entry import command
from forewarp.files import link_of


def export(config) -> None:
    """Load a run, or those of a film's windows, and write it."""
    from forewarp.export.formats import ABOUT, FORMATS, write
    from forewarp.files import check_replaceable

    saved = saved_runs(config)
    times = check(config, len(saved))
    folder = Path(config.out or Path(config.run) / "exports" / config.format)
    check_replaceable(folder, ABOUT)
    # These load torch; mistakes have been answered before.
    from forewarp.evaluation.layers import layer_of
    from forewarp.progress import Counted
    from forewarp.runs.fitted import method_name, opened

    sources = []
    for one in saved:
        run, module = opened(one)
        module.method = layer_of(module.method, config.layer, run.datamodule.scene.train)
        sources.append(source_of(run, module, method_name(one), times))
    whole = {"later": sources[1:]} if len(sources) > 1 else {"span": (0.0, 1.0), "begin": 0.0}
    source = replace(sources[0], **whole)
    about = {"run": str(config.run), "scene": source.name, "method": source.model, "layer": config.layer}
    options = {name: config[name] for name in FORMATS[config.format].options}
    with Counted(config.format) as progress:
        written = write(config.format, source, folder, about, progress, **options)
    files = list(written["bytes"])
    print(f"written: {folder / files[0] if len(files) == 1 else folder}: {summary(written)}")
    if config.format == "html":
        print(link_of(folder / files[0]))


def saved_runs(config) -> list:
    """Return the config of the run, or those of the windows in a folder of them, in their order."""
    from forewarp.runs.config import saved_config
    from forewarp.runs.windows import check_film

    folder = Path(config.run or "")
    inner = sorted(folder.glob("*/config.yaml"))
    if config.run is None or not inner or (folder / "config.yaml").is_file():
        return [saved_config(config.run, config)]
    found = [saved_config(str(place.parent), config) for place in inner]
    windows = sorted((one for one in found if one.data.get("window")), key=lambda one: one.data.window[0])
    check_film([tuple(one.data.window) for one in windows], folder)
    return windows


def source_of(run, module, model: str, times: list[float]):
    """Return the ``Source`` of exports: a fitted ``module`` of a run, a ``model`` by its config, at times."""
    from forewarp.export.tracks import Source
    from forewarp.runs.fitted import trust_degrees

    scene = run.datamodule.scene
    cameras, taken = [frame.camera for frame in scene.train], [frame.time for frame in scene.train]
    background = tuple(run.datamodule.targets("train").background.tolist())
    place = tuple(scene.protocol.get("span", (0.0, 1.0))), scene.protocol.get("window", [0.0])[0]
    seconds = scene.protocol.get("seconds")
    seconds = seconds and seconds / (place[0][1] - place[0][0])  # of all windows, where it is one
    more = {"world": scene.world, "trust": trust_degrees(Path(run.folder)), "seconds": seconds}
    return Source(module, model, cameras, times, background, scene.name, taken, *place, **more)


def summary(about: dict) -> str:
    """Say in a few words what was written.

    >>> summary({"bytes": {"a": 2_000_000, "b": 500_000}, "vertices": [7200, 72]})
    '2 files, 2.5 MB, at least 72 vertices each'
    >>> summary({"bytes": {"a": 40_624}})
    '1 file, 41 kB'
    """
    count, size = len(about["bytes"]), sum(about["bytes"].values())
    amount = f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.0f} kB"
    text = f"{count} file{'s' * (count != 1)}, {amount}"
    for what in {"particles", "points", "vertices"} & about.keys():
        of_files = isinstance(about[what], list)
        text += f", at least {min(about[what]):,} {what} each" if of_files else f", {about[what]:,} {what}"
    return text


def check(config, windows: int = 1) -> list[float]:
    """Refuse settings of which nothing can be written, before anything is loaded; return the times.

    Args:
        config: the command's.
        windows: how many there are of the film.
    """
    from omegaconf import ListConfig

    from forewarp.data.files import mismatch, one_of
    from forewarp.export.formats import FORMATS, check_option, require
    from forewarp.runs.overrides import key_of, next_command, typed_overrides

    if config.format not in FORMATS:
        from forewarp.drawing.images import FORMATS as OF_FILMS  # late: it loads torch

        words = [f"run={config.run or '<a run>'}", f"format={config.format}"]
        advice = f"a film is made by {next_command('render', words)}" if config.format in OF_FILMS else ""
        one_of(config.format, "format", *FORMATS, advice=advice)
    form, name = FORMATS[config.format], f"format={config.format}"
    if windows > 1 and form.times:
        raise mismatch("format", "glb or html for a film's windows", config.format, "export one of them")
    foreign = {option for other in FORMATS.values() for option in other.options} - set(form.options)
    for key in map(key_of, typed_overrides()):
        if key == "times" and not form.times:
            raise ValueError(f"times: expected none with {name}, which holds all times; leave it out")
        if key in foreign:
            raise ValueError(f"{key}: expected an option of {name} ({', '.join(form.options)}); leave it out")
    require(config.format)
    for key in ("layer", *form.options):
        check_option(key, config[key])
    times = config.times
    if not isinstance(times, ListConfig):
        if type(times) is not int or times < 1:
            raise ValueError(f"times: expected a whole number of at least 1, or a list, but got {times}")
        return [i / max(times - 1, 1) for i in range(times)]
    numbers = bool(times) and all(type(time) in (int, float) and 0 <= time <= 1 for time in times)
    if not numbers or sorted(set(times)) != list(times):
        wanted = "numbers in [0, 1], each later than the one before"
        raise ValueError(f"times: expected {wanted}, but got {list(times)}")
    return [float(time) for time in times]


def main() -> None:
    """Run the console script."""
    command("export", export, __doc__)


if __name__ == "__main__":
    main()
