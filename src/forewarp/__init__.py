"""Reconstruct a moving scene from images, and see it from anywhere, at any time.

``forewarp.load(run)`` opens a fitted scene; ``Camera``, ``look_at`` and ``orbit`` say from where to see it.
Everything else is imported from the file that defines it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from forewarp.scene.camera import Camera, look_at, orbit

__all__ = ["Camera", "load", "look_at", "orbit"]


def load(run, *, trust=(), device="cpu", data_root=None):
    """Open a fitted run, to render it, follow its points and read its numbers; or a ``scene.glb``.

    Args:
        run: the run's folder, or the file that ``forewarp-export format=glb`` wrote.
        trust: packages whose code the run's config may name, beside forewarp; nothing else is imported.
        device: where to compute: ``cpu`` or ``cuda``.
        data_root: the folder that holds the scene's folder, where the data have moved since.

    Returns:
        a ``forewarp.runs.fitted.Fitted``; of a file, a ``SceneFile``.

    Raises:
        ValueError: where there is no finished run, where it names code that is not trusted, or where a file
            is none of ours.
    """
    from forewarp.provenance import drop_missing_backend

    drop_missing_backend()  # before what imports matplotlib
    from forewarp.runs.fitted import open_run

    return open_run(run, trust=trust, device=device, data_root=data_root)


def __getattr__(name: str):
    """Import the other names when they are first used, as torch takes a second."""
    if name == "__version__":
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("forewarp")
        except PackageNotFoundError:  # on PYTHONPATH, not installed
            return "unknown"
    if name not in __all__:
        raise AttributeError(f"module 'forewarp' has no attribute '{name}'")
    from forewarp.scene import camera

    return getattr(camera, name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
