"""Scenes that are not there, refused before torch is loaded to read them."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from forewarp.data.files import MARKERS, scene_folder

# Other data modules, those that make their scene among them, say for themselves what they need.
READERS = {
    "forewarp.data.module.DNeRFDataModule": "dnerf",
    "forewarp.data.module.LegoCompleteDataModule": "lego_complete",
    "forewarp.data.module.HyperNeRFDataModule": "hypernerf",
    "forewarp.data.module.NHRDataModule": "nhr",
    "forewarp.data.module.PosedVideoDataModule": "posed_video",
}


def refuse_absent(config: DictConfig) -> None:
    """Refuse a scene whose folder is not there, unless ``absent`` says what else to do.

    Raises:
        SceneError: naming the scenes that are there.
    """
    reader = READERS.get(config.data.get("_target_"))
    if reader is not None and config.get("absent", "refuse") == "refuse":
        scene_folder(Path(config.data.root).expanduser(), str(config.data.scene), MARKERS[reader])
