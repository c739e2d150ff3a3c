"""NeRF: one field for all times."""

from __future__ import annotations

from forewarp.fields.networks import Template
from forewarp.methods.method import Start
from forewarp.methods.rays import OF_JAX, Field, SampledMethod
from forewarp.scene.view import Moment


class NeRF(SampledMethod):
    """``(x, d) -> (density, colour)``: ``N(PE(x), PE(d))``, whatever the time.

    A network of its own places the samples; both are trained (NeRF, equations 2, 5 and 6). It shows what a
    scene looks like if nothing may move: what moves is blurred to its mean over time.

    Args:
        start: scene, stage and numbers.
        glorot: the NeRF of HyperNeRF's tables: Nerfies without its warp, whose code is in JAX (first values:
            Glorot's, biases 0), in place of PyTorch's.
        network: sampling, width, layers, skip and octaves: see ``SampledMethod``.
    """

    terms = ("photo", "coarse_photo")

    def __init__(self, start: Start, *, glorot: bool = False, **network) -> None:
        super().__init__(start, glorot=glorot, **network)
        if glorot:
            self.published = "softplus"
            note = "as Nerfies without its warp (the configuration was not published)"
            self.conventions = (note, OF_JAX[0])
        self.coarse, self.fine = self.passes(lambda: Template(*self.sizes, **self.shape))

    def fields(self, moment: Moment) -> tuple[Field, Field]:
        """See ``SampledMethod``."""
        return self.both(self.position, self.direction)
