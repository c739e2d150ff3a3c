from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from forewarp.ops.backend import cores, match_threads, numba_installed


@pytest.mark.skipif(not numba_installed() or cores() < 2, reason="needs Numba and two cores")
def test_numba_follows_the_threads_of_pytorch(two_threads):
    import numba

    for wanted in (2, 2, 1, 2):
        torch.set_num_threads(wanted)
        assert match_threads() == wanted == numba.get_num_threads()


@pytest.mark.skipif(not numba_installed() or cores() < 2, reason="needs Numba and two cores")
def test_each_thread_is_matched_by_itself(two_threads):
    import numba

    match_threads()

    def seen():
        torch.set_num_threads(1)
        return match_threads(), numba.get_num_threads()

    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(seen).result() == (1, 1)
    torch.set_num_threads(2)
    assert match_threads() == 2 == numba.get_num_threads()
