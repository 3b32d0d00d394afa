"""Files of models as a hostile author writes them: other arrays, a right checksum and answer."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from hmt_ros.body import learned_file
from hmt_ros.body.learned_file import checksum, write_arrays


def arrays_of(path):
    """All arrays of a file."""
    with np.load(path) as content:
        return dict(content)


def forged(arrays, changes, read=None):
    """The arrays with changes (None: without) and the checksum of these.

    Args:
        read: makes the model from its arrays; if it does, the example has the answer of that model.
    """
    result = {name: x for name, x in (arrays | changes).items() if x is not None}
    if read is not None:
        # If the author can not make it work the file is written all the same.
        with suppress(Exception), np.errstate(all='ignore'):
            result['example/answer'] = learned_file._answer(read(result, 'model'), result)
    result['checksum'] = np.array(checksum(result))
    return result


def write_forged(path, old, changes, read=None):
    """Writes the file `old` with changes, and returns the path."""
    return write_arrays(path, forged(arrays_of(old), changes, read))
