"""What several methods do otherwise than published, and faults that they keep: one wording of each fact."""

from __future__ import annotations

CENTRES = "pixel centres at +0.5"
ALONG_RAYS = "near and far along unit rays"
ONE_TIME = "a step's rays are of one time"
BETWEEN_TIMES = "codes interpolated between training times"
NO_JUMP = "offsets without a jump at the canonical time"
JUMP = "offsets jump at the canonical time (continuous)"  # the fault that ``NO_JUMP`` mends
