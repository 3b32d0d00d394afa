"""Settings of Sphinx, for rosdoc2 (rosdoc2.yaml) and for ``sphinx-build docs build/html``."""

import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

project = 'hmt_ros'
author = 'hmt_ros contributors'
extensions = ['myst_parser']
source_suffix = {'.rst': 'restructuredtext', '.md': 'markdown'}
master_doc = 'index'
html_theme = 'sphinx_rtd_theme'
myst_heading_anchors = 4  # links lead to headings, as on the pages of a repository
exclude_patterns = ['generated']

# rosdoc2 executes this text elsewhere, and knows the version itself.
_package = Path(__file__).resolve().parents[1] / 'package.xml'
if _package.is_file():
    version = release = ET.parse(_package).findtext('version')


def _keep_text_of_links_outside(app: Any, name: str, source: list[str]) -> None:
    """Links to files beside docs/, which are not part of the pages, become their text."""
    source[0] = re.sub(r'\[([^\]]+)\]\(\.\./[^)]*\)', r'\1', source[0])


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect('source-read', _keep_text_of_links_outside)
