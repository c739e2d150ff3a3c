"""
forewarp-data says which scenes of the paper's four datasets are in a folder, whether they are complete and as
published, under which licence they come, and where their authors keep what is missing. It downloads nothing.

  forewarp-data check SCENES

SCENES holds dnerf/hook and so on, hypernerf/broom2 ..., nhr/sport_1 ..., lego_complete/lift ...
Layout, counts and sizes are compared, and of D-NeRF every byte. What is "complete" can be trained and
measured on; "as published" are the very files. The last line is the command that makes the paper's tables of
what is complete. The status is 0 where all is, else 1.
"""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

from forewarp.cli.entry import INTERRUPTED, MISTAKE
from forewarp.cli.mistakes import one_line

LACKING = 1


def check(root: Path) -> int:
    """Print what there is of each dataset below ``root``, a line a scene; return how many scenes lack.

    Raises:
        ValueError: where ``root`` is no folder.
    """
    from forewarp.data.published import DATASETS  # late: the help needs none of it

    if not root.is_dir():
        got = "a file" if root.exists() else "none"
        raise ValueError(f"{root}: expected the folder that holds dnerf/hook and so on, but got {got}")
    complete = total = 0
    for dataset in DATASETS:
        scenes = list(dataset.found(root))
        there, count = sum(found.is_complete for found in scenes), len(scenes)
        print(f"{dataset.name}: {there} of {count} scenes complete in {root / dataset.folder}")
        width = max(len(found.scene) for found in scenes)
        for found in scenes:
            print(f"  {found.scene:{width}}  {found.state:12}  {found.words}".rstrip())
        print(f"  licence: {dataset.licence}")
        if there < count:
            print(f"  to get what lacks: {dataset.where.format(root=shlex.quote(str(root)))}")
        sys.stdout.flush()
        complete, total = complete + there, total + count
    command = f"make reproduce-tables DATA={shlex.quote(str(root))}"
    if not complete:
        print(f"none of {total} scenes is complete; on counterparts of all: make reproduce-tables")
    elif complete < total:
        print(f"{complete} of {total} scenes are complete; the tables of these: {command}")
    else:
        print(f"all {total} scenes are complete; the paper's tables: {command}")
    return total - complete


def main() -> None:
    """Run the console script."""
    words = sys.argv[1:] or ["--help"]
    if {"-h", "--help"} & set(words):
        print(__doc__.strip())
        sys.exit(0)
    try:
        if words[0] != "check" or len(words) != 2:
            raise ValueError(f"expected check SCENES, but got {shlex.join(words)}")
        sys.exit(LACKING if check(Path(words[1]).expanduser()) else 0)
    except (OSError, ValueError) as error:
        print(f"forewarp-data: error: {one_line(error)}", file=sys.stderr)
        sys.exit(MISTAKE)
    except KeyboardInterrupt:
        print("\nforewarp-data: interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
