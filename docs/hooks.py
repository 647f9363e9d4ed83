"""Parts of the site without a second copy in the repository: pictures of the reports, live models."""

import re
from pathlib import Path

from mkdocs.structure.files import File, Files

from nsf.live.demo import MODELS, page_of

ROOT = Path(__file__).parents[1]
#: How a page beside this file shows one, so that the page reads well in the repository too.
SHOWN = re.compile(r"\]\(\.\./(reports/[\w/.-]+)\)")


def on_files(files: Files, config) -> Files:
    """Every picture that a page shows, at `reports/…` of the site, and each shipped model, at `live/…`."""
    pages = [Path(page.abs_src_path) for page in files.documentation_pages()]
    shown = {path for page in pages for path in SHOWN.findall(page.read_text(encoding="utf-8"))}
    for model in MODELS:
        files.append(File.generated(config, f"live/{model}.html", content=page_of(model)))
    for path in sorted(shown):
        if (ROOT / path).is_file():  # else the strict build names the page and the path
            files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    return files


def on_page_markdown(markdown: str, page, config, files) -> str:
    """The page with the paths of its pictures as they are in the site."""
    return SHOWN.sub(r"](\1)", markdown)
