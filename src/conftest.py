"""What doctests may use: ``fitted_run``, the folder of a small finished run, made if one asks for it."""

import pytest


@pytest.fixture(autouse=True)
def _names_of_doctests(request, doctest_namespace, tmp_path_factory):
    test = getattr(request.node, "dtest", None)
    if test is not None and "fitted_run" in test.docstring:
        from tests.support.commands import fitted_run

        doctest_namespace["fitted_run"] = str(fitted_run(tmp_path_factory))
