"""Reconstruct a moving scene from images, and see it from anywhere, at any time.

``forewarp.load(run)`` opens a fitted scene; everything else is imported from the file that defines it.
"""


def load(run, *, trust=(), device="cpu"):
    """Open a fitted run, to render it, follow its points and read its numbers; or a ``scene.glb``.

    Args:
        run: the run's folder, or the file that ``forewarp-export format=glb`` wrote.
        trust: packages whose code the run's config may name, beside forewarp; nothing else is imported.
        device: where to compute: ``cpu`` or ``cuda``.

    Returns:
        a ``forewarp.runs.fitted.Fitted``; of a file, a ``SceneFile``.

    Raises:
        ValueError: where there is no finished run, where it names code that is not trusted, or where a file
            is none of ours.
    """
    from forewarp.runs.fitted import open_run

    return open_run(run, trust=trust, device=device)
