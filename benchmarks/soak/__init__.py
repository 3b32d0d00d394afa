"""Nodes and files under load and fault.

`cases` lists what is done, runs it and tells of it; `messages`, `files` and `nodes` do it.
"""

from benchmarks.soak.cases import as_text, main, measure

__all__ = ['as_text', 'main', 'measure']
