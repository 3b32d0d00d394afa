"""A limit on memory and time for reading one untrusted file.

A reader makes a `Budget` from the size of its file, and charges each step to it in advance. The
limits grow with the size of the file: a long recording can be read, but a small file can not claim
to have much content.
"""

from __future__ import annotations

# Unpacked size allowed for every file, and additional size per byte of the file, bytes. Images of
# one colour are compressed a thousandfold, camera images and messages rarely tenfold.
FREE_BYTES, BYTES_PER_BYTE = 2**26, 100
# Number of records, rows or nodes allowed in every file, and file size per additional record,
# bytes.
FREE_RECORDS, BYTES_PER_RECORD = 100_000, 4


class BudgetError(ValueError):
    """A file, damaged or not, exceeds its budget; the message is one line."""


class Budget:
    """Bytes and records that the reader of one file may still use.

    Args:
        size: size of the file, bytes.
    """

    def __init__(self, size: int) -> None:
        self._bytes = FREE_BYTES + BYTES_PER_BYTE * size
        self._records = FREE_RECORDS + size // BYTES_PER_RECORD
        self._limits = self._bytes, self._records

    def spend(self, *, unpacked: int = 0, records: int = 0) -> None:
        """Charges the next step to the budget.

        Args:
            unpacked: size of compressed or repeated content once unpacked, bytes.
            records: number of messages, rows or nodes.

        Raises:
            BudgetError: the step exceeds the rest of the budget.
        """
        self._bytes -= unpacked
        self._records -= records
        if self._bytes < 0:
            raise BudgetError(f'it unpacks to more than {self._limits[0]} bytes')
        if self._records < 0:
            raise BudgetError(f'it has more than {self._limits[1]} records')
