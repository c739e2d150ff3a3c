import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from forewarp.glb import meshopt


def elements(count, stride, seed=0):
    """Bytes of every kind: constant, of small and of large differences."""
    generator = np.random.default_rng(seed)
    steps = generator.integers(-2, 3, (count, stride)) * (generator.random((count, stride)) < 0.4)
    made = np.cumsum(steps, 0).astype(np.uint8)
    made[:, ::4], made[:, 3::4] = generator.integers(0, 256, (count, 1)), 7
    return made


@pytest.mark.parametrize(
    ("count", "stride"), [(0, 4), (1, 4), (16, 8), (17, 8), (255, 12), (700, 12), (513, 64), (40, 256)]
)
def test_what_is_compressed_comes_back(count, stride):
    made = elements(count, stride)
    data = meshopt.encode(made)
    assert meshopt.least_bytes(count, stride) <= len(data) <= made.size * 1.1 + 300
    np.testing.assert_array_equal(meshopt.decode(data, count, stride), made)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 90), st.sampled_from([4, 8, 12, 20]), st.integers(0, 2**32 - 1), st.integers(1, 255))
def test_any_bytes_come_back(count, stride, seed, most):
    made = np.random.default_rng(seed).integers(0, most, (count, stride), dtype=np.uint8)
    np.testing.assert_array_equal(meshopt.decode(meshopt.encode(made), count, stride), made)


def test_a_block_is_stored_as_the_extension_says():
    made = np.zeros((16, 4), np.uint8)
    made[:, 0] = np.arange(16)  # differences of 1: codes 2, in 2 bits
    made[:, 1] = [0, 255] * 8  # differences of -1 and 1: codes 1 and 2
    made[8:, 2] = 100  # a single difference of 100: code 200, a byte of its own
    made[:, 3] = 10 * np.arange(16)  # differences of 10: codes 20, which need 8 bits
    first, ones = bytes([0b00101010, *[0b10101010] * 3]), bytes([0b00011001, *[0b10011001] * 3])
    single = bytes([0, 0, 0b11000000, 0, 200])
    rest = bytes([0, *[20] * 15])
    wanted = b"\xa0" + b"\1" + first + b"\1" + ones + b"\1" + single + b"\3" + rest + bytes(32)
    assert meshopt.encode(made) == wanted
    data = bytes.fromhex("175ff0bc77a92100 34b5")  # the example of the extension's text, in 4 bits
    values = meshopt._groups(np.frombuffer(data, np.uint8), np.array([0]), np.array([2], np.uint8))
    signed = ((values >> 1) ^ -(values & 1)).astype(np.int8)[0]
    assert signed.tolist() == [-1, -4, -3, 26, -91, 0, -6, 6, -4, -4, 5, -5, 1, -1, 0, 0]


def test_other_bytes_are_refused():
    data = meshopt.encode(elements(100, 12))
    for wrong in (data[:-1], data[:40], b"", b"\xa1" + data[1:], data + b"\0", b"\xa0" + data[1:] + data):
        with pytest.raises(ValueError, match=r"^expected .* but"):
            meshopt.decode(wrong, 100, 12)
    with pytest.raises(ValueError, match=r"expected 1000000000 elements"):
        meshopt.decode(data, 10**9, 12)
    with pytest.raises(ValueError, match="expected a stride of"):
        meshopt.decode(data, 100, 6)


@settings(max_examples=60, deadline=None)
@given(st.binary(min_size=0, max_size=200), st.integers(0, 100), st.sampled_from([4, 8]))
def test_no_bytes_lead_astray(data, count, stride):
    try:
        assert meshopt.decode(b"\xa0" + data, count, stride).shape == (count, stride)
    except ValueError as error:
        assert str(error).startswith("expected")  # noqa: PT017


@pytest.mark.parametrize("exponent", [-20, -9, -4, 0, 3])
def test_exponential_rounds_to_steps_and_moves_signs_to_the_last_byte(exponent):
    values = np.random.default_rng(0).normal(size=(200, 3)).astype(np.float32)
    stored = meshopt.exponential(values, exponent)
    step = 2.0**exponent
    np.testing.assert_allclose(meshopt.from_exponential(stored), np.rint(values / step) * step, rtol=1e-6)
    few = exponent >= -4
    assert (stored.reshape(200, 3, 4)[..., :2].any() == 0) == few


def test_exponential_keeps_what_is_large_small_or_nothing():
    values = np.array([[0.0, 1e30, -1e-24]], np.float32)
    exponents = np.frexp(values)[1] - 20
    stored = meshopt.from_exponential(meshopt.exponential(values, exponents))
    np.testing.assert_allclose(stored, values, rtol=1e-6)
    huge = np.array([[1e9, 3.0]], np.float32)
    stored = meshopt.from_exponential(meshopt.exponential(huge, -10))
    np.testing.assert_allclose(stored, huge, rtol=1e-6, atol=100)  # coarser steps, not another number


@pytest.mark.parametrize(("bits", "error"), [(6, 0.04), (8, 0.01), (12, 6e-4), (16, 8e-5)])
def test_quaternions_keep_their_rotation(bits, error):
    values = np.random.default_rng(0).normal(size=(500, 4))
    values /= np.linalg.norm(values, axis=1, keepdims=True)
    made = meshopt.from_quaternion(meshopt.quaternion(values, bits)) / 32767
    sign = np.sign((made * values).sum(1, keepdims=True))
    np.testing.assert_allclose(sign * made, values, atol=error)
    np.testing.assert_allclose(np.linalg.norm(made, axis=1), 1, atol=1e-4)
