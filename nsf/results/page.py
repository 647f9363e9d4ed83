"""The report's page, once as HTML that opens from a disk and once as Markdown for GitHub."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from nsf.results.formats import HTML, Rows, markdown_document


@dataclass(frozen=True)
class Picture:
    """One picture.

    Attributes:
        files: html shows the first, markdown the last.
        caption: below it.
        runs: that it shows.
        leads: whether it stands above all tables of a page with answers.
    """

    files: list[str]
    caption: str
    runs: list[str]
    leads: bool = False


@dataclass(frozen=True)
class Section:
    """Pictures under one heading."""

    heading: str
    pictures: list[Picture] = field(default_factory=list)


@dataclass(frozen=True)
class Table:
    """A table under a heading, and a note on it."""

    heading: str
    content: Rows
    note: str


@dataclass(frozen=True)
class Page:
    """Everything a report says, in the order it is said.

    Attributes:
        answers: to the question, with their names. A page that has any begins with them and the pictures
            that lead; html folds the rest.
    """

    title: str
    lead: str
    facts: Sequence[tuple[str, str]]
    warnings: Sequence[str]
    tables: Sequence[Table]
    sections: Sequence[Section]
    provenance: Table
    definitions: Sequence[tuple[str, str]] = ()
    answers: Sequence[tuple[str, str]] = ()

    @property
    def leading(self) -> list[Picture]:
        """The pictures that stand above all tables."""
        pictures = (picture for section in self.sections for picture in section.pictures)
        return [picture for picture in pictures if picture.leads and self.answers]

    @property
    def later(self) -> list[Section]:
        """The sections without these."""
        sections = [
            Section(one.heading, [picture for picture in one.pictures if picture not in self.leading])
            for one in self.sections
        ]
        return [section for section in sections if section.pictures]

    def write(self, folder: Path) -> None:
        """Write `index.html` and `index.md`."""
        (folder / "index.html").write_text(html_page(self), encoding="utf-8")
        (folder / "index.md").write_text(markdown_page(self), encoding="utf-8")


def html_page(page: Page) -> str:
    """The page with its style inside and its pictures beside it."""
    return HTML.get_template("report.html").render(**vars(page), page=page)


def markdown_page(page: Page) -> str:
    """The same page for GitHub."""
    return markdown_document("report.md", **vars(page), page=page)
