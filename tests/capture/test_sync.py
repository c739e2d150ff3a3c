import numpy as np
import pytest
from scipy.io import wavfile
from scipy.signal import fftconvolve, resample_poly

pytest.importorskip("pycolmap", reason="no pycolmap; make install adds it")

from forewarp.capture.sync import MOST, RATE, agreed, is_silent, synchronise
from forewarp.data.video import sound_of
from tests.support.films import numbered, write_film

OFFSETS = np.array([0.0, 0.3127, 1.5, 0.811])


def tracks(offsets, *, seconds=12.0, noise=0.02, seed=0, has_echo=True):
    """What microphones with echoes and noise of their own hear of one stretch of speech-like noise."""
    rng, rate = np.random.default_rng(seed), 6 * RATE
    count = round((seconds + max(offsets) + 1) * rate)
    loud = np.repeat(rng.uniform(size=count // 6000 + 1) ** 3, 6000)[:count]
    voice, heard = loud * rng.normal(size=count) * 0.2, []
    for offset in offsets:
        room = np.zeros(4800)
        room[0] = 1
        room[rng.integers(200, 4800, 30)] = 0.15 * has_echo * rng.normal(size=30)
        mine = fftconvolve(voice, room)[round(offset * rate) :][: round(seconds * rate)]
        mine = resample_poly(mine, 1, 6)
        heard.append((mine + noise * rng.normal(size=len(mine))).astype(np.float32))
    return heard


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.001, 0.05])
def test_offsets_are_found_through_echoes_and_noise(noise):
    found = synchronise(tracks(OFFSETS, noise=noise))
    assert found.offsets == pytest.approx(OFFSETS, abs=5e-4)
    assert found.is_sure().all()
    assert found.agreeing.tolist() == [3, 3, 3, 3]
    assert found.residual.max() < 1e-3
    assert found.certainty.min() > 1.5


def test_films_of_other_lengths_and_a_turned_microphone_do_not_matter():
    heard = tracks(OFFSETS[:2])
    found = synchronise([-heard[0], heard[1][: 4 * RATE]])
    assert found.offsets == pytest.approx(OFFSETS[:2], abs=5e-4)
    assert found.is_sure().all()


@pytest.mark.slow
def test_one_that_heard_another_thing_is_not_believed_and_does_not_matter():
    heard = tracks(OFFSETS)
    found = synchronise([*heard, tracks([0.0], seed=9)[0]])
    apart = found.offsets - found.offsets[0]
    assert apart[:4] == pytest.approx(OFFSETS, abs=5e-4)
    assert found.is_sure().tolist() == [True, True, True, True, False]


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 6])
def test_where_nothing_is_heard_by_two_nothing_is_believed(count):
    heard = [tracks([0.0], seed=seed)[0] for seed in range(count)]
    assert not synchronise(heard).is_sure().any()


def test_a_hum_that_all_hear_tells_nothing():
    rng, times = np.random.default_rng(0), np.arange(10 * RATE) / RATE
    hums = np.sin(2 * np.pi * 220 * (times + OFFSETS[:, None]))
    hums = (hums + 0.02 * rng.normal(size=hums.shape)).astype(np.float32)
    assert not synchronise(list(hums)).is_sure().any()


def test_pairs_that_are_wrong_are_outvoted_though_they_are_sure():
    true = np.array([0.0, 0.2, 0.5, 0.9, 1.4])
    votes = {(i, j): (true[j] - true[i], 1.6) for i in range(5) for j in range(i + 1, 5)}
    votes[0, 1], votes[2, 4] = (7.0, 9.0), (-3.0, 9.0)
    found = agreed(votes, 5)
    assert found.offsets == pytest.approx(true, abs=1e-9)
    assert found.agreeing.tolist() == [3, 3, 3, 4, 3]


def test_sound_begins_with_the_film_and_a_film_without_has_none(tmp_path):
    """In a file whose sound begins a second after its images, it is heard a second later."""
    clap = np.zeros(48000, np.int16)
    clap[24000:24048] = 20000
    wavfile.write(tmp_path / "clap.wav", 48000, clap)
    words = ["-itsoffset", "1", "-i", str(tmp_path / "clap.wav"), "-c:a", "aac"]
    film = write_film(tmp_path / "a.mp4", numbered(50), inputs=words)
    sound = sound_of(film, RATE, MOST)
    assert np.abs(sound).argmax() / RATE == pytest.approx(1.5, abs=2e-3)
    assert not is_silent(sound)
    assert is_silent(sound_of(write_film(tmp_path / "silent.mp4", numbered(3)), RATE, MOST))
