"""Reads archives of arrays (.npz), see import-video --help."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hmt_ros.app.import_video.keypoint_files.persons import FoundPersons, person
from msg_tools.files.array_file import read_archive
from msg_tools.files.budget import Budget

_MAX_BYTES = 2**28  # maximum size, bytes; the keypoints of an hour take 10**8
_RECORDS_PER_PERSON = 10  # cost of a person in the budget, records


def read_arrays(path: Path) -> FoundPersons:
    """Reads an archive; row t of each array is frame t.

    Raises:
        ValueError: the file is not an archive, has no keypoints, or has arrays of inconsistent
            shapes.
    """
    content = read_archive(path, _MAX_BYTES)
    budget = Budget(path.stat().st_size)
    if 'pixels' not in content:
        raise ValueError('no array pixels; wanted pixels and landmark_names')
    given = content.get('landmark_names')
    rows, n = (*content['pixels'].shape, 0, 0)[:2]
    n = n if given is None else given.size
    names = None if given is None else tuple(given.flat)
    if names is not None and not all(isinstance(x, str) for x in names):
        raise ValueError('landmark_names has entries that are not texts')
    budget.spend(records=_RECORDS_PER_PERSON * rows)
    shapes = {
        'pixels': (rows, n, 2),
        'visibility': (rows, n),
        'world': (rows, n, 3),
        'detected': (rows,),
    }
    for name, shape in shapes.items():
        if name in content and content[name].shape != shape:
            raise ValueError(f'{name} has shape {content[name].shape}, wanted {shape}')
        if name in content and content[name].dtype.kind not in 'fiub':
            raise ValueError(f'{name} holds {content[name].dtype}, wanted numbers')
    detected = content.get('detected', np.ones(rows, dtype=bool))
    sure, world = content.get('visibility'), content.get('world')
    found = FoundPersons(path, rows=rows, unnamed=n if names is None else 0)
    for t in range(rows if n else 0):
        seen = None
        if detected[t]:
            seen = person(
                names,
                content['pixels'][t],
                None if sure is None else sure[t],
                None if world is None else world[t],
            )
        found.add(t, seen)
    return found
