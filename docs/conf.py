"""Configuration of the site: `make docs` builds it with Sphinx into build/docs."""

import re
import tomllib
from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]

project = PROJECT["name"]
author = "The crossgrad developers"
release = version = PROJECT["version"]

extensions = ["myst_parser"]
html_theme = "furo"
html_title = project
html_static_path = []
# Links to headings use the anchors of GitHub, so that the pages can be read there, too.
myst_heading_anchors = 4

#: Pages of the site -> files at the top of the repository, which are shown there.
TOP = {"index": "README.md", "contributing": "CONTRIBUTING.md", "changelog": "CHANGELOG.md"}


def with_top_file(_app: Sphinx, page: str, source: list[str]) -> None:
    """Put the text of a file of the repository before a page, with links from the folder docs."""
    if page not in TOP:
        return
    text = (ROOT / TOP[page]).read_text(encoding="utf-8")
    text = text.replace("](docs/", "](")
    for name, file in TOP.items():
        text = text.replace(f"]({file}", f"]({name}.md")
    # The site does not contain the examples and the benchmarks.
    text = re.sub(r"\[([^]]+)\]\((?:examples|benchmarks)/[^)]*\)", r"\1", text)
    source[0] = f"{text}\n{source[0]}"


def setup(app: Sphinx) -> None:
    """Connect `with_top_file`."""
    app.connect("source-read", with_top_file)
