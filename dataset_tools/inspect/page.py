"""One HTML page with everything about the inspected episodes; images are embedded, so the file can be sent alone."""

import base64
import html
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dataset_tools.figure_style import look
from dataset_tools.inspect.episodes import Episode, KeyPose
from dataset_tools.inspect.panels import PANELS
from lerobot_histmv import keys

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
  td:nth-child(2), th:nth-child(2) {{ text-align: left; }}
  .reason {{ color: white; border-radius: .3rem; padding: .05rem .5rem; }}
</style></head>
<body><h1>{name}</h1><p class="facts">{facts}</p>
<nav>{links}</nav>
{sections}
</body></html>
"""
SECTION = """<section id="episode-{number}"><h2>Episode {number}: “{instruction}”</h2>
<p class="facts">{facts}</p>{notes}{table}
{figures}</section>"""
FIGURE = """<h3>{title}</h3><figure><figcaption>{caption}</figcaption><img src="{source}" alt="{title}"></figure>"""


@dataclass(frozen=True)
class Chapter:
    """What the page says of one episode, without its images, which take room.

    Attributes:
        number: the episode.
        instruction: the task's text.
        facts: one line of figures.
        notes: sentences about what is missing or assumed.
        table: the keyframes, as HTML.
        pictures: file by panel name.
    """

    number: int
    instruction: str
    facts: str
    notes: Sequence[str]
    table: str
    pictures: Mapping[str, Path]

    @classmethod
    def of(cls, episode: Episode, notes: Sequence[str], pictures: Mapping[str, Path]) -> "Chapter":
        """What is to be said of ``episode``, whose pictures were written already."""
        return cls(episode.number, episode.instruction, facts(episode), notes, keyframe_table(episode), dict(pictures))


def page(name: str, about: str, chapters: Sequence[Chapter]) -> str:
    """The whole page.

    Args:
        name: the dataset.
        about: a line on what was inspected.
        chapters: one per episode.
    """
    links = "".join(f'<a href="#episode-{one.number}">episode {one.number}</a>' for one in chapters)
    return TEMPLATE.format(
        name=html.escape(name), facts=html.escape(about), links=links, sections="\n".join(map(section, chapters))
    )


def section(chapter: Chapter) -> str:
    """One episode's part of the page."""
    figures = [
        FIGURE.format(title=panel.title, caption=panel.caption, source=data_uri(chapter.pictures[panel.name]))
        for panel in PANELS
        if panel.name in chapter.pictures
    ]
    return SECTION.format(
        number=chapter.number,
        instruction=html.escape(chapter.instruction),
        facts=html.escape(chapter.facts),
        notes="".join(f'<p class="note">{html.escape(note)}</p>' for note in chapter.notes),
        table=chapter.table,
        figures="\n".join(figures),
    )


def data_uri(path: Path) -> str:
    """A PNG file as text that stands where an address would."""
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode()}"


def facts(episode: Episode) -> str:
    """Length, keyframes and errors in one line."""
    counted = Counter(pose.reason for pose in episode.poses)
    why = ", ".join(f"{counted[reason]} {reason}" for reason in keys.REASONS if counted[reason])
    found = [f"{len(episode.poses)} keyframes ({why})"]
    if episode.motion:
        motion, unit = episode.motion, f"m{episode.unit}"
        frames, fps = len(motion.errors), motion.trajectory.fps
        found.insert(0, f"{frames} frames, {(frames - 1) / fps:.2f} s at {fps:g} Hz")
        mean, largest = 1000 * np.nanmean(motion.errors), 1000 * np.nanmax(motion.errors)
        found.append(f"error per moving frame: mean {mean:.2f} {unit}, largest {largest:.1f} {unit}")
        found.append(f"method {motion.options.method}, accepted {1000 * motion.options.epsilon:g} {unit}")
    return "; ".join(found)


def keyframe_table(episode: Episode) -> str:
    """The keyframes as an HTML table."""
    axes = [f"joint {index} [rad]" for index in range(len(episode.poses[0].position))]
    axes = axes if episode.is_joints else ["x [m]", "y [m]", "z [m]"]
    head = "".join(
        f"<th>{title}</th>" for title in ("", "kept for", "pose frame", "observation frame", *axes, "gripper")
    )
    rows = "".join(_row(number, pose) for number, pose in enumerate(episode.poses))
    return f"<table><tr>{head}</tr>{rows}</table>"


def _row(number: int, pose: KeyPose) -> str:
    style = look(pose.reason)
    reason = f'<span class="reason" style="background:{style.color}">{html.escape(pose.reason)}</span>'
    frames = (pose.frames.pose_frame, pose.frames.observation_frame) if pose.frames else ("?", "?")
    gripper = "" if pose.gripper is None else "open" if pose.gripper > 0.5 else "closed"
    cells = (number, reason, *frames, *(f"{value:.3f}" for value in pose.position), gripper)
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
