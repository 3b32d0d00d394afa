"""Nodes and files under load and fault.

`cases` lists the cases, runs them and reports; `messages`, `files` and `nodes` do it.
"""

from benchmarks.soak.cases import as_text, main, measure

__all__ = ['as_text', 'main', 'measure']
