"""Who imports whom (docs/architecture.md)."""

import ast
import re
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "forewarp"
BOTTOM = {
    "archives",
    "clock",
    "files",
    "interrupts",
    "media",
    "outline",
    "progress",
    "provenance",
}  # open to all
LOWER = {"ops", "scene", "losses", "metrics", "fields", "drawing", "renderer"}
MAY_IMPORT = {
    **dict.fromkeys([*BOTTOM, "ops"], set()),
    "scene": {"ops"},
    "losses": {"ops"},
    **dict.fromkeys(["metrics", "drawing", "fields", "data"], {"ops", "scene"}),
    "report": {"drawing", "metrics"},
    "synth": {"ops", "scene", "data", "drawing"},
    "renderer": {"ops", "scene", "fields"},
    "glb": {"ops", "scene", "fields"},
    "methods": LOWER,
    "training": LOWER | {"methods"},
    "evaluation": LOWER | {"methods", "training"},
    "runs": LOWER | {"glb", "methods", "training", "evaluation", "data"},
    "planning": LOWER | {"methods", "training", "evaluation", "data", "report", "runs"},
    "viewer": LOWER | {"methods", "training", "evaluation"},
    "export": LOWER | {"glb", "methods", "training", "evaluation"},
    "capture": {"ops", "scene", "drawing", "data"},
    "cli": LOWER
    | {
        "methods",
        "training",
        "evaluation",
        "data",
        "synth",
        "report",
        "runs",
        "planning",
        "viewer",
        "export",
        "capture",
    },
}
CONFIG = {"runs", "planning", "cli"}
ONLY_IN = {
    **dict.fromkeys(["hydra", "omegaconf"], CONFIG),
    "lightning": {"data", "training", "evaluation", "runs", "planning", "viewer", "cli"},
    **{
        "torchmetrics": {"metrics"},
        "numba": {"ops"},
        "PIL": {"media", "data", "report"},
        "matplotlib": {"report"},
    },
    **{"trimesh": {"synth"}, "embreex": {"synth"}, "torchvision": set()},
    **{"pycolmap": {"capture"}, "cv2": {"capture"}, "lzfse": {"capture"}},
    **{"skimage": {"export"}, "viser": {"export", "viewer", "cli"}},
    **{"imageio": {"drawing", "evaluation", "cli"}, "imageio_ffmpeg": {"media", "drawing"}},
    "rich": {"progress", "training", "evaluation", "planning", "cli"},
}
CONTRACT = {
    "method",
    "effect",
    "rows",
    "rays",
}  # files of methods/ that packages above may import
# Attributes of one method only.
OWN_PARTS = {"radiance", "lattice", "lattices", "motion", "deformation", "inpainter"}
ABOVE = {"training", "data", "report", "evaluation", "runs", "planning", "viewer", "export", "capture", "cli"}


def part_of(file: Path) -> str:
    """Return the package, or the module at the top, that a file belongs to."""
    return file.relative_to(SOURCE).parts[0].removesuffix(".py")


def imports(tree: ast.AST):
    """Yield every dotted name that is imported, also inside functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def breaches(part: str, tree: ast.AST) -> list[str]:
    """Return the imports that the table does not allow ``part``."""
    found = []
    for name in imports(tree):
        top, *rest = name.split(".")
        if top == "forewarp" and rest:
            found += [name] if rest[0] != part and rest[0] not in MAY_IMPORT[part] | BOTTOM else []
        elif part not in ONLY_IN.get(top, {part}):
            found.append(name)
    return found


def parts_named(tree: ast.AST) -> list[str]:
    """Return what a file above the methods names of a single method: imports and attributes."""
    names = (name for name in imports(tree) if name.startswith("forewarp.methods."))
    found = [name for name in names if name.split(".")[2] not in CONTRACT]
    return found + [n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute) and n.attr in OWN_PARTS]


def other_methods(file: Path, tree: ast.AST) -> list[str]:
    """Return imports of one method by another, or by the contract."""
    known = CONTRACT | {file.relative_to(SOURCE / "methods").parts[0].removesuffix(".py")}
    names = (name for name in imports(tree) if name.startswith("forewarp.methods."))
    return [name for name in names if name.split(".")[2] not in known]


FILES = sorted(path for path in SOURCE.rglob("*.py") if path.parent != SOURCE or path.name != "__init__.py")


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.relative_to(SOURCE).as_posix())
def test_imports_point_down(file):
    tree, part = ast.parse(file.read_text()), part_of(file)
    assert breaches(part, tree) == []
    assert part not in ABOVE or parts_named(tree) == []  # above the methods only their contract is known
    assert part != "methods" or other_methods(file, tree) == []


def module_of(file: Path) -> str:
    """Return the dotted name of a file within the package."""
    return ".".join(file.relative_to(SOURCE).with_suffix("").parts)


def test_no_files_import_each_other_in_a_circle():
    names = {module_of(file): file for file in FILES}
    graph = {}
    for name, file in names.items():
        found = {word.removeprefix("forewarp.") for word in imports(ast.parse(file.read_text()))}
        found |= {word.rpartition(".")[0] for word in found}  # "from module import name"
        graph[name] = found & names.keys() - {name}
    TopologicalSorter(graph).prepare()  # raises CycleError


def test_init_files_hold_one_sentence_but_for_the_public_door():
    folders = {file.parent: ast.parse(file.read_text()) for file in SOURCE.rglob("__init__.py")}
    assert {file.parent for file in SOURCE.rglob("*.py")} == folders.keys()
    door = {name for name in imports(folders.pop(SOURCE)) if name.startswith("forewarp.")}
    offered = {f"forewarp.scene.camera.{name}" for name in ("Camera", "look_at", "orbit")}
    before = "forewarp.provenance.drop_missing_backend"  # of what imports matplotlib
    assert door == {"forewarp.runs.fitted.open_run", "forewarp.scene.camera", before, *offered}
    assert {folder for folder, tree in folders.items() if [*map(type, tree.body)] != [ast.Expr]} == set()


def above(line):
    return parts_named(ast.parse(line))


def within(file):
    return lambda line: other_methods(SOURCE / "methods" / file, ast.parse(line))


def of(part):
    return lambda line: breaches(part, ast.parse(line))


@pytest.mark.parametrize(
    ("check", "line", "allowed"),
    [
        (above, "from forewarp.methods.method import Method", True),
        (above, "from forewarp.methods.voxel.model import VoxelMethod", False),
        (above, "from forewarp.methods import voxel", False),
        (above, "def f():\n    import forewarp.methods.voxel.model", False),
        (above, "module.method.radiance.shape", False),
        (above, "module.method.size", True),
        (within("voxel/forward.py"), "from forewarp.methods.voxel.structure import VoxelStage", True),
        (within("voxel/forward.py"), "from forewarp.methods.method import Start", True),
        (within("voxel/forward.py"), "from forewarp.methods.particles.model import Particles", False),
        (within("method.py"), "from forewarp.methods.voxel.model import VoxelMethod", False),
        (of("ops"), "from forewarp.scene.box import Box", False),
        (of("training"), "from forewarp.data.module import SceneDataModule", False),
        (of("training"), "def f():\n    import hydra", False),
        (of("cli"), "import hydra", True),
        (of("scene"), "import torch", True),
        (of("methods"), "from forewarp.renderer import Renderer", True),
        (of("renderer"), "from forewarp.methods.method import Method", False),
    ],
)
def test_the_checks_themselves(check, line, allowed):
    assert (check(line) == []) is allowed


def test_no_private_function_of_torch_is_called():
    for file in SOURCE.rglob("*.py"):
        assert not re.findall(r"\btorch\.(?:\w+\.)*_[a-z]\w*", file.read_text()), file
