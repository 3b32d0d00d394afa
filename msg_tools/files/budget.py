"""What reading one file from outside may cost.

A reader makes a `Budget` of the size of its file, and spends it before it spends memory or time.
What a file may unpack to grows with its size: a long recording is read, and a small file can not
claim what it does not have.
"""

from __future__ import annotations

# Bytes that any file may unpack to, and more for each of its own bytes. Images of one colour are
# compressed a thousandfold; those of a camera, and messages, rarely tenfold.
FREE_BYTES, BYTES_PER_BYTE = 2**26, 100
# Records, rows or nodes that any file may have, and how many of its bytes each more of them needs.
FREE_RECORDS, BYTES_PER_RECORD = 100_000, 4


class BudgetError(ValueError):
    """More than a file may take, in one line; the file need not be damaged."""


class Budget:
    """Bytes and records that are left to the reader of one file.

    Args:
        size: of the file, bytes.
    """

    def __init__(self, size: int) -> None:
        self._bytes = FREE_BYTES + BYTES_PER_BYTE * size
        self._records = FREE_RECORDS + size // BYTES_PER_RECORD
        self._limits = self._bytes, self._records

    def spend(self, *, unpacked: int = 0, records: int = 0) -> None:
        """Takes what the next step needs.

        Args:
            unpacked: bytes that compressed or repeated content becomes.
            records: messages, rows or nodes that are made.

        Raises:
            BudgetError: that much is not left.
        """
        self._bytes -= unpacked
        self._records -= records
        if self._bytes < 0:
            raise BudgetError(f'it unpacks to more than {self._limits[0]} bytes')
        if self._records < 0:
            raise BudgetError(f'it has more than {self._limits[1]} records')
