"""Finds phrases that make a reader stumble: ellipses, literal verbs, and words out of use.

    python tools/english.py [FILE ...]

Without files it reads all texts of the repository: code with its docstrings, comments and messages,
documentation, definitions of messages. It prints file, line and phrase with what to write instead,
and exits with 1 if it finds any. `ALLOWED` lists exceptions with their reasons.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SUFFIXES = ('.py', '.md', '.h', '.cpp', '.sh', '.bash', '.yaml', '.msg', '.srv', '.js', '.html')
# Regular expressions, and what to write instead.
PHRASES = {
    r'(?::|if|where) there (?:is|are) none\b': '"none", "... if missing"',
    r'\bof whom\b': 'a sentence of its own',
    r'\banew\b': '"again"',
    r'\bwhoever\b': '"anybody who", "the person who"',
    r'\bgo(?:es)? on with\b': '"continues with"',
    r'\btakes? in an? (?:image|message)\b': '"uses", "updates from"',
    r'\bis told (?:by|again)\b': '"is given by", "is reported again"',
    r'\bcomes? of (?:a|the)\b': '"follows from", "results from"',
    r'\bthere are none\b': '"none", "... if missing"',
    r'\bof which nothing\b': 'a sentence of its own',
    r'\bthose who\b': '"people who", "the people that"',
    r'\bhowever many\b': '"for any number of"',
    r'\btexts of errors\b': '"error messages"',
}
# Path and phrase, and why the phrase is right there.
ALLOWED = {
    ('tools/english.py', ''): 'lists the phrases',
    ('test/test_english.py', ''): 'tries the phrases',
}


def main(arguments: Sequence[str]) -> int:
    """Prints what it finds."""
    paths = [Path(x).resolve() for x in arguments] or list(_texts())
    found = [line for path in paths for line in stumbling(path)]
    sys.stdout.writelines(f'{line}\n' for line in found)
    return bool(found)


def stumbling(path: Path) -> Iterator[str]:
    """The phrases of a file, a line each."""
    name = path.relative_to(ROOT).as_posix() if path.is_relative_to(ROOT) else str(path)
    for number, line in enumerate(path.read_text('utf-8').splitlines(), 1):
        for phrase, instead in PHRASES.items():
            for match in re.finditer(phrase, line, re.IGNORECASE):
                if not {(name, ''), (name, match.group().lower())} & ALLOWED.keys():
                    yield f'{name}:{number}: "{match.group()}"; better {instead}'


def _texts() -> Iterator[Path]:
    """The texts that git knows, without results and the history."""
    listed = subprocess.run(
        ['git', 'ls-files'], cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.splitlines()
    for name in listed:
        if name.endswith(SUFFIXES) and not name.startswith('benchmarks/results/'):
            yield ROOT / name


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
