"""Nodes and files under load and fault.

`cases` lists what is done, runs it and tells of it. `messages`, `files`, `disk`, `nodes` and
`replay` do it; the cases of a running node stand in the modules that are called `node_...`.
"""

from benchmarks.soak.cases import as_text, main, measure

__all__ = ['as_text', 'main', 'measure']
