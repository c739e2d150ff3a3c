"""NeRF: one field for all times."""

from __future__ import annotations

from forewarp.fields.networks import Template
from forewarp.methods.method import Start
from forewarp.methods.rays import OF_JAX, Field, SampledMethod, Sampling, encoder
from forewarp.ops.encode import encoded_size
from forewarp.scene.view import Moment


class NeRF(SampledMethod):
    """``(x, d) -> (density, colour)``: ``N(PE(x), PE(d))``, whatever the time.

    A network of its own places the samples; both are trained (NeRF, equations 2, 5 and 6). It shows what a
    scene looks like if nothing may move: what moves is blurred to its mean over time.

    Args:
        start: scene, stage and numbers.
        sampling: see ``Sampling``.
        width, layers, skip: see ``fields.networks.Trunk``.
        position_frequencies, direction_frequencies: octaves of the encodings.
        glorot: the NeRF of HyperNeRF's tables: Nerfies without its warp, whose code is in JAX (first values:
            Glorot's, biases 0), in place of PyTorch's.
    """

    terms = ("photo", "coarse_photo")

    def __init__(
        self,
        start: Start,
        *,
        sampling: Sampling | None = None,
        width: int = 256,
        layers: int = 8,
        skip: int | None = 6,
        position_frequencies: int = 10,
        direction_frequencies: int = 4,
        glorot: bool = False,
    ) -> None:
        super().__init__(start, sampling or Sampling())
        if glorot:
            self.published = "softplus"
            note = "as Nerfies without its warp (the configuration was not published)"
            self.conventions = (note, OF_JAX[0])
        self.position = encoder("position", position_frequencies)
        self.direction = encoder("direction", direction_frequencies)
        sizes = encoded_size(3, position_frequencies), encoded_size(3, direction_frequencies)
        shape = {"width": width, "layers": layers, "skip": skip, "glorot": glorot}
        self.coarse, self.fine = self.passes(lambda: Template(*sizes, **shape))

    def fields(self, moment: Moment) -> tuple[Field, Field]:
        """See ``SampledMethod``."""
        return self.both(self.position, self.direction)
