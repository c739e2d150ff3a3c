"""Walk one command through the rooms: which modules it enters, and how often a call goes up a floor.

``python -m tests.support.walk forewarp-train experiment=demo budget.iterations=4`` runs the command in this
process under ``sys.setprofile``. A step of the walk is a call from a function of one room to a function of
another; what other packages do in between (Hydra, Lightning) is passed over. Code that runs at import is left
out. Each pair of modules counts once, however often it is walked.
"""

from __future__ import annotations

import importlib
import sys
from collections import Counter
from pathlib import Path

# As the table in tests/test_architecture.py allows imports: each room may import those of lower floors.
FLOORS = {
    **dict.fromkeys(["files", "progress", "ops", "drawing"], 0),
    **dict.fromkeys(["scene", "losses", "metrics", "report"], 1),
    **dict.fromkeys(["fields", "data", "synth"], 2),
    **dict.fromkeys(["renderer", "quadrature"], 3),
    **{"methods": 4, "training": 5, "evaluation": 6, "runs": 7, "planning": 8, "cli": 9, "replay": 10},
}


def room_of(module: str) -> str:
    """The room that a module is in: ``data/dnerf`` is in ``data``."""
    return module.split("/")[0]


class Walk:
    """Counts the calls between modules of forewarp while it is installed as the profile function."""

    def __init__(self, source: Path) -> None:
        self.source, self.calls = f"{source}/", Counter()

    def __call__(self, frame, event: str, _) -> None:
        """Note the module that is entered, and the nearest module of forewarp that called it."""
        entered = self._module(frame) if event == "call" else None
        if entered is None:
            return
        caller = frame.f_back
        while caller is not None and self._module(caller) is None:
            if caller.f_code.co_name == "<module>":  # an import, or the command itself
                break
            caller = caller.f_back
        self.calls[caller and self._module(caller), entered] += 1

    def _module(self, frame) -> str | None:
        file = frame.f_code.co_filename
        if not file.startswith(self.source) or frame.f_code.co_name == "<module>":
            return None
        return file[len(self.source) :].removesuffix(".py")

    def told(self) -> str:
        """What was found: modules, rooms, and the steps between rooms, those upwards by name."""
        steps = sorted((a, b) for a, b in self.calls if a is not None and room_of(a) != room_of(b))
        rise = {(a, b): FLOORS[room_of(b)] - FLOORS[room_of(a)] for a, b in steps}
        up, down = [step for step in steps if rise[step] > 0], [step for step in steps if rise[step] < 0]
        level = len(steps) - len(down) - len(up)
        modules = {module for step in self.calls for module in step if module is not None}
        counts = f"{len(down)} down, {len(up)} up, {level} on one floor"
        lines = [
            f"{len(modules)} modules in {len({room_of(module) for module in modules})} rooms",
            f"steps between rooms (pairs of modules): {counts}",
            *(f"  up: {a} -> {b} ({self.calls[a, b]} calls)" for a, b in up),
        ]
        return "\n".join(lines)


def main() -> None:
    """Run the command that is named and print its walk."""
    command, *overrides = sys.argv[1:]
    import forewarp

    walk = Walk(Path(forewarp.__file__).parent)
    sys.argv = [command, *overrides]
    task = importlib.import_module(f"forewarp.cli.{command.removeprefix('forewarp-')}").main
    sys.setprofile(walk)
    try:
        task()
    except SystemExit as leaving:
        status = leaving.code
    finally:
        sys.setprofile(None)
    print(walk.told())
    sys.exit(status)


if __name__ == "__main__":
    main()
