"""Who imports whom, and how long files and functions are (docs/architecture.md)."""

import ast
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "forewarp"
BOTTOM = {"files", "progress"}  # open to all
LOWER = {"ops", "scene", "losses", "metrics", "fields", "drawing", "renderer", "quadrature"}
MAY_IMPORT = {
    "files": set(),
    "progress": set(),
    "ops": set(),
    "scene": {"ops"},
    "losses": {"ops"},
    "metrics": {"ops", "scene"},
    "drawing": {"ops", "scene"},
    "report": {"drawing"},
    "fields": {"ops", "scene"},
    "data": {"ops", "scene"},
    "synth": {"ops", "scene", "data"},
    "renderer": {"ops", "scene", "fields"},
    "quadrature": {"ops", "scene"},
    "methods": LOWER | {"report"},
    "training": LOWER | {"methods"},
    "evaluation": LOWER | {"methods", "training"},
    "runs": LOWER | {"methods", "training", "evaluation", "data"},
    "planning": LOWER | {"methods", "training", "evaluation", "data", "report", "runs"},
    "replay": {"cli", "runs", "training"},
    "cli": LOWER | {"methods", "training", "evaluation", "data", "synth", "report", "runs", "planning"},
}
CONFIG = {"runs", "planning", "cli"}
ONLY_IN = {
    "hydra": CONFIG,
    "omegaconf": CONFIG,
    "lightning": {"data", "training", "evaluation", "runs", "planning", "cli"},
    "torchmetrics": {"metrics"},
    "numba": {"ops"},
    "trimesh": {"synth"},
    "embreex": {"synth"},
    "imageio": {"drawing", "evaluation", "cli"},
    "PIL": {"data"},
    "imageio_ffmpeg": {"drawing", "cli"},
    "rich": {"progress", "training", "evaluation", "planning", "cli"},
    "matplotlib": {"report"},
    "torchvision": set(),
}
CONTRACT = {"method", "abilities", "effect", "rows"}  # files of methods/ that packages above may import
OWN_PARTS = {
    "radiance",
    "lattice",
    "lattices",
    "motion",
    "deformation",
    "inpainter",
}  # attributes of one method only
FUNCTION_LINES, FILE_LINES = 60, 350
REASON = "# long: "


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


def above_methods(file: Path) -> bool:
    """Whether a file is above the methods, so that it may know only their contract."""
    return part_of(file) in ("training", "data", "report", "evaluation", "runs", "planning", "cli")


def parts_named(tree: ast.AST) -> list[str]:
    """Return what a file above the methods names of a single method: imports and attributes."""
    found = [
        name
        for name in imports(tree)
        if name.startswith("forewarp.methods.") and name.split(".")[2] not in CONTRACT
    ]
    return found + [n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute) and n.attr in OWN_PARTS]


def other_methods(file: Path, tree: ast.AST) -> list[str]:
    """Return imports of one method by another, or by the contract."""
    own, names = file.relative_to(SOURCE / "methods").parts[0].removesuffix(".py"), []
    for name in imports(tree):
        if name.startswith("forewarp.methods.") and name.split(".")[2] not in CONTRACT | {own}:
            names.append(name)
    return names


def own_lines(node: ast.FunctionDef) -> int:
    """Count a function's lines without its docstring."""
    doc = node.body[0] if ast.get_docstring(node) else None
    return node.end_lineno - node.lineno + 1 - (doc.end_lineno - doc.lineno + 1 if doc else 0)


def too_long(text: str) -> list[str]:
    """Return what exceeds a limit without giving a reason."""
    lines = text.splitlines()
    found = [] if len(lines) <= FILE_LINES or REASON in lines[0] else [f"{len(lines)} lines"]
    for node in ast.walk(ast.parse(text)):
        if not isinstance(node, ast.FunctionDef) or own_lines(node) <= FUNCTION_LINES:
            continue
        if REASON not in lines[node.lineno - 1]:
            found.append(f"{node.name}: {own_lines(node)} lines")
    return found


FILES = sorted(path for path in SOURCE.rglob("*.py") if path.parent != SOURCE or path.name != "__init__.py")


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.relative_to(SOURCE).as_posix())
def test_imports_point_down_and_lengths_keep_their_ceilings(file):
    text = file.read_text()
    assert breaches(part_of(file), ast.parse(text)) == []
    assert too_long(text) == []


@pytest.mark.parametrize(
    "file", [f for f in FILES if above_methods(f)], ids=lambda file: file.relative_to(SOURCE).as_posix()
)
def test_above_the_methods_only_their_contract_is_named(file):
    assert parts_named(ast.parse(file.read_text())) == []


@pytest.mark.parametrize(
    "file",
    [f for f in FILES if part_of(f) == "methods"],
    ids=lambda file: file.relative_to(SOURCE).as_posix(),
)
def test_no_method_imports_another(file):
    assert other_methods(file, ast.parse(file.read_text())) == []


@pytest.mark.parametrize(
    ("line", "allowed"),
    [
        ("from forewarp.methods.method import Method", True),
        ("from forewarp.methods.abilities import HasMatter", True),
        ("from forewarp.methods.effect import Effect", True),
        ("from forewarp.methods.voxel.terms import TERMS", False),
        ("from forewarp.methods import voxel", False),
        ("def f():\n    import forewarp.methods.voxel.method", False),
        ("module.method.radiance", False),
        ("module.method.radiance.lattice", False),
        ("grid.lattice", False),
        ("module.method.size", True),
        ("from forewarp.fields.radiance import DirectRadiance", True),
    ],
)
def test_the_check_of_what_stands_above(line, allowed):
    assert (parts_named(ast.parse(line)) == []) is allowed


@pytest.mark.parametrize(
    ("file", "line", "allowed"),
    [
        ("voxel/start.py", "from forewarp.methods.voxel.stage import VoxelStage", True),
        ("voxel/start.py", "from forewarp.methods.method import Start", True),
        ("voxel/start.py", "from forewarp.methods.particles.model import Particles", False),
        ("particles/model.py", "from forewarp.methods.voxel.method import VoxelMethod", False),
        ("method.py", "from forewarp.methods.voxel.method import VoxelMethod", False),
    ],
)
def test_the_check_of_methods_among_themselves(file, line, allowed):
    assert (other_methods(SOURCE / "methods" / file, ast.parse(line)) == []) is allowed


@pytest.mark.parametrize(
    ("file", "above"),
    [
        ("training/module.py", True),
        ("evaluation/evaluate.py", True),
        ("planning/planner.py", True),
        ("methods/tnerf.py", False),
    ],
)
def test_who_stands_above_the_methods(file, above):
    assert above_methods(SOURCE / file) is above
    assert (SOURCE / file).is_file()


def test_every_folder_is_a_package():
    assert {f.parent for f in SOURCE.rglob("*.py")} == {f.parent for f in SOURCE.rglob("__init__.py")}


def test_init_files_hold_one_sentence_but_for_the_public_door():
    for file in SOURCE.rglob("__init__.py"):
        if file.parent == SOURCE:
            assert list(imports(ast.parse(file.read_text()))) == ["forewarp.runs.fitted.open_run"]
            continue
        body = ast.parse(file.read_text()).body
        assert len(body) == 1, file
        assert isinstance(body[0], ast.Expr), file


@pytest.mark.parametrize(
    ("part", "line", "allowed"),
    [
        ("ops", "from forewarp.scene.box import Box", False),
        ("training", "from forewarp.data.module import SceneDataModule", False),
        ("training", "def f():\n    import hydra", False),
        ("synth", "from forewarp.data.dnerf import write_scene", True),
        ("cli", "import hydra", True),
        ("scene", "import torch", True),
        ("report", "from forewarp.scene.box import Box", False),
        ("training", "from forewarp.report.collect import collect", False),
        ("training", "import matplotlib", False),
        ("methods", "from forewarp.training.module import DynamicSceneModule", False),
        ("methods", "from forewarp.renderer import Renderer", True),
        ("fields", "from forewarp.renderer import Renderer", False),
        ("renderer", "from forewarp.methods.method import Method", False),
    ],
)
def test_the_check_itself(part, line, allowed):
    assert (breaches(part, ast.parse(line)) == []) is allowed


def test_a_long_function_needs_a_reason():
    body = "\n".join(["    pass"] * FUNCTION_LINES)
    assert too_long(f"def f():\n{body}") == [f"f: {FUNCTION_LINES + 1} lines"]
    assert too_long(f"def f():  # long: a table\n{body}") == []
