import numpy as np
import pytest

from photonfarm.core.keys import Stream, make_key, seed_of, uniform_of, view_key
from photonfarm.scene.view import view_keys


def test_a_key_is_the_same_on_every_machine_and_in_every_version() -> None:
    key = make_key("sample", 0, 1.5, b"x", np.arange(3, dtype=np.float32), np.array([True, False]))
    assert key.hex() == "5e6f288ffe9e2880620719f9e21de254"


def test_keys_tell_types_and_boundaries_of_their_parts_apart() -> None:
    keys = [make_key("ab", "c"), make_key("a", "bc"), make_key(1), make_key(1.0), make_key("1"), make_key(b"1")]
    keys += [make_key(np.zeros((2, 3), np.float32)), make_key(np.zeros((3, 2), np.float32))]
    keys += [make_key("view", seed) for seed in (0, -1)]  # 0 is a seed like any other
    assert len(set(keys)) == len(keys)


def test_byte_order_of_an_array_does_not_enter_its_key() -> None:
    array = np.arange(4, dtype="<f4")
    assert make_key(array) == make_key(array.astype(">f4"))


def test_the_key_of_a_view_is_the_documented_one_also_of_many_at_once() -> None:
    keys = [make_key(i) for i in range(3)]
    views = np.arange(18, dtype=np.float32).reshape(3, 6)
    wanted = [make_key("view", key, view) for key, view in zip(keys, views, strict=True)]
    assert [view_key(key, view) for key, view in zip(keys, views, strict=True)] == wanted
    assert view_keys(keys, views) == wanted


def test_the_two_halves_of_a_sample_have_different_seeds() -> None:
    keys = [make_key("sample", i) for i in range(200)]
    seeds = [seed_of(key, half) for key in keys for half in ("half A", "half B")]
    assert len(set(seeds)) == len(seeds)
    assert all(0 <= seed < 2**32 for seed in seeds)


def test_a_stream_is_uniform_in_mean_variance_and_lag_one_correlation() -> None:
    u = Stream(make_key("test"), "uniform").uniform(100_000)
    assert 0 <= u.min() < u.max() < 1
    z_mean = (u.mean() - 0.5) * np.sqrt(12 * u.size)
    z_lag = np.corrcoef(u[:-1], u[1:])[0, 1] * np.sqrt(u.size)
    assert abs(z_mean) < 4
    assert abs(z_lag) < 4
    assert u.var() == pytest.approx(1 / 12, rel=0.01)


def test_the_streams_of_many_keys_are_those_of_each() -> None:
    """2000 keys and 7 numbers after 5: several blocks of the generator, and several chunks of keys."""
    keys = [make_key("test", i) for i in range(2000)]
    found = uniform_of(keys, "placement", 7, first=5)
    assert found.tolist() == [Stream(key, "placement").uniform(12)[5:].tolist() for key in keys]


def test_a_stream_repeats_for_its_key_and_purpose_and_for_no_other() -> None:
    first = Stream(make_key("a"), "one").uniform(4)
    assert np.array_equal(first, Stream(make_key("a"), "one").uniform(4))
    assert not np.array_equal(first, Stream(make_key("a"), "two").uniform(4))
    assert not np.array_equal(first, Stream(make_key("b"), "one").uniform(4))


def test_a_part_of_another_type_is_refused() -> None:
    with pytest.raises(TypeError):
        make_key(None)  # type: ignore[arg-type]
