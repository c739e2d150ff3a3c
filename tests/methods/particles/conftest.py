"""The small scene that particles are tested on."""

import pytest

from tests.support.particles import small_data


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Its data module."""
    return small_data(tmp_path_factory.mktemp("scenes"))
