"""Tests of `msg_tools.files.budget`."""

import pytest

from msg_tools.files.budget import (
    BYTES_PER_BYTE,
    BYTES_PER_RECORD,
    FREE_BYTES,
    FREE_RECORDS,
    Budget,
)


def test_all_that_a_small_file_may_unpack_to_is_free():
    budget = Budget(0)
    budget.spend(unpacked=FREE_BYTES, records=FREE_RECORDS)
    with pytest.raises(ValueError, match=f'more than {FREE_BYTES} bytes'):
        budget.spend(unpacked=1)


def test_more_is_allowed_to_a_larger_file():
    size = 10_000_000
    budget = Budget(size)
    budget.spend(unpacked=FREE_BYTES + BYTES_PER_BYTE * size)
    budget.spend(records=FREE_RECORDS + size // BYTES_PER_RECORD)
    with pytest.raises(ValueError, match='records'):
        budget.spend(records=1)
