"""What a part cannot be built from is refused in one line that names what was expected."""

from functools import partial

import pytest

from forewarp.fields.curves import TrajectoryField
from forewarp.fields.grids import density_shift
from forewarp.fields.networks import Template, Trunk, density_of, mlp
from forewarp.scene.box import Box

CODES, LAYERS = (
    "frame codes: expected a time and width >= 1, but got",
    "expected layers >= 1 and width >= 1, but",
)
SKIP = r"width and layers >= 1 and a skip in \[2, layers\] or"
REFUSED = [
    (partial(mlp, 5, 2, width=7, layers=0), LAYERS),
    (partial(mlp, 5, 2, width=0, layers=2), LAYERS),
    *(
        (partial(density_shift, alpha), r"alpha_init: expected a number in \(0, 1\), but got")
        for alpha in (0.0, 1.0)
    ),
    *(
        (partial(Trunk, 5, **({"width": 6, "layers": 4, "skip": 3} | wrong)), SKIP)
        for wrong in ({"skip": 1}, {"skip": 5}, {"layers": 0}, {"width": 0})
    ),
    (partial(Template, 5, 0), "template: expected condition >= 1 and width >= 2, but got"),
    (partial(density_of, "exp"), "model.sampling.density: expected relu or softplus, but got 'exp'"),
    (
        partial(TrajectoryField, Box((0, 0, 0), (1, 1, 1)), bases=3, frames=1, canonical_time=0.3),
        "expected at least 2 distinct training times, but got 1; use model/motion=none",
    ),
]


@pytest.mark.parametrize(("call", "text"), REFUSED)
def test_refuses(call, text):
    with pytest.raises(ValueError, match=text):
        call()
