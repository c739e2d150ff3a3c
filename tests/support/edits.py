"""Changes what a JSON file holds."""

import json
from functools import reduce
from operator import getitem

GONE = object()


def edit(path, change):
    """Change a file by a function of its content or by places, ``{"frames.1.time": 3}``; ``GONE`` removes."""
    content = json.loads(path.read_text())
    if callable(change):
        change(content)
    else:
        for place, value in change.items():
            *way, last = (int(key) if key.isdecimal() else key for key in place.split("."))
            holder = reduce(getitem, way, content)
            if value is GONE:
                del holder[last]
            else:
                holder[last] = value
    path.write_text(json.dumps(content))
