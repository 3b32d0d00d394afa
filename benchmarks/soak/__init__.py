"""Soak test: nodes and files under load and faults.

`cases` lists, runs and reports the cases; `messages`, `files`, `nodes` and `hostile` do the work.
"""

from benchmarks.soak.cases import as_text, main, measure

__all__ = ['as_text', 'main', 'measure']
