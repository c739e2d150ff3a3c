"""What the operators and their kernels agree on: where the numbers of a splat lie, tiles, and limits."""

from __future__ import annotations

import math
from collections import namedtuple

# Columns of a splat; ``Splats.values`` has those up to the depth.
_NAMES = "x y conic_a conic_b conic_c opacity red green blue depth reach_x reach_y log_opacity"
COLUMN = namedtuple("Columns", _NAMES)(*range(13))
SPLAT_WIDTH = 16  # numbers of a splat as kernels read it: its columns, then zeros
TILE_SIZE = 8  # pixels of a tile along both axes
MAX_PER_TILE = 1 << 15  # splats of a tile that count, the nearest ones
LOG_MIN_ALPHA = -math.log(255.0)  # an alpha of less than a 255th is not seen
EPSILON = 1e-20  # the sum of a particle's weights is divided by this at least: that of one at rest is 0
