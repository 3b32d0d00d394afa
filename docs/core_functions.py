"""The page of the compiled core: its functions, from the file that binds them and the comments."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import hmt_ros

CORE = Path(hmt_ros.__file__).with_name('core')
_BOUND = re.compile(r'bind\(\s*m, "(\w+)", (\w+),\s*((?:"[^"]*"\s*)+)\)')
# A comment, and the function below it.
_DEFINED = re.compile(
    r'((?:^//.*\n)+)(?:^template <.*>\n)?^[A-Za-z][^;(\n]*?\b(\w+)\(', re.MULTILINE
)


class CoreFunction(NamedTuple):
    """A function of `hmt_ros.core`: its header, its call, and the comment before it."""

    header: str
    call: str
    text: str


def core_functions() -> list[CoreFunction]:
    """All functions of arrays, in the order of `bindings.cpp`.

    Raises:
        ValueError: A function has no comment in a header.
    """
    comments: dict[str, tuple[str, str]] = {}
    for path in sorted(CORE.rglob('*.h')):
        for comment, name in _DEFINED.findall(path.read_text('utf-8')):
            text = ' '.join(line.removeprefix('//').strip() for line in comment.splitlines())
            comments.setdefault(name, (path.relative_to(CORE).as_posix(), text))
    result = []
    for name, function, quoted in _BOUND.findall((CORE / 'bindings.cpp').read_text('utf-8')):
        if function not in comments:
            raise ValueError(f'{name} of bindings.cpp: no header has a comment before {function}')
        header, text = comments[function]
        arguments = ', '.join(' '.join(re.findall('"([^"]*)"', quoted)).split())
        result.append(CoreFunction(header, f'{name}({arguments})', text))
    return result


def core_page() -> str:
    """The page in Markdown, with a section for each header."""
    sections: dict[str, list[str]] = {}
    for function in core_functions():
        text = re.sub(r'[*<\[]', r'\\\g<0>', function.text)
        sections.setdefault(function.header, []).append(f'- `{function.call}`: {text}\n')
    parts = [f'## {header}\n\n' + '\n'.join(entries) for header, entries in sections.items()]
    return '# hmt_ros.core\n\n' + '\n'.join(parts)
