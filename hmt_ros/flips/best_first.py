"""Pairs of an entry of one sorted list and one of another, best sum first, compiled.

A heap holds at most one right entry for each left one, the next that it has not yet had: so the
product of the lists is never built.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def best_first(  # type: ignore[no-untyped-def]
    base, left, left_picks, left_bounds, right, right_picks, right_bounds, left_chains,
    right_chains, crossing, tables, picks, trunks, log_priors,
):  # fmt: skip
    """Fills picks, trunks and log priors of the best pairs on any of T trunks.

    Args:
        base: (T,) what each trunk adds to its sums.
        left, right: (E,), (F,) entries, trunk by trunk, best first.
        left_picks, right_picks: (E, A), (F, B) what each entry chooses for its chains.
        left_bounds, right_bounds: (T + 1,) where the entries of a trunk start.
        left_chains, right_chains: (A,), (B,) columns of the picks that they fill.
        crossing: (P, 2) columns of a left and a right chain of which not all choices go together.
        tables: (P, T, ., .) which do.
        picks: (N, A + B) becomes the choices.
        trunks, log_priors: (N,) become the trunks and the sums.

    Returns:
        How many pairs there are, at most N.
    """
    room = len(left) + len(base) + 1
    keys = np.empty(room)
    heap_trunk, heap_left = np.empty(room, np.int64), np.empty(room, np.int64)
    heap_right = np.empty(room, np.int64)
    size = 0
    for t in range(len(base)):
        i, j = left_bounds[t], right_bounds[t]
        if i < left_bounds[t + 1] and j < right_bounds[t + 1]:
            size = _push(
                keys, heap_trunk, heap_left, heap_right, size, base[t] + left[i] + right[j], t, i, j
            )
    found = 0
    while size > 0 and found < len(trunks):
        key, t, i, j = keys[0], heap_trunk[0], heap_left[0], heap_right[0]
        fresh = j == right_bounds[t]
        if j + 1 < right_bounds[t + 1]:
            _sift_down(
                keys, heap_trunk, heap_left, heap_right, size, base[t] + left[i] + right[j + 1],
                t, i, j + 1,
            )  # fmt: skip
        else:
            size -= 1
            if size > 0:
                _sift_down(
                    keys, heap_trunk, heap_left, heap_right, size, keys[size], heap_trunk[size],
                    heap_left[size], heap_right[size],
                )  # fmt: skip
        if fresh and i + 1 < left_bounds[t + 1]:
            size = _push(
                keys, heap_trunk, heap_left, heap_right, size, base[t] + left[i + 1] + right[j], t,
                i + 1, j,
            )  # fmt: skip
        for c in range(len(left_chains)):
            picks[found, left_chains[c]] = left_picks[i, c]
        for c in range(len(right_chains)):
            picks[found, right_chains[c]] = right_picks[j, c]
        fits = True
        for pair in range(len(crossing)):
            a, b = picks[found, crossing[pair, 0]], picks[found, crossing[pair, 1]]
            if not tables[pair, t, a, b]:
                fits = False
                break
        if fits:
            trunks[found] = t
            log_priors[found] = key
            found += 1
    return found


@njit(cache=True, nogil=True, inline='always')
def _push(keys, trunks, lefts, rights, size, key, t, i, j):  # type: ignore[no-untyped-def]
    """Adds an entry to a heap with the largest key first; returns the new size."""
    place = size
    while place > 0:
        parent = (place - 1) // 2
        if keys[parent] >= key:
            break
        keys[place], trunks[place] = keys[parent], trunks[parent]
        lefts[place], rights[place] = lefts[parent], rights[parent]
        place = parent
    keys[place], trunks[place], lefts[place], rights[place] = key, t, i, j
    return size + 1


@njit(cache=True, nogil=True, inline='always')
def _sift_down(keys, trunks, lefts, rights, size, key, t, i, j):  # type: ignore[no-untyped-def]
    """Replaces the first entry of a heap."""
    place = 0
    while True:
        child = 2 * place + 1
        if child >= size:
            break
        if child + 1 < size and keys[child + 1] > keys[child]:
            child += 1
        if keys[child] <= key:
            break
        keys[place], trunks[place] = keys[child], trunks[child]
        lefts[place], rights[place] = lefts[child], rights[child]
        place = child
    keys[place], trunks[place], lefts[place], rights[place] = key, t, i, j
