"""Nerfies: each frame's code bends space by screws to a template; what bends much but need not is pulled rigid."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn

from forewarp.fields.codes import CameraCodes, TimeCodes
from forewarp.fields.screws import ScrewWarp
from forewarp.fields.template import Template
from forewarp.methods.method import Start
from forewarp.methods.sampled import Field, SampledMethod, Sampling, encoder
from forewarp.ops.encode import encoded_size
from forewarp.quadrature import Sampled
from forewarp.scene.batch import Batch
from forewarp.scene.view import Moment
