"""The methods that the contract suite tests: one entry each, sized for images of 20 pixels."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

from forewarp.fields.curves import TrajectoryField
from forewarp.methods.dnerf import DNeRF
from forewarp.methods.hypernerf import HyperNeRF
from forewarp.methods.method import Method, Start
from forewarp.methods.ndvg import NDVG
from forewarp.methods.nerf import NeRF
from forewarp.methods.nerfies import Nerfies
from forewarp.methods.neural_volumes import NeuralVolumes
from forewarp.methods.particles import exposure
from forewarp.methods.particles.model import Particles
from forewarp.methods.particles.nodes import Nodes
from forewarp.methods.rays import Marching, Sampling
from forewarp.methods.tineuvox import TiNeuVox
from forewarp.methods.tnerf import TNeRF
from forewarp.methods.voxel.backward import BackwardWarp, Deformation
from forewarp.methods.voxel.effects import (
    LearnedUpsampler,
    Motion,
    SphericalHarmonics,
    StaticBackground,
    Together,
    TrilinearUpsampler,
    UNet3d,
    ViewNetwork,
)
from forewarp.methods.voxel.forward import ForwardWarp
from tests.support.tiny_scene import EVERYTHING, INPAINTER, RADIANCE
from tests.support.tiny_scene import RATES as VOXEL_RATES


@dataclass(frozen=True)
class Effect:
    """An optional part of a method.

    ``on`` are the model's fields that switch it on (None is off). ``parts`` are pairs of a class and a
    function name: none is called with the effect off, at least one with it on; empty for an effect that only
    gives the same functions more numbers. The names of its parameters and buffers begin with one of ``owns``;
    None: with its own name.
    """

    on: Mapping[str, object]
    parts: tuple[tuple[type, str], ...]
    owns: tuple[str, ...] | None = None


@dataclass(frozen=True)
class Entry:
    """A small method to test.

    ``model`` makes it; ``lr`` and ``numbers`` are of its stage, ``weights`` of its objective. After ``steps``
    its loss must be below ``falls`` times the first. ``effects`` are its optional parts by name, with which
    the names of their parameters begin. ``slow``: another entry has its parts, so its tests are slow ones.
    """

    model: Callable[[Start], Method]
    lr: Mapping[str, float]
    weights: Mapping[str, float] = field(default_factory=lambda: {"photo": 1.0})
    numbers: Mapping[str, object] = field(default_factory=dict)
    falls: float = 0.5
    steps: int = 60
    effects: Mapping[str, Effect] = field(default_factory=dict)
    slow: bool = False


TRAJECTORY = partial(TrajectoryField, bases=4, nodes=6, width=24, layers=3)
VOXELS = {
    "lr": VOXEL_RATES,
    "weights": {"photo": 1.0, "point_color": 0.01, "background_entropy": 1e-3},
    "numbers": {"num_voxels": [[0, 10**3], [0.6, 12**3]], "background_num_voxels": [[0, 6**3]]}
    | {"keep_alpha": 1e-2, "birth_alpha": 5e-3, "refresh_every": 5},
    "steps": 100,
}


def calls(of, *names):
    """Pairs of a class and the names of its functions."""
    return tuple((of, name) for name in names)


SHADING = calls(SphericalHarmonics, "forward") + calls(ViewNetwork, "forward")
SPLAT = calls(Motion, "warp") + calls(TrajectoryField, "flow", "coefficients")
FINER = calls(LearnedUpsampler, "residual", "forward") + calls(TrilinearUpsampler, "forward")
STILL = calls(StaticBackground, "forward") + calls(Together, "density")
VIEW = Effect({"view_dependence": SphericalHarmonics}, SHADING)
BACKGROUND = Effect({"background": EVERYTHING["background"]}, STILL)
WARP = {
    "motion": Effect({"motion": Motion}, SPLAT),
    "view_dependence": VIEW,
    "upsampler": Effect({"upsampler": EVERYTHING["upsampler"]}, FINER),
    "inpainter": Effect({"inpainter": INPAINTER}, calls(UNet3d, "features", "residual")),
    "background": BACKGROUND,
}
OF_PARTICLES = {
    "motion": Effect({"motion": "spline"}, calls(Nodes, "motion_and_maps", "backward"), ("deformation",)),
    "rotation": Effect({"rotation": True}, (), ("deformation.nodes.rotations",)),
    "view_dependence": Effect({"view_dependence": 1}, (), ("gaussians.sh",)),
    "color_over_time": Effect({"color_over_time": 1}, (), ("gaussians.color_over_time",)),
    "opacity_over_time": Effect({"opacity_over_time": 1}, (), ("gaussians.opacity_over_time",)),
    "exposure": Effect({"exposure": 1}, calls(exposure, "gain_and_bias", "lit", "to_unlit")),
    "background": Effect({"background": 0.03}, (), ("deformation.resting", "deformation.nodes.stopped")),
}
RATES = {"means": 1.5e-3, "scales": 5e-3, "quaternions": 3e-3, "opacity": 5e-2, "colors": 3e-2, "sh": 1e-3}
RATES |= {"color_over_time": 1e-3, "opacity_over_time": 3e-3, "skinning": 1e-2, "time_offsets": 0.3}
RATES |= {"exposure": 1e-3, "node_translations": 7e-3, "node_rotations": 8e-3}
SMALL_NETWORK = {"width": 32, "layers": 3, "skip": None, "position_frequencies": 4}
SMALL_NETWORK |= {"sampling": Sampling(16, 16, density="softplus", open_end=False, inside_box=True)}
SMALL_WARP = {"warp_width": 24, "warp_layers": 3, "warp_skip": None, "still_points": 64}
SMALL_VOLUMES = {"picture_size": (8, 8), "tower": (8, 16), "features": 16, "code": 8}
SMALL_VOLUMES |= {"decoder": (32, 16, 16, 8), "maps": 4, "warp_side": 6, "warp_width": 16, "weight_width": 8}
SMALL_VOLUMES |= {"step": 1 / 12, "from_identity": True, "first_opacity": 0.1, "first_deviation": 0.05}
NETWORK = {"lr": {"network": 2e-3}, "falls": 0.6, "steps": 150}
PHOTO, SLOW = {"photo": 1.0}, NETWORK | {"slow": True}
PASSES = PHOTO | {"coarse_photo": 1.0}
MARCHED = {"photo": 1.0, "point_color": 0.01, "background_entropy": 1e-3, "still": 0.1}
MARCHING = Marching(jitter=True, occupancy=12)

METHODS = {
    "forward": Entry(
        partial(ForwardWarp, radiance=RADIANCE, motion=Motion, trajectory=TRAJECTORY), **VOXELS, effects=WARP
    ),
    "backward": Entry(
        partial(BackwardWarp, radiance=RADIANCE, deformation=partial(Deformation, width=24, layers=3)),
        **VOXELS,
        effects={"view_dependence": VIEW, "background": BACKGROUND},
    ),
    "tnerf": Entry(partial(TNeRF, **SMALL_NETWORK, time_frequencies=2), **NETWORK),
    "nerf": Entry(partial(NeRF, **SMALL_NETWORK), weights=PASSES, **SLOW),  # it cannot show what moves
    "dnerf": Entry(
        partial(DNeRF, **SMALL_NETWORK, time_frequencies=2), weights=PHOTO | {"second_time": 1e-4}, **SLOW
    ),
    "nerfies": Entry(
        partial(Nerfies, **SMALL_NETWORK, **SMALL_WARP, elastic_samples=64),
        **{"weights": PASSES | {"elastic": 1e-3, "still": 1e-3}, "numbers": {"warp_in": 0.3}} | SLOW,
    ),
    "hypernerf": Entry(
        partial(HyperNeRF, **SMALL_NETWORK, **SMALL_WARP, slice_width=16),
        **{"weights": PASSES | {"still": 1e-3}} | SLOW,
        numbers={"warp_in": 0.3, "slice_from": 0.01, "slice_in": 0.2},
    ),
    "tineuvox": Entry(
        partial(TiNeuVox, marching=MARCHING, width=24, position_frequencies=3, camera=True, padded=False),
        {"grid": 8e-2, "deformation": 2e-3, "network": 5e-3},
        MARCHED | {"tv_grid": 1e-6},
        {"num_voxels": [[0, 9**3], [0.4, 13**3]]},
        steps=100,
        slow=True,
    ),
    "ndvg": Entry(
        partial(NDVG, marching=MARCHING, width=(24, 24), continuous=True),
        {"density": 0.1, "color": 0.1, "deformation": 0.1, "network": 3e-3},
        MARCHED | {"flow_l1": 1e-2, "tv_deformation": 1.0, "canonical": 1.0},
        {"num_voxels": [[0, 9**3], [0.4, 12**3]], "alpha_init": 1e-2},
        steps=100,
        slow=True,
    ),
    "neural_volumes": Entry(
        partial(NeuralVolumes, **SMALL_VOLUMES, jitter_in_pictures=False),
        {"network": 5e-3},
        {"photo": 104.04, "code_prior": 1e-3, "opacity_prior": 1e-2, "opacity_variation": 1e-2},
        falls=0.7,  # its rays also miss what an instant's one picture does not show
        steps=200,
        slow=True,
    ),
    "particles": Entry(
        partial(Particles, **{k: v for effect in OF_PARTICLES.values() for k, v in effect.on.items()}),
        RATES,
        {"photo": 1.0, "rigid": 3.0, "smooth": 0.1, "static": 0.05},
        {"density_interval": 0.05, "density_until": 0.9}
        | {"lr_final_factor": dict.fromkeys(RATES, 0.1) | {"means": 0.01}},
        steps=150,
        effects=OF_PARTICLES,
    ),
}
