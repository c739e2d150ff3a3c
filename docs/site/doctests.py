"""Show the doctests of a docstring as code: Markdown would take their arrows for quotations."""

import re

import griffe

# From the first line that begins with arrows to the next empty line.
DOCTEST = re.compile(r"^>>> .*?(?=\n\n|\Z)", re.MULTILINE | re.DOTALL)


class Doctests(griffe.Extension):
    """Fence what stands outside a section; griffe itself knows those of ``Examples:``."""

    def on_object(self, *, obj: griffe.Object, **_) -> None:
        """Change an object's docstring."""
        if obj.docstring:
            obj.docstring.value = fenced(obj.docstring.value)


def fenced(text: str) -> str:
    """Put a fence around each doctest of a docstring."""
    return DOCTEST.sub(lambda found: f"```pycon\n{found[0].rstrip()}\n```", text)
