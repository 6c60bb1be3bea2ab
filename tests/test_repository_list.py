"""The repository list: comes back as it was, and malformed ones are refused."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.transport.channels import REPOSITORY
from common.wire.header import REPOSITORY_LIST_VERSION, WireError
from common.wire.repository_list import (
    REPOSITORY_LIST_MAX_BYTES,
    REPOSITORY_LIST_MAX_POSES,
    RepositoryList,
    decode_repository_list,
    encode_repository_list,
)

U32 = st.integers(0, 2**32 - 1)


@given(U32, U32, st.dictionaries(U32, U32, max_size=40))
def test_it_comes_back_as_it_was(sender: int, receiver: int, poses: dict[int, int]) -> None:
    told = RepositoryList(sender, receiver, poses)
    assert decode_repository_list(encode_repository_list(told)) == told


def test_the_format_is_what_it_was() -> None:
    told = RepositoryList(0x01020304, 0x05060708, {9: 0x0A0B0C0D, 1: 2})
    assert encode_repository_list(told).hex(" ") == (
        "81 04 03 02 01 08 07 06 05 09 00 00 00 0d 0c 0b 0a 01 00 00 00 02 00 00 00"
    )


def test_the_longest_fits_its_channel() -> None:
    longest = encode_repository_list(RepositoryList(1, 2, {i: i for i in range(REPOSITORY_LIST_MAX_POSES)}))
    assert len(longest) == REPOSITORY_LIST_MAX_BYTES <= REPOSITORY.max_bytes
    with pytest.raises(WireError, match="at most 1024"):
        encode_repository_list(RepositoryList(1, 2, {i: i for i in range(REPOSITORY_LIST_MAX_POSES + 1)}))
    with pytest.raises(WireError, match="at most"):
        decode_repository_list(longest + bytes(8))


@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_refused_or_a_list(data: bytes) -> None:
    for each in (data, bytes([REPOSITORY_LIST_VERSION]) + data):
        try:
            told = decode_repository_list(each)
        except WireError:
            continue
        assert encode_repository_list(told) == each


@pytest.mark.parametrize("length", range(1, 25))
def test_every_truncation_in_a_pose_is_refused(length: int) -> None:
    whole = encode_repository_list(RepositoryList(1, 2, {3: 4, 5: 6}))
    if length in (9, 17):
        assert len(decode_repository_list(whole[:length]).poses) == (length - 9) // 8
        return
    with pytest.raises(WireError):
        decode_repository_list(whole[:length])


def test_a_pose_named_twice_is_refused() -> None:
    whole = encode_repository_list(RepositoryList(1, 2, {3: 4}))
    with pytest.raises(WireError, match="twice"):
        decode_repository_list(whole + whole[-8:])


@pytest.mark.parametrize(
    "wrong", [RepositoryList(-1, 0, {}), RepositoryList(0, 2**32, {}), RepositoryList(0, 0, {-1: 0})]
)
def test_impossible_numbers_have_no_encoding(wrong: RepositoryList) -> None:
    with pytest.raises(WireError):
        encode_repository_list(wrong)
