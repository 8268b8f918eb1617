"""Shards of ours and of zarr-python are the same; damaged ones raise, and never give other values or a crash."""

import errno
import os
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import pytest
import zarr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numcodecs import blosc
from zarr.codecs import BloscCodec, Crc32cCodec

from photonfarm.core.errors import CorruptError
from photonfarm.store.format import schema, shards
from photonfarm.store.format.schema import ArraySchema
from photonfarm.store.format.shards import Shard, ShardWriter, encode

SHARD_ROWS = 4
any_case = settings(max_examples=40, deadline=None, derandomize=True, suppress_health_check=list(HealthCheck))
dtypes = st.sampled_from(["<f2", "<f4", "<f8", "|i1", "|u1", "<i4", "<u2"])
shapes = st.lists(st.integers(1, 9), min_size=1, max_size=4).map(tuple)


def array_of(dtype: str, shape: tuple[int, ...], *, compressed: bool) -> ArraySchema:
    return ArraySchema("values", "sample", shape, np.dtype(dtype), compressed)


def random_rows(array: ArraySchema, rows: list[int], seed: int) -> dict[int, Any]:
    """Any bits at all, NaN and infinity among them, for the rows that are written; some compress and some do not."""
    rng = np.random.default_rng(seed)
    size = int(np.prod(array.shape)) * array.dtype.itemsize
    content = {row: rng.integers(0, 2 if row % 2 else 256, size, np.uint8) for row in rows}
    return {row: data.view(array.dtype).reshape(array.shape) for row, data in content.items()}


def write(path: Path, array: ArraySchema, rows: dict[int, Any], shard_rows: int = SHARD_ROWS) -> dict[str, Any]:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    writer = ShardWriter(path, array, shard_rows)
    for row, values in rows.items():
        writer.append(row, encode(array, values))
    return writer.finish()


def zarr_array(folder: Path, array: ArraySchema, shard_rows: int) -> zarr.Array:
    return zarr.create_array(
        str(folder),
        shape=(shard_rows, *array.shape),
        chunks=(1, *array.shape),
        shards=(shard_rows, *array.shape),
        dtype=array.dtype,
        fill_value=0,
        compressors=[BloscCodec(**schema.BLOSC), Crc32cCodec()] if array.compressed else [Crc32cCodec()],
        filters=None,
        chunk_key_encoding={"name": "default", "configuration": {"separator": "."}},
        overwrite=True,
        config={"write_empty_chunks": True},
    )


def same(found: Any, expected: Any) -> bool:
    return found.dtype == expected.dtype and found.shape == expected.shape and found.tobytes() == expected.tobytes()


@pytest.fixture
def noise(tmp_path: Path) -> tuple[Path, ArraySchema, dict[int, Any]]:
    """A shard of raw rows that each cover several pages, row 1 left out."""
    array = array_of("<f2", (2, 64, 64, 3), compressed=False)
    rows = random_rows(array, [3, 0, 2], seed=1)
    write(tmp_path / "shard", array, rows)
    return tmp_path / "shard", array, rows


# ---------------------------------------------------------------------------------------------------------- the format


@any_case
@given(dtypes, shapes, st.booleans(), st.integers(1, 6), st.data())
def test_shards_read_equal_in_zarr_and_those_of_zarr_read_equal_here(
    tmp_path_factory: pytest.TempPathFactory,
    dtype: str,
    shape: tuple[int, ...],
    compressed: bool,
    shard_rows: int,
    data: st.DataObject,
) -> None:
    folder = tmp_path_factory.mktemp("shards")
    array = array_of(dtype, shape, compressed=compressed)
    written = data.draw(st.lists(st.integers(0, shard_rows - 1), unique=True, min_size=1))  # in any order
    rows = random_rows(array, written, seed=data.draw(st.integers(0, 999)))

    theirs = zarr_array(folder / "ours", array, shard_rows)
    about = write(folder / "ours" / array.shard_name(0), array, rows, shard_rows)
    empty = np.zeros(shape, array.dtype)
    assert all(same(theirs[i], rows.get(i, empty)) for i in range(shard_rows))
    shard = Shard(folder / "ours" / array.shard_name(0), array, shard_rows)
    assert [row for row in range(shard_rows) if row in shard] == sorted(written)
    assert shard.summary() == about

    theirs = zarr_array(folder / "theirs", array, shard_rows)
    for row, values in rows.items():
        theirs[row] = values
    shard = Shard(folder / "theirs" / array.shard_name(0), array, shard_rows)
    for row in range(shard_rows):
        found = shard.read(row)
        assert (found is None) == (row not in rows)
        assert found is None or same(found, rows[row])


def test_the_checksum_is_the_crc_32c_of_another_library() -> None:
    content = np.random.default_rng(0).integers(0, 256, 1 << 20, np.uint8).tobytes()
    for length in [*range(300), 4095, 65537, 1 << 20]:
        assert int.from_bytes(shards.crc_of(content[:length]), "little") == google_crc32c.value(content[:length])


# --------------------------------------------------------------------------------------------------------- damaged ones


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("opened", [False, True])
def test_a_changed_bit_is_found_wherever_it_is(tmp_path: Path, compressed: bool, opened: bool) -> None:
    array = array_of("<f4", (6, 5), compressed=compressed)
    rows = random_rows(array, [2, 0, 3], seed=2)
    path = tmp_path / "shard"
    write(path, array, rows)
    whole = path.read_bytes()
    for place in range(0, len(whole), 5):
        shard = Shard(path, array, SHARD_ROWS) if opened else None
        if shard is not None:
            _ = [shard.read(row) for row in (*rows, *rows)]
        with path.open("r+b") as file:
            file.seek(place)
            file.write(bytes([whole[place] ^ (1 << place % 8)]))
        if shard is not None and place >= len(whole) - 16 * SHARD_ROWS - 4:
            assert all(same(shard.read(row), values) for row, values in rows.items())  # its index was read before
        else:
            with pytest.raises(CorruptError, match=str(path)):
                _check_equal(shard or Shard(path, array, SHARD_ROWS), rows)
        path.write_bytes(whole)


def _check_equal(shard: Shard, rows: dict[int, Any]) -> None:
    damaged = None
    for row, values in rows.items():
        try:
            assert same(shard.read(row), values)
        except CorruptError as error:
            damaged = error
    if damaged is not None:
        raise damaged


@pytest.mark.parametrize("compressed", [False, True])
def test_a_file_that_is_cut_while_it_is_open_raises_where_it_ends(tmp_path: Path, compressed: bool) -> None:
    array = array_of("<f2", (2, 64, 64, 3), compressed=compressed)
    rows = random_rows(array, [0, 1, 2], seed=3)
    path = tmp_path / "shard"
    write(path, array, rows)
    whole = path.read_bytes()
    for keep in [*range(0, len(whole), max(1, len(whole) // 30)), len(whole) - 1]:
        path.write_bytes(whole)
        shard = Shard(path, array, SHARD_ROWS)
        _ = [shard.read(row) for row in (*rows, *rows)]
        os.truncate(path, keep)
        for row, values in rows.items():
            if sum(shard._index[row]) <= keep:
                assert same(shard.read(row), values)
            else:
                with pytest.raises(CorruptError, match=f"{path}: row {row}"):
                    shard.read(row)
        with pytest.raises(CorruptError):
            Shard(path, array, SHARD_ROWS)


@any_case
@given(st.integers(0, 2), st.integers(0, 2**64 - 1), st.integers(0, 2**64 - 1), st.booleans())
def test_an_index_that_is_whole_but_wrong_never_gives_other_values(
    tmp_path_factory: pytest.TempPathFactory, row: int, offset: int, length: int, compressed: bool
) -> None:
    array = array_of("<f4", (6, 5), compressed=compressed)
    rows = random_rows(array, [0, 1, 2], seed=4)
    path = tmp_path_factory.mktemp("shards") / "shard"
    write(path, array, rows)
    whole = path.read_bytes()
    index = np.frombuffer(whole[-16 * SHARD_ROWS - 4 : -4], "<u8").reshape(SHARD_ROWS, 2).copy()
    for entry in ((offset, length), (offset % len(whole), length % len(whole)), (offset % 200, index[row, 1])):
        index[row] = entry
        content = index.tobytes()
        crc = google_crc32c.value(content).to_bytes(4, "little")
        path.write_bytes(whole[: -len(content) - 4] + content + crc)
        try:
            found = Shard(path, array, SHARD_ROWS).read(row)
        except CorruptError:
            continue
        assert found is None or any(same(found, values) for values in rows.values())


def compressed(count: int) -> bytes:
    return bytes(blosc.compress(np.zeros(count, "<f4"), b"lz4", 5, 1))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"short",
        bytes(100),
        compressed(299),  # less than the row: the rest would be garbage
        compressed(301),  # more than the row has room for
        compressed(300) + b"?",
        compressed(300)[:16] + b"\xff" * (len(compressed(300)) - 16),
    ],
)
def test_a_chunk_whose_checksum_is_right_but_whose_content_is_not_a_row_raises(tmp_path: Path, content: bytes) -> None:
    array = array_of("<f4", (6, 50), compressed=True)
    index = np.full((SHARD_ROWS, 2), 2**64 - 1, "<u8")
    index[0] = 0, len(content) + 4
    parts = [content, index.tobytes()]
    path = tmp_path / "shard"
    path.write_bytes(b"".join(part + google_crc32c.value(part).to_bytes(4, "little") for part in parts))
    shard = Shard(path, array, SHARD_ROWS)
    with pytest.raises(CorruptError):
        shard.read(0)


# --------------------------------------------------------------------------------------------------- disks that refuse


@pytest.mark.parametrize("number", [1, 2], ids=["index", "row"])
def test_a_read_that_the_disk_refuses_is_damage_and_names_the_file(
    noise: tuple[Path, ArraySchema, dict[int, Any]], monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    path, array, _ = noise
    preadv, calls = os.preadv, iter(range(1, 100))

    def failing(*arguments: Any) -> int:
        if next(calls) == number:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return preadv(*arguments)

    monkeypatch.setattr(os, "preadv", failing)
    with pytest.raises(CorruptError, match=str(path)):
        Shard(path, array, SHARD_ROWS).read(0)


@pytest.mark.parametrize(("number", "raised"), [(errno.EIO, CorruptError), (errno.EMFILE, OSError)])
def test_only_a_disk_makes_a_file_that_cannot_be_opened_damaged(
    noise: tuple[Path, ArraySchema, dict[int, Any]],
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    raised: type[OSError],
) -> None:
    """No job is to be set aside for want of descriptors."""
    path, array, _ = noise

    def failing(*_: Any) -> int:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "open", failing)
    with pytest.raises(raised) as caught:
        Shard(path, array, SHARD_ROWS)
    assert type(caught.value) is raised
