"""What the docs site makes while it is built: the home page, the reference, and links to source files."""

import ast
import re
from pathlib import Path, PurePosixPath

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "forewarp"
TITLE = "Reference"
WHOLE_WIDTH = "---\nhide: [navigation, toc]\n---\n\n"  # the home page has nothing beside it
SEARCH = "site/search-from-disk.js"
UNLISTED = {"cli", "kernels"}  # told by --help; each tested against its reference

INTRODUCTION = f"""# {TITLE}

One page a package, from the docstrings. `forewarp.load` opens a run as a
[`Fitted`](runs.md#forewarp.runs.fitted.Fitted) ([notebooks and scripts](../scripts.md)). What a method must
do is in [`methods.method`](methods.md#forewarp.methods.method), who may import whom in
[architecture](../architecture.md).
"""

# A link or picture of Markdown: what stands before the address, the address.
LINK = re.compile(r"(\]\()([^)\s#]+)")
# A piece of code in a row of a table, where only GitHub's Markdown wants its bars escaped.
ROW, CODE = re.compile(r"^\|.*$", re.MULTILINE), re.compile(r"`[^`]*`")


def packages() -> dict[str, list[str]]:
    """Return the modules of each package, dotted: the package itself first, then its files."""
    found = {}
    for init in sorted(SOURCE.rglob("__init__.py"), key=lambda file: file.parent.parts):
        parts = init.parent.relative_to(SOURCE.parent).parts
        if not UNLISTED & set(parts):
            files = sorted(file.stem for file in init.parent.glob("[!_]*.py"))
            found[".".join(parts)] = [".".join([*parts, name]) for name in files]
    return found


def about(package: str) -> str:
    """Return the first paragraph of a package's docstring."""
    text = (SOURCE.parent / Path(*package.split(".")) / "__init__.py").read_text()
    return ast.get_docstring(ast.parse(text)).split("\n\n")[0]


def page_of(package: str) -> str:
    """Name the page of a package."""
    return f"reference/{package.removeprefix('forewarp.').replace('.', '-')}.md"


def reference() -> dict[str, str]:
    """Write the pages of the reference: name -> Markdown."""
    rows = [f"| [`{name}`]({PurePosixPath(page_of(name)).name}) | {about(name)} |" for name in packages()]
    pages = {"reference/index.md": "\n".join([INTRODUCTION, "| package | holds |", "|---|---|", *rows])}
    for name, modules in packages().items():
        own = [f"::: {name}\n    options: {{show_root_toc_entry: false, show_submodules: false}}"]
        parts = [f"# {name}"] + (own if name == "forewarp" else [about(name)])
        pages[page_of(name)] = "\n\n".join(parts + [f"::: {module}" for module in modules])
    return pages


def on_config(config):
    """List the pages of the reference in the navigation, and let pages from disk search by our own script."""
    config.extra["polyfills"] = [SEARCH]  # in place of one from the network, which the plugin offline adds
    pages = [{"Packages": "reference/index.md"}] + [{name: page_of(name)} for name in packages()]
    config.nav = [{TITLE: pages} if TITLE in item else item for item in config.nav]
    return config


def on_files(files, config):
    """Add the home page, which is README.md, and the reference."""
    home = (ROOT / "README.md").read_text().replace("](docs/", "](")
    for name, text in {"index.md": WHOLE_WIDTH + home, **reference()}.items():
        files.append(File.generated(config, name, content=text))
    return files


def on_page_markdown(markdown, page, config, files):
    """Let links to a source file lead to where the reference has it, and show bars of code in tables."""
    here = PurePosixPath("docs", page.file.src_uri).parent

    def lead(found: re.Match) -> str:
        target = _plain(here / found[2])
        if target.suffix != ".py" or target.parts[:2] != ("src", "forewarp"):
            return found[0]
        name = ".".join(target.with_suffix("").parts[1:])
        up = "../" * len(PurePosixPath(page.file.src_uri).parent.parts)
        return f"{found[1]}{up}{page_of(name.rpartition('.')[0])}#{name}"

    bars = ROW.sub(lambda row: CODE.sub(lambda code: code[0].replace("\\|", "|"), row[0]), markdown)
    return LINK.sub(lead, bars)


def _plain(path: PurePosixPath) -> PurePosixPath:
    """Resolve the ``..`` of a path."""
    parts = []
    for part in path.parts:
        parts = parts[:-1] if part == ".." else [*parts, part]
    return PurePosixPath(*parts)
