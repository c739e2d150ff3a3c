"""One implementation of each thing: a second one would drift from the first."""

import ast
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1] / "src" / "forewarp"
TREES = {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text()) for path in ROOT.rglob("*.py")}


@cache
def homes(things):
    """Where each thing occurs: name -> files."""
    found = defaultdict(set)
    for file, tree in TREES.items():
        for name in things(tree):
            found[name].add(file)
    return found


def public_definitions(tree):
    defined = (n for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef))
    return [n.name for n in defined if not n.name.startswith("_")]


def attributes(tree):
    return [n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)]


def bodies(tree):
    """Every function's statements without its docstring, where there are at least two of them."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            own = node.body[1:] if ast.get_docstring(node) else node.body
            if len(own) > 1:
                yield "; ".join(ast.unparse(statement) for statement in own)


def test_no_public_name_of_the_core_is_defined_twice():
    core = ("ops/", "scene/", "fields/", "methods/", "losses.py", "renderer.py")
    found = homes(public_definitions)
    # A kernel bears the name of the operator that it serves.
    twice = {
        name: [f for f in files if f.startswith(core) and not f.startswith("ops/kernels/")]
        for name, files in found.items()
    }
    twice.pop("Deformation")  # of voxels, which configs of earlier runs name, and of particles
    assert {name: files for name, files in twice.items() if len(files) > 1} == {}


def test_nothing_is_written_twice():
    assert {body: files for body, files in homes(bodies).items() if len(files) > 1} == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("operation", "home"),
    [
        (
            "softplus",
            {"fields/grids.py", "methods/rays.py", "methods/neural_volumes.py"},
        ),  # raw density: of voxels, of networks, of decoded volumes
        # Compositing is in log space, in ops/march.py; a splat may be opaque, which has no logarithm.
        ("cumprod", {"ops/gaussians.py"}),
        # Trilinear reads are ops/grid.py's; Neural Volumes reads volumes with gradients to places; a lens of
        # images is undone before a sweep.
        ("grid_sample", {"methods/neural_volumes.py", "methods/particles/start.py"}),
        ("scatter_add_", set()),
    ],
)
def test_an_operation_has_one_home(operation, home):
    assert homes(attributes)[operation] == home


@pytest.mark.slow
def test_a_weight_is_compared_with_zero_in_the_objective_only():
    def comparisons(tree):
        for node in ast.walk(tree):
            if isinstance(node, ast.Compare) and any(
                isinstance(c, ast.Constant) and c.value == 0 for c in node.comparators
            ):
                yield from (n.id for n in ast.walk(node.left) if isinstance(n, ast.Name) and "weight" in n.id)

    assert homes(comparisons)["weight"] == {"training/objective.py"}


@pytest.mark.slow
def test_effects_are_asked_for_in_the_methods_only():
    def questions(tree):
        for node in ast.walk(tree):
            if isinstance(node, ast.Compare) and any(isinstance(o, ast.Is | ast.IsNot) for o in node.ops):
                yield from (n.attr for n in ast.walk(node.left) if isinstance(n, ast.Attribute))

    found = homes(questions)
    for effect in ("upsampler", "inpainter"):
        assert found[effect] == {"methods/voxel/forward.py"}
