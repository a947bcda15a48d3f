"""One HTML page about some episodes; pictures and videos are embedded, so that the file can be sent alone."""

import base64
import html
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.figure import Figure

from dataset_tools.figure_style import DPI

TEMPLATE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{name}</title>
<style>
  body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 0 auto;
         padding: 0 1.5rem 4rem; color: #222; }}
  nav {{ position: sticky; top: 0; background: #fffffff0; padding: .6rem 0; border-bottom: 1px solid #ddd; }}
  nav a {{ margin-right: 1rem; }} h1 {{ margin-bottom: 0; }} section {{ scroll-margin-top: 3rem; }}
  h2 {{ margin-top: 3rem; }} h3 {{ margin: 2rem 0 0; }} figure {{ margin: 0; }} img {{ max-width: 100%; }}
  figcaption, .facts {{ color: #555; font-size: .92rem; }}
  .note {{ background: #fff4e0; border-left: 4px solid #f59f00; padding: .3rem .8rem; margin: .4rem 0; }}
  table {{ border-collapse: collapse; font-size: .92rem; font-variant-numeric: tabular-nums; }}
  td, th {{ padding: .12rem 1.1rem .12rem 0; text-align: right; }}
  td:nth-child(2), th:nth-child(2) {{ text-align: left; }} video {{ max-width: 100%; }}
  .reason {{ color: white; border-radius: .3rem; padding: .05rem .5rem; }}
</style></head>
<body><h1>{name}</h1><p class="facts">{facts}</p>
<nav>{links}</nav>
{sections}
</body></html>
"""
SECTION = """<section id="{anchor}"><h2>{title}</h2>
<p class="facts">{facts}</p>{notes}{table}
{figures}</section>"""
FIGURE = """<h3>{title}</h3><figure><figcaption>{caption}</figcaption>{content}</figure>"""
CONTENTS = {
    ".png": ("image/png", '<img src="{source}" alt="{title}">'),
    ".mp4": ("video/mp4", '<video controls muted loop preload="auto" src="{source}"></video>'),
}
"""Type and HTML of what can be embedded, by the end of its file's name."""


@dataclass(frozen=True)
class Panel[Drawn]:
    """One picture that can be drawn of something.

    Attributes:
        name: end of its file's name.
        title: what it is.
        caption: how to read it.
        lacking: what the thing lacks for it; empty if it can be drawn.
        draw: the picture itself, only called if nothing is lacking.
    """

    name: str
    title: str
    caption: str
    lacking: Callable[[Drawn], str]
    draw: Callable[[Drawn], Figure]


@dataclass(frozen=True)
class Exhibit:
    """A picture or a video in a file, with what it is and how to read it."""

    title: str
    caption: str
    path: Path


@dataclass(frozen=True)
class Chapter:
    """What the page says of one episode, without its pictures, which take room.

    Attributes:
        name: the episode, as links call it.
        title: its headline.
        facts: one line of figures.
        notes: sentences about what is missing or assumed.
        table: its steps, as HTML.
        exhibits: its pictures and videos.
    """

    name: str
    title: str
    facts: str
    notes: Sequence[str]
    table: str
    exhibits: Sequence[Exhibit]


def draw_panels[Drawn](panels: Sequence[Panel[Drawn]], subject: Drawn, folder: Path, stem: str) -> list[Exhibit]:
    """Write the pictures that ``subject`` has the data for, to files in ``folder`` that begin with ``stem``."""
    exhibits = []
    for panel in panels:
        if not panel.lacking(subject):
            path = folder / f"{stem}_{panel.name}.png"
            panel.draw(subject).savefig(path, dpi=DPI)
            exhibits.append(Exhibit(panel.title, panel.caption, path))
    return exhibits


def page(name: str, about: str, chapters: Sequence[Chapter]) -> str:
    """The whole page.

    Args:
        name: its headline.
        about: a line on what is shown.
        chapters: one per episode.
    """
    links = "".join(f'<a href="#{_anchor(one)}">{html.escape(one.name)}</a>' for one in chapters)
    return TEMPLATE.format(
        name=html.escape(name), facts=html.escape(about), links=links, sections="\n".join(map(section, chapters))
    )


def section(chapter: Chapter) -> str:
    """One episode's part of the page."""
    return SECTION.format(
        anchor=_anchor(chapter),
        title=html.escape(chapter.title),
        facts=html.escape(chapter.facts),
        notes="".join(f'<p class="note">{html.escape(note)}</p>' for note in chapter.notes),
        table=chapter.table,
        figures="\n".join(map(figure, chapter.exhibits)),
    )


def figure(exhibit: Exhibit) -> str:
    """A picture or video with its caption."""
    kind, tag = CONTENTS[exhibit.path.suffix]
    data = base64.b64encode(exhibit.path.read_bytes()).decode()
    content = tag.format(source=f"data:{kind};base64,{data}", title=exhibit.title)
    return FIGURE.format(title=exhibit.title, caption=exhibit.caption, content=content)


def _anchor(chapter: Chapter) -> str:
    return chapter.name.replace(" ", "-")
