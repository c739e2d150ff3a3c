"""The house rules that a reader of imports and lengths can check."""

import ast
from pathlib import Path

import pytest

SOURCE = Path(__file__).parents[1] / "src" / "forewarp"
LOWER = {"ops", "scene", "losses", "metrics", "fields", "drawing", "effects", "renderer", "quadrature"}
MAY_IMPORT = {
    "ops": set(),
    "scene": {"ops"},
    "losses": {"ops"},
    "metrics": {"ops", "scene"},
    "drawing": {"ops", "scene"},
    "report": set(),
    "fields": {"ops", "scene"},
    "data": {"ops", "scene"},
    "synth": {"ops", "scene", "data"},
    "effects": {"ops", "scene", "fields"},
    "renderer": {"ops", "scene", "fields"},
    "quadrature": {"ops", "scene"},
    "methods": LOWER,
    "training": LOWER | {"methods"},
    "replay": {"cli"},
    "cli": LOWER | {"methods", "training", "data", "synth", "report"},
}
ONLY_IN = {
    "hydra": {"cli"},
    "omegaconf": {"cli"},
    "lightning": {"data", "training", "cli"},
    "torchmetrics": {"metrics"},
    "numba": {"ops"},
    "trimesh": {"synth"},
    "embreex": {"synth"},
    "imageio": {"data", "drawing", "cli"},
    "imageio_ffmpeg": {"drawing", "cli"},
    "rich": {"training", "cli"},
    "matplotlib": {"report"},
    "torchvision": set(),
}
FUNCTION_LINES, FILE_LINES = 40, 250
REASON = "# long: "


def part_of(file: Path) -> str:
    """The package (or the module, at the top) that a file belongs to."""
    return file.relative_to(SOURCE).parts[0].removesuffix(".py")


def imports(tree: ast.AST):
    """Every dotted module name that is imported, wherever it stands."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def breaches(part: str, tree: ast.AST) -> list[str]:
    """Imports that the table does not allow to ``part``."""
    found = []
    for name in imports(tree):
        top, *rest = name.split(".")
        if top == "forewarp" and rest:
            found += [name] if rest[0] != part and rest[0] not in MAY_IMPORT[part] else []
        elif part not in ONLY_IN.get(top, {part}):
            found.append(name)
    return found


def own_lines(node: ast.FunctionDef) -> int:
    """Lines of a function but for its docstring."""
    doc = node.body[0] if ast.get_docstring(node) else None
    return node.end_lineno - node.lineno + 1 - (doc.end_lineno - doc.lineno + 1 if doc else 0)


def too_long(text: str) -> list[str]:
    """What exceeds a ceiling without saying why."""
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


def test_init_files_hold_one_sentence():
    for file in SOURCE.rglob("__init__.py"):
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
    ],
)
def test_the_check_itself(part, line, allowed):
    assert (breaches(part, ast.parse(line)) == []) is allowed


def test_a_long_function_needs_a_reason():
    body = "\n".join(["    pass"] * FUNCTION_LINES)
    assert too_long(f"def f():\n{body}") == ["f: 41 lines"]
    assert too_long(f"def f():  # long: a table\n{body}") == []
