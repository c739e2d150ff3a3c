"""What measures memory: a process and those that it has started, and the rigs that it is measured on."""

import subprocess
import sys
import threading
import time

import pytest

from forewarp.data.multicam import read_scene
from tests.bench.memory import HEAD, Sampled, family, resident, row, write_rig

GRANDCHILD = "import subprocess, sys; subprocess.run([sys.executable, '-c', 'input()'])"


def test_memory_is_that_of_a_process_and_of_all_that_it_started():
    with subprocess.Popen([sys.executable, "-c", GRANDCHILD], stdin=subprocess.PIPE) as process:
        while len(found := family(process.pid)) < 2 or min(map(resident, found)) < 1e6:  # begun
            time.sleep(0.01)
        sampled = Sampled(process.pid)
        watch = threading.Thread(target=sampled.run)
        watch.start()
        while not sampled.rows:
            time.sleep(0.01)
        sampled.ended.set()
        watch.join()
        process.communicate(b"\n")
    at, size = sampled.rows[0]
    assert size > resident(process.pid) == 0
    assert sampled.peak() >= size
    assert sampled.peak(at + 1000) == 0


@pytest.mark.slow
@pytest.mark.parametrize("in_folders", [False, True])
def test_a_rig_of_looped_films_is_read(tmp_path, in_folders):
    write_rig(tmp_path / "loop", 60, 2, (64, 48), in_folders)
    scene = read_scene(tmp_path, "loop", scale=1)
    assert (len(scene.train), len(scene.test), scene.protocol["resolution"]) == (30, 30, [64, 48])
    first, again = (frame.load()[..., :3].float() for frame in (scene.train[0], scene.train[15]))
    assert float((first - again).abs().mean()) < 2


def test_a_row_has_a_number_for_each_column():
    told = dict.fromkeys(("disk", "decoding", "to the first step", "step"), 2.0)
    told |= dict.fromkeys(("peak before", "peak training", "peak scoring"), 2.5e9)
    cells = row(told, 6000, 20, (4, 3), True)
    assert len(cells) == len(HEAD)
    assert cells[:3] == ["6,000 JPEG", "20", "4 x 3"]
    assert cells[-1] == "2.50"
