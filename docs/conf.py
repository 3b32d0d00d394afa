"""Settings of Sphinx, for rosdoc2 (rosdoc2.yaml) and for ``sphinx-build docs build/html``."""

import re
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

project = 'hmt_ros'
author = 'hmt_ros contributors'
extensions = [
    'myst_parser',
    'sphinx.ext.autodoc',
    'sphinx.ext.autosummary',
    'sphinx.ext.napoleon',
]
# Pages of the reference, one for each module, in docs/api.
autosummary_generate = True
templates_path = ['_templates']
autodoc_member_order = 'bysource'
autodoc_typehints = 'none'
# Attributes of the docstring are those of the class, once.
napoleon_use_ivar = True
# Words in single backticks are code. Some are also names of attributes, in several classes.
default_role = 'code'
suppress_warnings = ['ref.python']
source_suffix = {'.rst': 'restructuredtext', '.md': 'markdown'}
master_doc = 'index'
html_theme = 'sphinx_rtd_theme'
myst_heading_anchors = 4  # anchors for headings, as on GitHub pages
exclude_patterns = ['generated']

# rosdoc2 executes this file elsewhere and sets the version itself.
_package = Path(__file__).resolve().parents[1] / 'package.xml'
if _package.is_file():
    sys.path.insert(0, str(_package.parent))
    version = release = ET.parse(_package).findtext('version')


def _keep_text_of_links_outside(app: Any, name: str, source: list[str]) -> None:
    """Replaces links to files outside docs/, which are not on the pages, by their text."""
    source[0] = re.sub(r'\[([^\]]+)\]\(\.\./[^)]*\)', r'\1', source[0])


def _as_written(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    """Shows equations of a docstring literally, and escapes bars and stars."""
    result: list[str] = []
    literal = False
    for before, line in zip(['', *lines], lines):
        indented = line.startswith('    ')
        if literal and line.strip() and not indented:
            literal = False
        if indented and not literal and result and not before.strip():
            paragraph = next((x for x in reversed(result) if x.strip()), '')
            if not paragraph.startswith((' ', ':', '..')) and not paragraph.endswith('::'):
                result += ['::', '']
                literal = True
        result.append(line if literal else re.sub(r'\||(?<![\\*\w])\*(?=\w)', r'\\\g<0>', line))
    lines[:] = result


def _write_core_page(app: Any) -> None:
    """Write the page of the compiled core beside those of the modules."""
    sys.path.insert(0, str(app.srcdir))
    from core_functions import core_page

    folder = Path(app.srcdir) / 'api'
    folder.mkdir(exist_ok=True)
    (folder / 'hmt_ros.core.md').write_text(core_page(), 'utf-8')


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect('builder-inited', _write_core_page)
    app.connect('source-read', _keep_text_of_links_outside)
    # Runs after napoleon.
    app.connect('autodoc-process-docstring', _as_written, priority=900)
