"""All of these tests need the packages of ``forewarp[synth]``."""

import pytest


@pytest.fixture(scope="session", autouse=True)
def _packages():
    for name in ("trimesh", "embreex"):
        pytest.importorskip(name)
